"""Samples of the memory, handles, threads and files of a running service, and their trends."""

import csv
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import theilslopes

from tests.served import Served, ancestry, process_table, repeating
from tests.service.chaos import KINDS, kind_of

MIB: Final = 2**20
PAGE: Final = os.sysconf("SC_PAGE_SIZE")
ALLOWED: Final = {"MiB": (0.05, 16.0), "handles": (0.0, 3.0), "threads": (0.0, 3.0), "files": (0.05, 20.0)}
"""Allowed total growth by unit: a share of the median, and an absolute amount."""
LEAST_SAMPLES: Final = 20
PASSING: Final = ("data/jobs", "data/library/calibrations")
"""Folders cleared by retention."""

Row = dict[str, float]


class Soaked(Served):
    """A ``trompe serve`` that deletes jobs ``kept`` seconds after their end. ``home`` has its data and TMPDIR."""

    def __init__(self, folder: Path, *, kept: float) -> None:
        self.home = folder / "service"
        (self.home / "tmp").mkdir(parents=True)
        own = {"TMPDIR": str(self.home / "tmp"), "TROMPE_RETENTION_DAYS": str(kept / 86_400)}
        super().__init__(self.home / "data", environment=own)

    def processes(self) -> dict[str, list[int]]:
        """Ids of its processes by kind, without the short-lived readers of uploads."""
        table = process_table()
        found: dict[str, list[int]] = {kind: [] for kind in KINDS.values()}
        for pid in sorted(table):
            line = list(ancestry(pid, table))
            kind = next((kind for each in line if (kind := kind_of(each)) is not None), None)
            if kind is not None and self.process.pid in line and not _reads_an_upload(pid):
                found[kind].append(pid)
        return found

    def sample(self) -> Row:
        """Current sample: values by process and unit."""
        row: Row = {}
        for kind, pids in self.processes().items():
            held = [_held(pid) for pid in pids]
            row |= {f"{kind} {unit}": sum(each[unit] for each in held) for unit in ("MiB", "handles", "threads")}
        lasting = _sizes(self.home, without=[self.home / place for place in PASSING])
        for name, sizes in (("passing", self.passing()), ("lasting", lasting)):
            row |= {f"{name} MiB": sum(sizes) / MIB, f"{name} files": len(sizes)}
        return row

    def passing(self) -> list[int]:
        """Sizes of the files deleted by retention."""
        return [size for place in PASSING for size in _sizes(self.home / place)]


@contextmanager
def watching(service: Soaked, file: Path, *, every: float) -> Iterator[list[Row]]:
    """The samples of ``service`` every ``every`` seconds during the block, which are written to ``file`` too."""
    started, rows = time.monotonic(), list[Row]()

    def look() -> None:
        rows.append({"seconds": time.monotonic() - started} | service.sample())
        writer = csv.DictWriter(table, list(rows[0]))
        if len(rows) == 1:
            writer.writeheader()
        writer.writerow({name: round(value, 1) for name, value in rows[-1].items()})
        table.flush()

    with file.open("w", newline="") as table, repeating(look, pause=every):
        yield rows


@dataclass(frozen=True)
class Trend:
    """Trend of one quantity: its median, its total growth and the allowed growth."""

    name: str
    median: float
    grew: float
    allowed: float

    @property
    def flat(self) -> bool:
        return self.grew <= self.allowed

    def __str__(self) -> str:
        words = "" if self.flat else "  GROWS"
        return f"{self.name:24} median {self.median:9.1f}   grew {self.grew:7.1f}   allowed {self.allowed:6.1f}{words}"


def trends(rows: Sequence[Row], *, warm: float) -> list[Trend]:
    """Trends from ``warm`` seconds on, without the files deleted by retention."""
    used = [row for row in rows if row["seconds"] >= warm]
    assert len(used) >= LEAST_SAMPLES, f"{len(used)} samples after the warm-up are too few; soak for longer"
    times = [row["seconds"] for row in used]
    return [
        trend(name, times, [row[name] for row in used])
        for name in used[0]
        if name.split()[-1] in ALLOWED and not name.startswith("passing")
    ]


def trend(name: str, times: ArrayLike, values: ArrayLike) -> Trend:
    """Trend of the quantity ``... UNIT``. Growth is the median slope (Theil-Sen) times the time, robust to peaks."""
    grew = float(theilslopes(values, times).slope * np.ptp(times))
    share, more = ALLOWED[name.split()[-1]]
    median = float(np.median(np.asarray(values, float)))
    return Trend(name, median, grew, share * median + more)


def _reads_an_upload(pid: int) -> bool:
    with suppress(OSError):
        return b"trompe_server.system.sandbox" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return True


def _held(pid: int) -> Row:
    """Resources of a process; zeros if it has ended."""
    folder = Path("/proc", str(pid))
    with suppress(OSError):
        resident = int((folder / "statm").read_text().split()[1]) * PAGE
        handles, threads = (len(os.listdir(folder / each)) for each in ("fd", "task"))
        return {"MiB": resident / MIB, "handles": handles, "threads": threads}
    return {"MiB": 0, "handles": 0, "threads": 0}


def _sizes(folder: Path, *, without: Sequence[Path] = ()) -> list[int]:
    """Sizes of the files below ``folder`` but not below ``without``."""
    sizes: list[int] = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if Path(place, name) not in without]
        for name in names:
            with suppress(FileNotFoundError):
                sizes.append(os.stat(os.path.join(place, name)).st_size)
    return sizes
