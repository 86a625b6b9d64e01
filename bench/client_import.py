"""What the client costs before it does anything: seconds to import it, megabytes to install it.

    python -m bench.client_import

The contenders take turns, each in a Python of its own. Processor seconds are what counts on a machine that others use
too; bytes are those of the files that are installed without extras, compiled ones left out.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import trompe_client
import trompe_renderer
import trompe_server
import trompe_shared
from bench._common import machine
from trompe_experiments.markdown import markdown_table

CONTENDERS = {
    "python, nothing imported": ["-c", ""],
    "import pydantic": ["-c", "import pydantic"],
    "import trompe_client": ["-c", "import trompe_client"],
    "Client() made": ["-c", "from trompe_client import Client; Client()"],
    "trompe --version": ["-m", "trompe_client.cli", "--version"],
    "trompe jobs --help": ["-m", "trompe_client.cli", "jobs", "--help"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    rows = [[name, *seconds] for name, seconds in _seconds(rounds).items()]
    header = ["a process", "processor seconds, median", "least", "seconds, median", "least"]
    print(machine(), "", markdown_table(header, rows), "", sep="\n")
    sizes = sorted(_sizes("trompe", {}).items(), key=lambda item: -item[1])
    rows = [[name, f"{size / 1e6:.1f}"] for name, size in sizes]
    total = sum(size for _, size in sizes)
    print(markdown_table(["installed by pip install trompe", "MB"], [*rows, ["together", f"{total / 1e6:.1f}"]]))


def _seconds(rounds: int) -> dict[str, list[str]]:
    """Median and least processor seconds, then median and least seconds, of each contender."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in CONTENDERS}
    for _ in range(rounds):
        for name, words in CONTENDERS.items():
            before, began = os.times(), time.perf_counter()
            subprocess.run([sys.executable, *words], stdout=subprocess.DEVNULL, check=True)
            after, ended = os.times(), time.perf_counter()
            processor = after.children_user - before.children_user + after.children_system - before.children_system
            spent[name].append((processor, ended - began))
    summaries = (statistics.median, min)
    return {
        name: [f"{summary(values):.3f}" for values in zip(*pairs, strict=True) for summary in summaries]
        for name, pairs in spent.items()
    }


def _sizes(name: str, seen: dict[str, int]) -> dict[str, int]:
    """Bytes of a distribution and of all that it needs without extras."""
    if name in seen:
        return seen
    distribution = metadata.distribution(name)
    seen[name] = _own() if name == "trompe" else _bytes(Path(str(file.locate())) for file in distribution.files or [])
    for need in distribution.requires or []:
        match = re.match(r"[\w.-]+", need)
        if match and ";" not in need:
            _sizes(match[0], seen)
    return seen


def _own() -> int:
    packages = (trompe_client, trompe_renderer, trompe_server, trompe_shared)
    return _bytes(file for package in packages for file in Path(str(package.__file__)).parent.rglob("*"))


def _bytes(files: Iterable[Path]) -> int:
    return sum(file.stat().st_size for file in files if file.is_file() and file.suffix != ".pyc")


if __name__ == "__main__":
    main()
