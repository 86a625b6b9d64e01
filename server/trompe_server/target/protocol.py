"""The target renderer, as the attack sees it: a black box that takes an object and views and gives images."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["TargetRenderer"]


class TargetRenderer(Protocol):
    """A renderer of which one may only ask images."""

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> NDArray[np.uint8]:
        """Images of ``obj``, (views, H, W, 3) uint8, sRGB, row 0 on top, not mirrored; ``size`` is (H, W).

        ``on_frame`` is called after each image, for progress bars. Raises ``RendererError`` when the renderer cannot be
        reached or refuses the object.
        """
        ...

    def close(self) -> None:
        """Let go of connections; the renderer can still be used by others."""
        ...
