"""The interface of an engine: a snapshot of the world goes in, images come out."""

import hashlib
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.world.snapshot import Snapshot
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError


@dataclass(frozen=True)
class GBuffer:
    """Per-pixel labels of a picture, sampled at pixel centres. Row 0 is on top, as a right-handed camera sees it.

    numbers: (H, W) int64, the instance's number; 0 for the background.
    depth: (H, W) float32, metres along the camera's axis; infinite for the background.
    flow: (H, W, 2) float32, motion in pixels to the right and down; 0 for the background and for points that were
        behind the camera.
    """

    numbers: NDArray[np.int64]
    depth: NDArray[np.float32]
    flow: NDArray[np.float32]


class Engine(Protocol):
    """A renderer. One thread creates it and makes all calls. ``info``: its identity, fixed after creation."""

    info: EngineInfo

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        """The picture, (height, width, 3) uint8, sRGB, row 0 on top, as a right-handed camera sees it.

        The camera is a pinhole with the vertical field of view ``trompe_shared.geometry.FIELD_OF_VIEW``. An engine that
        is not deterministic draws its noise from ``noise_seed(world)``. Raises ``RendererError`` for what it cannot
        draw.
        """
        ...


@runtime_checkable
class LabellingEngine(Engine, Protocol):
    """An engine that also renders SAILenv's views other than "main"."""

    def gbuffer(self, world: Snapshot, before: Snapshot, *, width: int, height: int) -> GBuffer:
        """Labels of the same picture; flow is the motion since ``before``."""
        ...


def noise_seed(world: Snapshot) -> int:
    """Seed, below 2^31, of a Monte Carlo engine: equal for equal cameras, lights and noise numbers.

    It does not depend on the objects: pictures of differently painted objects share their noise.
    """
    seen = (world.noise, world.camera.tolist(), world.lights, world.ambient)
    return int.from_bytes(hashlib.sha256(repr(seen).encode()).digest()[:4], "little") >> 1


def draw(engine: Engine, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
    """A copy of what ``engine.render`` gives: an engine may draw each picture into the same memory.

    Raises ``RendererError`` if it is not a picture of this size.
    """
    picture = engine.render(world, width=width, height=height)
    kind, shape = getattr(picture, "dtype", type(picture).__name__), getattr(picture, "shape", ())
    if kind != np.uint8 or shape != (height, width, 3):
        raise RendererError(f"The engine {engine.info.name} gave {kind} {shape}; expected uint8 {(height, width, 3)}.")
    return np.array(picture, order="C")
