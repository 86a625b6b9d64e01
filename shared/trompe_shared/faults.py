"""What pydantic found wrong, in words for whoever wrote it."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from pydantic import ValidationError

__all__ = ["Fault", "faults_of"]

OWN_WORDS: Final = "Value error, "
"""What pydantic puts before the message of a validator of ours."""

INNER_STEPS: Final = ("function-", "dict[", "literal[")
"""How the steps of a place begin that are pydantic's own, not the writer's."""


class Fault(NamedTuple):
    """One thing that is wrong. place: the names that lead to it, with dots; empty where it is about the whole."""

    place: str
    message: str
    kind: str

    def __str__(self) -> str:
        return f"{self.place}: {self.message}" if self.place else self.message


def faults_of(refusal: ValidationError | Sequence[Mapping[str, Any]]) -> Iterator[Fault]:
    """All that is wrong, in the order of the fields, by pydantic's error or by what FastAPI keeps of one.

    What was given is not asked for: it may be a whole document.
    """
    if isinstance(refusal, ValidationError):
        details: Sequence[Mapping[str, Any]] = refusal.errors(
            include_url=False, include_input=False, include_context=False
        )
    else:
        details = refusal
    for each in details:
        place = ".".join(step for step in map(str, each["loc"]) if not step.startswith(INNER_STEPS))
        yield Fault(place, each["msg"].removeprefix(OWN_WORDS), each["type"])
