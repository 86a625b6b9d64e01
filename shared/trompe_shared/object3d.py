"""A 3D object: its meshes, materials and textures, and the archive they came in.

The format is SAILenv's: a flat zip with ``<name>.obj``, ``<name>_mat_def.json`` (per material the file names of
``albedo``, ``normal`` and ``metallic``) and the PNGs. A zip or folder with a plain OBJ and MTL is read as well. Every
file of the archive is kept byte for byte; an attack replaces albedo images only, so that what comes out is what went
in.
"""

import io
import json
import lzma
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from trompe_shared.errors import ObjectError
from trompe_shared.wavefront import Part, parse_mtl, parse_obj

__all__ = [
    "MAX_TEXTURE_SIDE",
    "Material",
    "Object3D",
    "Part",
    "decode_rgb",
    "encode_png",
    "load_object",
    "object_from_files",
    "open_image",
    "pack_zip",
    "unpack",
    "unpacked_size",
    "unzip",
]

MAX_ARCHIVE_BYTES: Final = 512 * 2**20
MAX_MEMBERS: Final = 256
MAX_TEXTURE_SIDE: Final = 8192
MAX_TEXELS: Final = 2 * MAX_TEXTURE_SIDE**2
"""Of all albedo textures of an object together."""
MAX_RATIO: Final = 200
"""How many times its size an archive may unpack to, where that is much ..."""
MUCH: Final = 64 * 2**20
"""... which is more than this many bytes."""
IMAGE_FORMATS: Final = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF")
"""What is read as a texture: of what Pillow knows, the kinds that run no other program."""

_DAMAGED: Final = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, RuntimeError, EOFError, ValueError, OSError)
"""What ``zipfile`` raises for bytes that it cannot unpack."""

Texture = NDArray[np.uint8]


@dataclass(frozen=True)
class Material:
    """File names of a material's maps inside the archive; ``None`` where it has none.

    ``albedo`` is sRGB. ``normal`` is a tangent-space map, +Y up (OpenGL). ``metallic`` is Unity's
    MetallicSmoothness, linear: red is metallic, alpha is smoothness.
    """

    name: str
    albedo: str
    normal: str | None = None
    metallic: str | None = None


@dataclass(frozen=True)
class Object3D:
    """An object as read from its archive.

    ``files`` maps file names to their bytes, ``parts`` holds one mesh per material, ``textures`` the decoded
    albedo images by file name: (H, W, 3) uint8, sRGB, row 0 on top.
    """

    name: str
    files: Mapping[str, bytes]
    parts: tuple[Part, ...]
    materials: Mapping[str, Material]
    textures: Mapping[str, Texture]

    @property
    def n_texels(self) -> int:
        """Number of texels of all albedo textures together."""
        return sum(t.shape[0] * t.shape[1] for t in self.textures.values())

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the origin, metres."""
        return float(max(np.linalg.norm(part.vertices, axis=1).max() for part in self.parts))

    def albedo_of(self, part: Part) -> str:
        """File name of the albedo texture that ``part`` is painted with."""
        return self.materials[part.material].albedo

    def with_textures(self, textures: Mapping[str, Texture]) -> "Object3D":
        """The same object with some albedo images replaced: (H, W, 3) uint8 each, of any size.

        Raises ``ObjectError`` for a name that is not one of this object's albedo textures.
        """
        unknown = sorted(set(textures) - set(self.textures))
        if unknown:
            raise ObjectError(f"{unknown} are not albedo textures of {self.name!r}; it has {sorted(self.textures)}.")
        files = dict(self.files) | {name: self._repaint(name, image) for name, image in textures.items()}
        return replace(self, files=files, textures=dict(self.textures) | dict(textures))

    def _repaint(self, name: str, image: Texture) -> bytes:
        """PNG bytes of ``image``, carrying over the alpha channel (opacity) of the file it replaces."""
        with open_image(self.files[name], name) as before:
            alpha = before.convert("RGBA").getchannel("A") if before.has_transparency_data else None
        picture = Image.fromarray(image)
        if alpha is not None and alpha.size == picture.size:
            picture.putalpha(alpha)
        return encode_png(picture)

    def to_zip(self) -> bytes:
        """The archive as a flat zip; the same content gives the same bytes."""
        return pack_zip(self.files)


def encode_png(image: Image.Image | Texture) -> bytes:
    """PNG bytes of a picture or a uint8 array (lossless; fast compression)."""
    buffer = io.BytesIO()
    picture = image if isinstance(image, Image.Image) else Image.fromarray(image)
    picture.save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


@contextmanager
def open_image(data: bytes, name: str) -> Iterator[Image.Image]:
    """An image file that comes from anybody, opened for the time of the block: the one way in for pixels.

    It is of ``IMAGE_FORMATS``, and its sides are looked at before a pixel is decoded. Raises ``ObjectError`` with
    ``name``, also for what turns out to be damaged within the block.
    """
    try:
        with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
            if max(image.size) > MAX_TEXTURE_SIDE:
                raise ObjectError(
                    f"Texture {name!r} is {image.size} pixels; at most {MAX_TEXTURE_SIDE} a side are read."
                )
            yield image
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ObjectError(f"Texture {name!r} is too large ({error}); {MAX_TEXTURE_SIDE} a side are read.") from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, struct.error) as error:
        raise ObjectError(f"Texture {name!r} cannot be read as an image ({error}). Save it again as a PNG.") from error


def decode_rgb(data: bytes, name: str) -> Texture:
    """Decode an image file to (H, W, 3) uint8; of 16 bits the upper 8, as Pillow reads those of colours.

    Raises ``ObjectError`` with ``name`` when it cannot be read.
    """
    with open_image(data, name) as image:
        if image.mode.startswith("I;16"):  # Pillow would clip these greys, not scale them
            return np.repeat((np.array(image) >> 8).astype(np.uint8)[..., None], 3, axis=2)
        return np.array(image.convert("RGB"))


def pack_zip(files: Mapping[str, bytes]) -> bytes:
    """A flat, deflated zip of ``files`` with fixed time stamps, in the order of the mapping."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in files.items():
            stored = zipfile.ZIP_STORED if name.lower().endswith((".png", ".jpg")) else zipfile.ZIP_DEFLATED
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, compress_type=stored)
    return buffer.getvalue()


