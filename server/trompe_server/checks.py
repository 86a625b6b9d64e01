"""What must fit together in a job, said once: the API asks before it queues a job, the job when it opens.

Needs no torch, for the API has none. Raises ``ClassifierError`` or ``SpecError`` for what does not fit.
"""

from collections.abc import Sequence
from typing import Protocol

from trompe_shared.api import JobSpec
from trompe_shared.errors import ClassifierError, SpecError

__all__ = [
    "Classes",
    "check_diverse",
    "check_goal",
    "check_keep",
    "check_mask_size",
    "check_queries",
    "check_saliency",
    "check_same_classes",
    "check_vertices",
]


class Classes(Protocol):
    """What a classifier tells of its classes."""

    @property
    def name(self) -> str: ...

    @property
    def n_classes(self) -> int: ...

    @property
    def classes(self) -> Sequence[str] | None: ...


def check_goal(loss: str, n_classes: int, *, top_k: int, targeted: bool) -> None:
    """Refuse what needs more classes than a classifier has: to leave its best ones, and the loss that compares
    distances of logits."""
    if top_k >= n_classes:
        raise SpecError(f"top_k must be less than the {n_classes} classes there are, got {top_k}.")
    least = 4 if targeted else top_k + 2
    if loss == "dlr" and n_classes < least:
        raise SpecError(f"The dlr loss needs {least} classes for this goal, there are {n_classes}: choose margin.")


def check_saliency(spec: JobSpec, classifier: str) -> None:
    """Refuse options that need saliency for a classifier (its name) that gives no gradients."""
    if spec.tau is not None or spec.keep is not None:
        raise SpecError(f"tau and keep need saliency, and {classifier!r} gives no gradients: leave them out.")


def check_queries(spec: JobSpec, classifier: str) -> None:
    """Refuse to ask a classifier (its name) that gives gradients for scores in their place."""
    if spec.queries is not None:
        raise SpecError(
            f"queries are for classifiers that only give scores; {classifier!r} gives gradients: leave them out."
        )


def check_keep(spec: JobSpec, *, n_texels: int) -> None:
    """Refuse a share of an object's texels, ``n_texels`` in all, that is less than half of one."""
    if spec.keep is not None and round(spec.keep * n_texels) == 0:
        raise SpecError(
            f"keep={spec.keep:g} leaves none of the {n_texels} texels to move: keep {1 / n_texels:.1g} or more."
        )


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
