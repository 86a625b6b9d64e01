"""Trompe's server: surrogate, attack, judging, jobs, REST API.

``attack_object`` attacks one object without a service; see docs/library.md.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trompe_server.job.attack_object import AttackedObject, attack_object

__all__ = ["AttackedObject", "attack_object"]


def __getattr__(name: str) -> Any:
    """Import on first use: the API's process runs without torch."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from trompe_server.job import attack_object as module

    return getattr(module, name)
