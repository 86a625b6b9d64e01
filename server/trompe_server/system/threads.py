"""Number of torch's threads, how they wait for work, and how work is shared among them; and Python's threads.

OpenMP reads these settings once, at the first import of torch. A network on small images runs thousands of short
parallel regions a second. Waking threads that sleep after each region takes longer than their work; threads that spin
for long take the cores from other processes. So they spin for about as long as waking takes.
"""

import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, Final, TypeVar

S = TypeVar("S")
T = TypeVar("T")

SPINS: Final = 1000
"""Iterations that a thread of GNU's OpenMP spins before it sleeps: about 50 µs."""

PARTS: Final = 2
"""Parts of torch's work that run side by side; each keeps a batch's activations in memory."""

IN_PARTS: Final = "in_parts"
"""Name of the threads of these parts; further parts of one run in turn."""

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


def in_parts(work: Callable[[Sequence[S]], T], items: Sequence[S], *, split: bool = True) -> list[T]:
    """``work`` of each second of the ``items``, and of the others: side by side, each with half of torch's threads;
    of all at once unless ``split``.

    Two small batches at once wait less for each other and for Python than one batch on twice as many threads. The parts
    are the same for any number of threads, and so are sums over them. ``work`` begins with gradients enabled.
    """
    import torch  # reads the settings above once

    step, count = PARTS if split else 1, torch.get_num_threads()
    parts = [items[first::step] for first in range(min(step, len(items)))]
    if len(parts) < PARTS or count < PARTS or threading.current_thread().name.startswith(IN_PARTS):
        return [work(part) for part in parts]
    return list(_parts(os.getpid(), count).map(work, parts))


@cache
def _parts(process: int, count: int) -> ThreadPoolExecutor:
    """Threads of a ``process``, each with its share of the ``count`` that torch has."""
    import torch

    def share() -> None:
        torch.get_num_threads()  # the first question in a thread sets its number
        torch.set_num_threads(count // PARTS)

    executor, begun = ThreadPoolExecutor(PARTS, IN_PARTS, initializer=share), threading.Barrier(PARTS + 1)
    for _ in range(PARTS):
        executor.submit(begun.wait)
    begun.wait()
    torch.set_num_threads(count)  # later threads begin with the number that was set last
    return executor


def side_by_side(work: Callable[[S], T], items: Sequence[S], *, split: bool = True) -> list[T]:
    """``work`` of each item, in parts."""
    parts = in_parts(lambda part: list(map(work, part)), items, split=split)
    return [parts[number % len(parts)][number // len(parts)] for number in range(len(items))]


def threads() -> int:
    """Number of threads that the environment allows; by default one for each core."""
    outermost = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]  # a list has a number for each nested level
    return int(outermost or len(os.sched_getaffinity(0)))
