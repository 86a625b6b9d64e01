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
        asked = self.options(job.spec)
        return job_row(job, object=self._object(job.spec.object), classifier=asked["classifier"], label=asked["label"])

    def options(self, spec: JobSpec) -> dict[str, Any]:
        """What was asked of an object, with names for ids and for the numbers of classes."""
        name = self.classes(spec.classifier)
        classes = {"label": spec.label, "target_label": spec.target_label}
        return spec.model_dump(exclude={"object"}) | {
            "classifier": self._classifier(spec.classifier),
            **{option: name(given) if isinstance(given, int) else given for option, given in classes.items()},
            "ensemble": [self._classifier(each) for each in spec.ensemble],
            "judges": [self._classifier(each) for each in spec.judges],
        }

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
