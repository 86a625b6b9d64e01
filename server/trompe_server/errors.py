"""Errors of the service, in addition to the errors shared by all packages.

TrompeError
├── NotFoundError        nothing is stored under this id or name
│   └── MissingFileError     a job has no such file, or has it no longer
├── AmbiguousError       a name or the beginning of an id matches several stored things
├── ConflictError        the state of the job does not allow this
└── ServiceError         the service cannot start or continue: folder in use, child process does not start
"""

from trompe_shared.errors import TrompeError


class NotFoundError(TrompeError):
    """Nothing is stored under this id or name."""

    code = "not-found"


class MissingFileError(NotFoundError, FileNotFoundError):
    """A job has no such file, or has it no longer."""


class AmbiguousError(TrompeError):
    """A name or the beginning of an id matches several stored things."""

    code = "ambiguous"


class ConflictError(TrompeError):
    """The state of the job or of the service does not allow this."""

    code = "conflict"


class ServiceError(TrompeError):
    """The service cannot start or continue."""

    code = "service"
