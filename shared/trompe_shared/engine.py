"""Which engine draws the pictures: the identity by which renderers, calibrations and results are told apart."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Final

from pydantic import TypeAdapter, ValidationError

from trompe_shared.errors import ProtocolError
from trompe_shared.faults import faults_of

DEFAULT_ENGINE: Final = "pyrender"
"""The engine of a renderer worker that is not told one."""


@dataclass(frozen=True)
class EngineInfo:
    """Identity of an engine. Workers with equal identities give interchangeable pictures.

    name: as in ``trompe render --engine``. version: of the engine, not of Trompe. settings: all other causes of
    different pictures, as text. deterministic: equal requests give equal bytes; otherwise pictures are random (Monte
    Carlo), and equal requests with equal noise numbers give equal bytes.
    """

    name: str
    version: str
    settings: str = ""
    deterministic: bool = True

    def __str__(self) -> str:
        return f"{self.name} {self.version}".strip() + (f" ({self.settings})" if self.settings else "")

    def named(self, among: Iterable["EngineInfo"]) -> str:
        """The name alone if no other engine ``among`` these has it, else the whole identity."""
        return str(self) if any(each.name == self.name and each != self for each in among) else self.name

    def to_text(self) -> str:
        """The identity as JSON, for the handshake."""
        return json.dumps(asdict(self))

    @classmethod
    def from_text(cls, text: str) -> "EngineInfo":
        """Inverse of ``to_text``. Raises ``ProtocolError`` for any other text."""
        try:
            return TypeAdapter(cls).validate_json(text, strict=True)
        except ValidationError as error:
            faults = "; ".join(map(str, faults_of(error)))
            raise ProtocolError(f"{text!r} is not the identity of an engine ({faults}).") from error
