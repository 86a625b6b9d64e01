"""Wavefront OBJ and MTL, as far as a textured object needs them.

trimesh drops the material names (and with them the UVs) of an OBJ whose .mtl is not beside it, which is how
SAILenv ships its objects; so the few statements that matter are read here, with errors that name the line.
"""

import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError

__all__ = [
    "LARGEST",
    "MAX_FACES",
    "Part",
    "Surface",
    "obj_text",
    "parse_mtl",
    "parse_obj",
    "parse_surfaces",
    "smooth_normals",
]

MAX_FACES: Final = 2_000_000
LARGEST: Final = 1e6
"""Coordinates (metres) and texture coordinates that are larger are no object's, and have no precision left."""
_WIDTHS: Final = {"v": 3, "vt": 2, "vn": 3}
MAX_LINE: Final = 2**20
"""Characters of a line; one polygon with a hundred thousand corners is within."""
MAX_LINES: Final = 20_000_000
"""Lines of a file; ten for each triangle are within."""
_LINE: Final = re.compile(r"[\r\n]{0,65536}([^\r\n]*)")
"""A line, after the end of the one before. Many empty lines are read in pieces: other threads have their turns."""


@dataclass(frozen=True)
class Part:
    """The triangles of one material.

    vertices: (V, 3) float32, metres.
    normals:  (V, 3) float32, unit length.
    uvs:      (V, 2) float32; v = 0 is the bottom row of the texture.
    faces:    (F, 3) int32, counter-clockwise seen from outside.
    """

    material: str
    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    uvs: NDArray[np.float32]
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class Surface:
    """A part that may lack texture coordinates.

    vertices, normals, faces: as of ``Part``.
    uvs:     as of ``Part``; ``None`` where a corner has none.
    colours: (V, 3) float32 in [0, 1], as written in the file; ``None`` where a vertex has none.
    """

    material: str
    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.int32]
    uvs: NDArray[np.float32] | None = None
    colours: NDArray[np.float32] | None = None


class _Reader:
    """Statements of one OBJ file, collected line by line."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.numbers = {kind: array("d") for kind in _WIDTHS}
        self.colours = array("d")
        self.corners: dict[str, array[int]] = {}
        self.material = "default"
        self._triangles = 0

    def read(self, text: str) -> None:
        for count, found in enumerate(_LINE.finditer(text)):  # a list of all lines takes many times the text
            line = found[1]
            if count == MAX_LINES:
                raise ObjectError(f"{self.file!r} has more than {MAX_LINES} lines; simplify the mesh.")
            if len(line) > MAX_LINE:
                raise ObjectError(
                    f"{self.file}, line {_number(found)} has {len(line)} characters; at most {MAX_LINE} are read. "
                    "Split its polygon into triangles."
                )
            words = line.split()
            if not words:
                continue
            try:
                self._statement(words, line)
            except (ValueError, IndexError) as error:
                raise ObjectError(
                    f"{self.file}, line {_number(found)}: {line.strip()[:80]!r} cannot be read ({error})."
                ) from error

    def _statement(self, words: list[str], line: str) -> None:
        if words[0] == "f":
            ring = [self._corner(word) for word in words[1:]]
            if len(ring) < 3:
                raise ValueError("a face needs three corners or more")
            self._triangles += len(ring) - 2
            if self._triangles > MAX_FACES:
                raise ObjectError(f"{self.file!r} has more than {MAX_FACES} triangles; simplify the mesh.")
            triangles = self.corners.setdefault(self.material, array("q"))
            for k in range(1, len(ring) - 1):
                triangles.extend(ring[0] + ring[k] + ring[k + 1])
        elif words[0] in self.numbers:
            size = _WIDTHS[words[0]]
            values = [float(word) for word in words[1 : size + 1]]
            if len(values) != size:
                raise ValueError(f"expected {size} numbers")
            self.numbers[words[0]].extend(values)
            if words[0] == "v" and len(words) >= 7:
                self.colours.extend([float(word) for word in words[-3:]])
        elif words[0] == "usemtl":
            self.material = line.split(maxsplit=1)[1].strip()

    def _corner(self, word: str) -> tuple[int, int, int]:
        fields = [*word.split("/"), "", ""][:3]
        return (self._index(fields[0], "v"), self._index(fields[1], "vt"), self._index(fields[2], "vn"))

    def _index(self, field: str, kind: str) -> int:
        """Zero-based index of a corner's field; -1 where it has none."""
        if field == "":
            return -1
        count, value = len(self.numbers[kind]) // _WIDTHS[kind], int(field)
        index = value - 1 if value > 0 else count + value
        if not 0 <= index < count:
            raise ValueError(f"{kind} {value} does not exist, {count} are defined so far")
        return index


def _number(line: re.Match[str]) -> int:
    """The number of a line, from 1, whether lines end with a line feed, a carriage return or both."""
    return 1 + max(line.string.count(end, 0, line.start(1)) for end in "\r\n")


def parse_obj(text: str, file: str) -> tuple[Part, ...]:
    """The parts of an OBJ text, one per material, in the order of first use.

    Polygons are split into fans. Raises ``ObjectError`` naming the line for what cannot be read, and for a mesh
    without triangles, without UVs or with absurd numbers.
    """
    return tuple(_part(surface, file) for surface in parse_surfaces(text, file))


