"""Photographs behind the object, for renderers with uniform backgrounds only."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from PIL import Image, ImageOps

from trompe_server.renderers.protocol import Images, OnFrame, TargetRenderer
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D


def fitted(picture: Images, size: tuple[int, int]) -> Images:
    """``picture`` (h, w, 3), cropped and scaled to ``size`` (H, W)."""
    return np.asarray(ImageOps.fit(Image.fromarray(picture), (size[1], size[0]), Image.Resampling.LANCZOS))


class BackdropTarget:
    """Render views with a backdrop over black and over white; the difference tells how much shows through.

    pictures: the backdrops by name, (h, w, 3) uint8, sRGB.
    """

    def __init__(self, target: TargetRenderer, pictures: Mapping[str, Images]) -> None:
        self._target, self._pictures = target, pictures

    @property
    def engine(self) -> EngineInfo:
        return self._target.engine

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: tuple[int, int], on_frame: OnFrame | None = None
    ) -> Images:
        """Render as ``TargetRenderer.render``, with two images for each view with a backdrop."""
        before = [replace(view, background=(0, 0, 0)) if view.backdrop else view for view in views]
        images = self._target.render(obj, before, size=size, on_frame=on_frame)
        pictured = [k for k, view in enumerate(views) if view.backdrop]
        if not pictured:
            return images
        bright = self._target.render(obj, [replace(views[k], background=(255, 255, 255)) for k in pictured], size=size)
        behind = {name: fitted(picture, size) for name, picture in self._pictures.items()}
        images = images.copy()
        for image, k in zip(bright, pictured, strict=True):
            images[k] = _blended(images[k], image, behind[views[k].backdrop or ""])
        return images

    def close(self) -> None:
        self._target.close()


def _blended(dark: Images, bright: Images, behind: Images) -> Images:
    """The picture in front of ``behind``, from its images over black and over white."""
    through = np.clip((bright - dark.astype(np.float32)).mean(axis=2, keepdims=True) / 255, 0, 1)
    blended: Images = np.clip(np.round(dark + through * behind), 0, 255).astype(np.uint8)
    return blended
