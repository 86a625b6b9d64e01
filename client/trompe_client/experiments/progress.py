"""The one progress display of an experiment: a bar over all jobs, a line for each that runs."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from trompe_client.experiments.plan import Row
from trompe_client.experiments.run import Finished, Show
from trompe_shared.api import Job, JobState

__all__ = ["experiment_display", "in_words"]


@contextmanager
def experiment_display(console: Console) -> Iterator[Show]:
    """Bars on a terminal, elsewhere a line for each job that is done, as long as the block lasts."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[detail]}", markup=False),
    )
    with Progress(*columns, console=console) as bars:
        yield _Bars(bars)


def in_words(seconds: float) -> str:
    """E.g. ``40 s``, ``12 min``, ``3.5 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class _Clock:
    """How many jobs are done, and when the rest will be, by those that ended while they were watched."""

    started: float | None = None
    """When the first job was looked at; those that end before were done long ago."""

    def begin(self, total: int, done: int) -> None:
        self.total, self.done = total, done

    def watch(self) -> None:
        if self.started is None:
            self.started, self.before = time.monotonic(), self.done

    def tick(self) -> None:
        self.done += 1

    def left(self) -> str:
        """Words on the time that is left."""
        if self.started is None or self.done in {self.before, self.total}:
            return ""
        each = (time.monotonic() - self.started) / (self.done - self.before)
        return f"about {in_words(each * (self.total - self.done))} left"


class _Lines:
    def __init__(self, console: Console) -> None:
        self._console, self._clock = console, _Clock()

    def begin(self, *, total: int, done: int) -> None:
        self._clock.begin(total, done)
        self._console.print(f"{total} jobs, {done} of them done before")

    def look(self, row: Row, job: Job) -> None:
        """A log shows ends alone."""
        self._clock.watch()

    def end(self, row: Row, finished: Finished) -> None:
        self._clock.tick()
        words = [f"{self._clock.done}/{self._clock.total}", _named(row), _ended(finished), self._clock.left()]
        self._console.print("  ".join(word for word in words if word))


class _Bars:
    def __init__(self, bars: Progress) -> None:
        self._bars, self._clock = bars, _Clock()
        self._running: dict[str, TaskID] = {}

    def begin(self, *, total: int, done: int) -> None:
        self._clock.begin(total, done)
        self._all = self._bars.add_task("jobs", total=total, completed=done, detail="")

    def look(self, row: Row, job: Job) -> None:
        self._clock.watch()
        if job.state is not JobState.running:
            return
        if row.key not in self._running:
            self._running[row.key] = self._bars.add_task("", total=100, detail="")
        progress = job.progress
        done = round(100 * progress.fraction)
        self._bars.update(self._running[row.key], completed=done, description=_named(row), detail=progress.phase)

    def end(self, row: Row, finished: Finished) -> None:
        self._clock.tick()
        if row.key in self._running:
            self._bars.remove_task(self._running.pop(row.key))
        self._bars.console.print(f"{_named(row)}  {_ended(finished)}", markup=False, highlight=False)
        self._bars.update(self._all, completed=self._clock.done, detail=self._clock.left())


def _named(row: Row) -> str:
    return "  ".join(word for word in (row.object, row.place.configuration, f"seed {row.request.seed}") if word)


def _ended(finished: Finished) -> str:
    if finished.result is None or finished.result.target.a_drop is None:
        return f"{finished.state}: {finished.error}"
    drops = {"A_drop": finished.result.target.a_drop}
    if finished.result.held_out is not None and finished.result.held_out.a_drop is not None:
        drops["held-out"] = finished.result.held_out.a_drop
    return ", ".join(f"{name} {drop:.2f}" for name, drop in drops.items())
