"""Number of torch's threads, and how they wait for work; and Python's threads.

OpenMP reads these settings once, at the first import of torch. A network on small images runs thousands of short
parallel regions a second. Waking threads that sleep after each region takes longer than their work; threads that spin
for long take the cores from other processes. So they spin for about as long as waking takes.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, TypeVar

T = TypeVar("T")

SPINS: Final = 1000
"""Iterations that a thread of GNU's OpenMP spins before it sleeps: about 50 µs."""

WORTH: Final = 8
"""Items for which threads of Python are worth their start."""


def prepare_threads(count: int | None = None) -> None:
    """Give torch ``count`` threads, by default one for each core available to this process.

    Call it before the first import of torch. Variables already in the environment win.
    """
    cores = len(os.sched_getaffinity(0)) if count is None else count
    os.environ.setdefault("OMP_NUM_THREADS", str(cores))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))


def in_threads(make: Callable[..., T], *items: Iterable[Any]) -> list[T]:
    """``make`` of each item, in as many threads as torch has, for work that mostly holds no lock of Python's."""
    rows = list(zip(*items, strict=True))
    if len(rows) < WORTH:
        return [make(*row) for row in rows]
    with ThreadPoolExecutor(threads(), thread_name_prefix="in_threads") as executor:
        return list(executor.map(lambda row: make(*row), rows))


def threads() -> int:
    """Number of threads that the environment allows; by default one for each core."""
    outermost = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]  # a list has a number for each nested level
    return int(outermost or len(os.sched_getaffinity(0)))
