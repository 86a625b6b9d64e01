"""Replace the base colour textures of a glTF file and keep the rest byte for byte.

A texture replaces its image if nothing else uses that image; otherwise it becomes a new image. A colour factor already
in the texture becomes 1. A painted material loses its colours of the older kind (specular-glossiness). A mesh without
texture coordinates gets those of its paint: its vertices are split at seams, its triangles stay.
"""

import base64
import copy
import json
import posixpath
from collections.abc import Iterator
from typing import Final
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import free_name, repainted
from trompe_server.formats.gltf import Model, Slot, load
from trompe_server.formats.gltf_container import BIN_CHUNK, Container, split_glb
from trompe_server.formats.gltf_schema import DRACO
from trompe_server.formats.gltf_shapes import Shape
from trompe_server.formats.gltf_write import Json, Writer, append, glb
from trompe_server.formats.pictures import Pixels
from trompe_server.formats.unwrap import Unwrapped
from trompe_server.formats.upload import Upload
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D, decode_alpha, with_alpha_of

_TYPES: Final = {"EXT_texture_webp": "image/webp", "EXT_texture_avif": "image/avif", "KHR_texture_basisu": "image/ktx2"}
"""Types of images that extensions of textures allow."""


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """``upload`` with the textures of ``painted``. Raises ``ObjectError``."""
    model = load(upload)
    changed = repainted(model.object(), painted)
    editor = _Editor(model.container)
    for slot, name in model.slots.items():
        if name in changed:
            _Repainting(model, editor, slot).apply(changed[name])
    return editor.finish()


