"""The limit that transparency sets to paint."""

from collections.abc import Iterator
from typing import Final

from trompe_shared.object3d import Object3D
from trompe_shared.opacity import strongest

FAINT: Final = 0.25
"""Opacity below which the paint on a material is hardly seen: a quarter of its change reaches the image."""


def faint_warnings(obj: Object3D) -> Iterator[str]:
    """A warning for each material that is nearly transparent wherever it is strongest."""
    for name, opacity in strongest(obj).items():
        if opacity < FAINT:
            yield f"The material {name!r} is nearly transparent (opacity {opacity:.2f}): paint on it changes little."
