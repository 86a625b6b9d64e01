"""Exit codes, listed by ``trompe --help`` and docs/cli.md."""

from typing import Final

from trompe_client import _errors as errors
from trompe_shared.errors import ClassifierError, LabelError, ObjectError, SpecError

INTERRUPTED: Final = 130

EXITS: Final = {
    0: "success; n.a. is a success too",
    1: "any other error; `doctor` found a fault",
    2: "invalid options or files",
    3: "no server answers",
    4: "refused: missing or wrong token, or missing right; or too many requests",
    5: "no such job, object, classifier or file, or not possible in its state",
    6: "the job failed",
    7: "the job was cancelled",
    8: "--timeout is over; the job continues",
    INTERRUPTED: "interrupted by Ctrl-C; a job on a server continues",
}

_CODES: Final[dict[type[Exception], int]] = {
    SpecError: 2,
    ObjectError: 2,
    ClassifierError: 2,
    LabelError: 2,
    errors.BadRequest: 2,
    errors.ServerUnreachable: 3,
    errors.EmbeddedServerError: 3,
    errors.Unauthorized: 4,
    errors.Forbidden: 4,
    errors.TooMany: 4,
    errors.NotFound: 5,
    errors.Conflict: 5,
    errors.JobFailed: 6,
    errors.JobCancelled: 7,
    errors.WaitTimeout: 8,
}


def exit_code(error: Exception) -> int:
    """Exit code of an error."""
    return next((code for kind, code in _CODES.items() if isinstance(error, kind)), 1)
