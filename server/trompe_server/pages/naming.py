"""What the ids in a job stand for, in words."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from trompe_server.errors import NotFoundError
from trompe_server.library import Library
from trompe_server.pages.present import ClassNames, JobRow, job_row
from trompe_shared.api import Job, JobSpec
from trompe_shared.errors import TrompeError

__all__ = ["Names"]


class Names:
    """Names of stored things; each is looked up once. A thing that is gone keeps the beginning of its id."""

    def __init__(self, library: Library) -> None:
        self._object = cache(lambda reference: _name(lambda: library.object(reference).name, reference))
        self._classifier = cache(lambda reference: _name(lambda: library.classifier(reference).name, reference))
        self._classes = cache(lambda reference: _classes(library, reference))

    def row(self, job: Job) -> JobRow:
        """A job in a list."""
        spec = job.spec
        return job_row(
            job,
            object=self._object(spec.object),
            classifier=self._classifier(spec.classifier),
            label=self._class(spec, spec.label),
        )

    def options(self, spec: JobSpec) -> dict[str, Any]:
        """What was asked of an object, with names for ids and for the numbers of classes."""
        return spec.model_dump(exclude={"object"}) | {
            "classifier": self._classifier(spec.classifier),
            "label": self._class(spec, spec.label),
            "target_label": None if spec.target_label is None else self._class(spec, spec.target_label),
            "ensemble": [self._classifier(each) for each in spec.ensemble],
            "judges": [self._classifier(each) for each in spec.judges],
        }

    def _class(self, spec: JobSpec, given: str | int) -> str:
        return self.classes(spec.classifier)(given) if isinstance(given, int) else given

    def classes(self, classifier: str) -> ClassNames:
        """What a classifier's classes are called."""
        known = self._classes(classifier)
        return lambda index: known[index] if index < len(known) else f"class {index}"


def _classes(library: Library, reference: str) -> Sequence[str]:
    """The names of a classifier's classes, none where it is gone or has none."""
    try:
        return library.classifier(reference).classes or ()
    except NotFoundError:
        return ()


def _name(look_up: Callable[[], str], reference: str) -> str:
    try:
        return look_up()
    except TrompeError:
        return reference[:12]
