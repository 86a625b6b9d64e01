"""Number of torch's threads, and how they wait for work.

OpenMP reads these settings once, at the first import of torch. A network on small images runs thousands of short
parallel regions a second. Waking threads that sleep after each region takes longer than their work; threads that spin
for long take the cores from other processes. So they spin for about as long as waking takes.
"""

import os
from typing import Final

SPINS: Final = 1000
"""Iterations that a thread of GNU's OpenMP spins before it sleeps: about 50 µs."""


def prepare_threads(count: int | None = None) -> None:
    """Give torch ``count`` threads, by default one for each core available to this process.

    Call it before the first import of torch. Variables already in the environment win.
    """
    cores = len(os.sched_getaffinity(0)) if count is None else count
    os.environ.setdefault("OMP_NUM_THREADS", str(cores))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))
