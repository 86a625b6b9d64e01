"""A photograph behind the object, for a renderer that only knows uniform backgrounds."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from trompe_server.target.protocol import TargetRenderer
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["BackdropTarget"]

Images = NDArray[np.uint8]


class BackdropTarget:
    """Renders each view in front of black and of white; the difference says how much of the picture shows through.

    ``picture`` is (h, w, 3) uint8, sRGB; it is cropped and scaled to fill the image. Views' own backgrounds are
    ignored.
    """

    def __init__(self, target: TargetRenderer, picture: Images) -> None:
        self._target, self._picture = target, Image.fromarray(picture)

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> Images:
        """See ``TargetRenderer.render``; asks for two images a view."""
        black = [replace(view, background=(0, 0, 0)) for view in views]
        white = [replace(view, background=(255, 255, 255)) for view in views]
        dark = self._target.render(obj, black, size=size, on_frame=on_frame).astype(np.float32)
        bright = self._target.render(obj, white, size=size).astype(np.float32)
        through = np.clip((bright - dark).mean(axis=3, keepdims=True) / 255, 0, 1)
        blended: Images = np.clip(np.round(dark + through * self.backdrop(size)), 0, 255).astype(np.uint8)
        return blended

    def backdrop(self, size: tuple[int, int]) -> Images:
        """What stands behind the object, (H, W, 3) uint8."""
        return np.asarray(ImageOps.fit(self._picture, (size[1], size[0]), Image.Resampling.LANCZOS))

    def close(self) -> None:
        """Close the renderer behind it."""
        self._target.close()