class _Repainting:
    """The repaint of one texture."""

    def __init__(self, model: Model, editor: "_Editor", slot: Slot) -> None:
        self._model, self._editor, self._slot = model, editor, slot
        self._materials = [index for index in model.users[slot] if index is not None]

    def apply(self, rgb: Pixels) -> None:
        image, slot = self._slot.image, self._slot
        if slot.unwrapped is not None:
            self._wrap(rgb)
        elif image is None:
            self._point_to(self._editor.add_texture(self._editor.add_image(with_alpha_of(rgb, None))))
        else:
            png = with_alpha_of(rgb, decode_alpha(self._model.container.image_bytes(image), "the image"))
            if self._editor.serves_only(image, self._materials):
                self._editor.replace_image(image, png)
                self._point_to(None)
            else:
                self._point_to_copies(self._editor.add_image(png))

    def _point_to_copies(self, image: int) -> None:
        """Point each of the slot's materials to ``image``, sampled as its present texture."""
        for material in (self._editor.document["materials"][index] for index in self._materials):
            texture = self._editor.document["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
            self._paint(material, self._editor.add_texture(image, sampled_like=texture))

    def _point_to(self, texture: int | None) -> None:
        """Point the slot's materials to ``texture`` (``None``: the present one) with a factor of 1."""
        for index in self._materials:
            self._paint(self._editor.document["materials"][index], texture)
        if None in self._model.users[self._slot] and texture is not None:
            fresh = self._editor.add("materials", {})
            self._paint(self._editor.document["materials"][fresh], texture)
            for (mesh, primitive), shape in self._model.shapes.items():
                if shape.material is None and shape.cut is None:
                    self._editor.document["meshes"][mesh]["primitives"][primitive]["material"] = fresh

    def _paint(self, material: Json, texture: int | None) -> None:
        self._editor.drop_extension(SPECULAR_GLOSSINESS, material, self._editor.document.get("materials", []))
        pbr = material.setdefault("pbrMetallicRoughness", {})
        if texture is not None:
            info = pbr.setdefault("baseColorTexture", self._placement(material))
            info["index"] = texture
        if self._slot.factor != (1.0, 1.0, 1.0):
            pbr["baseColorFactor"] = [1.0, 1.0, 1.0, pbr["baseColorFactor"][3]]

    def _placement(self, material: Json) -> Json:
        """Placement of the material's other maps."""
        others = (material.get("normalTexture"), material["pbrMetallicRoughness"].get("metallicRoughnessTexture"))
        info: Json = next((info for info in others if info is not None), {})
        return copy.deepcopy({key: info[key] for key in ("texCoord", "extensions") if key in info})

    def _wrap(self, rgb: Pixels) -> None:
        """Give the unwrapped primitives a copy of the material with the texture.

        Raises ``ObjectError`` if other maps of the material use the texture coordinates that are replaced.
        """
        slot, document = self._slot, self._editor.document
        own = slot.unwrapped is not None and slot.unwrapped >= 0
        material = copy.deepcopy(document["materials"][slot.unwrapped]) if own else {}
        mapped = any(_texture_uses(material, ""))
        texture = self._editor.add_texture(self._editor.add_image(with_alpha_of(rgb, None)))
        self._paint(material, texture)
        index = self._editor.add("materials", material)
        wanted = slot.unwrapped if own else None
        for (mesh, number), shape in self._model.shapes.items():
            if shape.cut is not None and shape.material == wanted:
                primitive = document["meshes"][mesh]["primitives"][number]
                if mapped and "TEXCOORD_0" in primitive["attributes"]:
                    raise ObjectError("The glTF has vertex colours and other maps on one material; take the GLB.")
                self._editor.cut_open(primitive, shape, shape.cut)
                primitive["material"] = index


class _Editor(Writer):
    """Changes to the file's JSON, buffers and images."""

    def __init__(self, container: Container) -> None:
        super().__init__(json.loads(container.text.removeprefix(b"\xef\xbb\xbf")))
        self._container = container
        self._before = copy.deepcopy(self.document)
        self.binary += container.buffers[0] if self._has_own_chunk() else b""
        self._files = dict(container.upload.files)
        self._extra = bytearray()
        self._binary_before = bytes(self.binary)
        self._serving = _users_of_images(self.document)

    def _has_own_chunk(self) -> bool:
        buffers = self.document.get("buffers", [])
        return self._container.binary and bool(buffers) and buffers[0].get("uri") is None

    def serves_only(self, image: int, materials: list[int]) -> bool:
        """Whether an image serves as base colour of these materials and nothing else."""
        entry = self._before["images"][image]
        alike = [other for other in self._before["images"] if _source(other) == _source(entry)]
        accessors = self._before.get("accessors", [])
        in_use = "bufferView" in entry and any(a.get("bufferView") == entry["bufferView"] for a in accessors)
        return len(alike) == 1 and not in_use and self._serving.get(image) == set(materials)

    def replace_image(self, index: int, png: bytes) -> None:
        """Replace an image by a PNG."""
        entry = self.document["images"][index]
        uri = entry.get("uri")
        if uri is None:
            self._replace_view(entry, png)
        elif uri.startswith("data:"):
            entry["uri"] = _data_uri(png, "image/png")
        else:
            self._replace_file(entry, uri, png)
        if entry.get("mimeType", "image/png") != "image/png":
            entry["mimeType"] = "image/png"
        self._show_in_all_readers(index)

    def _show_in_all_readers(self, image: int) -> None:
        """Leave the textures of an image no copy in another encoding, which other readers would show instead."""
        textures = self.document["textures"]
        for texture in textures:
            if image in _sources(texture) and (others := _encodings(texture)):
                texture["source"] = image
                for name in others:
                    self.drop_extension(name, texture, textures)

    def _replace_file(self, entry: Json, uri: str, png: bytes) -> None:
        upload = self._container.upload
        path = upload.beside(uri)
        if not path.lower().endswith(".png"):
            del self._files[path]
            path = free_name(path.rsplit(".", 1)[0] + ".png", self._files)
            entry["uri"] = quote(posixpath.relpath(path, posixpath.dirname(upload.main) or "."))
        self._files[path] = png

    def _replace_view(self, entry: Json, png: bytes) -> None:
        """Replace the bytes in the GLB's own chunk and move the views behind them."""
        views = self.document["bufferViews"]
        view = views[entry["bufferView"]]
        start = view.get("byteOffset", 0)
        end = start + view["byteLength"]
        others = [o for other in views for o in _ranges(other) if o is not view and o["buffer"] == view["buffer"]]
        overlaps = any(
            o.get("byteOffset", 0) < end and o.get("byteOffset", 0) + o["byteLength"] > start for o in others
        )
        if view["buffer"] != 0 or not self._has_own_chunk() or overlaps:
            entry["bufferView"] = self.add_view(png)
            return
        padding = (end - start - len(png)) % 4
        shift = len(png) + padding - (end - start)
        self.binary[start:end] = png + bytes(padding)
        view["byteLength"] = len(png)
        for other in others:
            if other.get("byteOffset", 0) >= end:
                other["byteOffset"] += shift

    def add_texture(self, image: int, *, sampled_like: Json | None = None) -> int:
        """Add a texture of an image, with the sampler of the texture ``sampled_like``; return its number."""
        kept = {key: value for key, value in (sampled_like or {}).items() if key == "sampler"}
        return self.add("textures", kept | {"source": image})

    def add_image(self, png: bytes) -> int:
        """Add an image; return its number."""
        image: Json = {"mimeType": "image/png"}
        if self._container.binary:
            image["bufferView"] = self.add_view(png)
        else:
            image["uri"] = _data_uri(png, "image/png")
        return self.add("images", image)

    def cut_open(self, primitive: Json, shape: Shape, cut: Unwrapped) -> None:
        """Split a primitive's vertices at the seams and add the texture coordinates of its paint."""
        attributes = {k: v for k, v in primitive["attributes"].items() if k not in {"TEXCOORD_0", "COLOR_0"}}
        primitive["attributes"] = {name: self._gather(index, cut.source) for name, index in attributes.items()}
        if "targets" in primitive:
            primitive["targets"] = [
                {name: self._gather(index, cut.source) for name, index in target.items()}
                for target in primitive["targets"]
            ]
        primitive["attributes"]["TEXCOORD_0"] = self.add_uvs(cut.uvs)
        primitive["indices"] = self.add_corners(cut.faces)
        primitive["mode"] = 4
        self.drop_extension(DRACO, primitive, [each for mesh in self.document["meshes"] for each in mesh["primitives"]])

    def drop_extension(self, name: str, entry: Json, alike: list[Json]) -> None:
        """Remove an extension from ``entry``, and from the file's lists if then none of ``alike`` has it.

        An image of its type stays, and the extension among those used.
        """
        if _extensions(entry).pop(name, None) is not None:
            _keep(entry, "extensions", entry["extensions"])
            if not any(name in _extensions(each) for each in alike):
                types = [image.get("mimeType") for image in self.document.get("images", [])]
                is_used = name in _TYPES and _TYPES[name] in types
                keys = {"extensionsRequired"} if is_used else {"extensionsRequired", "extensionsUsed"}
                for key in keys & self.document.keys():
                    _keep(self.document, key, [used for used in self.document[key] if used != name])

    def _gather(self, index: int, source: NDArray[np.int64]) -> int:
        accessor = self.document["accessors"][index]
        values = self._container.raw(index)[source]
        kept = {k: v for k, v in accessor.items() if k in {"componentType", "type", "normalized", "name"}}
        if "min" in accessor:
            kept |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add_accessor(values, kept)

    def add_view(self, data: bytes, entry: Json | None = None) -> int:
        """Add a buffer view of new bytes, in the GLB's own chunk or in a new buffer; return its number."""
        if self._container.binary and not self.document.get("buffers"):
            self.document["buffers"] = [{"byteLength": 0}]
        if self._has_own_chunk():
            return super().add_view(data, entry)
        place = {"buffer": len(self._before.get("buffers", [])), "byteOffset": append(self._extra, data)}
        return self.add("bufferViews", place | {"byteLength": len(data)} | (entry or {}))

    def finish(self) -> Upload:
        """The changed upload; unchanged files keep their bytes."""
        upload = self._container.upload
        if self._extra:
            self.add("buffers", {"byteLength": len(self._extra), "uri": _data_uri(self._extra, _BYTES)})
        if self.binary != self._binary_before:
            self.document["buffers"][0]["byteLength"] = len(self.binary)
        same = self.document == self._before  # as if unpainted, if a new image has the length of the old one
        if same and self.binary == self._binary_before and self._files == upload.files:
            return upload
        text = self._container.text if same else _dumped(self.document, self._container.text)
        main = self._packed(text) if self._container.binary else text
        return Upload(upload.main, self._files | {upload.main: main}, upload.packed)

    def _packed(self, text: bytes) -> bytes:
        kept = split_glb(self._container.upload.data)[1:]
        if kept and kept[0][0] == BIN_CHUNK:
            kept = kept[1:]
        own = [(BIN_CHUNK, bytes(self.binary))] if self.binary else []
        return glb(text, [*own, *kept])


_BYTES: Final = "application/octet-stream"
SPECULAR_GLOSSINESS: Final = "KHR_materials_pbrSpecularGlossiness"
"""Holds colours that some viewers show in place of the base colour."""


def _dumped(document: Json, before: bytes) -> bytes:
    """JSON, indented if ``before`` was."""
    if b"\n" in before.strip():
        return json.dumps(document, indent=2, ensure_ascii=False).encode()
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()


def _data_uri(data: bytes | bytearray, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _source(image: Json) -> tuple[object, object]:
    """What two images of one file have in common."""
    uri = image.get("uri")
    if uri is not None and not uri.startswith("data:"):
        uri = posixpath.normpath(unquote(uri).replace("\\", "/")).casefold()
    return uri, image.get("bufferView")


def _extensions(entry: Json) -> Json:
    found = entry.get("extensions")
    return found if isinstance(found, dict) else {}


def _ranges(view: Json) -> list[Json]:
    """The ranges of a buffer view, also that of its compressed copy (``EXT_meshopt_compression``)."""
    keys = ("buffer", "byteOffset", "byteLength")
    copies = (each for each in _extensions(view).values() if isinstance(each, dict) and "buffer" in each)
    return [view, *(each for each in copies if all(isinstance(each.setdefault(key, 0), int) for key in keys))]


def _users_of_images(document: Json) -> dict[int, set[int | str]]:
    """Users of each image: numbers of materials for base colour, paths for any other use."""
    users: dict[int, set[int | str]] = {}
    for number, material in enumerate(document.get("materials", [])):
        for path, index in _texture_uses(material, ""):
            user = number if path == ".pbrMetallicRoughness.baseColorTexture" else path
            texture = document["textures"][index] if 0 <= index < len(document.get("textures", [])) else {}
            for source in _sources(texture):
                users.setdefault(source, set()).add(user)
    return users


def _texture_uses(entry: object, path: str) -> Iterator[tuple[str, int]]:
    """(Path within a material, number of the texture) of each use of a texture."""
    if not isinstance(entry, dict):
        return
    for key, value in entry.items():
        if key.endswith("Texture") and isinstance(value, dict) and isinstance(value.get("index"), int):
            yield f"{path}.{key}", value["index"]
        yield from _texture_uses(value, f"{path}.{key}")


def _keep(entry: Json, key: str, left: Json | list[str]) -> None:
    """Replace ``entry[key]`` by what is left of it; glTF allows no empty lists."""
    if left:
        entry[key] = left
    else:
        del entry[key]


def _encodings(texture: Json) -> dict[str, int]:
    """Extensions of a texture that name an image, with its number."""
    found = _extensions(texture).items()
    return {k: v["source"] for k, v in found if isinstance(v, dict) and isinstance(v.get("source"), int)}


def _sources(texture: Json) -> list[int]:
    """The images of a texture in all encodings."""
    own = texture.get("source")
    return [*([own] if isinstance(own, int) else []), *_encodings(texture).values()]