def _part(surface: Surface, file: str) -> Part:
    if surface.uvs is None:
        raise ObjectError(
            f"{file!r}, material {surface.material!r}: faces without texture coordinates (vt); unwrap the mesh first."
        )
    return Part(surface.material, surface.vertices, surface.normals, surface.uvs, surface.faces)


def parse_surfaces(text: str, file: str) -> tuple[Surface, ...]:
    """As ``parse_obj``, but for meshes that need not have UVs, and with the colours of vertices, where all have one."""
    reader = _Reader(file)
    reader.read(text)
    if not reader.corners:
        raise ObjectError(f"{file!r} has no faces.")
    numbers = dict(reader.numbers)
    if len(reader.colours) == len(numbers["v"]):
        numbers["colour"] = reader.colours
    with np.errstate(over="ignore"):  # too large for single precision is too large
        arrays = {kind: _rows(values, _WIDTHS.get(kind, 3)).astype(np.float32) for kind, values in numbers.items()}
    for kind, values in arrays.items():
        if not np.isfinite(values).all():
            raise ObjectError(f"{file!r} has a {kind!r} statement with a number that is not finite.")
        if kind != "vn" and values.size and np.abs(values).max() > LARGEST:
            raise ObjectError(
                f"{file!r} has a {kind!r} statement with a number beyond {LARGEST:g}; positions are metres."
            )
    return tuple(_surface(material, corners, arrays) for material, corners in reader.corners.items())


def _rows(values: "array[float] | array[int]", width: int) -> NDArray[Any]:
    return np.array(values).reshape(-1, width)


def _surface(material: str, corners: "array[int]", arrays: dict[str, NDArray[np.float32]]) -> Surface:
    unique, inverse = np.unique(_rows(corners, 3), axis=0, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.int32)
    vertex, texture, given = unique.T
    smooth = smooth_normals(arrays["v"], vertex, faces)
    normals = smooth if given.min() < 0 else _normalised(arrays["vn"][given], fallback=smooth)
    uvs = arrays["vt"][texture] if texture.min() >= 0 else None
    colours = arrays["colour"][vertex] if "colour" in arrays else None
    return Surface(material, arrays["v"][vertex], normals, faces, uvs, colours)


def smooth_normals(
    positions: NDArray[np.float32], index: NDArray[np.int64], faces: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Area-weighted normals (V, 3) of vertices that stand at ``positions[index]``, shared by those at the same one.

    positions: (P, 3); index: (V,); faces: (F, 3) indices of vertices.
    """
    a, b, c = (positions[index[faces[:, k]]].astype(np.float64) for k in range(3))
    face_normals = np.cross(b - a, c - a)
    sums = np.zeros((len(positions), 3))
    for k in range(3):
        np.add.at(sums, index[faces[:, k]], face_normals)
    return _normalised(sums[index], fallback=np.tile([0.0, 1.0, 0.0], (len(index), 1)))


def _normalised(vectors: NDArray[np.floating], *, fallback: NDArray[np.floating]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors.astype(np.float64), axis=1, keepdims=True)
    return np.where(lengths > 1e-12, vectors / np.maximum(lengths, 1e-12), fallback).astype(np.float32)


def obj_text(parts: tuple[Part, ...], *, library: str | None = None) -> str:
    """An OBJ text from which ``parse_obj`` reads these parts, every number as it is; ``library`` names its .mtl."""
    return "".join(_statements(parts, library))


def _statements(parts: tuple[Part, ...], library: str | None) -> Iterator[str]:
    if library is not None:
        yield f"mtllib {library}\n"
    first = 1
    for part in parts:
        yield f"usemtl {part.material}\n"
        for kind, rows in (("v", part.vertices), ("vt", part.uvs), ("vn", part.normals)):
            line = f"{kind} " + " ".join(["%.9g"] * rows.shape[1]) + "\n"
            yield (line * len(rows)) % tuple(rows.reshape(-1).tolist())
        corners = np.repeat(part.faces.reshape(-1) + first, 3)
        yield ("f %d/%d/%d %d/%d/%d %d/%d/%d\n" * len(part.faces)) % tuple(corners.tolist())
        first += len(part.vertices)


def parse_mtl(text: str) -> dict[str, dict[str, str]]:
    """Maps of each material of an MTL text: ``{name: {"albedo": file, "normal": file}}``, files without folders."""
    keys = {"map_kd": "albedo", "map_bump": "normal", "bump": "normal", "norm": "normal"}
    materials: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for found in _LINE.finditer(text):
        words = found[1].split(maxsplit=1)
        if len(words) < 2:
            continue
        if words[0] == "newmtl":
            current = materials.setdefault(words[1].strip(), {})
        elif words[0].lower() in keys:
            # Options (-bm 1.0) stand before the file name, which is the last word; names with blanks have no options.
            name = words[1].strip() if not words[1].startswith("-") else words[1].split()[-1]
            current[keys[words[0].lower()]] = name.replace("\\", "/").rsplit("/", 1)[-1]
    return materials
