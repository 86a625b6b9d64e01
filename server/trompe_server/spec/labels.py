"""Class labels: from a name, a synonym or an index to the index of the class."""

import operator
import unicodedata
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
    wanted = _folded(label)
    whole = [index for index, name in enumerate(classes) if _folded(name) == wanted]
    exact = [index for index in whole if classes[index] == label]
    fits = exact or whole or [index for index, name in enumerate(classes) if wanted in _synonyms(name)]
    if len(fits) != 1:
        raise _unclear(label, fits, classes, classifier)
    return fits[0]


def _folded(text: str) -> str:
    """Text for comparison: systems compose accents differently."""
    return unicodedata.normalize("NFC", text).strip().casefold()


def _synonyms(name: str) -> dict[str, str]:
    """The synonyms of a name, by their folded form."""
    return {_folded(part): part.strip() for part in name.split(",")}


def _unclear(label: str, fits: Sequence[int], classes: Sequence[str], classifier: str) -> LabelError:
    if fits:
        candidates = "; ".join(f"{index} ({classes[index]})" for index in fits)
        return LabelError(f"{label!r} fits several classes of {classifier!r}: {candidates}. Give the index.")
    known = {folded: part for name in classes for folded, part in _synonyms(name).items()}
    close = get_close_matches(_folded(label), list(known), n=3)
    hint = (
        f"did you mean {', '.join(repr(known[each]) for each in close)}?"
        if close
        else f"an example of a class is {classes[0]!r}."
    )
    return LabelError(f"{classifier!r} has no class {label!r}; {hint} Give a class, its index, or another network.")
