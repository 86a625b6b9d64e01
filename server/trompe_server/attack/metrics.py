"""What an attack achieved, in figures: accuracies with their uncertainty, and how much of the object was changed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist, fmean, stdev
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.api import FEW_RECOGNISED, Accuracy, ViewPrediction
from trompe_shared.geometry import View

__all__ = [
    "DropOverSeeds",
    "accuracy",
    "drop_interval",
    "drop_over_seeds",
    "drop_warning",
    "max_view_change",
    "mean_texel_change",
    "predicted_classes",
    "reach_warning",
    "share_beyond",
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
RESAMPLES: Final = 4000
LITTLE: Final = 0.3
"""An ``a_drop`` below this is worth one too."""

LARGE_LOSS: Final = 0.2
"""So is an ``a_drop`` of held-out views that is less than the own views' by more than this."""


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
    count, before = len(logits_before), int(_right(logits_before, label).sum())
    after = None if logits_after is None else int(_right(logits_after, label, like=logits_before).sum())
    return Accuracy(
        views=count,
        a_before=before / count,
        a_after=None if after is None else after / count,
        a_drop=(before - after) / before if before and after is not None else None,
        a_drop_interval=None if logits_after is None else drop_interval(logits_before, logits_after, label),
        a_before_interval=wilson_interval(before, count),
        a_after_interval=None if after is None else wilson_interval(after, count),
    )


def _right(logits: Logits, label: int, *, like: Logits | None = None) -> NDArray[np.bool_]:
    """The rows (views,) whose best class is ``label``, of logits that have the shape of ``like``."""
    if like is not None and logits.shape != like.shape:
        raise ValueError(f"logits of the same views were expected, got {like.shape} and {logits.shape}")
    if not len(logits):
        raise ValueError("accuracy needs at least one view")
    return np.asarray(logits.argmax(axis=1) == label)


def drop_interval(before: Logits, after: Logits, label: int, *, seed: int = 0) -> tuple[float, float] | None:
    """95 % bootstrap interval of ``a_drop`` over views, each drawn with both of its outcomes; ``None`` where it is n.a.

    Every combination of outcomes (right or wrong, before and after) counts half a view more than was seen: the plain
    bootstrap is sure of an attack that fooled each of a few views, this one is as wide there as Wilson's interval.
    Resamples of which no view is recognised are left out. Raises ``ValueError`` as ``accuracy`` does.
    """
    right, still = _right(before, label), _right(after, label, like=before)
    if not right.any():
        return None
    seen = np.array([np.sum(right & still), np.sum(right & ~still), np.sum(~right & still), np.sum(~right & ~still)])
    weights = (seen + 0.5) / (seen + 0.5).sum()
    drawn = np.random.default_rng(seed).multinomial(len(right), weights, RESAMPLES)
    drops = _drops(drawn[drawn[:, :2].any(axis=1)])
    return float(np.quantile(drops, 0.025)), float(np.quantile(drops, 0.975))


def _drops(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """``a_drop`` of counts (n, 4) of views that are right both times, only before, only after, never."""
    drops: NDArray[np.float64] = (counts[:, 1] - counts[:, 2]) / counts[:, :2].sum(axis=1)
    return drops


def drop_warning(found: Accuracy) -> str | None:
    """What a reader of ``a_drop`` must know: that nothing, or little, was recognised before the attack."""
    recognised = round(found.a_before * found.views)
    if not recognised:
        return f"None of the {found.views} views was recognised before the attack: A_drop is n.a."
    if found.a_before >= FEW_RECOGNISED:
        return None
    return (
        f"Only {found.a_before:.0%} of the views were recognised before the attack: "
        f"A_drop rests on {recognised} of {found.views} views."
    )


def reach_warning(target: Accuracy, held_out: Accuracy | None, *, stronger: str, wider: str) -> str | None:
    """What a reader must know of an attack that fooled few views (and ``stronger`` says what to do), or few but its own
    (``wider`` does)."""
    own, other = target.a_drop, held_out.a_drop if held_out else None
    if own is not None and own < LITTLE:
        return f"The attack came to little: A_drop {own:.2f} on its own views. {stronger}"
    if own is None or other is None or own - other <= LARGE_LOSS:
        return None
    return (
        f"It holds less from other views: A_drop {own:.2f} on the attack's own, {other:.2f} on held-out ones. {wider}"
    )


@dataclass(frozen=True)
class DropOverSeeds:
    """``a_drop`` of one setting over seeds: how many, their mean, standard deviation and 95 % interval of the mean.

    ``spread`` and ``interval`` are ``None`` for a single seed. They hold what the seeds change, and not how few views a
    figure rests on.
    """

    seeds: int
    mean: float
    spread: float | None
    interval: tuple[float, float] | None


def drop_over_seeds(drops: Sequence[float | None]) -> DropOverSeeds | None:
    """Student's interval of the mean of each seed's ``a_drop``, cut at 1; seeds without one (n.a.) do not count.

    ``None`` when no seed has one.
    """
    known = [drop for drop in drops if drop is not None]
    if not known:
        return None
    mean = fmean(known)
    if len(known) == 1:
        return DropOverSeeds(1, mean, None, None)
    spread = stdev(known)
    half = _student_quantile(len(known) - 1) * spread / len(known) ** 0.5
    return DropOverSeeds(len(known), mean, spread, (mean - half, min(mean + half, max(1.0, mean))))


def _student_quantile(freedom: int) -> float:
    """Quantile 0.975 of Student's t: with t = sqrt(freedom) tan(x), the density of x is cos(x)^(freedom - 1)."""
    x = np.linspace(0, np.pi / 2, 100_001)
    density = np.cos(x) ** (freedom - 1)
    area = np.cumsum(density) - (density + 1) / 2
    return float(np.sqrt(freedom) * np.tan(np.interp(0.95, area / area[-1], x)))


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
        roll=view.camera.roll,
        light_intensity=view.light.intensity,
        light_ambient=view.light.ambient,
        light_colour=view.light.colour,
        background=view.backdrop or f"#{bytes(view.background).hex()}",
        before=before[0],
        before_confidence=before[1],
        before_true_confidence=before[2],
        after=after[0],
        after_confidence=after[1],
        after_true_confidence=after[2],
    )


def predicted_classes(logits: Logits) -> dict[int, int]:
    """How many rows of logits (views, classes) each class is the best of, the most frequent first, then by index."""
    counts = Counter(logits.argmax(axis=1).tolist())
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


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


def share_beyond(
    images_before: Images, images_after: Images, pixels: NDArray[np.bool_], *, epsilon: float
) -> tuple[float, float]:
    """How far the paper's constraint on views, |I - I'| < epsilon in every channel, is broken.

    Share of ``pixels`` (views, H, W), the object's, that changed by more than ``epsilon`` ([0, 1] units), and share of
    the views that hold such a pixel. Both 0.0 where there is nothing to count.
    """
    beyond = (_difference(images_before, images_after) > epsilon * 255 + 1e-9).any(axis=-1) & pixels
    count, views = int(pixels.sum()), len(pixels)
    return (int(beyond.sum()) / count if count else 0.0, int(beyond.any(axis=(1, 2)).sum()) / views if views else 0.0)
