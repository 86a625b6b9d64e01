"""PLY: polygons with normals, colours or texture coordinates, text or binary. trimesh reads them.

A texture is named by ``comment TextureFile picture.png``, as MeshLab writes it. Texture coordinates belong to vertices
(``s`` and ``t``, or ``u`` and ``v``) or to the corners of faces (``texcoord``).
"""

import io
import re
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import assemble, check_numbers, free_name, painted_object, repainted, safe_name
from trompe_server.formats.upload import Upload, refusing
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import PICTURE_SUFFIXES, base_name
from trompe_shared.object3d import Material, Object3D, decode_alpha, encode_png, with_alpha_of
from trompe_shared.polygons import unfold
from trompe_shared.wavefront import MAX_FACES, Part, Surface, in_unit, smooth_normals

MATERIAL: Final = "surface"
MAX_HEADER: Final = 2**16
REMEDY: Final = "Save it again as triangles, binary or text."
HEADER: Final = re.compile(rb"ply(?:\r?\n.*?^end_header\r?\n|\r[^\n]*?\rend_header\r)", re.DOTALL | re.MULTILINE)
ELEMENT: Final = re.compile(rb"^element +(\w+) +(\d{1,18})\s*\n((?:(?!element|end_header).*\n)*)", re.MULTILINE)
PROPERTY: Final = re.compile(rb"^property +(?:list +(\w+) +)?(\w+) +(\S+)", re.MULTILINE)
TYPES: Final = {"char": "i1", "uchar": "u1", "int": "i4", "uint": "u4", "float": "f4"}
"""Names of types whose meaning NumPy does not share."""


@dataclass(frozen=True)
class _Header:
    """size: bytes in the file. textures: their file names. corner_uvs: whether faces list the coordinates of their
    corners. face_colours: whether faces have colours."""

    text: bytes
    size: int
    rows: int
    textures: tuple[str, ...]
    corner_uvs: bool
    face_colours: bool


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """``upload`` with the texture of ``painted``: replaces its texture file, or adds one to a new PLY."""
    original, texture = _read(upload)
    changed = repainted(original, painted)
    if not changed:
        return upload
    ((name, rgb),) = changed.items()
    if texture is not None:
        alpha = decode_alpha(upload.files[texture], texture)
        return Upload(upload.main, {**upload.files, texture: with_alpha_of(rgb, alpha)}, upload.packed)
    (part,) = original.parts
    place = free_name(name, upload.flat())
    return upload.with_flat({base_name(upload.main): _written(part, place), place: encode_png(rgb)})


def read(upload: Upload) -> Object3D:
    """Read a PLY and the texture beside it. Raises ``ObjectError``."""
    return _read(upload)[0]


def _read(upload: Upload) -> tuple[Object3D, str | None]:
    """The object and the path of its texture; ``None`` without a texture or without texture coordinates."""
    header = _header(upload.data)
    surface = _surface(upload.data, header)
    if not header.textures or surface.uvs is None:
        if surface.colours is None:
            _refuse_unread(upload, header, surface)
        return painted_object(upload.stem, surface), None
    if len(header.textures) > 1:
        raise ObjectError(
            f"The PLY has {len(header.textures)} textures, {', '.join(header.textures)[:200]}; one is supported. Bake "
            "them into one, or export it as glTF."
        )
    (texture,) = header.textures
    file, path = safe_name(texture, default="texture.png"), upload.beside(texture)
    part = Part(MATERIAL, surface.vertices, surface.normals, surface.uvs, surface.faces)
    materials = {MATERIAL: Material(MATERIAL, file)}
    return assemble(safe_name(upload.stem), [part], materials, {file: upload.files[path]}), path


def _refuse_unread(upload: Upload, header: _Header, surface: Surface) -> None:
    """Raise ``ObjectError`` for colours that an object without colours of vertices would lack."""
    if header.face_colours:
        raise ObjectError(
            "The PLY has colours of faces, which are not supported; make them colours of vertices and save it again."
        )
    pictures = sorted(name for name in upload.files if name.lower().endswith(tuple(PICTURE_SUFFIXES)))
    if pictures and not header.textures and (surface.uvs is not None or header.corner_uvs):
        raise ObjectError(
            f"The PLY has texture coordinates, but does not say what {pictures[:4]} is for. Add the line "
            "'comment TextureFile NAME' to its header, or leave the pictures away for a plain object."
        )


