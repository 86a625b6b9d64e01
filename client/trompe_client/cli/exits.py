"""Exit codes: what a script can tell from them. ``trompe --help`` and docs/cli.md list the same table."""

from typing import Final

from trompe_client._errors import (
    BadRequest,
    Conflict,
    EmbeddedServerError,
    Forbidden,
    JobCancelled,
    JobFailed,
    NotFound,
    ServerUnreachable,
    TooMany,
    Unauthorized,
    WaitTimeout,
)
from trompe_shared.errors import ClassifierError, LabelError, ObjectError, SpecError

__all__ = ["EXITS", "INTERRUPTED", "exit_code"]

INTERRUPTED: Final = 130

EXITS: Final = {
    0: "done; a job that ends as n.a. is done, too",
    1: "an error that none of the others describes; `doctor` found something wrong",
    2: "wrong usage: options or files are not right",
    3: "no server answers",
    4: "refused: no token, a wrong one, one without the right to do this; or too many requests",
    5: "there is no such job, object, classifier or file, or it is in no state for this",
    6: "the job failed",
    7: "the job was cancelled",
    8: "the job was still going on when --timeout was over; it goes on",
    INTERRUPTED: "interrupted by Ctrl-C; a job on a server goes on",
}

_CODES: Final[dict[type[Exception], int]] = {
    SpecError: 2,
    ObjectError: 2,
    ClassifierError: 2,
    LabelError: 2,
    BadRequest: 2,
    ServerUnreachable: 3,
    EmbeddedServerError: 3,
    Unauthorized: 4,
    Forbidden: 4,
    TooMany: 4,
    NotFound: 5,
    Conflict: 5,
    JobFailed: 6,
    JobCancelled: 7,
    WaitTimeout: 8,
}


def exit_code(error: Exception) -> int:
    """The exit code that stands for an error."""
    return next((code for kind, code in _CODES.items() if isinstance(error, kind)), 1)
