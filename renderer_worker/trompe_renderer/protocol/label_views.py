"""Views as SAILenv sends them, mirrored: Unity's picture is the mirror image of a right-handed camera's.

Units and signs that the protocol leaves open are defined here; docs/worker.md lists them.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engines.engine import GBuffer
from trompe_renderer.world.snapshot import Snapshot
from trompe_shared.object3d import encode_png

_SCATTER: Final = 3_635_633
"""An odd factor: multiplication modulo 2^24 maps numbers to distinct colours, far apart for neighbours."""


def main_view(picture: NDArray[np.uint8]) -> bytes:
    """Payload of the main view, from a picture (H, W, 3) uint8 as the engine returns it."""
    return encode_png(_mirrored(picture))


def label_views(names: list[str], gbuffer: GBuffer, world: Snapshot, *, depth_range: float) -> dict[str, bytes]:
    """Payloads of the views ``names``, all but "main". ``depth_range``: metres shown as white."""
    makers: Mapping[str, Callable[[], bytes]] = {
        "category": lambda: _category(gbuffer, world),
        "object": lambda: encode_png(_mirrored(instance_color(gbuffer.numbers))),
        "optical": lambda: _optical(gbuffer),
        "depth": lambda: encode_png(_mirrored(_depth(gbuffer, depth_range))),
    }
    return {name: makers[name]() for name in names}


def instance_color(numbers: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Colours (..., 3) uint8 RGB of instance numbers (...), distinct below 2^24; 0 is black."""
    scattered = (numbers.astype(np.uint32) * np.uint32(_SCATTER)).astype(">u4")
    return scattered[..., None].view(np.uint8)[..., 1:]


def _category(gbuffer: GBuffer, world: Snapshot) -> bytes:
    """Three equal bytes a pixel, bottom row first."""
    table = np.zeros(1 + max((instance.number for instance in world.instances), default=0), np.uint8)
    for instance in world.instances:
        table[instance.number] = instance.category
    return bytes(np.repeat(_mirrored(table[gbuffer.numbers])[::-1, :, None], 3, axis=2).tobytes())


def _optical(gbuffer: GBuffer) -> bytes:
    """Two float32 a pixel, to the right and down in the mirrored picture, bottom row first."""
    return bytes((_mirrored(gbuffer.flow)[::-1] * np.array([-1, 1], "<f4")).tobytes())


def _depth(gbuffer: GBuffer, depth_range: float) -> NDArray[np.uint8]:
    share = np.minimum(gbuffer.depth / np.float32(depth_range), 1.0)
    return np.asarray(np.rint(255 * share), np.uint8)


def _mirrored(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


def flat_view(view: str, width: int, height: int) -> bytes:
    """The payload of an empty view."""
    raw = {"category": 3, "optical": 8}
    if view in raw:
        return bytes(width * height * raw[view])
    return encode_png(np.zeros((height, width) if view == "depth" else (height, width, 3), np.uint8))
