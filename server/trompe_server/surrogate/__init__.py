"""The surrogate renderer: rasterise once, then gather. Usable without any server."""

from trompe_server.surrogate.canvas import Canvas
from trompe_server.surrogate.sampling import SamplingModel
from trompe_server.surrogate.surrogate import (
    Geometry,
    Surrogate,
    behind,
    curve_surrogate,
    diffuse_surrogate,
    prepare_geometry,
    textures_of,
)

__all__ = [
    "Canvas",
    "Geometry",
    "SamplingModel",
    "Surrogate",
    "behind",
    "curve_surrogate",
    "diffuse_surrogate",
    "prepare_geometry",
    "textures_of",
]