def _header(data: bytes) -> _Header:
    """Facts of the header that trimesh does not check or tell. Raises ``ObjectError``."""
    found = HEADER.match(data[:MAX_HEADER])
    if found is None:
        raise ObjectError("The PLY file has no complete header; save it again.")
    text = found[0].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b" red\n" not in text:
        for name in (b"red", b"green", b"blue"):
            text = re.sub(rb"^(property +\w+ +)(?:diffuse_%s|%s)$" % (name, name[:1]), rb"\1" + name, text, flags=re.M)
    rows = sum(int(element[2]) for element in ELEMENT.finditer(text))
    if rows > 3 * MAX_FACES:
        raise ObjectError(f"The PLY's header announces {rows} rows; at most {3 * MAX_FACES} are read.")
    if b"format ascii" in text and len(_lines(data[found.end() :])) < rows:
        raise ObjectError(f"The PLY file ends too early: its header announces {rows} rows; save it again.")
    names = dict.fromkeys(re.findall(rb"^comment TextureFile +(.+?)\s*$", text, re.MULTILINE | re.IGNORECASE))
    textures = tuple(name.decode("utf-8", "replace") for name in names)
    coloured = any(element[1] == b"face" and b" red\n" in element[3] for element in ELEMENT.finditer(text))
    return _Header(text, found.end(), rows, textures, b" texcoord" in text, coloured)


def _lines(rows: bytes) -> list[bytes]:
    return [line for line in rows.splitlines() if line.strip()]


def _regular(data: bytes, header: _Header) -> tuple[bytes, list[NDArray[Any]]]:
    """``data`` as trimesh reads it: nothing after the last row, polygons of one size in a binary file; its polygons."""
    text, position, body = header.text, header.size, []
    if b"format ascii" in text:
        rows = _lines(data[position:])[: header.rows]
        return text + b"\n".join(rows), _polygons_of_text(rows, text)
    found: list[NDArray[Any]] = []
    order = ">" if b"format binary_big_endian" in text else "<"
    for element in ELEMENT.finditer(header.text):
        polygons, end = _polygons(data, position, element, order)
        found += polygons
        if len({len(polygon) for polygon in polygons}) > 1:
            if header.corner_uvs and header.textures:
                raise ObjectError(f"The PLY has texture coordinates of polygons of different sizes. {REMEDY}")
            faces = np.array([(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)])
            announced = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
            text = text.replace(element[0], announced.encode())
            body.append(_face_rows(faces, order))
        else:
            body.append(data[position:end])
        position = end
    return text + b"".join(body), found


def _polygons_of_text(rows: list[bytes], header: bytes) -> list[NDArray[Any]]:
    """Vertex indices of the polygons in the rows of faces that begin with them."""
    first = 0
    for element in ELEMENT.finditer(header):
        some = rows[first : first + int(element[2])]
        if re.match(rb"property +list +\w+ +\w+ +vertex_ind(ices|ex)\n", element[3]):
            if all(row.split(None, 1)[0] == b"3" for row in some):
                break  # most files, in a fraction of the time
            return [np.array(words[1 : 1 + int(words[0])], np.int64) for words in map(bytes.split, some)]
        first += len(some)
    return []


def _polygons(data: bytes, position: int, element: re.Match[bytes], order: str) -> tuple[list[NDArray[Any]], int]:
    """Vertex indices of the polygons of a binary element, if it has any, and the position of the element's end."""
    properties = [
        (_dtype(length, order) if length else None, _dtype(kind, order), name)
        for length, kind, name in PROPERTY.findall(element[3])
    ]
    if all(length is None for length, _, _ in properties):
        return [], position + int(element[2]) * sum(kind.itemsize for _, kind, _ in properties)
    polygons = []
    for _ in range(int(element[2])):
        for length, kind, name in properties:
            count = 1
            if length is not None:
                count, position = int(np.frombuffer(data, length, 1, position)[0]), position + length.itemsize
            if count < 0:
                raise ValueError(f"a list of {count} items")
            if name in (b"vertex_indices", b"vertex_index") and kind.kind in "iu":
                polygons.append(np.frombuffer(data, kind, count, position))
            position += count * kind.itemsize
    return polygons, position


