"""How many threads torch has, and how they wait for each other.

OpenMP reads this once, when torch is first imported. A network on small images is thousands of short parallel pieces a
second. Threads that sleep after each (the passive policy alone) are woken up for longer than they work; threads that
stay awake for long take the cores from everybody else. So they stay awake for about as long as waking takes.
"""

import os
from typing import Final

__all__ = ["prepare_threads"]

SPINS: Final = 1000
"""Looks that a thread of GNU's OpenMP takes for new work before it sleeps: some 50 µs."""


def prepare_threads(count: int | None = None) -> None:
    """Give torch ``count`` threads, by default one for each core that this process may use.

    Call it before torch is imported. What the environment says already stays.
    """
    cores = len(os.sched_getaffinity(0)) if count is None else count
    os.environ.setdefault("OMP_NUM_THREADS", str(cores))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))
