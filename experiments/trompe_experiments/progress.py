"""Display of an experiment's progress, a bar for all jobs and a line for each running one, and its log to a tracker."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from trompe_client.tracking import MlflowRun
from trompe_experiments.about import in_words
from trompe_experiments.plan import Row
from trompe_experiments.run import Finished, Show
from trompe_shared.api import Job, JobSpec, JobState


@contextmanager
def experiment_display(console: Console) -> Iterator[Show]:
    """Bars on a terminal, otherwise a line for each finished job."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[detail]}", markup=False),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        yield _Display(bars)


class _Display:
    """Bars, or lines if they are disabled. Estimates the time left from the jobs that ended since the first poll."""

    started: float | None = None
    """Time of the first poll. Jobs that end before it were finished by an earlier run."""

    def __init__(self, bars: Progress) -> None:
        self._bars, self._running = bars, dict[str, TaskID]()

    def begin(self, *, total: int, done: int) -> None:
        self.total, self.done = total, done
        self._all = self._bars.add_task("jobs", total=total, completed=done, detail="")
        if self._bars.disable:
            self._bars.console.print(f"{total} jobs, {done} already done")

    def look(self, row: Row, job: Job) -> None:
        if self.started is None:
            self.started, self.before = time.monotonic(), self.done
        if job.state is JobState.running:
            if row.key not in self._running:
                self._running[row.key] = self._bars.add_task(_named(row), total=100, detail="")
            done, phase = round(100 * job.progress.fraction), job.progress.phase
            self._bars.update(self._running[row.key], completed=done, detail=phase)

    def end(self, row: Row, finished: Finished) -> None:
        self.done += 1
        if row.key in self._running:
            self._bars.remove_task(self._running.pop(row.key))
        left = self._left()
        words = [_named(row), _ended(finished)]
        if self._bars.disable:
            words = [f"{self.done}/{self.total}", *words, *([left] if left else [])]
        self._bars.console.print("  ".join(words), markup=False, highlight=False)
        self._bars.update(self._all, completed=self.done, detail=left)

    def _left(self) -> str:
        if self.started is None or self.done in {self.before, self.total}:
            return ""
        each = (time.monotonic() - self.started) / (self.done - self.before)
        return f"about {in_words(each * (self.total - self.done))} left"


class Tracked:
    """A display whose jobs are runs of a tracker too. Finished jobs of an earlier run are not logged again."""

    def __init__(self, display: Show, new_run: Callable[[str, JobSpec], MlflowRun]) -> None:
        self._display, self._new_run, self._runs = display, new_run, dict[str, MlflowRun]()

    def begin(self, *, total: int, done: int) -> None:
        self._display.begin(total=total, done=done)

    def look(self, row: Row, job: Job) -> None:
        self._run(row).progress(job.progress)
        self._display.look(row, job)

    def end(self, row: Row, finished: Finished) -> None:
        self._run(row).end(finished.result)
        del self._runs[row.key]
        self._display.end(row, finished)

    def _run(self, row: Row) -> MlflowRun:
        if row.key not in self._runs:
            name = "  ".join(filter(None, (row.place.experiment, row.object, row.place.configuration)))
            self._runs[row.key] = self._new_run(name, row.request)
        return self._runs[row.key]


def _named(row: Row) -> str:
    return "  ".join(word for word in (row.object, row.place.configuration, f"seed {row.request.search.seed}") if word)


def _ended(finished: Finished) -> str:
    if finished.result is None or finished.result.target.a_drop is None:
        return f"{finished.state}: {finished.error}"
    drops = {"A_drop": finished.result.target.a_drop}
    if finished.result.held_out is not None and finished.result.held_out.a_drop is not None:
        drops["held-out"] = finished.result.held_out.a_drop
    return ", ".join(f"{name} {drop:.2f}" for name, drop in drops.items())
