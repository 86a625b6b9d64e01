"""The surrogate renderer: rasterise once, then gather. Independent of the server."""

from trompe_server.surrogate.canvas import Canvas
from trompe_server.surrogate.joint import AnyCanvas, AnySurrogate, JointSurrogate, joined
from trompe_server.surrogate.sampling import SamplingModel
from trompe_server.surrogate.surrogate import (
    Geometry,
    Painted,
    Surrogate,
    behind,
    curve_surrogate,
    diffuse_surrogate,
    prepare_geometry,
    textures_of,
)

__all__ = [
    "AnyCanvas",
    "AnySurrogate",
    "Canvas",
    "Geometry",
    "JointSurrogate",
    "Painted",
    "SamplingModel",
    "Surrogate",
    "behind",
    "curve_surrogate",
    "diffuse_surrogate",
    "joined",
    "prepare_geometry",
    "textures_of",
]
