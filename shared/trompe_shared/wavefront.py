"""Wavefront OBJ and MTL: the statements of a textured mesh, with errors that name the line.

SAILenv ships OBJ files without an .mtl. Material names, and every number as written, must survive for a repaint that
changes nothing else.
"""

import re
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError
from trompe_shared.local_files import base_name
from trompe_shared.polygons import unfold

MAX_FACES: Final = 2_000_000
LARGEST: Final = 1e6
"""Largest coordinate (metres) and texture coordinate."""
NO_MATERIAL: Final = "default"
"""Material of faces without one."""
_WIDTHS: Final = {"v": 3, "vt": 2, "vn": 3}
MAX_LINE: Final = 2**20
"""Characters of a line: enough for a polygon with a hundred thousand corners."""
MAX_LINES: Final = 20_000_000
"""Lines of a file: ten for each triangle."""
_LINE: Final = re.compile(r"[\r\n]{0,65536}([^\r\n]*)")
"""The end of a line and the next line. The bound on empty lines lets other threads run."""
_CONTINUED: Final = re.compile(r"\\[ \t]*(?:\r\n|\r|\n)")
_LONG: Final = re.compile(rf"(?<![^\r\n])[fv][^\r\n#\\]*(?:{_CONTINUED.pattern}[^\r\n#\\]*)+")
"""A statement of numbers that a backslash continues on the next line; comments may end in one, too."""
_JOINT: Final = " \v"
"""Stands for the end of a continued line, so that lines can be counted."""
_NUMBER: Final = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_OPTION: Final = re.compile(
    r"-(?:(?:blend[uv]|boost|bm|cc|clamp|imfchan|texres|type)\s+\S+|mm\s+\S+\s+\S+|"
    rf"[ost](?:\s+{_NUMBER}(?=\s)){{1,3}})\s+",
    re.IGNORECASE,
)
"""An option before the file name of a map, with its values."""


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
    """A part, possibly without texture coordinates.

    vertices, normals, faces: as in ``Part``.
    uvs:     as in ``Part``; ``None`` if any corner has none.
    colours: (V, 3) float32 in [0, 1], up to rounding; ``None`` if any vertex has none.
    """

    material: str
    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.int32]
    uvs: NDArray[np.float32] | None = None
    colours: NDArray[np.float32] | None = None


FLAT: Final = -2
"""Index of the normal of a first flat polygon, instead of none (-1); each has its own."""


