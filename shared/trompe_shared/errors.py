"""Errors raised by more than one package.

    TrompeError
    ├── ObjectError          the 3D object is unreadable or inconsistent
    ├── ProtocolError        malformed bytes on a SAILenv connection
    ├── ClassifierError      a classifier cannot be loaded or violates the contract
    ├── LabelError           a label is not one of the classifier's classes
    ├── RendererError        a renderer worker is unreachable or answered with an error
    │   └── RendererLostError    it is gone, hangs or sends nonsense; another renderer may succeed
    └── SpecError            the options of a job contradict each other or are out of range

Each message says what was wrong, what was expected and what to do.
"""


class TrompeError(Exception):
    """Base of all deliberate errors of Trompe."""

    code = "error"


class ObjectError(TrompeError):
    """The 3D object is unreadable or inconsistent."""

    code = "invalid-object"


class ProtocolError(TrompeError):
    """Malformed bytes on a SAILenv connection."""

    code = "protocol"


class ClassifierError(TrompeError):
    """A classifier cannot be loaded or violates the contract."""

    code = "invalid-classifier"


class LabelError(TrompeError):
    """A label is not one of the classifier's classes."""

    code = "unknown-label"


class RendererError(TrompeError):
    """A renderer worker is unreachable or answered with an error."""

    code = "renderer"


class RendererLostError(RendererError):
    """A renderer worker is gone, hangs or sends nonsense; another renderer may succeed."""


class SpecError(TrompeError):
    """The options of a job contradict each other or are out of range."""

    code = "invalid-spec"
