"""A 3D object: its meshes, materials and textures, and the files of its archive.

The format is SAILenv's: a flat zip with ``<name>.obj``, ``<name>_mat_def.json`` (per material the file names of
``albedo``, ``normal`` and ``metallic``; ours: ``opacity`` of a blended one) and the PNGs. A zip or folder with a plain
OBJ and MTL is read, too. Every file of the archive is kept byte for byte; an attack replaces albedo images only.
"""

import io
import json
import lzma
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from posixpath import commonpath
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from trompe_shared.errors import ObjectError
from trompe_shared.local_files import MODEL_SUFFIXES, base_name, files_of, libraries, named, pack_zip, text_of
from trompe_shared.wavefront import Part, beyond_edges, dissolve, parse_mtl, parse_obj

MAX_ARCHIVE_BYTES: Final = 512 * 2**20
MAX_MEMBERS: Final = 256
MAX_TEXTURE_SIDE: Final = 8192
MAX_TEXELS: Final = 2 * MAX_TEXTURE_SIDE**2
"""Of all albedo textures of an object together."""
MAX_RATIO: Final = 200
"""Largest ratio of unpacked to packed size, for archives that unpack to more than ``MUCH``."""
MUCH: Final = 64 * 2**20
UTF_8: Final = 0x800
"""Flag of a zip's member whose name is UTF-8, not code page 437."""
COARSEST: Final = 1e-3
"""Largest distance of neighbouring numbers at an object's place, as a share of its extent."""
SPHERE_STEPS: Final = 100
"""Steps of the search for the smallest sphere around an object; the error falls with their number."""
PLAIN_ROUGHNESS: Final = 0.9
"""Roughness where no metallic map tells another one."""
IMAGE_FORMATS: Final = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF")
"""Formats of textures. Pillow reads none of them through another program."""

_DAMAGED: Final = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, RuntimeError, EOFError, ValueError, OSError)
"""Errors of ``zipfile`` for damaged archives."""

Texture = NDArray[np.uint8]


@dataclass(frozen=True)
class Material:
    """File names of a material's maps inside the archive; ``None`` without one.

    ``albedo`` is sRGB. ``normal`` is a tangent-space map, +Y up (OpenGL). ``metallic`` is Unity's
    MetallicSmoothness, linear: red is metallic, alpha is smoothness. ``opacity``, in [0, 1], multiplies the albedo's
    alpha in a surface blended over what lies behind it; ``None``: alpha below one half cuts holes, the rest is opaque.
    """

    name: str
    albedo: str
    normal: str | None = None
    metallic: str | None = None
    opacity: float | None = None


