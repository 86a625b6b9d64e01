"""Assemble surfaces, materials and images to an object in SAILenv's format; find what a repaint changed of one."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.pictures import Pixels, encode_srgb, linear_rgb, shrink
from trompe_server.formats.unwrap import BAKED_SIDE, bake, laid_out, unwrap
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


def painted_flat(surface: Surface, colour: Sequence[float]) -> tuple[Part, Pixels]:
    """A surface without texture with its generated one; unwrapped if it lacks UVs with area or has vertex colours.

    colour: linear; multiplies the vertex colours, which are sRGB-encoded in [0, 1].
    """
    if surface.colours is None and surface.uvs is not None and laid_out(surface.uvs, surface.faces):
        part = Part(surface.material, surface.vertices, surface.normals, surface.uvs, surface.faces)
        return part, flat_picture(colour)
    (cut,), size = unwrap([(surface.vertices, surface.faces)])
    part = Part(surface.material, surface.vertices[cut.source], surface.normals[cut.source], cut.uvs, cut.faces)
    if surface.colours is None:
        return part, flat_picture(colour, size)
    shades = linear_rgb(np.rint(np.clip(surface.colours, 0, 1) * 255).astype(np.uint8))
    return part, bake([(cut, shades[cut.source] * np.asarray(colour))], size=size)


def painted_object(stem: str, surface: Surface) -> Object3D:
    """The object of one surface in its vertex colours, or else light grey, named after the file ``stem``."""
    name = safe_name(stem)
    colour = DEFAULT_COLOUR if surface.colours is None else (1.0, 1.0, 1.0)
    (part, picture), file = painted_flat(surface, colour), f"{name}_albedo.png"
    return assemble(name, [part], {part.material: Material(part.material, file)}, {file: encode_png(picture)})


def check_numbers(values: NDArray[np.floating], what: str) -> None:
    """Raise ``ObjectError`` for positions or texture coordinates that are not finite or beyond ``LARGEST``."""
    if not np.isfinite(values).all() or (values.size and np.abs(values).max() > LARGEST):
        raise ObjectError(
            f"{what} has numbers that are not finite or beyond {LARGEST:g}; positions are metres, objects lie near the "
            "origin."
        )


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


def repainted(original: Object3D, painted: Object3D) -> dict[str, Pixels]:
    """The textures (H, W, 3) of ``painted``, by name, with colours different from ``original``.

    Raises ``ObjectError`` if the meshes differ.
    """
    if _mesh(original) != _mesh(painted) or original.textures.keys() != painted.textures.keys():
        raise ObjectError(
            f"The mesh of {painted.name!r} is not the uploaded one (it was moved, or read by another version of "
            "Trompe), so its paint does not fit the uploaded file. Take the zip or the GLB, or upload it again."
        )
    before = {name: shrink(original.textures[name], max(image.shape[:2])) for name, image in painted.textures.items()}
    return {name: image for name, image in painted.textures.items() if not np.array_equal(before[name], image)}


def _mesh(obj: Object3D) -> list[bytes]:
    return [data for name, data in obj.files.items() if name.lower().endswith(".obj")]
