"""Failures of a library on a stranger's file, as errors a user can act on."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from trompe_shared.errors import ObjectError


@contextmanager
def refusing(what: str, *, remedy: str) -> Iterator[None]:
    """Translate exceptions, and NumPy's warning about malformed numbers, to ``ObjectError``; not ``MemoryError``."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "string or file could not be read to its end", DeprecationWarning)
            yield
    except (MemoryError, ObjectError):
        raise
    except Exception as error:
        raise ObjectError(f"{what} cannot be read ({type(error).__name__}: {str(error)[:200]}). {remedy}") from error
