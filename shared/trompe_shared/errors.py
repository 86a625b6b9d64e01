"""The errors that more than one package raises.

    TrompeError
    ├── ObjectError          the 3D object cannot be read or does not hold together
    ├── ProtocolError        bytes on a SAILenv connection that the protocol does not allow
    ├── ClassifierError      a classifier cannot be loaded or does not keep the contract
    ├── LabelError           a label is not one of the classifier's classes
    ├── RendererError        a renderer worker is unreachable or answered with an error
    │   └── RendererLostError    it is not there, hangs, or talks nonsense; another one may do what this one did not
    └── SpecError            the options of a job contradict each other or are out of range

Each message says what was wrong, what was expected and what to do about it.
"""

__all__ = [
    "ClassifierError",
    "LabelError",
    "ObjectError",
    "ProtocolError",
    "RendererError",
    "RendererLostError",
    "SpecError",
    "TrompeError",
]


class TrompeError(Exception):
    """Base of every error that Trompe raises on purpose."""

    code = "error"


class ObjectError(TrompeError):
    """The 3D object cannot be read or does not hold together."""

    code = "invalid-object"


class ProtocolError(TrompeError):
    """Bytes on a SAILenv connection that the protocol does not allow."""

    code = "protocol"


class ClassifierError(TrompeError):
    """A classifier cannot be loaded or does not keep the contract."""

    code = "invalid-classifier"


class LabelError(TrompeError):
    """A label is not one of the classifier's classes."""

    code = "unknown-label"


class RendererError(TrompeError):
    """A renderer worker is unreachable or answered with an error."""

    code = "renderer"


class RendererLostError(RendererError):
    """A renderer worker is not there, hangs, or talks nonsense; another one may do what this one did not."""


class SpecError(TrompeError):
    """The options of a job contradict each other or are out of range."""

    code = "invalid-spec"