def _dtype(name: bytes, order: str) -> np.dtype[Any]:
    return np.dtype(order + np.dtype(TYPES.get(name.decode(), name.decode())).str[1:])


def _surface(data: bytes, header: _Header) -> Surface:
    split = header.corner_uvs and bool(header.textures)
    with refusing("The PLY file", remedy=REMEDY), np.errstate(over="ignore"):
        from trimesh.exchange.ply import load_ply  # takes a second to import
        from trimesh.geometry import triangulate_quads

        regular, listed = _regular(data, header)
        loaded: dict[str, Any] = load_ply(io.BytesIO(regular), fix_texture=split, skip_materials=True)
        vertices, polygons = _floats(loaded.get("vertices")), loaded.get("faces")
        if vertices is None or polygons is None or polygons.shape[1:] < (3,) or polygons.dtype.kind not in "iu":
            raise ObjectError("The PLY holds no mesh: it needs vertices with x, y, z, and faces with vertex_indices.")
        faces = triangulate_quads(polygons)
        _check_faces(faces, len(vertices))
        faces = faces if split else _unfolded(faces, listed, vertices)
        uvs = _floats(loaded["visual"].uv) if "visual" in loaded and (split or not header.corner_uvs) else None
        normals = None if split else _floats(loaded.get("vertex_normals"))
        colours = None if split else _colours(loaded.get("vertex_colors"))
    for values in (vertices, uvs):
        if values is not None:
            check_numbers(values, "The PLY")
    if normals is None or not np.isfinite(normals).all():
        positions, index = vertices, np.arange(len(vertices))
        if split:
            positions, index = np.unique(vertices, axis=0, return_inverse=True)
        normals = smooth_normals(positions, index, faces)
    return Surface(MATERIAL, vertices, normals, faces.astype(np.int32), uvs, colours)


def _unfolded(faces: NDArray[Any], polygons: list[NDArray[Any]], vertices: NDArray[np.float32]) -> NDArray[Any]:
    """``faces``, unless some of the ``polygons`` are concave: then all of these as triangles."""
    sizes = np.array([len(polygon) - 2 for polygon in polygons if len(polygon) > 2])
    if sizes.max(initial=1) == 1:
        return faces
    fans = np.array([(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)], np.int64)
    triangles = fans.copy()
    unfold(triangles[..., None], vertices, np.stack([np.cumsum(sizes) - sizes, sizes], axis=1))
    return faces if (triangles == fans).all() else triangles


def _floats(values: Any) -> NDArray[np.float32] | None:
    return None if values is None else np.asarray(values, np.float64).astype(np.float32)


def _colours(values: Any) -> NDArray[np.float32] | None:
    """Colours (V, 3) in [0, 1] of integers up to 255 or of 16 bits, or of floats up to 1 or up to 255."""
    colours = _floats(values)
    if colours is None:
        return None
    if values.dtype.kind in "iu":
        return colours[:, :3] / np.float32(255 if values.max(initial=0) <= 255 else 65535)
    return np.nan_to_num(in_unit(colours[:, :3]))


def _check_faces(faces: NDArray[np.int64], count: int) -> None:
    if faces.ndim != 2 or not 0 < len(faces) <= MAX_FACES:
        raise ObjectError(f"The PLY has {len(faces)} triangles; expected 1 to {MAX_FACES}.")
    if faces.min() < 0 or faces.max() >= count:
        raise ObjectError(f"A face of the PLY names vertex {faces.max()}, but there are {count}; save it again.")


def _written(part: Part, texture: str) -> bytes:
    """A binary PLY with the texture coordinates of ``part``."""
    header = [
        f"ply\nformat binary_little_endian 1.0\ncomment TextureFile {texture}\nelement vertex {len(part.vertices)}"
    ]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t")]
    header += [f"element face {len(part.faces)}", "property list uchar int vertex_indices", "end_header\n"]
    vertices = np.concatenate([part.vertices, part.normals, part.uvs], axis=1).astype("<f4")
    return "\n".join(header).encode() + vertices.tobytes() + _face_rows(part.faces, "<")


def _face_rows(faces: NDArray[Any], order: str) -> bytes:
    rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("corners", f"{order}i4", (3,))]))
    rows["count"], rows["corners"] = 3, faces
    return rows.tobytes()
