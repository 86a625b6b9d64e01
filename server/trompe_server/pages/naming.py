"""Names for the ids and class indices of jobs."""

from collections.abc import Sequence
from functools import cache
from typing import Any

from trompe_server.errors import NotFoundError
from trompe_server.library import Library
from trompe_server.pages.present import ClassNames, JobRow
from trompe_shared.api import OPTIONS, Job, JobSpec, JudgementSpec
from trompe_shared.errors import ClassifierError


class Names:
    """Names of stored things, as of the submission of the job, and of classes, looked up once for a classifier."""

    def __init__(self, library: Library) -> None:
        self._classes = cache(lambda reference: _classes(library, reference))

    def row(self, job: Job) -> JobRow:
        """A job in a list."""
        spec = job.spec
        if isinstance(spec, JudgementSpec):
            before, after = (_named(job, each) for each in (spec.before, spec.after))
            return JobRow.of(
                job,
                object=after if after == before else f"{after}, judged beside {before}",
                classifier=", ".join(_named(job, spec.networks)) or spec.suite or "tiny",
                label=" or ".join(map(str, spec.label)),
                epsilon=spec.epsilon,
            )
        return JobRow.of(
            job,
            object=_named(job, spec.object),
            classifier=_named(job, spec.victim.classifier),
            label=self._object_classes(spec),
            epsilon=spec.paint.epsilon,
        )

    def options(self, job: Job) -> dict[str, Any]:
        """Options of an attack by keyword, with names in place of ids and class indices."""
        spec, dumped = job.attack, job.attack.model_dump()
        return {
            keyword: _named(job, dumped[option.part][option.field])
            if option.file
            else dumped[option.part][option.field]
            for keyword, option in OPTIONS.items()
        } | {
            "label": self._object_classes(spec),
            "target": None if spec.goal.target is None else self._class(spec, spec.goal.target),
        }

    def _object_classes(self, spec: JobSpec) -> str:
        return " or ".join(self._class(spec, label) for label in spec.goal.label)

    def _class(self, spec: JobSpec, given: str | int) -> str:
        return self.classes(spec.victim.classifier)(given) if isinstance(given, int) else given

    def classes(self, classifier: str) -> ClassNames:
        """Function from a class index to its name."""
        known = self._classes(classifier)
        return lambda index: known[index] if index < len(known) else f"class {index}"


def _classes(library: Library, reference: str) -> Sequence[str]:
    """Names of a classifier's classes; none for one that is deleted, no longer allowed, or cannot be loaded."""
    try:
        return library.classifier(reference).classes or ()
    except (NotFoundError, ClassifierError):
        return ()


def _named(job: Job, value: Any) -> Any:
    """A reference, or several, with names in place of ids; of an unknown id the first 12 digits."""
    if isinstance(value, str):
        return job.names.get(value, value if len(value) < 64 else value[:12])
    if isinstance(value, dict):
        return {name: _named(job, each) for name, each in value.items()}
    return [_named(job, each) for each in value]
