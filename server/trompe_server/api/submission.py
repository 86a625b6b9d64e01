"""What a job names is looked up before it is queued: a mistake is told to the one who made it, at once."""

import re
from typing import TypeVar

from trompe_server.checks import (
    check_diverse,
    check_goal,
    check_keep,
    check_mask_size,
    check_queries,
    check_saliency,
    check_same_classes,
    check_vertices,
)
from trompe_server.labels import resolve_label
from trompe_server.library import Library
from trompe_shared.api import ClassifierInfo, JobSpec, ObjectInfo
from trompe_shared.errors import SpecError
from trompe_shared.object3d import decode_rgb

__all__ = ["checked_spec"]

Spec = TypeVar("Spec", bound=JobSpec)

_COLOUR = re.compile(r"white|black|#[0-9a-fA-F]{6}")


def checked_spec(spec: Spec, library: Library) -> Spec:
    """``spec`` with the ids of what it names.

    Raises ``NotFoundError``, ``AmbiguousError``, ``LabelError``, ``ClassifierError`` or ``SpecError``.
    """
    obj = library.object(spec.object)
    classifier = library.classifier(spec.classifier)
    _check_goal(spec, classifier)
    _check_gradients(spec, classifier)
    _check_materials(spec, obj)
    members = [library.classifier(name) for name in spec.ensemble]
    check_same_classes([classifier, *members])
    references = {
        "object": _reference(obj),
        "classifier": _reference(classifier),
        "ensemble": [_member(spec, classifier, member) for member in members],
        "judges": [_judge(spec, classifier, library.classifier(judge)) for judge in spec.judges],
        "background": [name if _COLOUR.fullmatch(name) else library.background(name).id for name in spec.background],
        "masks": {texture: _mask(texture, picture, obj, library) for texture, picture in spec.masks.items()},
    }
    return spec.model_copy(update=references)


def _check_goal(spec: JobSpec, classifier: ClassifierInfo) -> None:
    """Raise ``LabelError`` or ``SpecError`` for classes that there are not, and for a goal that contradicts itself."""
    label = resolve_label(spec.label, classifier.classes, classifier.n_classes)
    if spec.target_label is not None and label == resolve_label(
        spec.target_label, classifier.classes, classifier.n_classes
    ):
        raise SpecError(
            f"The target class {spec.target_label!r} is the object's own class: choose another one, or none to have "
            "the object taken for anything else."
        )
    check_goal(spec.loss, classifier.n_classes, top_k=spec.top_k, targeted=spec.target_label is not None)


def _check_gradients(spec: JobSpec, classifier: ClassifierInfo) -> None:
    """Raise ``SpecError`` where the attack needs gradients that the classifier does not give."""
    if classifier.white_box:
        check_queries(spec, classifier.name)
        return
    check_vertices(spec, classifier.name)
    if spec.queries is None and spec.attack_on == "texture":
        raise SpecError(
            f"The classifier {classifier.name!r} gives no gradients: it can be one of the judges, or be attacked by "
            "its scores (queries=10 asks it about ten images for each gradient)."
        )
    check_saliency(spec, classifier.name)
    check_diverse(spec, classifier.name)


def _check_materials(spec: JobSpec, obj: ObjectInfo) -> None:
    unknown = sorted(set(spec.materials) - set(obj.materials))
    if unknown:
        raise SpecError(f"There is no material {unknown}; {obj.name!r} has {obj.materials}.")
    check_keep(spec, n_texels=sum(height * width for height, width in obj.textures.values()))
    unknown = sorted(set(spec.masks) - set(obj.textures))
    if unknown:
        raise SpecError(f"There is no texture {unknown} to mask; {obj.name!r} has {sorted(obj.textures)}.")


def _mask(texture: str, picture: str, obj: ObjectInfo, library: Library) -> str:
    """Id of the picture that is painted over a texture; it must have the texture's size."""
    pixels = decode_rgb(library.background_bytes(picture), picture)
    check_mask_size(texture, size=obj.textures[texture], mask=pixels.shape[:2])
    return library.background(picture).id


def _member(spec: JobSpec, classifier: ClassifierInfo, member: ClassifierInfo) -> str:
    """A member of the ensemble must give gradients."""
    if not member.white_box:
        raise SpecError(f"{member.name!r} gives no gradients, so it can be a judge, but not in the ensemble.")
    return _judge(spec, classifier, member)


def _judge(spec: JobSpec, classifier: ClassifierInfo, judge: ClassifierInfo) -> str:
    """A judge must know the label, too; an index means the same class only among as many classes."""
    resolve_label(spec.label, judge.classes or classifier.classes, judge.n_classes)
    return _reference(judge)


def _reference(info: ObjectInfo | ClassifierInfo) -> str:
    return info.name if info.shipped else info.id
