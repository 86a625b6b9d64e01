"""Prediction quality of a surrogate, view by view: of the unpainted object and of the change by a repaint."""

from dataclasses import asdict, dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from trompe_server.surrogate.surrogate import Image8, Painted, Surrogate, ViewBatch, painted
from trompe_shared.object3d import Object3D

MAX_ERROR: Final = 1.5 / 255
"""Largest mean error on the unpainted object's pixels of a colour model within tolerance, sRGB in [0, 1] units."""

MIN_EXPLAINED: Final = 0.8
"""Smallest share of the variance of a random repaint's effect that a model within tolerance explains."""


@dataclass(frozen=True)
class Fidelity:
    """Prediction quality for each view.

    error: mean |predicted - true| of the unpainted object's pixels, without anchoring, sRGB in [0, 1] units.
    correlation, slope: of predicted against true change of the image under a random repaint, wherever either changes.
    explained: share of the variance of the true change; 1 is perfect, 0 equals predicting no change.
    """

    error: tuple[float, ...]
    correlation: tuple[float, ...]
    slope: tuple[float, ...]
    explained: tuple[float, ...]

    def mean(self) -> dict[str, float]:
        """Means over the views."""
        return {name: float(np.mean(values)) for name, values in asdict(self).items()}

    @property
    def score(self) -> float:
        """Score of a hypothesis: explained variance, less 1 % for each 0.5/255 of error."""
        mean = self.mean()
        return mean["explained"] - 5 * mean["error"]

    @property
    def good_enough(self) -> bool:
        """Whether the surrogate is within tolerance on average."""
        mean = self.mean()
        return mean["error"] <= MAX_ERROR and mean["explained"] >= MIN_EXPLAINED


def measure_fidelity(
    surrogate: Surrogate, obj: Object3D | Painted, clean: Image8, repainted: Object3D | Painted, images: Image8
) -> Fidelity:
    """Compare ``surrogate`` with the target's images (views, H, W, 3) of ``obj`` (clean) and of ``repainted``."""
    told = [fit for fit in compare_views(surrogate, obj, clean, repainted, images) if fit is not None]
    error, correlation, slope, explained, _ = zip(*(told or [NOTHING_SEEN]), strict=True)
    return Fidelity(error, correlation, slope, explained)


class ViewFit(NamedTuple):
    """``Fidelity`` of one view. change: root mean square of the true change, sRGB in [0, 1] units."""

    error: float
    correlation: float
    slope: float
    explained: float
    change: float

    @property
    def poor(self) -> bool:
        """Whether less than ``MIN_EXPLAINED`` of the change is explained, after allowing for 8-bit rounding."""
        power = self.change**2
        return (1 - self.explained) * max(power, ROUNDED) > (1 - MIN_EXPLAINED) * power + 2 * ROUNDED


def compare_views(
    surrogate: Surrogate, obj: Object3D | Painted, clean: Image8, repainted: Object3D | Painted, images: Image8
) -> list[ViewFit | None]:
    """The fidelity of each view; ``None`` if neither target nor prediction shows a change.

    Images of a renderer that is not deterministic should share their noise: its number is the view's.
    """
    device = surrogate.base.device
    true = [torch.from_numpy(each).to(device) for each in (clean, images)]
    fits: list[ViewFit | None] = []
    with torch.no_grad():
        texels = [painted(each, device).texels(surrogate.geometry) for each in (obj, repainted)]
        for number, batch in enumerate(surrogate.geometry.batches):
            before, after = (surrogate.colours(each, number)[0] for each in texels)
            shown, repainted_shown = (batch.of(each) / 255 for each in true)
            if surrogate.missed is None:
                columns = (after - before, before, shown, repainted_shown)
            else:
                columns = (after - shown, shown - surrogate.missed[number], shown, repainted_shown)
            seen = [torch.split(column, list(batch.counts)) for column in columns]
            by_view = zip(*seen, _unforeseen(batch, *true), strict=True)
            fits += [_compare(*pixels) if _telling(*pixels) else None for pixels in by_view]
    return fits


NOTHING_SEEN: Final = ViewFit(0.0, 0.0, 0.0, 0.0, 0.0)
"""The fidelity if no view shows a change."""


def _telling(predicted_change: Tensor, _: Tensor, clean: Tensor, after: Tensor, unforeseen: Tensor) -> bool:
    """Whether target or prediction shows a change in 8 bits."""
    return bool((255 * predicted_change).round().any() or (after != clean).any() or len(unforeseen))


def _unforeseen(batch: ViewBatch, clean: Tensor, images: Tensor) -> list[Tensor]:
    """Changes (values,) of each view at pixels without object in the surrogate, sRGB in [0, 1] units."""
    some = slice(batch.views.start, batch.views.stop)
    before, after = (each[some].flatten(0, 2) for each in (clean, images))
    elsewhere = (after != before).index_fill_(0, batch.pixel, False)
    by_view = zip(*(each.view(len(batch.views), -1) for each in (before, after, elsewhere)), strict=True)
    return [new[where] / 255 - old[where] / 255 for old, new, where in by_view]


ROUNDED: Final = 1 / 255**2 / 12
"""Variance of rounding to 8 bits; smaller changes count as this much."""


def _compare(predicted_change: Tensor, predicted: Tensor, clean: Tensor, after: Tensor, unforeseen: Tensor) -> ViewFit:
    change = torch.cat([(after - clean).flatten(), unforeseen]).double()
    guess = torch.cat([predicted_change.flatten(), torch.zeros_like(unforeseen)]).double()
    variance, power = float(change.square().mean()), float(guess.square().mean())
    product = float((change * guess).mean())
    correlation = product / max((variance * power) ** 0.5, 1e-12)
    explained = 1 - float((change - guess).square().mean()) / max(variance, ROUNDED)
    error = float((predicted - clean).abs().mean()) if len(clean) else 0.0
    return ViewFit(error, correlation, product / max(power, 1e-12), explained, variance**0.5)
