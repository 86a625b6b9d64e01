"""The surrogate renderer: rasterise once, then gather. Independent of the server."""

from trompe_server.surrogate.canvas import Canvas
from trompe_server.surrogate.joint import AnyCanvas, AnySurrogate, JointSurrogate, joined
from trompe_server.surrogate.sampling import SamplingModel
from trompe_server.surrogate.surrogate import (
    Geometry,
    Image8,
    Painted,
    Surrogate,
    behind,
    curve_surrogate,
    diffuse_surrogate,
    prepare_geometry,
    tensor_of,
    textures_of,
)

__all__ = [
    "AnyCanvas",
    "AnySurrogate",
    "Canvas",
    "Geometry",
    "Image8",
    "JointSurrogate",
    "Painted",
    "SamplingModel",
    "Surrogate",
    "behind",
    "curve_surrogate",
    "diffuse_surrogate",
    "joined",
    "prepare_geometry",
    "tensor_of",
    "textures_of",
]
