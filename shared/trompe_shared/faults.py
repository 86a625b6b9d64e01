"""Pydantic's validation errors as messages for users."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from pydantic import ValidationError

OWN_WORDS: Final = "Value error, "
"""Pydantic's prefix for messages of our own validators."""

INNER_STEPS: Final = ("function-", "dict[", "literal[")
"""Prefixes of steps that pydantic adds to a place."""


class Fault(NamedTuple):
    """One error. place: names of the fields that lead to it, joined by dots; empty for the whole document."""

    place: str
    message: str
    kind: str

    def __str__(self) -> str:
        return f"{self.place}: {self.message}" if self.place else self.message


def faults_of(refusal: ValidationError | Sequence[Mapping[str, Any]]) -> Iterator[Fault]:
    """All errors in the order of the fields, from pydantic's exception or from FastAPI's copy of its details.

    The input is left out: it may be a whole document.
    """
    if isinstance(refusal, ValidationError):
        refusal = refusal.errors(include_input=False)
    for each in refusal:
        place = ".".join(step for step in map(str, each["loc"]) if not step.startswith(INNER_STEPS))
        yield Fault(place, each["msg"].removeprefix(OWN_WORDS), each["type"])
