"""Checks of a submitted job: its objects and networks must exist and fit together."""

import re
from typing import TypeVar

from trompe_server.library import Library
from trompe_server.spec.checks import (
    check_gradients,
    check_keep,
    check_mask_size,
    check_members,
    check_same_classes,
    check_target,
    check_top_k,
)
from trompe_server.spec.labels import resolve_label, resolve_labels
from trompe_shared.api import BackgroundInfo, ClassifierInfo, JobSpec, ObjectInfo
from trompe_shared.errors import SpecError
from trompe_shared.object3d import decode_rgb

__all__ = ["checked_spec"]

Spec = TypeVar("Spec", bound=JobSpec)

_COLOUR = re.compile(r"white|black|#[0-9a-fA-F]{6}")


def checked_spec(spec: Spec, library: Library) -> tuple[Spec, dict[str, str]]:
    """``spec`` with ids in place of names, and the names of uploads by id.

    Raises ``NotFoundError``, ``AmbiguousError``, ``LabelError``, ``ClassifierError`` or ``SpecError``.
    """
    obj = library.object(spec.object)
    classifier = library.classifier(spec.victim.classifier)
    _check_goal(spec, classifier)
    check_gradients(spec, classifier.name, white_box=classifier.white_box)
    _check_paint(spec, obj)
    members = [library.classifier(name) for name in spec.victim.ensemble]
    check_members([(member.name, member.white_box) for member in members])
    check_same_classes([classifier, *members])
    judges = [library.classifier(judge) for judge in spec.judges.networks]
    for other in (*members, *judges):  # an index means the same class only among as many classes
        resolve_labels(spec.goal.label, other.classes or classifier.classes, other.n_classes, other.name)
    victim = {"classifier": classifier.reference, "ensemble": [member.reference for member in members]}
    masks = {texture: _mask(texture, picture, obj, library) for texture, picture in spec.paint.masks.items()}
    pictures = {name: library.background(name) for name in spec.views.background if not _COLOUR.fullmatch(name)}
    background = [pictures[name].id if name in pictures else name for name in spec.views.background]
    stored: list[ObjectInfo | ClassifierInfo] = [obj, classifier, *members, *judges]
    names = {one.id: one.name for one in stored if not one.shipped}
    names |= {picture.id: picture.name for picture in (*masks.values(), *pictures.values())}
    checked = spec.model_copy(
        update={
            "object": obj.reference,
            "victim": spec.victim.model_copy(update=victim),
            "judges": spec.judges.model_copy(update={"networks": [judge.reference for judge in judges]}),
            "paint": spec.paint.model_copy(update={"masks": {name: mask.id for name, mask in masks.items()}}),
            "views": spec.views.model_copy(update={"background": background}),
        }
    )
    return checked, names


def _check_goal(spec: JobSpec, classifier: ClassifierInfo) -> None:
    """Raise ``LabelError`` for unknown classes, ``SpecError`` for a contradictory goal."""
    goal, known = spec.goal, (classifier.classes, classifier.n_classes, classifier.name)
    labels = resolve_labels(goal.label, *known)
    check_target(labels, None if goal.target is None else resolve_label(goal.target, *known))
    check_top_k(goal.top_k, classifier.n_classes - len(labels))


def _check_paint(spec: JobSpec, obj: ObjectInfo) -> None:
    unknown = sorted(set(spec.paint.materials) - set(obj.materials))
    if unknown:
        raise SpecError(f"{obj.name!r} has no material {unknown}; it has {obj.materials}.")
    check_keep(spec.paint.keep, n_texels=sum(height * width for height, width in obj.textures.values()))
    unknown = sorted(set(spec.paint.masks) - set(obj.textures))
    if unknown:
        raise SpecError(f"{obj.name!r} has no texture {unknown} to mask; it has {sorted(obj.textures)}.")


def _mask(texture: str, picture: str, obj: ObjectInfo, library: Library) -> BackgroundInfo:
    """A mask picture. Raises ``SpecError`` unless it has the texture's size."""
    pixels = decode_rgb(library.background_bytes(picture), picture)
    check_mask_size(texture, size=obj.textures[texture], mask=pixels.shape[:2])
    return library.background(picture)