@dataclass(frozen=True)
class Object3D:
    """An object as read from its archive.

    files: content by file name.
    parts: one mesh per material.
    textures: decoded albedo images by file name, (H, W, 3) uint8, sRGB, row 0 on top.
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

    @cached_property
    def sphere(self) -> tuple[tuple[float, float, float], float]:
        """(Centre (x, y, z), radius), metres, of a sphere around all vertices; within 1 % of the smallest one.

        Badoiu and Clarkson (2003), Smaller core-sets for balls: the centre moves towards the farthest vertex in
        ever smaller steps.
        """
        vertices = np.unique(np.concatenate([part.vertices for part in self.parts]).astype(np.float64), axis=0)
        centre = (vertices.min(0) + vertices.max(0)) / 2
        for step in range(SPHERE_STEPS):
            farthest = vertices[np.square(vertices - centre).sum(1).argmax()]
            centre += (farthest - centre) / (step + 2)
        x, y, z = centre.tolist()
        return (x, y, z), float(np.linalg.norm(vertices - centre, axis=1).max())

    @property
    def blended(self) -> frozenset[str]:
        """The albedo textures of blended materials."""
        return frozenset(each.albedo for each in self.materials.values() if each.opacity is not None)

    @property
    def maps(self) -> frozenset[str]:
        """The image files of the materials: albedo, normal and metallic."""
        return frozenset(
            name for m in self.materials.values() for name in (m.albedo, m.normal, m.metallic) if name is not None
        )

    def albedo_of(self, part: Part) -> str:
        """File name of the albedo texture of ``part``."""
        return self.materials[part.material].albedo

    def with_textures(self, textures: Mapping[str, Texture]) -> "Object3D":
        """The same object with some albedo images replaced, (H, W, 3) uint8 of any size; alpha stays, and each file of
        equal pixels.

        Raises ``ObjectError`` for a name that is not one of this object's albedo textures.
        """
        unknown = sorted(set(textures) - set(self.textures))
        if unknown:
            raise ObjectError(f"{unknown} are not albedo textures of {self.name!r}; it has {sorted(self.textures)}.")
        new = {name: image for name, image in textures.items() if not np.array_equal(image, self.textures[name])}
        painted = {name: with_alpha_of(image, decode_alpha(self.files[name], name)) for name, image in new.items()}
        return replace(self, files={**self.files, **painted}, textures={**self.textures, **textures})

    def to_zip(self) -> bytes:
        """The archive as a flat zip; the same content gives the same bytes."""
        return pack_zip(self.files)


def encode_png(image: Image.Image | Texture) -> bytes:
    """PNG bytes of a picture or a uint8 array, (H, W) or (H, W, channels); fast compression."""
    buffer = io.BytesIO()
    picture = image if isinstance(image, Image.Image) else Image.fromarray(image)
    picture.save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def with_alpha_of(rgb: Texture, alpha: Texture | None) -> bytes:
    """PNG bytes of ``rgb`` with ``alpha`` (h, w), resized if necessary."""
    if alpha is None:
        return encode_png(np.ascontiguousarray(rgb))
    return encode_png(np.dstack([rgb, resized(alpha, (rgb.shape[1], rgb.shape[0]))]))


def resized(pixels: Texture, size: tuple[int, int]) -> Texture:
    """A picture (H, W) or (H, W, 3) at the size (width, height)."""
    if (pixels.shape[1], pixels.shape[0]) == size:
        return pixels
    return np.array(Image.fromarray(np.ascontiguousarray(pixels)).resize(size, Image.Resampling.LANCZOS))


@contextmanager
def open_image(data: bytes, name: str) -> Iterator[Image.Image]:
    """Open an untrusted image file within a ``with`` block: the only entrance for pixels.

    Accepts ``IMAGE_FORMATS`` and checks the sides before it decodes a pixel. Raises ``ObjectError`` with ``name``, also
    for damage found within the block.
    """
    try:
        with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
            if max(image.size) > MAX_TEXTURE_SIDE:
                raise ObjectError(
                    f"Texture {name!r} is {image.size} pixels; at most {MAX_TEXTURE_SIDE} a side are read."
                )
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1) if image.format == "JPEG" else 1
            if orientation in range(2, 9):
                raise ObjectError(
                    f"Picture {name!r} is stored turned (EXIF orientation {orientation}), which programs treat "
                    "differently; save it upright."
                )
            yield image
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ObjectError(f"Texture {name!r} is too large ({error}); {MAX_TEXTURE_SIDE} a side are read.") from error
    except UnidentifiedImageError as error:
        raise ObjectError(
            f"Texture {name!r} cannot be read as an image (it is none of {', '.join(IMAGE_FORMATS)}). Save it again as "
            "a PNG."
        ) from error
    except (OSError, ValueError, SyntaxError, struct.error) as error:
        raise ObjectError(f"Texture {name!r} cannot be read as an image ({error}). Save it again as a PNG.") from error


def decode_rgb(data: bytes, name: str) -> Texture:
    """Decode an image file to (H, W, 3) uint8; of 16 bits it keeps the upper 8.

    Raises ``ObjectError`` with ``name`` for an unreadable file.
    """
    with open_image(data, name) as image:
        return _rgb(image)


def _rgb(image: Image.Image) -> Texture:
    if image.mode.startswith("I;16"):  # Pillow clips these greys instead of scaling them
        return np.repeat((np.array(image) >> 8).astype(np.uint8)[..., None], 3, axis=2)
    return np.array(image.convert("RGB"))


def decode_alpha(data: bytes, name: str) -> Texture | None:
    """Alpha (H, W) uint8 of an image file; ``None`` for a file without. Raises ``ObjectError`` as ``decode_rgb``."""
    with open_image(data, name) as image:
        return np.array(image.convert("RGBA").getchannel("A")) if image.has_transparency_data else None


def roughness_metallic(data: bytes, name: str) -> Texture:
    """Roughness and metallic (H, W, 2) uint8 of a metallic map (``Material``). Raises ``ObjectError``."""
    with open_image(data, name) as image:
        smoothness = np.array(image.getchannel("A")) if "A" in image.getbands() else None
        metallic = _rgb(image)[..., 0]
    plain = np.full(metallic.shape, round(255 * PLAIN_ROUGHNESS), np.uint8)
    return np.stack([plain if smoothness is None else 255 - smoothness, metallic], axis=-1)


def load_object(source: bytes | str | Path) -> Object3D:
    """Read an object from the bytes of a zip, or from the path of a zip, a folder, or an OBJ with the files it names.

    Raises ``ObjectError`` for a missing, inconsistent or too large object.
    """
    if isinstance(source, bytes):
        return object_from_files(unzip(source))
    path = Path(source)
    if path.is_dir():
        return object_from_files({p.name: p.read_bytes() for p in sorted(path.iterdir()) if p.is_file()})
    if not path.is_file():
        raise ObjectError(f"There is no file or folder {str(path)!r}.")
    if path.suffix.lower() == ".obj":
        return object_from_files(_with_files(path))
    if path.suffix.lower() in MODEL_SUFFIXES:
        raise ObjectError(
            f"{str(path)!r} is no zip or OBJ; take trompe_server.formats.read_object(data, name={path.name!r}).obj."
        )
    return object_from_files(unzip(path.read_bytes()))


def _with_files(mesh: Path) -> dict[str, bytes]:
    """An OBJ and the files it names, by name without folders."""
    names = files_of(mesh)
    files = {Path(name).name: (mesh.parent / name).read_bytes() for name in names}
    if len(files) < len(names):
        raise ObjectError(f"{str(mesh)!r} names files of one name in different folders, {names}; rename one of them.")
    return files


def unzip(data: bytes) -> dict[str, bytes]:
    """Members of a flat zip; one common folder is removed. Raises ``ObjectError``, also beyond the limits."""
    files = unpack(data)
    if any("/" in name for name in files):
        raise ObjectError("The archive must be flat: an .obj, its materials and its textures in one folder.")
    return files


def unpack(data: bytes) -> dict[str, bytes]:
    """Members of a zip by their path below their common folder, in the order of the archive.

    Raises ``ObjectError`` for an archive that is damaged, too large, or holds links or paths outside of it.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except _DAMAGED as error:
        raise ObjectError(f"The object is not a zip archive ({error}). Zip the folder that holds the .obj.") from error
    named = [info for info in archive.infolist() if info.filename]
    members = [info for info in named if not info.is_dir() and "__MACOSX" not in info.filename]
    _check_size(members, len(data))
    paths = [_checked_path(info) for info in members]
    common = len(PurePosixPath(commonpath([path.parent for path in paths] or [PurePosixPath()])).parts)
    names = ["/".join(path.parts[common:]) for path in paths]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ObjectError(f"The archive holds two files of one name, {twice!r}; zip the folder again.")
    try:
        return {name: _read_member(archive, info) for name, info in zip(names, members, strict=True)}
    except _DAMAGED as error:
        raise ObjectError(f"The archive is damaged or encrypted ({error}). Zip the folder again.") from error


