"""How long should torch's threads stay awake between two pieces of work? Steps of an attack, alone and in company.

python -m bench.threads [--object toilet] [--rounds 3]

Each row is a process of its own, for OpenMP reads its environment once; they take turns. In company means beside as
many processes that compute without a pause as there are cores.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median
from typing import Final

from bench._common import assets, bench_objects, in_rounds, machine
from bench.surrogate_speed import fastest_classifier, outside_share, work_of
from trompe_experiments.markdown import markdown_table
from trompe_server.job.texture_attack import CHUNK
from trompe_server.system.memory import keep_freed_memory
from trompe_server.system.threads import SPINS

AWAKE: Final = {"not at all": 0, "for a moment, as attack workers have it": SPINS, "for 300 times as long": 300 * SPINS}
"""Looks for new work before a thread sleeps."""
BUSY: Final = "while True: pass"


def milliseconds(name: str) -> float:
    """Median time of a step per view, in this process."""
    keep_freed_memory()
    entry = bench_objects([name])[0]
    classifier = fastest_classifier()
    work = work_of(entry, entry.obj, name, classifier.image_size, 60, "calibrated")
    return in_rounds({"step": outside_share(work, classifier, [])}, 4)["step"].median * 1e3 / (CHUNK * 60)


def measured(name: str, spins: int) -> float:
    """``milliseconds`` of another process whose threads stay awake for ``spins``."""
    environment = os.environ | {"GOMP_SPINCOUNT": str(spins), "OMP_WAIT_POLICY": "passive"}
    command = [sys.executable, "-m", "bench.threads", "--one", name]
    return float(subprocess.check_output(command, env=environment, text=True).split()[-1])


@contextmanager
def company(processes: int) -> Iterator[None]:
    """So many processes that compute."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", default="toilet" if assets() else "mug", metavar="NAME")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--one", metavar="NAME", help="measure this process alone, and print milliseconds")
    options = parser.parse_args()
    if options.one:
        print(milliseconds(options.one))
        return
    cores = len(os.sched_getaffinity(0))
    taken: dict[str, list[list[float]]] = {words: [[], []] for words in AWAKE}
    for _ in range(options.rounds):
        for busy in (0, cores):
            with company(busy):
                for words, spins in AWAKE.items():
                    taken[words][busy > 0].append(measured(options.object, spins))
    first = [median(times) for times in taken["not at all"]]
    rows = [
        [words, *(f"{median(times):.1f} ({median(times) / base:.2f})" for times, base in zip(each, first, strict=True))]
        for words, each in taken.items()
    ]
    header = [f"{options.object}: threads stay awake", "alone, ms a view (ratio)", f"beside {cores} busy processes"]
    print(f"{machine()}\n\n{markdown_table(header, rows)}")


if __name__ == "__main__":
    main()
