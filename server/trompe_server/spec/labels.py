"""Class labels: from a name, a synonym or an index to the index of the class."""

import operator
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Final, SupportsIndex

from trompe_server.spec.checks import check_labels
from trompe_shared.errors import LabelError

MOST_DIGITS: Final = 18
"""Digits of an index; Python refuses to convert thousands."""


def resolve_labels(
    label: str | SupportsIndex | Sequence[str | SupportsIndex],
    classes: Sequence[str] | None,
    n_classes: int,
    classifier: str,
) -> tuple[int, ...]:
    """Indices of the classes that count as the object, from one label or several.

    Raises ``LabelError`` as ``resolve_label`` does, and ``SpecError`` as ``check_labels`` does.
    """
    given = [label] if isinstance(label, str | SupportsIndex) else label
    found = tuple(resolve_label(each, classes, n_classes, classifier) for each in given)
    check_labels(found, n_classes, given=given)
    return found


def resolve_label(label: str | SupportsIndex, classes: Sequence[str] | None, n_classes: int, classifier: str) -> int:
    """Index in [0, n_classes) of the class called ``label``; ``classifier`` is the network's name.

    ``label`` is an index, its digits, the full name of a class, or one of the name's comma-separated synonyms ("toilet
    tissue" for "toilet tissue, toilet paper, bathroom tissue"), in any case. Raises ``LabelError`` for an index out of
    range, and for a name of no class or of several.
    """
    if isinstance(label, SupportsIndex) or label.strip().isdecimal():
        digits = label.strip() if isinstance(label, str) else str(operator.index(label))
        if len(digits) > MOST_DIGITS or not 0 <= int(digits) < n_classes:
            raise LabelError(
                f"{digits[:MOST_DIGITS]} is not a class of {classifier!r}; its indices are 0..{n_classes - 1}."
            )
        return int(digits)
    if classes is None or len(classes) != n_classes:  # names that it borrows are those of another network
        raise LabelError(
            f"{classifier!r} has no class names to find {label!r} in; give an index in 0..{n_classes - 1}, or "
            "class names with it."
        )
    wanted = label.strip().casefold()
    whole = [index for index, name in enumerate(classes) if name.casefold() == wanted]
    exact = [index for index in whole if classes[index] == label]
    fits = exact or whole or [index for index, name in enumerate(classes) if wanted in _synonyms(name)]
    if len(fits) != 1:
        raise _unclear(label, fits, classes, classifier)
    return fits[0]


def _synonyms(name: str) -> list[str]:
    return [part.strip().casefold() for part in name.split(",")]


def _unclear(label: str, fits: Sequence[int], classes: Sequence[str], classifier: str) -> LabelError:
    if fits:
        candidates = "; ".join(f"{index} ({classes[index]})" for index in fits)
        return LabelError(f"{label!r} fits several classes of {classifier!r}: {candidates}. Give the index.")
    close = get_close_matches(label.strip().casefold(), [s for name in classes for s in _synonyms(name)], n=3)
    hint = f"did you mean {', '.join(map(repr, close))}?" if close else f"an example of a class is {classes[0]!r}."
    return LabelError(f"{classifier!r} has no class {label!r}; {hint} Give a class, its index, or another network.")
