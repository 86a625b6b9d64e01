"""What must fit together in a job, said once: the API asks before it queues a job, the job when it opens.

Needs no torch, for the API has none. Raises ``ClassifierError`` or ``SpecError`` for what does not fit.
"""

from collections.abc import Sequence
from typing import Protocol

from trompe_shared.api import JobSpec
from trompe_shared.errors import ClassifierError, SpecError

__all__ = ["Classes", "check_diverse", "check_mask_size", "check_saliency", "check_same_classes", "check_vertices"]


class Classes(Protocol):
    """What a classifier tells of its classes."""

    @property
    def name(self) -> str: ...

    @property
    def n_classes(self) -> int: ...

    @property
    def classes(self) -> Sequence[str] | None: ...


def check_saliency(spec: JobSpec, classifier: str) -> None:
    """Refuse options that need saliency for a classifier (its name) that gives no gradients."""
    if spec.tau is not None or spec.keep is not None:
        raise SpecError(f"tau and keep need saliency, and {classifier!r} gives no gradients: leave them out.")


def check_diverse(spec: JobSpec, classifier: str) -> None:
    """Refuse to show images at random places to a classifier (its name) that gives no gradients."""
    if spec.diverse:
        raise SpecError(
            f"diverse needs gradients, and {classifier!r} gives none: leave it out, or attack a .pt2 file and name "
            "this one as a judge."
        )


def check_vertices(spec: JobSpec, classifier: str) -> None:
    """Refuse to move vertices for a classifier (its name) that gives no gradients."""
    if spec.attack_on == "vertices":
        raise SpecError(
            f"Vertices are moved along gradients, and {classifier!r} gives none: attack a .pt2 file and name this one "
            "as a judge, or attack the light, which needs scores alone."
        )


def check_same_classes(classifiers: Sequence[Classes]) -> None:
    """Refuse an ensemble of which two do not mean the same by their logits."""
    first = next((one for one in classifiers if one.classes is not None), classifiers[0])
    for other in classifiers:
        _check_pair(first, other)


def _check_pair(first: Classes, other: Classes) -> None:
    both = f"{first.name!r} and {other.name!r} cannot be attacked together:"
    if first.n_classes != other.n_classes:
        raise ClassifierError(
            f"{both} they have {first.n_classes} and {other.n_classes} classes; name classifiers of the same classes."
        )
    if first.classes is None or other.classes is None:
        return
    for index, (mine, its) in enumerate(zip(first.classes, other.classes, strict=True)):
        if mine != its:
            raise ClassifierError(
                f"{both} class {index} is {mine!r} for one and {its!r} for the other; "
                "name classifiers of the same classes in the same order."
            )


def check_mask_size(texture: str, *, size: Sequence[int], mask: Sequence[int]) -> None:
    """Refuse a mask picture of another size than its texture's; both are (height, width)."""
    if tuple(mask) != tuple(size):
        raise SpecError(
            f"The mask of {texture!r} is {mask[1]} x {mask[0]} pixels, the texture {size[1]} x {size[0]}: paint it at "
            "the texture's size."
        )