def unpacked_size(data: bytes) -> int:
    """Unpacked bytes according to the zip's directory; 0 for a damaged zip."""
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
    path = PurePosixPath(_name_of(info).replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or re.match("[A-Za-z]:", info.filename):
        raise ObjectError(f"The archive holds {info.filename[:80]!r}, which leads out of it; zip one folder.")
    if stat.S_ISLNK(info.external_attr >> 16):
        raise ObjectError(f"The archive holds the link {info.filename[:80]!r}; put the file itself there.")
    return path


def _name_of(info: zipfile.ZipInfo) -> str:
    """The name of a member; macOS writes UTF-8 without saying so."""
    try:
        return info.filename if info.flag_bits & UTF_8 else info.filename.encode("cp437").decode()
    except UnicodeError:
        return info.filename


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    with archive.open(info) as member:
        return member.read(MAX_ARCHIVE_BYTES)


def object_from_files(files: Mapping[str, bytes]) -> Object3D:
    """Read an object from the files of its archive. Raises ``ObjectError``."""
    if len(files) > MAX_MEMBERS:
        raise ObjectError(
            f"The object has {len(files)} files, most of them a picture for each material; at most {MAX_MEMBERS} are "
            "read. Merge materials, or their pictures into one (an atlas)."
        )
    mesh = _mesh_name(files)
    name = mesh[: -len(".obj")]
    parts = parse_obj(text_of(files[mesh]), mesh)
    if not any(np.ptp(part.vertices, axis=0).any() for part in parts):
        raise ObjectError(f"{mesh!r} has no extent: all its corners are in one place.")
    _refuse_remote(parts, mesh)
    materials = _materials(files, parts)
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
    used = {key: _without_idle_blending(material, files) for key, material in used.items()}
    obj = Object3D(name, dict(files), parts, used, textures)
    if obj.n_texels > MAX_TEXELS:
        raise ObjectError(f"The albedo textures have {obj.n_texels} texels; at most {MAX_TEXELS} are read.")
    return obj


def _refuse_remote(parts: Sequence[Part], mesh: str) -> None:
    """Raise ``ObjectError`` for an object so far from the origin that single precision distorts it."""
    corners = np.concatenate([part.vertices for part in parts])
    extent, step = np.ptp(corners, axis=0).max(), np.spacing(np.abs(corners).max())
    if step > COARSEST * extent:
        raise ObjectError(
            f"{mesh!r} is {extent:.2g} m large and up to {np.abs(corners).max():.3g} m from the origin, where single "
            f"precision only has positions {step:.2g} m apart. Move it to the origin."
        )


def _without_idle_blending(material: Material, files: Mapping[str, bytes]) -> Material:
    """``material``, not blended if its alpha is 1 everywhere."""
    if material.opacity is None or material.opacity < 1:
        return material
    alpha = decode_alpha(files[material.albedo], material.albedo)
    return replace(material, opacity=None) if alpha is None or alpha.min() == 255 else material


def _mesh_name(files: Mapping[str, bytes]) -> str:
    meshes = [name for name in files if name.lower().endswith(".obj")]
    if len(meshes) != 1:
        found = f"found {sorted(meshes)}" if meshes else f"found only {sorted(files)[:8]}"
        raise ObjectError(f"The object must hold exactly one .obj file, {found}.")
    return meshes[0]


def _member(files: Mapping[str, bytes], name: str) -> bytes:
    if name not in files:
        remedy = "put it beside the model, or give the folder that holds both"
        if "<UDIM>" in name.upper():
            remedy = "UDIM tiles are not supported, so bake them to one picture"
        elif not name.isascii():
            remedy += ", or save the material file in UTF-8 if its name is spelled differently"
        raise ObjectError(f"The texture {name!r} is named by a material but did not come with it; {remedy}.")
    return files[name]


def definition_of(files: Mapping[str, bytes]) -> str | None:
    """The name of the mat_def file of the archive's mesh: that of its name, or any without an MTL."""
    if (own := named(f"{_mesh_name(files)[: -len('.obj')]}_mat_def.json", files)) is not None:
        return own
    if any(name.lower().endswith(".mtl") for name in files):
        return None
    return next((name for name in files if name.endswith("_mat_def.json")), None)


def mtl_texts(files: Mapping[str, bytes]) -> dict[str, str]:
    """The texts of the MTL files of the archive's mesh, by name; the first to define a material counts."""
    return {name: text_of(files[name]) for name in libraries(text_of(files[_mesh_name(files)]), files)}


def _materials(files: Mapping[str, bytes], parts: Collection[Part]) -> dict[str, Material]:
    """Materials of the mat_def file, else of the MTL files; normal maps of those that ``parts`` use."""
    if (definition := definition_of(files)) is not None:
        return _materials_from_json(files[definition], definition)
    used = {part.material for part in parts}
    materials: dict[str, Material] = {}
    for text in mtl_texts(files).values():
        for name, maps in parse_mtl(text).items():
            if "albedo" in maps and name not in materials:
                if "clamp" in maps:
                    _check_clamped(name, [part.uvs for part in parts if part.material == name])
                normal = _normal(maps, files) if name in used else None
                materials[name] = Material(name, maps["albedo"], normal, opacity=dissolve(maps, name))
    return materials


def _check_clamped(material: str, uvs: Collection[NDArray[np.float32]]) -> None:
    """Raise ``ObjectError`` unless all coordinates of a texture that does not repeat are within [0, 1]."""
    if any(map(beyond_edges, uvs)):
        raise ObjectError(
            f"Material {material!r} clamps its texture beyond the edges (-clamp on), which is not supported; use "
            "texture coordinates (vt) within [0, 1], or delete the option to repeat the texture."
        )


def _normal(maps: Mapping[str, str], files: Mapping[str, bytes]) -> str | None:
    """The normal map of an MTL's material: ``norm``, or a bump map in colours; a grey one, or the albedo, holds
    heights."""
    bump = maps.get("bump")
    if bump is None or "normal" in maps or bump == maps["albedo"]:
        return maps.get("normal")
    rgb = decode_rgb(_member(files, bump), bump)
    return None if (rgb == rgb[..., :1]).all() else bump


def _materials_from_json(data: bytes, file: str) -> dict[str, Material]:
    try:
        table = json.loads(data)
        return {
            str(name): Material(
                str(name),
                base_name(maps["albedo"]),
                base_name(maps["normal"]) if maps.get("normal") else None,
                base_name(maps["metallic"]) if maps.get("metallic") else None,
                _share(maps.get("opacity")),
            )
            for name, maps in table.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ObjectError(
            f"{file!r} is not a material definition ({type(error).__name__}: {error}); expected "
            '{"material": {"albedo": "file.png", "normal": "file.png", "metallic": "file.png"}}, '
            'and "opacity" from 0 to 1 for a blended one.'
        ) from error


def _share(value: float | None) -> float | None:
    if value is not None and not 0 <= value <= 1:
        raise ValueError(f"the opacity {value} is not from 0 to 1")
    return value if value is None else float(value)
