"""Pictures straight from an engine in this thread, without a socket."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engines.engine import Engine, draw
from trompe_renderer.world.model import HashedModel, model_of, repainted
from trompe_renderer.world.snapshot import Instance, Snapshot, WorldLight
from trompe_renderer.world.validation import unit_color
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D


class EngineRender:
    """A ``Render`` over an engine. As in a worker, a repaint changes ``obj.textures`` and not ``obj.files``."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._model: HashedModel | None = None

    def __call__(self, obj: Object3D, views: Sequence[View], /, *, size: tuple[int, int]) -> NDArray[np.uint8]:
        """See ``Render``. Raises ``RendererError`` for pictures of the wrong type or size."""
        if self._model is not None and obj.parts is self._model.obj.parts:
            self._model = repainted(self._model, obj.textures)
        else:
            self._model = model_of(obj)
        worlds = [_world(self._model, view) for view in views]
        return np.stack([draw(self._engine, world, width=size[1], height=size[0]) for world in worlds])


def _world(model: HashedModel, view: View) -> Snapshot:
    """``model`` alone at the origin."""
    return Snapshot(
        instances=(Instance(model, np.eye(4), 1, 1),),
        camera=np.asarray(np.linalg.inv(view.camera.world_to_camera()), np.float64),
        lights=(WorldLight.of(view.light),) if view.light.intensity > 0 else (),
        ambient=(view.light.ambient,) * 3,
        background=unit_color(view.background),
        noise=view.noise,
    )
