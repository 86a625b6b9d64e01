"""The target renderer as a black box: an object and views in, images out."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

Images = NDArray[np.uint8]
"""(views, H, W, 3), or one image without the first axis."""
OnFrame = Callable[[], None]


class TargetRenderer(Protocol):
    """A renderer that gives images and nothing else."""

    @property
    def engine(self) -> EngineInfo:
        """Identity of the engine, the same for all images. Raises ``RendererError`` if no renderer can be reached."""
        ...

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: tuple[int, int], on_frame: OnFrame | None = None
    ) -> Images:
        """Images of ``obj``, (views, H, W, 3) uint8, sRGB, row 0 on top, not mirrored; ``size`` is (H, W).

        on_frame: called after each image, for progress bars. Raises ``RendererError`` if the renderer cannot be reached
        or refuses the object.
        """
        ...

    def close(self) -> None:
        """Close the connections; others can still use the renderer."""
        ...
