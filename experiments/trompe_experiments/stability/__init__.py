"""Stability suite: whole jobs against disturbed targets and networks."""

from typing import Final

__all__ = ["AFTERWARDS", "REFERENCE"]

REFERENCE: Final = "as it should be"
"""Name of the undisturbed case."""
AFTERWARDS: Final = "unforeseen: "
"""Prefix of the names of cases whose disturbance starts after the job: no warning is possible."""
