"""The views of a frame as SAILenv sends them: Unity's picture is the mirror image of a right-handed camera's.

Units and signs that the protocol leaves open are chosen here (docs/worker.md tells users).
"""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.scenery import Scenery
from trompe_renderer.survey import Survey
from trompe_shared.object3d import encode_png

__all__ = ["flat", "instance_color", "label_views"]

_SCATTER: Final = 3_635_633
"""An odd factor: multiplying by it modulo 2^24 gives each number a colour of its own, far from its neighbours'."""


def label_views(names: list[str], survey: Survey, scenery: Scenery, *, depth_range: float) -> dict[str, bytes]:
    """Payloads of the views ``names``, any but "main". ``depth_range``: the distance that white stands for, metres."""
    makers: Mapping[str, Callable[[], bytes]] = {
        "category": lambda: _category(survey, scenery),
        "object": lambda: encode_png(_mirrored(instance_color(survey.numbers))),
        "optical": lambda: _optical(survey),
        "depth": lambda: encode_png(_mirrored(_depth(survey, depth_range))),
    }
    return {name: makers[name]() for name in names}


def instance_color(numbers: NDArray[np.int64]) -> NDArray[np.uint8]:
    """(..., 3) uint8 RGB for instance numbers (...): black for 0, else a colour that no other number below 2^24 has."""
    scattered = (numbers.astype(np.uint32) * np.uint32(_SCATTER)).astype(">u4")
    return scattered[..., None].view(np.uint8)[..., 1:]


def _category(survey: Survey, scenery: Scenery) -> bytes:
    """Three equal bytes a pixel, bottom row first."""
    table = np.zeros(1 + max((p.number for p in scenery.placements), default=0), np.uint8)
    for placement in scenery.placements:
        table[placement.number] = placement.category
    return bytes(np.repeat(_mirrored(table[survey.numbers])[::-1, :, None], 3, axis=2).tobytes())


def _optical(survey: Survey) -> bytes:
    """Two float32 a pixel, to the right and down in the mirrored picture, bottom row first."""
    return bytes((_mirrored(survey.flow)[::-1] * np.array([-1, 1], "<f4")).tobytes())


def _depth(survey: Survey, depth_range: float) -> NDArray[np.uint8]:
    share = np.minimum(survey.depth / np.float32(depth_range), 1.0)
    return np.asarray(np.rint(255 * share), np.uint8)


def _mirrored(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


def flat(view: str, width: int, height: int) -> bytes:
    """A view that shows nothing, in the form that the protocol gives it."""
    raw = {"category": 3, "optical": 8}
    if view in raw:
        return bytes(width * height * raw[view])
    return encode_png(np.zeros((height, width) if view == "depth" else (height, width, 3), np.uint8))
