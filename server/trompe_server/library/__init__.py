"""Objects, classifiers and backgrounds that jobs can name."""

from trompe_server.library.library import Library

__all__ = ["Library"]
