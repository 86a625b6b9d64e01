"""The errors of the service, on top of those that all packages share.

TrompeError
├── NotFoundError        nothing is stored under that id or name
├── AmbiguousError       a name or the beginning of an id fits several stored things
├── ConflictError        the job is not in a state that allows this
└── ServiceError         the service cannot start or cannot go on: folder in use, a child process that does not come up
"""

from trompe_shared.errors import TrompeError

__all__ = ["AmbiguousError", "ConflictError", "NotFoundError", "ServiceError"]


class NotFoundError(TrompeError):
    """Nothing is stored under that id or name."""

    code = "not-found"


class AmbiguousError(TrompeError):
    """A name or the beginning of an id fits several stored things."""

    code = "ambiguous"


class ConflictError(TrompeError):
    """The job is not in a state that allows this."""

    code = "conflict"


class ServiceError(TrompeError):
    """The service cannot start or cannot go on."""

    code = "service"
