"""PLY: triangles with normals, colours or texture coordinates at their vertices, text or binary.

A texture is named as MeshLab and others do it: ``comment TextureFile picture.png``, with properties ``s`` and ``t``.
"""

import re
import struct
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import (
    DEFAULT_COLOUR,
    assemble,
    check_numbers,
    free_name,
    painted_flat,
    safe_name,
)
from trompe_server.formats.comparison import repainted
from trompe_server.formats.pictures import decode, with_alpha_of
from trompe_server.formats.upload import Upload
from trompe_server.formats.wavefront import shrunk
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Material, Object3D, encode_png
from trompe_shared.wavefront import MAX_FACES, Part, Surface, smooth_normals

__all__ = ["read", "repaint"]

MAX_HEADER: Final = 2**16
MATERIAL: Final = "surface"
TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Element:
    """Rows of a kind: ``properties`` are (name, type), of a list (name, type of its length, type of its items)."""

    name: str
    count: int
    properties: list[tuple[str, ...]]


@dataclass(frozen=True)
class _Header:
    order: str
    elements: list[_Element]
    texture: str | None
    length: int


def read(upload: Upload, max_texture: int | None = None) -> Object3D:
    """The object of a PLY and the texture beside it. Raises ``ObjectError``."""
    return shrunk(_read(upload), max_texture)


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """``upload`` with the texture of ``painted``: its file replaced, or a PLY that names one where there was none."""
    original = _read(upload)
    changed = repainted(original, painted)
    if not changed:
        return upload
    ((name, rgb),) = changed.items()
    texture = _header(upload.data).texture
    if texture is not None:
        path = upload.beside(texture)
        alpha = decode(upload.files[path], texture)[1]
        return Upload(upload.main, {**upload.files, path: with_alpha_of(rgb, alpha)}, upload.packed)
    (part,) = original.parts
    place = free_name(name, upload.flat())
    return upload.with_flat({upload.main.rsplit("/", 1)[-1]: _written(part, place), place: encode_png(rgb)})


def _read(upload: Upload) -> Object3D:
    name = safe_name(upload.stem)
    header = _header(upload.data)
    surface = _surface(upload.data, header)
    if header.texture is not None and surface.uvs is not None:
        file = safe_name(header.texture, default="texture.png")
        part = Part(MATERIAL, surface.vertices, surface.normals, surface.uvs, surface.faces)
        picture = upload.files[upload.beside(header.texture)]
        return assemble(name, [part], {MATERIAL: Material(MATERIAL, file)}, {file: picture})
    painted = painted_flat([surface], DEFAULT_COLOUR if surface.colours is None else (1.0, 1.0, 1.0))
    file = f"{name}_albedo.png"
    return assemble(name, painted.parts, {MATERIAL: Material(MATERIAL, file)}, {file: encode_png(painted.picture)})


def _header(data: bytes) -> _Header:
    found = re.match(rb"ply\r?\n.*?^end_header\r?\n", data[:MAX_HEADER], re.DOTALL | re.MULTILINE)
    if found is None:
        raise ObjectError("The PLY file has no header that ends; save it again.")
    order, elements, texture = None, [], None
    for line in found[0].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:2] == ["comment", "TextureFile"]:
            texture = line.split(maxsplit=2)[2].strip() if len(words) > 2 else None
        try:
            if words[:1] == ["format"]:
                order = ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_property(words))
        except (KeyError, IndexError, ValueError) as error:
            raise ObjectError(f"The PLY's header has {line[:80]!r}, which is not read; save it again.") from error
    if order is None or any(not 0 <= element.count <= 3 * MAX_FACES for element in elements):
        raise ObjectError(f"The PLY's header names no format, or more than {3 * MAX_FACES} rows; simplify the mesh.")
    return _Header(order, elements, texture, len(found[0]))


def _property(words: list[str]) -> tuple[str, ...]:
    if words[1] == "list":
        return words[4], TYPES[words[2]], TYPES[words[3]]
    return words[2], TYPES[words[1]]


