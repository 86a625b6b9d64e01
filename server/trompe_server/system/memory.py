"""Memory allocation of the process; it decides the cost of a step on large textures.

By default glibc returns large freed arrays to the system and requests every page of the next one anew. On 4096 x 4096
texels that takes longer than the arithmetic.
"""

import ctypes
from typing import Final

GIB: Final = 2**30

ARENA_MAX: Final = (-8, 1)
"""One heap for all threads: further heaps could not hold large arrays."""
MMAP_THRESHOLD: Final = (-3, GIB)
"""Take arrays of up to 1 GiB from the heap."""
TRIM_THRESHOLD: Final = (-1, GIB)
"""Keep up to 1 GiB of free memory at the end of the heap."""


def keep_freed_memory() -> bool:
    """Keep up to 1 GiB of freed memory for the next arrays; return whether the C library can (glibc only).

    Call it before other threads start and before large arrays exist. The heap settles after a few steps, at about twice
    the memory of the arrays alive at the same time.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    options = (ARENA_MAX, MMAP_THRESHOLD, TRIM_THRESHOLD)
    return mallopt is not None and all(mallopt(*option) == 1 for option in options)
