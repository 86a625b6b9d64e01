"""Suites: what a judgement looks at, fixed by name, so that figures of different groups can be compared.

A suite never changes. Other views, networks, renderers or image pipelines make a new one (``standard-2``).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

__all__ = ["SUITES", "Suite"]


@dataclass(frozen=True)
class Suite:
    """views: random ones, drawn from ``seed``. image_size: (H, W) of the rendered images. networks: by name.

    The image pipelines are those that judge every result (``image_pipelines.SUITE``).
    """

    views: int
    seed: int
    image_size: tuple[int, int]
    renderers: tuple[str, ...]
    networks: tuple[str, ...]


SUITES: Final[Mapping[str, Suite]] = {
    "standard-1": Suite(
        views=100,
        seed=20261123,
        image_size=(224, 224),
        renderers=("pyrender", "three"),
        networks=(
            "tiny",
            "torchvision:mobilenet_v2",
            "torchvision:inception_v3",
            "torchvision:resnet50",
            "torchvision:vit_b_16",
        ),
    )
}
