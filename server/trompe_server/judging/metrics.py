"""Metrics of an attack: accuracies with confidence intervals, and the share of the object that changed."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from statistics import NormalDist
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from trompe_shared.api import FEW_RECOGNISED, Accuracy, ViewPrediction
from trompe_shared.geometry import View

Logits = NDArray[np.float32]
Images = NDArray[np.uint8]
Textures = Mapping[str, NDArray[np.uint8]]
Label = int | Sequence[int]
"""The object's class, or several that all count as the object."""

Z: Final = NormalDist().inv_cdf(0.975)
"""Normal quantile of a two-sided 95 % interval."""
RESAMPLES: Final = 4000
LITTLE: Final = 0.3
"""An ``a_drop`` below this causes a warning."""

LARGE_LOSS: Final = 0.2
"""So does a held-out ``a_drop`` that falls short of the own views' by more than this."""

LARGE_SHARE: Final = 0.3
"""Or by more than this share of the own views'."""


def wilson_interval(share: float, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a ``share`` of ``count`` > 0 independent views, inside [0, 1]."""
    spread = Z**2 / count
    centre = (share + spread / 2) / (1 + spread)
    half = np.sqrt(spread * share * (1 - share) + spread**2 / 4) / (1 + spread)
    return min(share, max(0.0, float(centre - half))), max(share, min(1.0, float(centre + half)))


def accuracy(
    logits_before: Logits,
    logits_after: Logits | None,
    label: Label,
    *,
    near: Collection[int] | None = None,
    distinct: int | None = None,
) -> Accuracy:
    """Shares of the views classified as ``label`` before and after, from logits (views, classes) of the same views.

    logits_after: ``None`` if there was no attack. near: neighbours of ``label``; ``None`` if unknown. distinct: number
    of distinct views, all by default. Raises ``ValueError`` for different views and for none.
    """
    count, before = len(logits_before), int(recognised(logits_before, label).sum())
    after = None if logits_after is None else int(recognised(logits_after, label, like=logits_before).sum())
    own = distinct or count
    interval = None if logits_after is None else drop_interval(logits_before, logits_after, label, distinct=own)
    labels = [label] if isinstance(label, int) else label
    wide = None if near is None else accuracy(logits_before, logits_after, [*labels, *near], distinct=own)
    return Accuracy(
        views=count,
        distinct=own,
        a_before=before / count,
        a_after=None if after is None else after / count,
        a_drop=(before - after) / before if before and after is not None else None,
        a_drop_interval=interval,
        a_before_interval=wilson_interval(before / count, own),
        a_after_interval=None if after is None else wilson_interval(after / count, own),
        a_drop_with_neighbours=None if wide is None else wide.a_drop,
        a_drop_with_neighbours_interval=None if wide is None else wide.a_drop_interval,
    )


def recognised(logits: Logits, label: Label, *, like: Logits | None = None) -> NDArray[np.bool_]:
    """Mask (views,) of the rows classified as ``label``. Raises ``ValueError`` if the shape is not that of ``like``."""
    if like is not None and logits.shape != like.shape:
        raise ValueError(f"logits of the same views were expected, got {like.shape} and {logits.shape}")
    if not len(logits):
        raise ValueError("accuracy needs at least one view")
    return np.isin(logits.argmax(axis=1), label)


def drop_interval(
    before: Logits, after: Logits, label: Label, *, distinct: int | None = None
) -> tuple[float, float] | None:
    """95 % bootstrap interval of ``a_drop`` over paired views; ``None`` if ``a_drop`` is n.a.

    Of views that are not all ``distinct``, as many as there are distinct ones are drawn, with the same shares. Each
    combination of outcomes (right or wrong, before and after) gets half a view on top of its count. Without it the
    bootstrap has no width if all of a few views were fooled; with it the width is that of Wilson's interval there.
    Resamples without a recognised view are dropped. Raises ``ValueError`` as ``accuracy`` does.
    """
    right, still = recognised(before, label), recognised(after, label, like=before)
    if not right.any():
        return None
    seen = np.array([np.sum(right & still), np.sum(right & ~still), np.sum(~right & still), np.sum(~right & ~still)])
    own = distinct or len(right)
    weights = seen * (own / len(right)) + 0.5
    drawn = np.random.default_rng(0).multinomial(own, weights / weights.sum(), RESAMPLES)
    both, lost, won, _ = drawn[drawn[:, :2].any(axis=1)].T
    low, high = np.quantile((lost - won) / (both + lost), [0.025, 0.975]).tolist()
    return low, high


def drop_warning(found: Accuracy) -> str | None:
    """Warning about an ``a_drop`` that rests on few or no recognised views; ``None`` if there are enough."""
    recognised = round(found.a_before * found.views)
    if not recognised:
        return f"None of the {found.counted} views was recognised before the attack: A_drop is n.a."
    if found.a_before >= FEW_RECOGNISED:
        return None
    return (
        f"Only {found.a_before:.0%} of the views were recognised before the attack: "
        f"A_drop rests on {recognised} of {found.counted} views."
    )


def reach_warning(target: Accuracy, held_out: Accuracy | None, *, stronger: str, wider: str) -> str | None:
    """Warning about an attack that fooled few views, or few except its own; ``None`` for any other.

    stronger, wider: the advice to add in the first and in the second case.
    """
    own, other = target.a_drop, held_out.a_drop if held_out else None
    if own is not None and own < LITTLE:
        return f"The attack had little effect: A_drop {own:.2f} on its own views. {stronger}"
    if own is None or other is None or own - other <= min(LARGE_LOSS, LARGE_SHARE * own):
        return None
    return (
        f"The effect is weaker from other views: A_drop {own:.2f} on the attack's own, {other:.2f} on held-out ones. "
        f"{wider}"
    )


def transfer_gap(surrogate: Accuracy | None, target: Accuracy) -> float | None:
    """Surrogate ``a_drop`` minus target ``a_drop``; ``None`` if either is n.a."""
    if surrogate is None or surrogate.a_drop is None or target.a_drop is None:
        return None
    return surrogate.a_drop - target.a_drop


def agreement(before: Logits, after: Logits, predicted: Logits, label: Label) -> dict[str, float | None]:
    """Agreement of a surrogate with its target on the classifier's verdicts of the repainted object's own views.

    From logits (views, classes) of the target before and after, and of the surrogate's images after.
    disagreement: share of the views recognised in one and not in the other. margin_error: mean |difference| of the
    margins, as a share of the margin that the attack moved in the target; ``None`` if it moved none.
    """
    clean, true, guess = (margins(logits, label) for logits in (before, after, predicted))
    moved = float((clean - true).mean())
    differ = recognised(after, label) != recognised(predicted, label, like=after)
    error = float(np.abs(guess - true).mean()) / moved if moved > 0 else None
    return {"disagreement": float(differ.mean()), "margin_error": error}


def margins(logits: Logits, label: Label) -> NDArray[np.float64]:
    """Best logit of the object's classes minus the best of all others, (views,)."""
    own = np.zeros(logits.shape[1], np.bool_)
    own[np.asarray(label)] = True
    return np.asarray(logits[:, own].max(axis=1) - logits[:, ~own].max(axis=1), np.float64)


def view_predictions(views: Sequence[View], before: Logits, after: Logits | None, label: Label) -> list[ViewPrediction]:
    """Predictions for each view from logits (views, classes); ``after`` is ``None`` if there was no attack."""
    old = _verdicts("before", before, label)
    new = [{}] * len(old) if after is None else _verdicts("after", after, label)
    return [
        ViewPrediction(
            **camera_and_light(view), background=view.backdrop or f"#{bytes(view.background).hex()}", **was, **now
        )
        for view, was, now in zip(views, old, new, strict=True)
    ]


def _verdicts(when: str, logits: Logits, label: Label) -> list[dict[str, Any]]:
    """Class, its probability and that of ``label`` in each row, as fields of a ``ViewPrediction``."""
    return [
        {
            when: int(k),
            f"{when}_confidence": float(row[k]),
            f"{when}_true_confidence": float(row[np.array(label)].sum()),
        }
        for k, row in zip(logits.argmax(axis=1), softmax(logits.astype(np.float64), axis=-1), strict=True)
    ]


def camera_and_light(view: View) -> dict[str, Any]:
    """Fields of a record of a view."""
    camera = {name: getattr(view.camera, name) for name in ("azimuth", "elevation", "distance", "roll")}
    return camera | {f"light_{name}": value for name, value in vars(view.light).items()}


def fooled_as(before: Logits, after: Logits, label: Label) -> Counter[int]:
    """Number of views by class after the attack, of those recognised before it and not after."""
    return Counter(after[recognised(before, label) & ~recognised(after, label, like=before)].argmax(axis=1).tolist())


def texels_altered(before: Textures, after: Textures) -> float:
    """Share of all texels with a difference in any channel (``N%``); textures are (H, W, 3) uint8, same names."""
    return float(np.concatenate([change.any(axis=1) for change in _changes(before, after)]).mean())


def mean_texel_change(before: Textures, after: Textures) -> float:
    """Mean |change| over the channels of the altered texels, in [0, 1] units; 0.0 if none is altered."""
    change = np.concatenate(_changes(before, after))
    altered = change[change.any(axis=1)]
    return float(altered.mean() / 255) if len(altered) else 0.0


def _changes(before: Textures, after: Textures) -> list[NDArray[np.uint8]]:
    """|change| (texels, 3) uint8 of each texture. Raises ``ValueError`` if names or sizes differ."""
    if {name: t.shape for name, t in before.items()} != {name: t.shape for name, t in after.items()}:
        raise ValueError("textures before and after must have the same names and sizes")
    return [difference(before[name], after[name]).reshape(-1, 3) for name in sorted(before)]


def difference(a: Images, b: Images) -> Images:
    """|a - b| of uint8 arrays, without overflow or a wider copy."""
    return np.maximum(a, b) - np.minimum(a, b)


def max_view_change(images_before: Images, images_after: Images) -> float:
    """Largest |change| of any channel of any pixel between images (views, H, W, 3) uint8, in [0, 1] units."""
    return int(difference(images_before, images_after).max()) / 255


def share_beyond(
    images_before: Images, images_after: Images, pixels: NDArray[np.bool_], *, epsilon: float
) -> tuple[float, float]:
    """Violations of the paper's constraint on views, |I - I'| < epsilon in every channel: (of pixels, of views).

    Share of the object's ``pixels`` (views, H, W) that changed by more than ``epsilon`` ([0, 1] units), and share of
    the views with such a pixel. Both are 0.0 if there are none to count.
    """
    beyond = (difference(images_before, images_after) > epsilon * 255 + 1e-9).any(axis=-1) & pixels
    count, views = int(pixels.sum()), len(pixels)
    return (int(beyond.sum()) / count if count else 0.0, int(beyond.any(axis=(1, 2)).sum()) / views if views else 0.0)