class _Reader:
    def __init__(self, file: str) -> None:
        self.file = file
        self.numbers = {kind: array("d") for kind in _WIDTHS}
        self.colours = array("d")
        self.corners: dict[str, array[int]] = {}
        self.fans: dict[str, array[int]] = {}
        """The first triangle and the number of triangles of each larger polygon of a material."""
        self.material = NO_MATERIAL
        self.flat = False
        """Whether faces without normals are flat: smoothing is off."""
        self._triangles = 0

    def read(self, text: str) -> None:
        if _CONTINUED.search(text):
            text = _LONG.sub(lambda statement: _CONTINUED.sub(_JOINT, statement[0]), text)
        for count, found in enumerate(_LINE.finditer(text)):  # a list of all lines would take many times the memory
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
        if words[0] != "usemtl" and "#" in line:  # names may contain it
            words = line.split("#")[0].split() or ["#"]
        if words[0] == "f":
            ring = [self._corner(word) for word in words[1:]]
            if self.flat:
                ring = [(v, vt, FLAT - self._triangles if vn < 0 else vn) for v, vt, vn in ring]
            if len(ring) < 3:
                raise ValueError("a face needs three corners or more")
            self._triangles += len(ring) - 2
            if self._triangles > MAX_FACES:
                raise ObjectError(f"{self.file!r} has more than {MAX_FACES} triangles; simplify the mesh.")
            triangles = self.corners.setdefault(self.material, array("q"))
            if len(ring) > 3:
                self.fans.setdefault(self.material, array("q")).extend((len(triangles) // 9, len(ring) - 2))
            for k in range(1, len(ring) - 1):
                triangles.extend(ring[0] + ring[k] + ring[k + 1])
        elif words[0] in self.numbers:
            size = _WIDTHS[words[0]]
            values = [float(word) for word in words[1 : size + 1]]
            if words[0] == "vt" and len(values) == 1:
                values.append(0.0)
            if len(values) != size:
                raise ValueError(f"expected {size} numbers")
            self.numbers[words[0]].extend(values)
            if words[0] == "v" and len(words) >= 7:
                self.colours.extend([float(word) for word in words[-3:]])
        elif words[0] == "s":
            self.flat = words[1:2] in (["off"], ["0"])
        elif words[0] == "usemtl":
            self.material = line.strip()[len("usemtl") :].strip() or NO_MATERIAL

    def _corner(self, word: str) -> tuple[int, int, int]:
        fields = [*word.split("/"), "", ""][:3]
        return (self._index(fields[0], "v"), self._index(fields[1], "vt"), self._index(fields[2], "vn"))

    def _index(self, field: str, kind: str) -> int:
        """Zero-based index of a corner's field; -1 for an empty field."""
        if field == "":
            return -1
        count, value = len(self.numbers[kind]) // _WIDTHS[kind], int(field)
        index = value - 1 if value > 0 else count + value
        if not 0 <= index < count:
            raise ValueError(f"{kind} {value} does not exist, {count} are defined so far")
        return index


def _number(line: re.Match[str]) -> int:
    """The number of a line, from 1, for all kinds of line ends."""
    text, end = line.string, line.start(1)
    return 1 + max(text.count(mark, 0, end) for mark in "\r\n") + text.count(_JOINT, 0, end)


def parse_obj(text: str, file: str) -> tuple[Part, ...]:
    """The parts of an OBJ text, one per material, in the order of first use. Polygons are split into triangles.

    Raises ``ObjectError`` for an unreadable line, and for a mesh without triangles, without UVs or with absurd numbers.
    """
    return tuple(textured(surface, file) for surface in parse_surfaces(text, file))


def textured(surface: Surface, file: str) -> Part:
    """The surface as a part. Raises ``ObjectError`` if it has no texture coordinates."""
    if surface.uvs is None:
        raise ObjectError(
            f"{file!r}, material {surface.material!r} has a texture, but faces without texture coordinates (vt); "
            "unwrap the mesh in a modelling program."
        )
    return Part(surface.material, surface.vertices, surface.normals, surface.uvs, surface.faces)


def parse_surfaces(text: str, file: str) -> tuple[Surface, ...]:
    """As ``parse_obj``, also for meshes without UVs, and with vertex colours if all vertices have one."""
    reader = _Reader(file)
    reader.read(text)
    if not reader.corners:
        raise ObjectError(f"{file!r} has no faces ('f' lines); export the mesh with its faces, not only its points.")
    numbers = dict(reader.numbers)
    if len(reader.colours) == len(numbers["v"]):
        numbers["colour"] = reader.colours
    with np.errstate(over="ignore"):  # infinite in single precision is refused below
        arrays = {kind: _rows(values, _WIDTHS.get(kind, 3)).astype(np.float32) for kind, values in numbers.items()}
    for kind, values in arrays.items():
        if kind == "vn":
            continue  # triangles without area have any normals
        if not np.isfinite(values).all():
            raise ObjectError(f"{file!r} has a {kind!r} statement with a number that is not finite.")
        if values.size and np.abs(values).max() > LARGEST:
            raise ObjectError(
                f"{file!r} has a {kind!r} statement with a number beyond {LARGEST:g}; positions are metres, objects "
                "lie near the origin."
            )
    if "colour" in arrays:
        arrays["colour"] = in_unit(arrays["colour"])
    return tuple(
        _surface(material, corners, reader.fans.get(material, array("q")), arrays)
        for material, corners in reader.corners.items()
    )


def in_unit(colours: NDArray[np.float32]) -> NDArray[np.float32]:
    """Colours (V, 3) as written, up to 1 or up to 255, as numbers up to 1; a little more is a rounding error."""
    return colours / np.float32(255) if colours.max() > 2 else colours


def _rows(values: "array[float] | array[int]", width: int) -> NDArray[Any]:
    return np.array(values).reshape(-1, width)


def _surface(
    material: str, corners: "array[int]", fans: "array[int]", arrays: dict[str, NDArray[np.float32]]
) -> Surface:
    rows = _rows(corners, 3)
    unfold(rows.reshape(-1, 3, 3), arrays["v"], _rows(fans, 2))
    unique, inverse = np.unique(rows, axis=0, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.int32)
    vertex, texture, given = unique.T
    smooth = smooth_normals(arrays["v"], vertex, faces)
    if (flat := given <= FLAT).any():
        own = smooth_normals(arrays["v"][vertex], np.arange(len(vertex)), faces)  # each flat polygon has its vertices
        smooth = np.where(flat[:, None], own, smooth)
    normals = smooth if given.min() < 0 else _normalised(arrays["vn"][given], fallback=smooth)
    uvs = arrays["vt"][texture] if texture.min() >= 0 else None
    colours = arrays["colour"][vertex] if "colour" in arrays else None
    return Surface(material, arrays["v"][vertex], normals, faces, uvs, colours)


def smooth_normals(
    positions: NDArray[np.float32], index: NDArray[np.int64], faces: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Area-weighted normals (V, 3) of vertices at ``positions[index]``; vertices at one position share a normal.

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
    sound = (lengths > 1e-12) & np.isfinite(lengths)
    return np.where(sound, vectors / np.where(sound, lengths, 1), fallback).astype(np.float32)


def obj_text(parts: tuple[Part, ...], *, libraries: Iterable[str] = ()) -> str:
    """An OBJ text that ``parse_obj`` reads as exactly these parts; ``libraries`` are its MTL files."""
    return "".join(_statements(parts, libraries))


def _statements(parts: tuple[Part, ...], libraries: Iterable[str]) -> Iterator[str]:
    for library in libraries:
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


def area(uvs: NDArray[np.float32], faces: NDArray[np.int32]) -> float:
    """Area of triangles (F, 3) of texture coordinates (V, 2); that of the texture is 1."""
    a, b, c = np.moveaxis(uvs[faces].astype(np.float64), 1, 0)
    return float(np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1))).sum() / 2)