def load_object(source: bytes | str | Path) -> Object3D:
    """Read an object from the bytes of a zip, or from the path of a zip, a folder or an OBJ file.

    Raises ``ObjectError`` when there is none, when it does not hold together, or when it is unreasonably large.
    """
    if isinstance(source, bytes):
        return object_from_files(unzip(source))
    path = Path(source)
    if path.is_dir():
        return object_from_files({p.name: p.read_bytes() for p in sorted(path.iterdir()) if p.is_file()})
    if not path.is_file():
        raise ObjectError(f"There is no file or folder {str(path)!r}.")
    if path.suffix.lower() == ".obj":
        return load_object(path.parent)
    return object_from_files(unzip(path.read_bytes()))


def unzip(data: bytes) -> dict[str, bytes]:
    """Members of a flat zip (one common folder is allowed and removed), within the limits. Raises ``ObjectError``."""
    files = unpack(data)
    if any("/" in name for name in files):
        raise ObjectError("The archive must be flat: an .obj, its materials and its textures in one folder.")
    return files


def unpack(data: bytes) -> dict[str, bytes]:
    """Members of a zip by their path below the folder that is common to all, in the order of the archive.

    Raises ``ObjectError`` for an archive that is damaged, unpacks to too much, or holds what is no plain file below it.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except _DAMAGED as error:
        raise ObjectError(f"The object is not a zip archive ({error}). Zip the folder that holds the .obj.") from error
    named = [info for info in archive.infolist() if info.filename]
    members = [info for info in named if not info.is_dir() and "__MACOSX" not in info.filename]
    _check_size(members, len(data))
    paths = [_checked_path(info) for info in members]
    common = _common_folder(paths)
    names = ["/".join(path.parts[common:]) for path in paths]
    if len(set(names)) < len(names):
        raise ObjectError("The archive holds two files of one name; zip the folder again.")
    try:
        return {name: _read_member(archive, info) for name, info in zip(names, members, strict=True)}
    except _DAMAGED as error:
        raise ObjectError(f"The archive is damaged or encrypted ({error}). Zip the folder again.") from error


def unpacked_size(data: bytes) -> int:
    """Bytes that a zip says it unpacks to; 0 for what is none."""
    try:
        return sum(info.file_size for info in zipfile.ZipFile(io.BytesIO(data)).infolist())
    except _DAMAGED:
        return 0


def _check_size(members: list[zipfile.ZipInfo], packed: int) -> None:
    if len(members) > MAX_MEMBERS:
        raise ObjectError(f"The archive has {len(members)} files; at most {MAX_MEMBERS} are read.")
    size = sum(info.file_size for info in members)
    if size > MAX_ARCHIVE_BYTES:
        raise ObjectError(f"The archive unpacks to more than {MAX_ARCHIVE_BYTES >> 20} MiB.")
    if size > MUCH and size > MAX_RATIO * packed:
        raise ObjectError(
            f"The archive unpacks to {size // packed} times its size; at most {MAX_RATIO} times is read. "
            "Save its textures as PNG."
        )


def _checked_path(info: zipfile.ZipInfo) -> PurePosixPath:
    path = PurePosixPath(info.filename.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or re.match("[A-Za-z]:", info.filename):
        raise ObjectError(f"The archive holds {info.filename[:80]!r}, which leads out of it; zip one folder.")
    if stat.S_ISLNK(info.external_attr >> 16):
        raise ObjectError(f"The archive holds the link {info.filename[:80]!r}; put the file itself there.")
    return path


def _common_folder(paths: list[PurePosixPath]) -> int:
    """How many folders all ``paths`` have in common at their beginning."""
    folders = [path.parts[:-1] for path in paths]
    shortest = min(folders, key=len, default=())
    return next((k for k, part in enumerate(shortest) if any(f[k] != part for f in folders)), len(shortest))


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    with archive.open(info) as member:
        return member.read(MAX_ARCHIVE_BYTES)


def object_from_files(files: Mapping[str, bytes]) -> Object3D:
    """Put an object together from the files of its archive. Raises ``ObjectError``."""
    mesh = _mesh_name(files)
    name = mesh[: -len(".obj")]
    parts = parse_obj(files[mesh].decode("utf-8", "replace"), mesh)
    if not any(np.ptp(part.vertices, axis=0).any() for part in parts):
        raise ObjectError(f"{mesh!r} has no extent: all its corners are in one place.")
    materials = _materials(name, files)
    for part in parts:
        if part.material not in materials:
            raise ObjectError(
                f"{mesh!r} uses the material {part.material!r}, which is not defined; {name}_mat_def.json "
                f"(or the .mtl) defines {sorted(materials) or 'none'}."
            )
    used = {part.material: materials[part.material] for part in parts}
    albedos = sorted({material.albedo for material in used.values()})
    textures = {file: decode_rgb(_member(files, file), file) for file in albedos}
    for file in {f for m in used.values() for f in (m.normal, m.metallic) if f is not None}:
        decode_rgb(_member(files, file), file)
    obj = Object3D(name, dict(files), parts, used, textures)
    if obj.n_texels > MAX_TEXELS:
        raise ObjectError(f"The albedo textures have {obj.n_texels} texels; at most {MAX_TEXELS} are read.")
    return obj


def _mesh_name(files: Mapping[str, bytes]) -> str:
    meshes = [name for name in files if name.lower().endswith(".obj")]
    if len(meshes) != 1:
        found = f"found {sorted(meshes)}" if meshes else f"found only {sorted(files)[:8]}"
        raise ObjectError(f"The object must hold exactly one .obj file, {found}.")
    return meshes[0]


def _member(files: Mapping[str, bytes], name: str) -> bytes:
    if name not in files:
        raise ObjectError(f"The texture {name!r} is named by a material but is not in the archive; add the file.")
    return files[name]


def _materials(name: str, files: Mapping[str, bytes]) -> dict[str, Material]:
    """Materials of the mat_def file, else of the MTL files."""
    definition = next((f for f in (f"{name}_mat_def.json", *files) if f in files and f.endswith("_mat_def.json")), None)
    if definition is not None:
        return _materials_from_json(files[definition], definition)
    materials = {}
    for file in files:
        if file.lower().endswith(".mtl"):
            for material, maps in parse_mtl(files[file].decode("utf-8", "replace")).items():
                if "albedo" in maps:
                    materials[material] = Material(material, maps["albedo"], maps.get("normal"))
    return materials


def _materials_from_json(data: bytes, file: str) -> dict[str, Material]:
    try:
        table = json.loads(data)
        return {
            str(name): Material(
                str(name),
                _base(maps["albedo"]),
                *(_base(maps[k]) if maps.get(k) else None for k in ("normal", "metallic")),
            )
            for name, maps in table.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ObjectError(
            f"{file!r} is not a material definition ({type(error).__name__}: {error}); expected "
            '{"material": {"albedo": "file.png", "normal": "file.png", "metallic": "file.png"}}.'
        ) from error


def _base(name: str) -> str:
    """File name without folders, whichever way the slashes lean."""
    return re.split(r"[\\/]", name)[-1]
