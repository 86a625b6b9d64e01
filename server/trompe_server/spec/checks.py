"""Rules between the options of a job and the things it names. The API checks them before it queues a job, the job when
it opens. No torch.
"""

import re
from collections.abc import Sequence
from itertools import product
from typing import Protocol

from trompe_shared.api import JobSpec
from trompe_shared.errors import ClassifierError, SpecError


class Classes(Protocol):
    """Name and classes of a classifier."""

    @property
    def name(self) -> str: ...

    @property
    def n_classes(self) -> int: ...

    @property
    def classes(self) -> Sequence[str] | None: ...


def check_labels(labels: Sequence[int], n_classes: int, *, given: Sequence[object] = ()) -> None:
    """Raise ``SpecError`` unless the object's classes (indices) are distinct, and some but not all of ``n_classes``.

    given: the words in which they were named, for the message.
    """
    for place, label in enumerate(labels):
        if (first := labels.index(label)) < place:
            words: Sequence[object] = given or labels
            raise SpecError(
                f"The labels {words[first]!r} and {words[place]!r} are the same class, {label}: name each `label` once."
            )
    if not 0 < len(labels) < n_classes:
        raise SpecError(
            f"{len(labels)} of the classifier's {n_classes} classes count as the object: name one or more, and leave "
            "one to be taken for."
        )


def check_indices(label: Sequence[str | int], victim: Classes, judges: Sequence[Classes]) -> None:
    """Raise ``SpecError`` for a class of the victim given by its index that is another class for a judge."""
    given = [each for each in map(str.strip, map(str, label)) if re.fullmatch(r"\d{1,18}", each)]
    indices = [int(each) for each in given if int(each) < victim.n_classes]
    for judge, index in product(judges, indices):
        other = f"The index {index} is another class for the judge {judge.name!r}:"
        if judge.n_classes != victim.n_classes:
            raise SpecError(
                f"{other} it has {judge.n_classes} classes, {victim.name!r} has {victim.n_classes}. Give the `label` "
                "by name, and class names with both."
            )
        if victim.classes is not None and judge.classes is not None:
            mine, its = victim.classes[index], judge.classes[index]
            if not _same_class(mine, its):
                raise SpecError(f"{other} {its!r}, not {mine!r}. Give the `label` by name.")


def check_top_k(top_k: int, n_others: int) -> None:
    """Raise ``SpecError`` for more than ``n_others``, the number of classes other than the object's."""
    if top_k > n_others:
        raise SpecError(
            f"`top_k` must be at most the number of classes other than the object's, {n_others}; got {top_k}."
        )


def check_target(labels: Sequence[int], target: int | None) -> None:
    """Raise ``SpecError`` for a target class that counts as the object (indices)."""
    if target in labels:
        raise SpecError(f"The target class {target} is the object's own class: choose another `target`, or none.")


def check_gradients(spec: JobSpec, classifier: str, *, white_box: bool) -> None:
    """Raise ``SpecError`` for options that do not fit a victim with (``white_box``) or without gradients."""
    queries = spec.victim.queries
    if white_box:
        if queries is not None:
            raise SpecError(f"`queries` is for classifiers without gradients; {classifier!r} gives them: leave it out.")
        return
    if queries is None:
        raise SpecError(
            f"{classifier!r} gives scores but no gradients (.onnx). Attack a .pt2 file and name this one by `judges`, "
            "or estimate gradients from its scores by `queries: 10`."
        )
    if spec.paint.tau is not None or spec.paint.keep is not None:
        raise SpecError(f"`tau` and `keep` need gradients, and {classifier!r} gives none: leave them out.")


def check_members(members: Sequence[tuple[str, bool]]) -> None:
    """Raise ``ClassifierError`` for members of an ensemble, (name, white box), without gradients."""
    blind = [name for name, white_box in members if not white_box]
    if blind:
        raise ClassifierError(
            f"{', '.join(map(repr, blind))} gives scores but no gradients (.onnx): name it by `judges`, not by "
            "`ensemble`."
        )


def check_keep(keep: float | None, *, n_texels: int) -> None:
    """Raise ``SpecError`` for a share of ``n_texels`` texels that is less than half a texel."""
    if keep is not None and round(keep * n_texels) == 0:
        raise SpecError(
            f"`keep: {keep:g}` leaves none of the {n_texels} texels to move: keep {1 / n_texels:.1g} or more."
        )


def check_same_classes(classifiers: Sequence[Classes]) -> None:
    """Raise ``ClassifierError`` for an ensemble of classifiers with different classes."""
    first = next((one for one in classifiers if one.classes is not None), classifiers[0])
    for other in classifiers:
        _check_pair(first, other)


def _same_class(one: str, other: str) -> bool:
    """Whether one name has all words of the other, as "tree_frog" and "tree frog, tree-frog"."""
    words, others = (set(re.findall(r"[^\W_]+", name.casefold())) for name in (one, other))
    return words <= others or others <= words


def _check_pair(first: Classes, other: Classes) -> None:
    both = f"{first.name!r} and {other.name!r} cannot be attacked together:"
    if first.n_classes != other.n_classes:
        raise ClassifierError(
            f"{both} they have {first.n_classes} and {other.n_classes} classes; name classifiers of the same classes."
        )
    if first.classes is None or other.classes is None:
        return
    for index, (mine, its) in enumerate(zip(first.classes, other.classes, strict=True)):
        if not _same_class(mine, its):
            raise ClassifierError(
                f"{both} class {index} is {mine!r} for one and {its!r} for the other; "
                "name classifiers of the same classes in the same order."
            )


def check_mask_size(texture: str, *, size: Sequence[int], mask: Sequence[int]) -> None:
    """Raise ``SpecError`` for a mask of another size than its texture's; both are (height, width)."""
    if tuple(mask) != tuple(size):
        raise SpecError(
            f"The mask of {texture!r} is {mask[1]} x {mask[0]} pixels, the texture {size[1]} x {size[0]}: paint it at "
            "the texture's size."
        )