def beyond_edges(uvs: NDArray[np.float32]) -> bool:
    """Whether texture coordinates (V, 2) leave [0, 1], so that it matters how a texture goes on there."""
    return bool(uvs.min() < -1e-3 or uvs.max() > 1 + 1e-3)


def parse_mtl(text: str) -> dict[str, dict[str, str]]:
    """Maps of each material of an MTL text: ``{name: {"albedo": file, "normal": file}}``, files without folders.

    ``bump`` maps normals or heights. Transparent materials have ``map_d`` (a file), ``d`` or ``tr`` (numbers), too;
    see ``dissolve``. An albedo that does not repeat has ``clamp``. Raises ``ObjectError`` for a map that is scaled or
    moved.
    """
    keys = {"map_kd": "albedo", "map_bump": "bump", "bump": "bump", "norm": "normal", "map_kn": "normal"}
    keys |= {key: key for key in ("map_d", "d", "tr")}
    materials: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for found in _LINE.finditer(text):
        words = found[1].split(maxsplit=1)
        if len(words) < 2:
            continue
        if words[0] == "newmtl":
            current = materials.setdefault(words[1].strip(), {})
        elif words[0].lower() in keys:
            options, name = _split(words[1].strip())
            if _moves(options):
                raise ObjectError(
                    f"The MTL scales or moves the texture {name!r} ({words[1].strip()[:80]}), which is not supported; "
                    "apply that to the texture coordinates in a modelling program."
                )
            if words[0].lower() == "map_kd" and _brightens(options):
                raise ObjectError(
                    f"The MTL changes the levels of the texture {name!r} ({words[1].strip()[:80]}), which is not "
                    "supported; change the picture itself."
                )
            current[keys[words[0].lower()]] = base_name(name)
            if words[0].lower() == "map_kd" and re.search(r"-clamp\s+on\s", options.lower()):
                current["clamp"] = "on"
    return materials


def _split(words: str) -> tuple[str, str]:
    """(Options, file name) of a map. The name may contain blanks, but not after options unknown here."""
    start = 0
    while (option := _OPTION.match(words, start)) is not None:
        start = option.end()
    if words.startswith("-", start):
        start = len(words) - len(words.split()[-1])
    return words[:start], words[start:]


def _moves(options: str) -> bool:
    """Whether the options of a map change its scale (``-s``, by default 1 1 1) or its place (``-o``, 0 0 0)."""
    given = re.findall(rf"-([so])((?:\s+{_NUMBER})+)", options.lower())
    return any(float(number) != (flag == "s") for flag, numbers in given for number in numbers.split())


def _brightens(options: str) -> bool:
    """Whether the options of a map give its levels a base (``-mm``, by default 0) or a gain (1)."""
    given = re.findall(rf"-mm\s+({_NUMBER})\s+({_NUMBER})", options.lower())
    return any((float(base), float(gain)) != (0, 1) for base, gain in given)


def dissolve(maps: Mapping[str, str], material: str) -> float | None:
    """Opacity in (0, 1] of a blended material with ``maps`` of ``parse_mtl``; ``None`` for an opaque one.

    ``d`` is opacity and ``Tr`` is 1 - opacity. An opacity of 0 counts as 1: some programs write ``Tr 1`` (MeshLab) or
    ``d 0`` for solid materials. Raises ``ObjectError``.
    """
    try:
        given = float(maps["d"]) if "d" in maps else 1 - float(maps.get("tr", "0"))
    except ValueError as error:
        raise ObjectError(f"Material {material!r}: its d or Tr is not a number ({error}); expected 0 to 1.") from error
    opacity = min(max(0.0, given), 1.0) or 1.0
    return opacity if opacity < 1 or "map_d" in maps else None
