"""What a job names is looked up before it is queued: a mistake is told to the one who made it, at once."""

import re

from trompe_server.labels import resolve_label
from trompe_server.library import Library
from trompe_shared.api import ClassifierInfo, JobSpec, ObjectInfo
from trompe_shared.errors import SpecError

__all__ = ["checked_spec"]

_COLOUR = re.compile(r"white|black|#[0-9a-fA-F]{6}")


def checked_spec(spec: JobSpec, library: Library) -> JobSpec:
    """``spec`` with the ids of what it names.

    Raises ``NotFoundError``, ``AmbiguousError``, ``LabelError`` or ``SpecError``.
    """
    obj = library.object(spec.object)
    classifier = library.classifier(spec.classifier)
    if not classifier.white_box:
        raise SpecError(
            f"The classifier {classifier.name!r} gives no gradients, so it cannot be attacked, "
            "only be one of the judges. Upload a .pt2 (torch.export) file to attack it."
        )
    resolve_label(spec.label, classifier.classes, classifier.n_classes)
    judges = [_judge(spec, classifier, library.classifier(judge)) for judge in spec.judges]
    background = spec.background
    if not _COLOUR.fullmatch(background):
        background = library.background(background).id
    references = {"object": _reference(obj), "classifier": _reference(classifier), "judges": judges}
    return spec.model_copy(update=references | {"background": background})


def _judge(spec: JobSpec, classifier: ClassifierInfo, judge: ClassifierInfo) -> str:
    """A judge must know the label, too; an index means the same class only among as many classes."""
    resolve_label(spec.label, judge.classes or classifier.classes, judge.n_classes)
    return _reference(judge)


def _reference(info: ObjectInfo | ClassifierInfo) -> str:
    return info.name if info.shipped else info.id
