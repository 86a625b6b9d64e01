"""Named pipelines: those an attack can expect, and the fixed suite that judges every result."""

from collections.abc import Mapping
from typing import Final

from trompe_server.image_pipelines.pipeline import ImagePipeline

PIPELINES: Final[Mapping[str, ImagePipeline]] = {
    "robust": ImagePipeline(
        spared=0.25, often=0.6, resize=(0.4, 1), gamma=(0.7, 1.45), gain=(0.85, 1.15), noise=(0, 0.04), jpeg=(30, 90)
    ),
    "transfer": ImagePipeline(
        often=0.75,
        mirrored=0.5,
        zoom=(0.75, 1.33),
        shift=(-0.1, 0.1),
        resize=(0.4, 1),
        gamma=(0.7, 1.45),
        gain=(0.85, 1.15),
        noise=(0, 0.1),
        jpeg=(30, 90),
    ),
}
"""Pipelines of an attack by name."""

SUITE: Final[Mapping[str, ImagePipeline]] = {
    "half size": ImagePipeline(resize=(0.5, 0.5)),
    "three quarters": ImagePipeline(resize=(0.75, 0.75)),
    "JPEG 75": ImagePipeline(jpeg=(75, 75)),
    "JPEG 30": ImagePipeline(jpeg=(30, 30)),
    "gamma 0.8": ImagePipeline(gamma=(0.8, 0.8)),
    "gamma 1.25": ImagePipeline(gamma=(1.25, 1.25)),
    "filmic": ImagePipeline(filmic=(1, 1)),
    "blur 1": ImagePipeline(blur=(1, 1)),
    "crop": ImagePipeline(zoom=(1.15, 1.15)),
    "grain": ImagePipeline(noise=(0.05, 0.05)),
}
"""What each result is judged through besides the images themselves."""
