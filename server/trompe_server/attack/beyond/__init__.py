"""Beyond texture: the light and the shape of an object as what the attack may change. Usable without any server."""

from trompe_server.attack.beyond.chance import chances
from trompe_server.attack.beyond.light import (
    FoundLight,
    LightPlace,
    LightRanges,
    LightTrial,
    find_light,
    load_light,
    save_light,
)
from trompe_server.attack.beyond.light_map import light_map
from trompe_server.attack.beyond.relief import LightProbes, Relief, probe_light
from trompe_server.attack.beyond.shape import Shape, shape_of, with_vertices
from trompe_server.attack.beyond.vertices import (
    VertexBudget,
    VertexState,
    VertexStep,
    load_vertices,
    move_vertices,
    save_vertices,
)

__all__ = [
    "FoundLight",
    "LightPlace",
    "LightProbes",
    "LightRanges",
    "LightTrial",
    "Relief",
    "Shape",
    "VertexBudget",
    "VertexState",
    "VertexStep",
    "chances",
    "find_light",
    "light_map",
    "load_light",
    "load_vertices",
    "move_vertices",
    "probe_light",
    "save_light",
    "save_vertices",
    "shape_of",
    "with_vertices",
]
