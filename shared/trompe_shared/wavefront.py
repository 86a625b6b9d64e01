"""Wavefront OBJ and MTL, as far as a textured object needs them.

trimesh drops the material names (and with them the UVs) of an OBJ whose .mtl is not beside it, which is how
SAILenv ships its objects; so the few statements that matter are read here, with errors that name the line.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError

__all__ = ["Part", "parse_mtl", "parse_obj"]


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


class _Reader:
    """Statements of one OBJ file, collected line by line."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.numbers: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
        self.corners: dict[str, list[tuple[int, int, int]]] = {}
        self.material = "default"

    def read(self, text: str) -> None:
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.split()
            if not words:
                continue
            try:
                self._statement(words, line)
            except (ValueError, IndexError) as error:
                raise ObjectError(
                    f"{self.file}, line {number}: {line.strip()[:80]!r} cannot be read ({error})."
                ) from error

    def _statement(self, words: list[str], line: str) -> None:
        if words[0] == "f":
            ring = [self._corner(word) for word in words[1:]]
            if len(ring) < 3:
                raise ValueError("a face needs three corners or more")
            triangles = self.corners.setdefault(self.material, [])
            for k in range(1, len(ring) - 1):
                triangles += [ring[0], ring[k], ring[k + 1]]
        elif words[0] in self.numbers:
            size = 2 if words[0] == "vt" else 3
            values = [float(word) for word in words[1 : size + 1]]
            if len(values) != size:
                raise ValueError(f"expected {size} numbers")
            self.numbers[words[0]].append(values)
        elif words[0] == "usemtl":
            self.material = line.split(maxsplit=1)[1].strip()

    def _corner(self, word: str) -> tuple[int, int, int]:
        fields = [*word.split("/"), "", ""][:3]
        return (self._index(fields[0], "v"), self._index(fields[1], "vt"), self._index(fields[2], "vn"))

    def _index(self, field: str, kind: str) -> int:
        """Zero-based index of a corner's field; -1 where it has none."""
        if field == "":
            return -1
        count, value = len(self.numbers[kind]), int(field)
        index = value - 1 if value > 0 else count + value
        if not 0 <= index < count:
            raise ValueError(f"{kind} {value} does not exist, {count} are defined so far")
        return index


def parse_obj(text: str, file: str) -> tuple[Part, ...]:
    """The parts of an OBJ text, one per material, in the order of first use.

    Polygons are split into fans. Raises ``ObjectError`` naming the line for what cannot be read, and for a mesh
    without triangles, without UVs or with non-finite numbers.
    """
    reader = _Reader(file)
    reader.read(text)
    if not reader.corners:
        raise ObjectError(f"{file!r} has no faces.")
    with np.errstate(over="ignore"):  # too large for single precision is not finite, and refused as such
        arrays = {kind: np.asarray(rows, dtype=np.float32) for kind, rows in reader.numbers.items()}
    for kind, values in arrays.items():
        if not np.isfinite(values).all():
            raise ObjectError(f"{file!r} has a {kind!r} statement with a number that is not finite.")
    return tuple(_part(material, corners, arrays, file) for material, corners in reader.corners.items())


def _part(
    material: str, corners: list[tuple[int, int, int]], arrays: dict[str, NDArray[np.float32]], file: str
) -> Part:
    unique, inverse = np.unique(np.asarray(corners, dtype=np.int64), axis=0, return_inverse=True)
    if unique[:, 1].min() < 0:
        raise ObjectError(
            f"{file!r}, material {material!r}: faces without texture coordinates (vt); unwrap the mesh first."
        )
    faces = inverse.reshape(-1, 3).astype(np.int32)
    vertices = arrays["v"][unique[:, 0]]
    given = unique[:, 2]
    smooth = _smooth_normals(arrays["v"], unique[:, 0], faces)
    normals = smooth if given.min() < 0 else _normalised(arrays["vn"][given], fallback=smooth)
    return Part(material, vertices, normals, arrays["vt"][unique[:, 1]], faces)


def _smooth_normals(
    positions: NDArray[np.float32], index: NDArray[np.int64], faces: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Area-weighted vertex normals (V, 3), shared by corners at the same position index."""
    a, b, c = (positions[index[faces[:, k]]].astype(np.float64) for k in range(3))
    face_normals = np.cross(b - a, c - a)
    sums = np.zeros((len(positions), 3))
    for k in range(3):
        np.add.at(sums, index[faces[:, k]], face_normals)
    return _normalised(sums[index], fallback=np.tile([0.0, 1.0, 0.0], (len(index), 1)))


def _normalised(vectors: NDArray[np.floating], *, fallback: NDArray[np.floating]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, vectors / np.maximum(lengths, 1e-12), fallback).astype(np.float32)


def parse_mtl(text: str) -> dict[str, dict[str, str]]:
    """Maps of each material of an MTL text: ``{name: {"albedo": file, "normal": file}}``, files without folders."""
    keys = {"map_kd": "albedo", "map_bump": "normal", "bump": "normal", "norm": "normal"}
    materials: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        words = line.split(maxsplit=1)
        if len(words) < 2:
            continue
        if words[0] == "newmtl":
            current = materials.setdefault(words[1].strip(), {})
        elif words[0].lower() in keys:
            # Options (-bm 1.0) stand before the file name, which is the last word; names with blanks have no options.
            name = words[1].strip() if not words[1].startswith("-") else words[1].split()[-1]
            current[keys[words[0].lower()]] = name.replace("\\", "/").rsplit("/", 1)[-1]
    return materials
