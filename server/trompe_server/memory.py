"""How the process gets memory from the system. Tells what a step on large textures costs.

By default glibc hands large arrays back to the system when they are freed, and gets every page of the next one anew: on
4096 x 4096 texels that takes longer than the arithmetic.
"""

import ctypes
from typing import Final

__all__ = ["keep_freed_memory"]

GIB: Final = 2**30

ARENA_MAX: Final = (-8, 1)
"""One heap for all threads: others could not hold large arrays."""
MMAP_THRESHOLD: Final = (-3, GIB)
"""Arrays up to 1 GiB come from the heap ..."""
TRIM_THRESHOLD: Final = (-1, GIB)
"""... and up to 1 GiB at its end stays with the process when it is free."""


def keep_freed_memory() -> bool:
    """Keep up to 1 GiB of freed memory for the next arrays. Says whether it could; only glibc knows how to.

    Call it before other threads start and before large arrays are made. It takes some steps until the gaps are where
    they are wanted, and about twice the memory of the arrays that live at the same time.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    options = (ARENA_MAX, MMAP_THRESHOLD, TRIM_THRESHOLD)
    return mallopt is not None and all(mallopt(*option) == 1 for option in options)
