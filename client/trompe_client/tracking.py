"""Log jobs to an experiment tracker by the progress hook: parameters, curves, result, files."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from trompe_client._job import JobHandle
from trompe_client._progress import Show
from trompe_shared.api import Event, JobSpec, Progress, Result
from trompe_shared.errors import SpecError

__all__ = ["TRACKERS", "MlflowRun", "tracked"]


class MlflowRun:
    """A run of MLflow, at ``MLFLOW_TRACKING_URI``, in the experiment ``MLFLOW_EXPERIMENT_NAME`` (default: trompe).

    Raises ``SpecError`` without MLflow.
    """

    def __init__(self, name: str, spec: JobSpec) -> None:
        try:
            mlflow: Any = import_module("mlflow")
        except ImportError as error:
            raise SpecError(f"MLflow is not installed ({error}): pip install 'trompe[mlflow]'.") from error
        self._client = mlflow.MlflowClient()
        experiment = os.environ.get("MLFLOW_EXPERIMENT_NAME", "trompe")
        known = self._client.get_experiment_by_name(experiment)
        where = known.experiment_id if known else self._client.create_experiment(experiment)
        self._id, self._step = self._client.create_run(where, run_name=name).info.run_id, -1
        for key, value in _flat(spec.model_dump(mode="json", exclude_none=True)):
            self._client.log_param(self._id, key, str(value)[:LONGEST])

    def progress(self, progress: Progress) -> None:
        """Log loss and share of fooled views of a new step; a step's second report changes nothing."""
        if progress.step is None or progress.step <= self._step:
            return
        self._step = progress.step
        for key, value in (("loss", progress.loss), ("fooled", progress.fooled)):
            if value is not None:
                self._client.log_metric(self._id, key, value, step=progress.step)

    def end(self, result: Result | None, folder: Path | None = None) -> None:
        """Log the numbers and the files in ``folder``, and end the run; without a ``result`` it has failed."""
        for key, value in _flat({} if result is None else result.model_dump(mode="json", exclude={"spec"})):
            if isinstance(value, int | float):
                self._client.log_metric(self._id, key, value)
        if folder is not None:
            self._client.log_artifacts(self._id, str(folder))
        self._client.set_terminated(self._id, "FAILED" if result is None else "FINISHED")


LONGEST: Final = 500
"""Longest value of a parameter of MLflow."""
TRACKERS: Final = {"mlflow": MlflowRun}


@contextmanager
def tracked(tracker: str | None, job: JobHandle, folder: Path | None) -> Iterator[Show]:
    """A progress hook that logs ``job`` to a tracker; the end of the block logs its result and the files in ``folder``.

    ``None`` logs nothing. Raises ``SpecError`` if the tracker is not installed.
    """
    if tracker is None:
        yield lambda _event: None
        return
    spec, result = job.status.attack, None
    run = TRACKERS[tracker](f"{job.status.names.get(spec.object, spec.object)} {job.id}", spec)

    def log(event: Event) -> None:
        run.progress(event.progress)

    try:
        yield log
        result = job.result()
    finally:
        run.end(result, folder if result else None)


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(Path with dots, value) of each leaf of nested mappings; lists are leaves."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
