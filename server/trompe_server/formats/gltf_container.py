"""Open a glTF file: check its JSON against the schema, find its buffers, read accessors and images."""

import base64
import binascii
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from trompe_server.formats.gltf_schema import INSTANCING, READ_EXTENSIONS, Document, Draco, Material, Primitive
from trompe_server.formats.upload import Upload
from trompe_shared.errors import ObjectError
from trompe_shared.faults import faults_of

MAX_JSON: Final = 32 * 2**20
GLB_MAGIC: Final = b"glTF"
JSON_CHUNK: Final = 0x4E4F534A
BIN_CHUNK: Final = 0x004E4942
COMPONENTS: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

T = TypeVar("T")


def at(items: Sequence[T], index: int, what: str) -> T:
    """``items[index]``. Raises ``ObjectError`` for an index out of range."""
    if not 0 <= index < len(items):
        raise ObjectError(f"The glTF names {what} {index}, but has {len(items)}; export it again.")
    return items[index]


@dataclass(frozen=True)
class Container:
    """text: the JSON as in the file. buffers: at least as long as their declared lengths. decompressed: accessors of
    which the buffers hold only compressed numbers."""

    upload: Upload
    text: bytes
    document: Document
    buffers: tuple[bytes, ...]
    binary: bool
    decompressed: Mapping[int, NDArray[np.generic]] = field(default_factory=dict)

    def material(self, index: int | None) -> Material:
        """A material, or glTF's default one."""
        return Material() if index is None else at(self.document.materials, index, "material")

    def view(self, index: int) -> bytes:
        """Bytes of a buffer view."""
        view = at(self.document.buffer_views, index, "buffer view")
        data = at(self.buffers, view.buffer, "buffer")
        if view.byte_offset + view.byte_length > len(data):
            raise ObjectError(f"Buffer view {index} of the glTF ends beyond its buffer; export it again.")
        return data[view.byte_offset : view.byte_offset + view.byte_length]

    def raw(self, index: int) -> NDArray[np.generic]:
        """Stored numbers of an accessor, (count, components)."""
        if index in self.decompressed:
            return self.decompressed[index]
        accessor = at(self.document.accessors, index, "accessor")
        kind, width = np.dtype(COMPONENTS[accessor.component_type]), WIDTHS[accessor.type]
        what = f"Accessor {index}"
        if accessor.buffer_view is None:
            values = np.zeros((accessor.count, width), kind)
        else:
            values = self._rows(accessor.buffer_view, accessor.byte_offset, (accessor.count, width), kind, what)
        if (sparse := accessor.sparse) is not None:
            where, of = sparse.indices, sparse.values
            numbers = np.dtype(COMPONENTS[where.component_type])
            changed = self._rows(where.buffer_view, where.byte_offset, (sparse.count, 1), numbers, what)[:, 0]
            if changed.max() >= accessor.count:
                raise ObjectError(
                    f"{what} of the glTF changes row {changed.max()} of {accessor.count}; export it again."
                )
            values[changed] = self._rows(of.buffer_view, of.byte_offset, (sparse.count, width), kind, what)
        return values

    def _rows(
        self, view: int, offset: int, shape: tuple[int, int], kind: np.dtype[np.generic], what: str
    ) -> NDArray[np.generic]:
        """Numbers of a buffer view, in rows as far apart as it says."""
        data, size = self.view(view), kind.itemsize * shape[1]
        stride = self.document.buffer_views[view].byte_stride or size
        if offset + stride * (shape[0] - 1) + size > len(data) or stride < size:
            raise ObjectError(f"{what} of the glTF reads beyond its buffer view; export it again.")
        return np.ndarray(shape, kind, data, offset, (stride, kind.itemsize)).copy()

    def numbers(self, index: int, width: int) -> NDArray[np.float32]:
        """An accessor of ``width`` components as float32 (count, width), normalised if declared so."""
        values, accessor = self.raw(index), self.document.accessors[index]
        if values.shape[1] != width:
            raise ObjectError(f"Accessor {index} of the glTF has {values.shape[1]} components, expected {width}.")
        if not accessor.normalized or accessor.component_type == 5126:
            return values.astype(np.float32)
        largest = np.iinfo(values.dtype).max  # type: ignore[type-var]
        return np.maximum(values.astype(np.float32) / largest, -1.0)

    def image_bytes(self, index: int) -> bytes:
        """The image file of an image."""
        image = at(self.document.images, index, "image")
        if image.buffer_view is not None:
            return self.view(image.buffer_view)
        if image.uri is None:
            raise ObjectError(f"Image {index} of the glTF has neither a buffer view nor a URI; export it again.")
        return resolve(image.uri, self.upload)


def resolve(uri: str, upload: Upload) -> bytes:
    """Bytes of a data URI or of a file of the upload. Raises ``ObjectError`` for any other URI."""
    if not uri.startswith("data:"):
        return upload.files[upload.beside(uri)]
    head, _, data = uri.partition(",")
    if not head.endswith(";base64"):
        raise ObjectError("The glTF has a data URI that is not base64; export it again.")
    try:
        return base64.b64decode(data, validate=True)
    except binascii.Error as error:
        raise ObjectError(f"The glTF has a damaged data URI ({error}); export it again.") from error


