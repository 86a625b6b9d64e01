"""What an attack achieved, in figures: accuracies with their uncertainty, and how much of the object was changed."""

from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.api import Accuracy, ViewPrediction
from trompe_shared.geometry import View

__all__ = [
    "accuracy",
    "max_view_change",
    "mean_texel_change",
    "softmax",
    "texels_altered",
    "transfer_gap",
    "view_predictions",
    "wilson_interval",
]

Logits = NDArray[np.float32]
Images = NDArray[np.uint8]
Textures = Mapping[str, NDArray[np.uint8]]
_Verdict = tuple[int, float, float]
_NoVerdict = tuple[None, None, None]

Z: Final = NormalDist().inv_cdf(0.975)
"""Normal quantile of a two-sided 95 % interval."""


def softmax(logits: Logits) -> NDArray[np.float64]:
    """Probabilities of logits (N, classes) along the last axis."""
    shifted = np.exp(logits.astype(np.float64) - logits.max(axis=-1, keepdims=True))
    probabilities: NDArray[np.float64] = shifted / shifted.sum(axis=-1, keepdims=True)
    return probabilities


def wilson_interval(hits: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of the share ``hits / count``, inside [0, 1]; ``count`` > 0."""
    share, spread = hits / count, Z**2 / count
    centre = (share + spread / 2) / (1 + spread)
    half = np.sqrt(spread * share * (1 - share) + spread**2 / 4) / (1 + spread)
    return min(share, max(0.0, float(centre - half))), max(share, min(1.0, float(centre + half)))


def accuracy(logits_before: Logits, logits_after: Logits | None, label: int) -> Accuracy:
    """Shares of the views classified as ``label`` before and after, from logits (views, classes) of the same views.

    ``logits_after`` is ``None`` when there was no attack. Raises ``ValueError`` for other views or none.
    """
    if logits_after is not None and logits_after.shape != logits_before.shape:
        raise ValueError(f"logits of the same views were expected, got {logits_before.shape} and {logits_after.shape}")
    count, before = len(logits_before), _hits(logits_before, label)
    after = None if logits_after is None else _hits(logits_after, label)
    return Accuracy(
        views=count,
        a_before=before / count,
        a_after=None if after is None else after / count,
        a_drop=(before - after) / before if before and after is not None else None,
        a_before_interval=wilson_interval(before, count),
        a_after_interval=None if after is None else wilson_interval(after, count),
    )


def _hits(logits: Logits, label: int) -> int:
    """Number of the rows whose best class is ``label``."""
    if not len(logits):
        raise ValueError("accuracy needs at least one view")
    return int((logits.argmax(axis=1) == label).sum())


def transfer_gap(surrogate: Accuracy | None, target: Accuracy) -> float | None:
    """Surrogate ``a_drop`` minus target ``a_drop``; ``None`` where either is n.a."""
    if surrogate is None or surrogate.a_drop is None or target.a_drop is None:
        return None
    return surrogate.a_drop - target.a_drop


def view_predictions(views: Sequence[View], before: Logits, after: Logits | None, label: int) -> list[ViewPrediction]:
    """What the logits (views, classes) say of each view; ``after`` is ``None`` when there was no attack."""
    old = _verdicts(before, label)
    new: Sequence[_Verdict | _NoVerdict] = _verdicts(after, label) if after is not None else [(None,) * 3] * len(old)
    return [_prediction(*row) for row in zip(views, old, new, strict=True)]


def _verdicts(logits: Logits, label: int) -> list[_Verdict]:
    """(class, its probability, probability of ``label``) of each row."""
    best, probabilities = logits.argmax(axis=1), softmax(logits)
    return [(int(k), float(row[k]), float(row[label])) for k, row in zip(best, probabilities, strict=True)]


def _prediction(view: View, before: _Verdict, after: _Verdict | _NoVerdict) -> ViewPrediction:
    return ViewPrediction(
        azimuth=view.camera.azimuth,
        elevation=view.camera.elevation,
        distance=view.camera.distance,
        light_azimuth=view.light.azimuth,
        light_elevation=view.light.elevation,
        before=before[0],
        before_confidence=before[1],
        before_true_confidence=before[2],
        after=after[0],
        after_confidence=after[1],
        after_true_confidence=after[2],
    )


def texels_altered(before: Textures, after: Textures) -> float:
    """Share of all texels in which any channel differs (``N%``); textures are (H, W, 3) uint8 by the same names."""
    return float(np.concatenate([change.any(axis=1) for change in _changes(before, after)]).mean())


def mean_texel_change(before: Textures, after: Textures) -> float:
    """Mean |change| over the channels of the altered texels, in [0, 1] units; 0.0 when none was altered."""
    change = np.concatenate(_changes(before, after))
    altered = change[change.any(axis=1)]
    return float(altered.mean() / 255) if len(altered) else 0.0


def _changes(before: Textures, after: Textures) -> list[NDArray[np.uint8]]:
    """|change| (texels, 3) uint8 of each texture. Raises ``ValueError`` when names or sizes differ."""
    if {name: t.shape for name, t in before.items()} != {name: t.shape for name, t in after.items()}:
        raise ValueError("textures before and after must have the same names and sizes")
    return [_difference(before[name], after[name]).reshape(-1, 3) for name in sorted(before)]


def _difference(a: Images, b: Images) -> Images:
    """|a - b| of uint8 arrays, without overflow or a wider copy."""
    return np.maximum(a, b) - np.minimum(a, b)


def max_view_change(images_before: Images, images_after: Images) -> float:
    """Largest |change| of any channel of any pixel between images (views, H, W, 3) uint8, in [0, 1] units."""
    return int(_difference(images_before, images_after).max()) / 255
