"""What the ids in a job stand for, in words."""

from collections.abc import Callable
from functools import cache

from trompe_server.errors import NotFoundError
from trompe_server.library import Library
from trompe_server.pages.present import ClassNames, JobRow, job_row
from trompe_shared.api import Job
from trompe_shared.errors import TrompeError

__all__ = ["Names"]


class Names:
    """Names of stored things; each is looked up once. A thing that is gone keeps the beginning of its id."""

    def __init__(self, library: Library) -> None:
        self._object = cache(lambda reference: _name(lambda: library.object(reference).name, reference))
        self._classifier = cache(lambda reference: _name(lambda: library.classifier(reference).name, reference))
        self._library = library

    def row(self, job: Job) -> JobRow:
        """A job in a list."""
        return job_row(job, object=self._object(job.spec.object), classifier=self._classifier(job.spec.classifier))

    def classes(self, classifier: str) -> ClassNames:
        """What a classifier's classes are called."""
        try:
            known = self._library.classifier(classifier).classes
        except NotFoundError:
            known = None
        return lambda index: known[index] if known and index < len(known) else f"class {index}"


def _name(look_up: Callable[[], str], reference: str) -> str:
    try:
        return look_up()
    except TrompeError:
        return reference[:12]