def split_glb(data: bytes) -> list[tuple[int, bytes]]:
    """Type and bytes of each chunk. Raises ``ObjectError``."""
    if len(data) < 20:
        raise ObjectError("The GLB file ends too early; export it again.")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise ObjectError(f"The GLB file has version {version}; expected 2. Export it as glTF 2.0.")
    chunks, position = [], 12
    end = min(length, len(data))
    while position + 8 <= end:
        size, kind = struct.unpack_from("<II", data, position)
        if position + 8 + size > end:
            raise ObjectError("A chunk of the GLB file ends beyond it; export it again.")
        chunks.append((kind, data[position + 8 : position + 8 + size]))
        position += 8 + size
    if not chunks or chunks[0][0] != JSON_CHUNK:
        raise ObjectError("The first chunk of the GLB file is not JSON; export it again.")
    return chunks


def open_container(upload: Upload) -> Container:
    """Open a .gltf or .glb file. Raises ``ObjectError``."""
    binary = upload.data[:4] == GLB_MAGIC
    chunks = split_glb(upload.data) if binary else [(JSON_CHUNK, upload.data)]
    text = chunks[0][1]
    document = _document(text)
    own = next((chunk for kind, chunk in chunks[1:2] if kind == BIN_CHUNK), None)
    container = Container(upload, text, document, _buffers(document, upload, own), binary)
    primitives = [primitive for mesh in document.meshes for primitive in mesh.primitives]
    compressed = [(primitive, primitive.draco) for primitive in primitives if primitive.draco is not None]
    found = (accessors for each in compressed for accessors in _decompressed(container, *each))
    return replace(container, decompressed=dict(found))


def _decompressed(
    container: Container, primitive: Primitive, draco: Draco
) -> Iterator[tuple[int, NDArray[np.generic]]]:
    """The accessors of a primitive that only Draco's bytes hold."""
    import DracoPy  # type: ignore[import-not-found]

    accessors = container.document.accessors
    wanted = {name: index for name, index in primitive.attributes.items() if name in draco.attributes}
    read = [*wanted.values(), *([] if primitive.indices is None else [primitive.indices])]
    if all(at(accessors, index, "accessor").buffer_view is not None for index in read):
        return  # the file has both
    if primitive.indices is None or primitive.mode != 4:
        raise ObjectError("A mesh of the glTF that Draco compresses is no list of triangles; export it again.")
    try:
        mesh: Any = DracoPy.decode(container.view(draco.buffer_view))
        values = {
            index: mesh.get_attribute_by_unique_id(draco.attributes[name])["data"] for name, index in wanted.items()
        } | {primitive.indices: mesh.faces.reshape(-1, 1)}
    except Exception as error:
        raise ObjectError(f"A mesh of the glTF cannot be decompressed by Draco ({error}); export it again.") from error
    for index, numbers in values.items():
        accessor = at(accessors, index, "accessor")
        shape, declared = numbers.shape, (accessor.count, WIDTHS[accessor.type])
        if shape != declared:
            raise ObjectError(
                f"Accessor {index} of the glTF has {declared} numbers, Draco's bytes {shape}; export it again."
            )
        yield index, numbers.astype(COMPONENTS[accessor.component_type])


def _document(text: bytes) -> Document:
    if len(text) > MAX_JSON:
        raise ObjectError(
            f"The glTF's JSON has {len(text)} bytes; the limit is {MAX_JSON}. Put buffers and images beside it, or "
            "export it as .glb."
        )
    try:
        document = Document.model_validate_json(text.removeprefix(b"\xef\xbb\xbf"))
    except ValidationError as error:
        first = next(faults_of(error))
        raise ObjectError(f"The glTF is not valid at {first.place or 'the JSON'}: {first.message}.") from error
    if not document.asset.version.startswith("2."):
        raise ObjectError(f"The glTF has version {document.asset.version[:20]!r}; export it as glTF 2.0.")
    needed = [*document.extensions_required, *({INSTANCING} & {*document.extensions_used})]
    unread = dict.fromkeys(name for name in needed if not name.startswith(READ_EXTENSIONS))
    if unread:
        raise ObjectError(
            f"The glTF requires {', '.join(unread)[:200]}, which is not supported; export it uncompressed, with PNG, "
            "JPEG or WebP textures and without extensions."
        )
    if older := [
        material.name or f"number {k}" for k, material in enumerate(document.materials) if material.colour_unread
    ]:
        raise ObjectError(
            f"The glTF's materials {', '.join(older)[:200]} have their colours in KHR_materials_pbrSpecularGlossiness, "
            "which is archived; convert them to metallic-roughness, e.g. by `npx @gltf-transform/cli metalrough`."
        )
    return document


def _buffers(document: Document, upload: Upload, own: bytes | None) -> tuple[bytes, ...]:
    found = []
    for index, buffer in enumerate(document.buffers):
        data = own if buffer.uri is None and index == 0 else resolve(buffer.uri or "", upload)
        if data is None or len(data) < buffer.byte_length:
            have = 0 if data is None else len(data)
            raise ObjectError(f"Buffer {index} of the glTF has {have} bytes and should have {buffer.byte_length}.")
        found.append(data)
    return tuple(found)
