"""Assemble surfaces, materials and images to an object in SAILenv's format."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.pictures import Pixels, encode_srgb, linear_rgb
from trompe_server.formats.unwrap import BAKED_SIDE, bake, unwrap
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Material, Object3D, encode_png, object_from_files
from trompe_shared.wavefront import LARGEST, Part, Surface, obj_text

DEFAULT_COLOUR: Final = tuple(linear_rgb(np.full(3, 204, np.uint8)).tolist())
"""Linear colour of surfaces without one: light grey."""


def safe_name(text: str, *, default: str = "object") -> str:
    """``text`` as a file or material name safe in every format, file system and shell."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text).strip("_.-")[:80] or default


def free_name(wanted: str, taken: Collection[str]) -> str:
    """``wanted`` (a file or material name), with a number appended if it is taken."""
    stem, dot, ending = wanted.rpartition(".") if "." in wanted else (wanted, "", "")
    names = (wanted, *(f"{stem}_{k}{dot}{ending}" for k in range(2, len(taken) + 3)))
    lower = {name.lower() for name in taken}
    return next(name for name in names if name.lower() not in lower)


def flat_picture(colour: Sequence[float], size: tuple[int, int] = (BAKED_SIDE, BAKED_SIDE)) -> Pixels:
    """A texture (H, W, 3) of one linear colour."""
    return np.broadcast_to(encode_srgb(colour), (*size, 3)).copy()


@dataclass(frozen=True)
class Painted:
    """Surfaces of one material with their generated texture."""

    parts: tuple[Part, ...]
    picture: Pixels


def painted_flat(surfaces: Sequence[Surface], colour: Sequence[float]) -> Painted:
    """Texture the surfaces of one material; unwrap them if one lacks UVs or has vertex colours.

    colour: linear; multiplies the vertex colours, which are sRGB-encoded in [0, 1].
    """
    coloured = any(surface.colours is not None for surface in surfaces)
    if not coloured and all(surface.uvs is not None for surface in surfaces):
        return Painted(tuple(_part(surface) for surface in surfaces), flat_picture(colour))
    cut, size = unwrap([(surface.vertices, surface.faces) for surface in surfaces])
    parts = tuple(
        Part(surface.material, surface.vertices[u.source], surface.normals[u.source], u.uvs, u.faces)
        for surface, u in zip(surfaces, cut, strict=True)
    )
    if not coloured:
        return Painted(parts, flat_picture(colour, size))
    shades = [_vertex_colours(surface)[u.source] * np.asarray(colour) for surface, u in zip(surfaces, cut, strict=True)]
    return Painted(parts, bake(list(zip(cut, shades, strict=True)), size=size))


def painted_object(stem: str, surface: Surface, colour: Sequence[float]) -> Object3D:
    """The object of one surface without texture, named after the file ``stem``; see ``painted_flat``."""
    name = safe_name(stem)
    painted, file = painted_flat([surface], colour), f"{name}_albedo.png"
    material = {surface.material: Material(surface.material, file)}
    return assemble(name, painted.parts, material, {file: encode_png(painted.picture)})


def _vertex_colours(surface: Surface) -> NDArray[np.float64]:
    if surface.colours is None:
        return np.ones((len(surface.vertices), 3))
    return linear_rgb(np.rint(np.clip(surface.colours, 0, 1) * 255).astype(np.uint8))


def _part(surface: Surface) -> Part:
    assert surface.uvs is not None
    return Part(surface.material, surface.vertices, surface.normals, surface.uvs, surface.faces)


def check_numbers(values: NDArray[np.floating], what: str) -> None:
    """Raise ``ObjectError`` for positions or texture coordinates that are not finite or beyond ``LARGEST``."""
    if not np.isfinite(values).all() or (values.size and np.abs(values).max() > LARGEST):
        raise ObjectError(f"{what} has numbers that are not finite or beyond {LARGEST:g}; positions are in metres.")


def assemble(
    name: str, parts: Sequence[Part], materials: Mapping[str, Material], files: Mapping[str, bytes]
) -> Object3D:
    """The object of these parts; ``files``: the images of ``materials``. Raises ``ObjectError``."""
    maps = ("albedo", "normal", "metallic")
    table = {
        key: {use: getattr(material, use) for use in maps}
        | ({} if material.opacity is None else {"opacity": material.opacity})
        for key, material in materials.items()
    }
    return object_from_files(
        {
            f"{name}.obj": obj_text(tuple(parts)).encode(),
            f"{name}_mat_def.json": json.dumps(table, indent=1).encode(),
            **files,
        }
    )
