"""Log the jobs of an experiment to a tracker, beside the display of their progress."""

from collections.abc import Callable

from trompe_client.tracking import Run
from trompe_experiments.plan import Row
from trompe_experiments.run import Finished, Show
from trompe_shared.api import Job, JobSpec


class Tracked:
    """A display whose jobs are runs of a tracker too. Finished jobs of an earlier run are not logged again."""

    def __init__(self, display: Show, new_run: Callable[[str, JobSpec], Run]) -> None:
        self._display, self._new_run, self._runs = display, new_run, dict[str, Run]()

    def begin(self, *, total: int, done: int) -> None:
        self._display.begin(total=total, done=done)

    def look(self, row: Row, job: Job) -> None:
        self._run(row).progress(job.progress)
        self._display.look(row, job)

    def end(self, row: Row, finished: Finished) -> None:
        self._run(row).end(finished.result)
        del self._runs[row.key]
        self._display.end(row, finished)

    def _run(self, row: Row) -> Run:
        if row.key not in self._runs:
            name = "  ".join(filter(None, (row.place.experiment, row.object, row.place.configuration)))
            self._runs[row.key] = self._new_run(name, row.request)
        return self._runs[row.key]
