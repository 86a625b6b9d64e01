"""From what people call a class to its index among the logits."""

from collections.abc import Sequence
from difflib import get_close_matches

from trompe_shared.errors import LabelError

__all__ = ["resolve_label"]


def resolve_label(label: str | int, classes: Sequence[str] | None, n_classes: int) -> int:
    """Index in [0, n_classes) of the class called ``label``.

    ``label`` is an index, its digits, the full name of a class, or one of the comma-separated synonyms that a name
    lists ("toilet tissue" for "toilet tissue, toilet paper, bathroom tissue"); case does not matter.
    Raises ``LabelError`` for an index out of range and for a name that fits no class or several.
    """
    if isinstance(label, int) or label.strip().isdecimal():
        return _checked_index(int(label), n_classes)
    if classes is None:
        raise LabelError(
            f"The classifier has no class names, so {label!r} means nothing to it; give an index in 0..{n_classes - 1}."
        )
    wanted = label.strip().casefold()
    whole = [index for index, name in enumerate(classes) if name.casefold() == wanted]
    fits = whole or [index for index, name in enumerate(classes) if wanted in _synonyms(name)]
    if len(fits) != 1:
        raise _unclear(label, fits, classes)
    return fits[0]


def _checked_index(index: int, n_classes: int) -> int:
    if not 0 <= index < n_classes:
        raise LabelError(f"{index} is not a class of this classifier; its indices are 0..{n_classes - 1}.")
    return index


def _synonyms(name: str) -> list[str]:
    return [part.strip().casefold() for part in name.split(",")]


def _unclear(label: str, fits: Sequence[int], classes: Sequence[str]) -> LabelError:
    if fits:
        candidates = "; ".join(f"{index} ({classes[index]})" for index in fits)
        return LabelError(f"{label!r} fits several classes: {candidates}. Give the index.")
    close = get_close_matches(label.strip().casefold(), [s for name in classes for s in _synonyms(name)], n=3)
    hint = f"did you mean {', '.join(map(repr, close))}?" if close else f"it knows, for example, {classes[0]!r}."
    return LabelError(f"The classifier has no class {label!r}; {hint} An index works too.")
