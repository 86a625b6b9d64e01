"""Targets and classifiers that are not what the attack takes them for, or not as they come: what suites are made of."""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.classifiers.protocol import Images, Logits, Wrapper, fit_images, in_batches
from trompe_server.surrogate.shading import decode, encode
from trompe_server.target import TargetRenderer
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = [
    "ChangedClassifier",
    "DisturbedTarget",
    "at_size",
    "bfloat16",
    "bfloat16_gradients",
    "bounce",
    "brighter_when_dark",
    "filmic",
    "flicker",
    "grain",
    "jittered",
    "jpeg",
    "quantised",
    "relit",
    "resized_twice",
    "saturated",
    "smaller",
]

See = Callable[[Images, int], NDArray[np.float64]]
"""What becomes of an image (H, W, 3) of a frame, which is counted over all requests."""
Aim = Callable[[View, int], View]
"""The view that is rendered in place of the one that was asked for."""
Network = Callable[[Float[Tensor, "n 3 H W"]], Float[Tensor, "n classes"]]

BATCH: Final = 20


@dataclass
class DisturbedTarget:
    """``inner``, aimed and seen otherwise. ``frames`` counts the images so far: it is what random numbers come from."""

    inner: TargetRenderer
    see: See | None = None
    aim: Aim | None = None
    scale: float = 1.0
    """Images are rendered so much smaller, and scaled up to the size that was asked for."""
    frames: int = field(default=0, init=False)

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> Images:
        """See ``TargetRenderer.render``."""
        first, self.frames = self.frames, self.frames + len(views)
        aimed = views if self.aim is None else [self.aim(view, first + k) for k, view in enumerate(views)]
        own = (round(size[0] * self.scale), round(size[1] * self.scale))
        images = self.inner.render(obj, aimed, size=own, on_frame=on_frame)
        if own != size:
            images = np.stack([_scaled(image, size) for image in images])
        if self.see is None:
            return images
        seen = [self.see(image, first + k) for k, image in enumerate(images)]
        rounded: Images = np.clip(np.round(np.stack(seen)), 0, 255).astype(np.uint8)
        return rounded

    def close(self) -> None:
        """See ``TargetRenderer.close``."""
        self.inner.close()


def _scaled(image: Images, size: tuple[int, int]) -> Images:
    return np.asarray(Image.fromarray(image).resize((size[1], size[0]), Image.Resampling.BILINEAR))


def grain(sigma: float) -> See:
    """Another normal noise in every frame; ``sigma`` in 1/255."""
    return lambda image, frame: image + np.random.default_rng(frame).normal(0, sigma, image.shape)


def flicker(strength: float) -> See:
    """A lamp that flickers."""
    return lambda image, frame: image * (1 - strength * (0.5 + 0.5 * np.sin(frame)))


def brighter_when_dark(strength: float) -> See:
    """Exposure that depends on the whole picture."""
    return lambda image, _: image * (1 - strength * (image.mean() / 255 - 0.5))


def filmic(image: Images, _: int) -> NDArray[np.float64]:
    """A tone curve as engines put over their pictures, the same for every pixel: Narkowicz's fit of ACES."""
    light = decode(torch.from_numpy(image / 255))
    toned = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    return np.asarray(255 * encode(toned.clamp(0, 1)).numpy(), np.float64)


def bounce(strength: float) -> See:
    """Interreflection: what is not white takes on some of the object's mean colour, squared."""

    def see(image: Images, _: int) -> NDArray[np.float64]:
        there = (image != 255).any(axis=2, keepdims=True)
        colour = (image * there).sum(axis=(0, 1)) / max(int(there.sum()), 1) / 255
        return np.asarray(image + there * strength * 255 * colour**2)

    return see


def jpeg(quality: int) -> See:
    """Compressed and read again."""

    def see(image: Images, _: int) -> NDArray[np.float64]:
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, "JPEG", quality=quality)
        return np.asarray(Image.open(buffer), np.float64)

    return see


def resized_twice(factor: float) -> See:
    """Made smaller by ``factor`` and as large as before again."""

    def see(image: Images, _: int) -> NDArray[np.float64]:
        height, width = image.shape[:2]
        small = _scaled(image, (round(height * factor), round(width * factor)))
        return _scaled(small, (height, width)).astype(np.float64)

    return see


def jittered(degrees: float, share: float) -> Aim:
    """A camera that stands a little elsewhere in every frame: normal, ``degrees`` in angles, ``share`` of distance."""

    def aim(view: View, frame: int) -> View:
        turn, lift, step = np.random.default_rng(frame).normal(0, 1, 3)
        camera = view.camera
        moved = replace(
            camera,
            azimuth=camera.azimuth + degrees * turn,
            elevation=float(np.clip(camera.elevation + degrees * lift, -90, 90)),
            distance=camera.distance * (1 + share * step),
        )
        return replace(view, camera=moved)

    return aim


def relit(azimuth: float, intensity: float = 1.0) -> Aim:
    """Light from so many degrees of azimuth elsewhere, and so much brighter."""

    def aim(view: View, _: int) -> View:
        light = view.light
        moved = replace(light, azimuth=light.azimuth + azimuth, intensity=light.intensity * intensity)
        return replace(view, light=moved)

    return aim


def smaller(target: TargetRenderer, scale: float) -> DisturbedTarget:
    """A target whose images are ``scale`` times the size that is asked for, and scaled up."""
    return DisturbedTarget(target, scale=scale)


@dataclass(frozen=True)
class ChangedClassifier(Wrapper):
    """``inner`` with its network replaced by ``network``, which sees images in [0, 1] and gives logits.

    ``size`` (H, W) of the images, where that is not ``inner``'s. Unless it ``judges``, results are judged by ``inner``.
    """

    inner: WhiteBoxClassifier
    network: Network
    size: tuple[int, int] | None = None
    judges: bool = True

    @property
    def image_size(self) -> tuple[int, int]:
        """See ``Classifier``."""
        return self.size or self.inner.image_size

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """See ``WhiteBoxClassifier``."""
        return self.network(images)

    @torch.no_grad()
    def predict(self, images: Images) -> Logits:
        """See ``Classifier``."""
        if not self.judges:
            return self.inner.predict(images)
        parts = [self.network(fit_images(batch, self.image_size)).numpy() for batch in in_batches(images, BATCH)]
        return np.concatenate([np.zeros((0, self.n_classes), np.float32), *parts])


def bfloat16(classifier: WhiteBoxClassifier) -> ChangedClassifier:
    """Computed in bfloat16."""

    def network(images: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return classifier.logits(images).float()

    return ChangedClassifier(classifier, network)


def bfloat16_gradients(classifier: WhiteBoxClassifier) -> ChangedClassifier:
    """Attacked in bfloat16, judged as it is."""
    return replace(bfloat16(classifier), judges=False)


def at_size(classifier: WhiteBoxClassifier, side: int) -> ChangedClassifier:
    """Shown square images of another size, as only a fully convolutional network can be."""
    return ChangedClassifier(classifier, classifier.logits, (side, side))


def saturated(classifier: WhiteBoxClassifier, factor: float) -> ChangedClassifier:
    """With logits ``factor`` times as large: a softmax that is sure of everything, and nearly flat."""
    return ChangedClassifier(classifier, lambda images: factor * classifier.logits(images))


def quantised(classifier: WhiteBoxClassifier, levels: int) -> ChangedClassifier:
    """With images rounded to a few levels first: gradient masking, since rounding has none."""
    return ChangedClassifier(
        classifier, lambda images: classifier.logits((images * (levels - 1)).round() / (levels - 1))
    )