def _surface(data: bytes, header: _Header) -> Surface:
    try:
        rows = _text_rows(data, header) if header.order == "" else _binary_rows(data, header)
    except (ValueError, IndexError, struct.error) as error:
        raise ObjectError(
            f"The PLY file ends too early or holds what is no number ({error}); save it again."
        ) from error
    vertex, polygons = _of(header, rows, "vertex", length=2), _of(header, rows, "face", length=3)
    corners = polygons.get("vertex_indices", polygons.get("vertex_index"))
    if not {"x", "y", "z"} <= vertex.keys() or corners is None or not len(vertex["x"]):
        raise ObjectError("The PLY holds no mesh: it needs vertices with x, y, z, and faces with vertex_indices.")
    faces = _fans(corners, len(vertex["x"]))
    vertices = _columns(vertex, "x", "y", "z")
    assert vertices is not None
    uvs = next(
        (
            u
            for names in (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
            if (u := _columns(vertex, *names)) is not None
        ),
        None,
    )
    for values in (vertices, uvs):
        if values is not None:
            check_numbers(values, "The PLY")
    normals = _columns(vertex, "nx", "ny", "nz")
    if normals is None or not np.isfinite(normals).all():
        normals = smooth_normals(vertices, np.arange(len(vertices)), faces)
    return Surface(MATERIAL, vertices, normals, faces, uvs, _colours(vertex))


def _of(header: _Header, rows: dict[str, dict[str, Any]], name: str, *, length: int) -> dict[str, Any]:
    """Columns of an element that are plain (``length`` 2), or lists of whole numbers (3)."""
    element = next((element for element in header.elements if element.name == name), None)
    properties = element.properties if element is not None else []
    wanted = {prop[0] for prop in properties if len(prop) == length and (length == 2 or prop[2][0] in "iu")}
    return {key: values for key, values in rows.get(name, {}).items() if key in wanted}


def _columns(rows: dict[str, Any], *names: str) -> NDArray[np.float32] | None:
    if not set(names) <= rows.keys():
        return None
    with np.errstate(over="ignore"):  # too large for single precision is refused as such
        return np.stack([np.asarray(rows[name], np.float64) for name in names], axis=1).astype(np.float32)


def _colours(rows: dict[str, Any]) -> NDArray[np.float32] | None:
    colours = _columns(rows, "red", "green", "blue")
    if colours is None:
        return None
    whole = np.asarray(rows["red"]).dtype.kind in "iu" or colours.max() > 1.0
    return np.nan_to_num(colours / 255 if whole else colours)


def _fans(polygons: Any, count: int) -> NDArray[np.int32]:
    """Triangles (F, 3) of polygons: an array (F, corners), or a list of arrays."""
    rings = [polygons] if isinstance(polygons, np.ndarray) else [np.asarray(ring)[None] for ring in polygons]
    fans = [
        np.stack([ring[:, 0], ring[:, k], ring[:, k + 1]], axis=1)
        for ring in rings
        for k in range(1, ring.shape[1] - 1)
    ]
    faces = np.concatenate(fans) if fans else np.zeros((0, 3), np.int64)
    if not len(faces) or len(faces) > MAX_FACES:
        raise ObjectError(f"The PLY has {len(faces)} triangles; from 1 to {MAX_FACES} are read.")
    if faces.min() < 0 or faces.max() >= count:
        raise ObjectError(f"A face of the PLY names vertex {faces.max()} and there are {count}; save it again.")
    return faces.astype(np.int32)


def _text_rows(data: bytes, header: _Header) -> dict[str, dict[str, Any]]:
    lines = iter(data[header.length :].decode("ascii", "replace").splitlines())
    return {element.name: _text_element(element, lines) for element in header.elements}


def _text_element(element: _Element, lines: Any) -> dict[str, Any]:
    columns: dict[str, list[Any]] = {prop[0]: [] for prop in element.properties}
    for _ in range(element.count):
        words = iter(next(lines, "").split())
        for prop in element.properties:
            numeric = int if prop[-1][0] in "iu" else float
            if len(prop) == 2:
                columns[prop[0]].append(numeric(next(words, "")))
            else:
                columns[prop[0]].append([numeric(next(words, "")) for _ in range(int(next(words, "")))])
    return dict(columns)


def _binary_rows(data: bytes, header: _Header) -> dict[str, dict[str, Any]]:
    position, found = header.length, {}
    for element in header.elements:
        lists = any(len(prop) == 3 for prop in element.properties)
        reader = _rows_with_lists if lists else _plain_rows
        found[element.name], position = reader(data, position, element, header.order)
    return found


def _plain_rows(data: bytes, position: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    kind = np.dtype([(prop[0], order + prop[1]) for prop in element.properties])
    rows = np.frombuffer(data, kind, element.count, position)
    return {name: rows[name] for name in kind.names or ()}, position + kind.itemsize * element.count


def _rows_with_lists(data: bytes, position: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    """Rows whose lists are all as long as in the first row are read at once, others one by one."""
    if not element.count:
        return {prop[0]: [] for prop in element.properties}, position
    first, _ = _row(data, position, element, order)
    lengths = {prop[0]: len(first[prop[0]]) for prop in element.properties if len(prop) == 3}
    fields = []
    for prop in element.properties:
        if len(prop) == 3:
            fields.append((f"length of {prop[0]}", order + prop[1]))
            fields.append((prop[0], order + prop[2], (lengths[prop[0]],)))  # type: ignore[arg-type]
        else:
            fields.append((prop[0], order + prop[1]))
    kind = np.dtype(fields)
    if position + kind.itemsize * element.count <= len(data):
        rows = np.frombuffer(data, kind, element.count, position)
        if all((rows[f"length of {name}"] == length).all() for name, length in lengths.items()):
            return {prop[0]: rows[prop[0]] for prop in element.properties}, position + kind.itemsize * element.count
    columns: dict[str, list[Any]] = {prop[0]: [] for prop in element.properties}
    for _ in range(element.count):
        row, position = _row(data, position, element, order)
        for name, value in row.items():
            columns[name].append(value)
    return dict(columns), position


def _row(data: bytes, position: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    row = {}
    for prop in element.properties:
        count = 1
        if len(prop) == 3:
            length = np.frombuffer(data, order + prop[1], 1, position)
            count, position = int(length[0]), position + length.itemsize
        kind = np.dtype(order + prop[-1])
        if not 0 <= count <= (len(data) - position) // kind.itemsize:
            raise ValueError(f"a list of {count} items")
        values = np.frombuffer(data, kind, count, position)
        position += values.nbytes
        row[prop[0]] = values if len(prop) == 3 else values[0]
    return row, position


def _written(part: Part, texture: str) -> bytes:
    """A binary PLY with the texture coordinates that the part was painted with."""
    header = [
        f"ply\nformat binary_little_endian 1.0\ncomment TextureFile {texture}\nelement vertex {len(part.vertices)}"
    ]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t")]
    header += [f"element face {len(part.faces)}", "property list uchar int vertex_indices", "end_header\n"]
    vertices = np.concatenate([part.vertices, part.normals, part.uvs], axis=1).astype("<f4")
    faces = np.zeros(len(part.faces), np.dtype([("count", "u1"), ("corners", "<i4", (3,))]))
    faces["count"], faces["corners"] = 3, part.faces
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()
