"""An object's surface as something that can move: its distinct positions, and what follows from them.

Corners at one position move together, across faces, materials and seams of the texture, so that nothing tears.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from trompe_shared.object3d import Object3D, object_from_files

__all__ = ["Shape", "shape_of", "with_vertices"]


@dataclass(frozen=True)
class Shape:
    """The surface of an object at rest. Faces are in the order of ``mesh_of``; float64, metres.

    corners: the position of each corner. outwards: the unit normal of each position, zero where there is none.
    normal: which of ``normals`` each corner is shaded with; these (unit length) are the authored ones, told apart by
    position. pairs: positions joined by an edge, both ways.
    """

    positions: Float[Tensor, "positions 3"]
    corners: Int[Tensor, "faces 3"]
    outwards: Float[Tensor, "positions 3"]
    normal: Int[Tensor, "faces 3"]
    normals: Float[Tensor, "normals 3"]
    pairs: Int[Tensor, "2 edges"]

    def moved(self, heights: Float[Tensor, " positions"]) -> Float[Tensor, "positions 3"]:
        """The positions, each ``heights`` metres outwards. Differentiable."""
        return self.positions + heights[:, None] * self.outwards

    def shaded(self, positions: Float[Tensor, "positions 3"]) -> Float[Tensor, "normals 3"]:
        """The unit normals that the surface is shaded with when it has moved to ``positions``. Differentiable.

        Each turns as the mean normal of the faces around it that share it does: hard edges stay hard, smooth stay
        smooth, and what has not moved keeps the normal that it was given.
        """
        turn = self._means(positions) - self._means(self.positions)
        return normalize(self.normals + turn, dim=1)

    def _means(self, positions: Float[Tensor, "positions 3"]) -> Float[Tensor, "normals 3"]:
        """Unit normals by area of the faces that share each of ``normals``."""
        faces = _face_normals(positions[self.corners]).repeat_interleave(3, 0)
        summed = positions.new_zeros(len(self.normals), 3).index_add(0, self.normal.flatten(), faces)
        return normalize(summed, dim=1)

    def smoothed(self, field: Float[Tensor, " positions"], rounds: int) -> Float[Tensor, " positions"]:
        """``field``, ``rounds`` times half replaced by the mean of its neighbours. Differentiable.

        No value leaves the range of the field's, so that a bound on it bounds the result.
        """
        start, end = self.pairs
        degree = field.new_zeros(len(field)).index_add(0, start, field.new_ones(len(start)))
        for _ in range(rounds):
            around = field.new_zeros(len(field)).index_add(0, start, field[end]) / degree.clamp(min=1)
            field = torch.where(degree > 0, (field + around) / 2, field)
        return field


def shape_of(obj: Object3D) -> Shape:
    """The surface of ``obj``."""
    vertices = np.concatenate([part.vertices[part.faces] for part in obj.parts]).reshape(-1, 3)
    authored = np.concatenate([part.normals[part.faces] for part in obj.parts]).reshape(-1, 3)
    positions, corner = np.unique(vertices + np.float32(0), axis=0, return_inverse=True)  # -0.0 is 0.0
    keyed = np.column_stack([corner.reshape(-1).astype(np.float64), authored + np.float32(0)])
    groups, group = np.unique(keyed, axis=0, return_inverse=True)
    corners = torch.from_numpy(corner.reshape(-1, 3))
    places = torch.from_numpy(positions.astype(np.float64))
    around = _face_normals(places[corners]).repeat_interleave(3, 0)
    outwards = normalize(torch.zeros_like(places).index_add(0, corners.flatten(), around), dim=1)
    edges = torch.cat([corners[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2))]).T
    pairs = torch.unique(edges[:, edges[0] != edges[1]], dim=1)
    normals = normalize(torch.from_numpy(groups[:, 1:].copy()), dim=1)
    return Shape(places, corners, outwards, torch.from_numpy(group.reshape(-1, 3)), normals, pairs)


def _face_normals(triangles: Float[Tensor, "faces 3 3"]) -> Float[Tensor, "faces 3"]:
    """Normals of triangles, twice their area long."""
    return (triangles[:, 1] - triangles[:, 0]).cross(triangles[:, 2] - triangles[:, 0], dim=1)


def with_vertices(obj: Object3D, shape: Shape, heights: Float[Tensor, " positions"]) -> Object3D:
    """``obj`` with the positions of its ``shape`` moved outwards by ``heights`` (metres), and its OBJ rewritten so.

    Faces, texture coordinates, materials and all other lines stay as they are; positions are written such that they are
    read back to the last bit. Normals are turned as ``Shape.shaded`` says where the file has any. ``obj`` itself where
    nothing moves.
    """
    if not bool((heights * shape.outwards.norm(dim=1)).any()):
        return obj
    places = shape.moved(heights)
    name = next(name for name in obj.files if name.lower().endswith(".obj"))
    text = obj.files[name].decode("utf-8", "surrogateescape")
    rewritten = "".join(_rewritten(text, obj, shape, places, shape.shaded(places)))
    return object_from_files({**obj.files, name: rewritten.encode("utf-8", "surrogateescape")})


def _rewritten(text: str, obj: Object3D, shape: Shape, places: Tensor, normals: Tensor) -> Iterator[str]:
    """The lines of an OBJ file with other positions and normals."""
    lines = text.splitlines(keepends=True)
    rings = _rings(lines, obj, shape)
    position_of = {vertex: position for ring in rings.values() for vertex, position, _ in ring}
    written: dict[int, int] = {}
    vertex = -1
    for number, line in enumerate(lines):
        words = line.split()
        kind = words[0] if words else ""
        if kind == "v":
            vertex += 1
            position = position_of.get(vertex)
            stays = position is None or torch.equal(places[position], shape.positions[position])
            yield line if stays else f"v {_numbers(places[position])}{''.join(f' {word}' for word in words[4:])}\n"
        elif kind == "f":
            yield from _face(words, rings[number], normals, written)
        elif kind != "vn":
            yield line


Ring = list[tuple[int, int, int]]
"""Of each corner of a polygon: vertex in the file, position, normal."""


def _rings(lines: list[str], obj: Object3D, shape: Shape) -> dict[int, Ring]:
    """What the corners of the face in each line are, by the line's number.

    The file's faces of a material, in order and cut into fans, are those of its part.
    """
    first, total = {}, 0
    for part in obj.parts:
        first[part.material], total = total, total + len(part.faces)
    corners, normals = shape.corners.tolist(), shape.normal.tolist()
    rings: dict[int, Ring] = {}
    vertices, material = 0, "default"
    for number, line in enumerate(lines):
        words = line.split()
        kind = words[0] if words else ""
        if kind == "v":
            vertices += 1
        elif kind == "usemtl":
            material = line.split(maxsplit=1)[1].strip().encode("utf-8", "surrogateescape").decode("utf-8", "replace")
        elif kind == "f":
            start, count = first[material], len(words) - 3
            first[material] += count
            places = [(start, 0), (start, 1), *((start + k, 2) for k in range(count))]
            indices = [int(word.split("/")[0]) for word in words[1:]]
            rings[number] = [
                (index - 1 if index > 0 else vertices + index, corners[face][corner], normals[face][corner])
                for index, (face, corner) in zip(indices, places, strict=True)
            ]
    return rings


def _face(words: list[str], ring: Ring, normals: Tensor, written: dict[int, int]) -> Iterator[str]:
    """A face, after those of its normals that have not been ``written`` yet (their numbers in the file, from 1)."""
    corners = []
    for word, (_, _, normal) in zip(words[1:], ring, strict=True):
        fields = word.split("/")
        if len(fields) > 2 and fields[2]:
            if normal not in written:
                written[normal] = len(written) + 1
                yield f"vn {_numbers(normals[normal])}\n"
            fields[2] = str(written[normal])
        corners.append("/".join(fields))
    yield f"f {' '.join(corners)}\n"


def _numbers(vector: Float[Tensor, " 3"]) -> str:
    """The shortest decimals that are read back to the same single-precision numbers."""
    single: NDArray[np.float32] = vector.numpy().astype(np.float32)
    return " ".join(np.format_float_positional(value, unique=True, trim="0") for value in single)
