"""A renderer that is not what it seems: our engine with a disturbed camera, light or picture.

``trompe render --engine trompe_experiments.stability.disturbed_engine:DisturbedEngine --set grain=8``
"""

import sys
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from click import FloatRange, IntRange
from numpy.typing import NDArray
from PIL import Image

from trompe_renderer.engines.pyrender import PyrenderEngine, PyrenderOptions
from trompe_renderer.world.snapshot import Matrix, Snapshot, WorldLight
from trompe_server.image_pipelines import ImagePipeline
from trompe_server.renderers import SailenvTarget, local_renderer
from trompe_shared.geometry import FIELD_OF_VIEW, look_rotation

NAME: Final = "trompe_experiments.stability.disturbed_engine:DisturbedEngine"
Picture = NDArray[np.uint8]
Levels = NDArray[np.float64]


@dataclass(frozen=True)
class Disturbance:
    """What is disturbed; the defaults disturb nothing. Random numbers follow the number of the picture.

    field_of_view: vertical, degrees. jitter: noise of the camera's angles, degrees, and of its distance, percent.
    turn, dim: azimuth added to directional lights, degrees, and factor of their intensity. scale: of the rendered size;
    the picture is scaled up. grain: standard deviation, levels of 255. flicker: share by which the light varies.
    exposure: how much brighter dark pictures become. bounce: share of the object's squared mean colour added to it.
    filmic: the tone curve of ACES (Narkowicz's fit) on all pixels. jpeg: quality, 0 is none. resize: down by this
    factor and up again.
    """

    field_of_view: Annotated[float, FloatRange(1, 179)] = FIELD_OF_VIEW
    jitter: float = 0.0
    turn: float = 0.0
    dim: float = 1.0
    scale: Annotated[float, FloatRange(0.01, 1)] = 1.0
    grain: float = 0.0
    flicker: float = 0.0
    exposure: float = 0.0
    bounce: float = 0.0
    filmic: bool = False
    jpeg: Annotated[int, IntRange(0, 100)] = 0
    resize: Annotated[float, FloatRange(0.01, 1)] = 1.0


class DisturbedEngine:
    """An ``Engine`` over pyrender. It calls itself deterministic even where it is not: nobody is warned."""

    def __init__(self, options: Disturbance) -> None:
        self._inner = PyrenderEngine(PyrenderOptions())
        self.info = self._inner.info
        self._options, self._frame = options, 0

    def render(self, world: Snapshot, *, width: int, height: int) -> Picture:
        how, frame = self._options, self._frame
        self._frame += 1
        own = round(width * how.scale), round(height * how.scale)
        picture = self._inner.render(_aimed(world, how, frame), width=own[0], height=own[1])
        if own != (width, height):
            picture = np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR))
        return np.clip(np.round(_seen(picture.astype(float), how, frame)), 0, 255).astype(np.uint8)


def disturbed_renderer(**options: float) -> AbstractContextManager[SailenvTarget]:
    """A worker with a ``DisturbedEngine`` during a ``with``; ``options`` are fields of ``Disturbance``."""
    settings = [word for name, value in options.items() for word in ("--set", f"{name}={value}")]
    command = (sys.executable, "-m", "trompe_shared.child", "render", "--port", "0", "--engine", NAME)
    return local_renderer((*command, *settings))


def _aimed(world: Snapshot, how: Disturbance, frame: int) -> Snapshot:
    """``world`` with another camera and other lights."""
    wider = np.tan(np.radians(how.field_of_view / 2)) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    camera = _jittered(world, how.jitter, frame) if how.jitter and world.instances else world.camera
    lights = tuple(_relit(light, how) for light in world.lights)
    return replace(world, camera=camera @ np.diag([wider, wider, 1, 1]), lights=lights)


def _jittered(world: Snapshot, degrees: float, frame: int) -> Matrix:
    """The camera, moved around the object and to or fro."""
    turn, lift, step = np.random.default_rng(frame).normal(0, degrees, 3)
    object_ = world.instances[0]
    centre = object_.pose[:3, :3] @ np.array(object_.model.obj.sphere[0]) + object_.pose[:3, 3]
    rotation = look_rotation(turn, 0) @ world.camera[:3, :3] @ look_rotation(0, lift)
    offset = rotation @ world.camera[:3, :3].T @ (world.camera[:3, 3] - centre)
    camera = world.camera.copy()
    camera[:3, :3], camera[:3, 3] = rotation, centre + (1 + step / 100) * offset
    return camera


def _relit(light: WorldLight, how: Disturbance) -> WorldLight:
    if light.kind != "Directional":
        return light
    x, y, z = (look_rotation(how.turn, 0) @ np.array(light.direction)).tolist()
    return replace(light, direction=(x, y, z), intensity=how.dim * light.intensity)


def _seen(picture: Levels, how: Disturbance, frame: int) -> Levels:
    """``picture`` (H, W, 3), 0 to 255, as the disturbed renderer shows it."""
    picture = picture * (1 - how.flicker * (0.5 + 0.5 * np.sin(frame)))
    picture = picture * (1 - how.exposure * (picture.mean() / 255 - 0.5))
    there = (picture != 255).any(axis=2, keepdims=True)
    colour = (picture * there).sum(axis=(0, 1)) / max(int(there.sum()), 1) / 255
    picture = picture + there * how.bounce * 255 * colour**2
    levels = np.clip(np.round(picture), 0, 255).astype(np.uint8)
    picture = _pipeline(how).shown(levels[None])[0].astype(float)
    return picture + np.random.default_rng(frame).normal(0, how.grain, picture.shape)


def _pipeline(how: Disturbance) -> ImagePipeline:
    return ImagePipeline(
        resize=(how.resize, how.resize),
        filmic=(1, 1) if how.filmic else None,
        jpeg=(how.jpeg, how.jpeg) if how.jpeg else None,
    )
