"""The supported part of glTF 2.0's schema, with ranges for all numbers and indices."""

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, AliasPath, BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

from trompe_shared.wavefront import MAX_FACES

DRACO: Final = "KHR_draco_mesh_compression"
"""Holds the compressed numbers of a primitive, or a compressed copy of them."""

READ_EXTENSIONS: Final = (
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    DRACO,
    "KHR_materials_",
    "KHR_lights_punctual",
    "EXT_texture_webp",
)
"""Prefixes of extensions a file may require: supported, or about light and finish without effect here."""

INSTANCING: Final = "EXT_mesh_gpu_instancing"
"""Refused even where it is optional: without it one of many instances is left."""

MAX_NODES: Final = 100_000
MAX_JOINTS: Final = 65_536

Index = Annotated[int, Field(ge=0, lt=2**31)]
Size = Annotated[int, Field(ge=0, lt=2**40)]
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
Unit = Annotated[float, Field(ge=-1e-6, le=1 + 1e-6), AfterValidator(lambda value: min(max(value, 0.0), 1.0))]
"""From 0 to 1, up to rounding."""
Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]
Quadruple = tuple[Number, Number, Number, Number]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, alias_generator=to_camel)


class Asset(_Part):
    version: str


class Buffer(_Part):
    """Bytes in the GLB's own chunk, in a data URI or in a file."""

    byte_length: Size
    uri: str | None = None


class BufferView(_Part):
    buffer: Index
    byte_offset: Size = 0
    byte_length: Size
    byte_stride: Annotated[int, Field(ge=1, le=1024)] | None = None


class SparseValues(_Part):
    """Values of the changed rows of an accessor."""

    buffer_view: Index
    byte_offset: Size = 0


class SparseIndices(SparseValues):
    """Numbers of the changed rows."""

    component_type: Literal[5121, 5123, 5125]


class Sparse(_Part):
    """Rows of an accessor with other values than its buffer view."""

    count: Annotated[int, Field(ge=1, le=3 * MAX_FACES)]
    indices: SparseIndices
    values: SparseValues


class Accessor(_Part):
    buffer_view: Index | None = None
    byte_offset: Size = 0
    component_type: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    normalized: bool = False
    count: Annotated[int, Field(ge=1, le=3 * MAX_FACES)]
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    sparse: Sparse | None = None


class Draco(_Part):
    """Compressed bytes, and Draco's number of each attribute in them."""

    buffer_view: Index
    attributes: dict[str, Index]


class Primitive(_Part):
    """Triangles of one material."""

    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    draco: Draco | None = Field(default=None, validation_alias=AliasPath("extensions", DRACO))


class Mesh(_Part):
    """Primitives of one mesh; ``weights`` blend their morph targets."""

    primitives: Annotated[tuple[Primitive, ...], Field(min_length=1)]
    weights: tuple[Number, ...] = ()


class Node(_Part):
    """A transform: a matrix in column order, or translation, rotation (quaternion x, y, z, w) and scale."""

    mesh: Index | None = None
    skin: Index | None = None
    children: tuple[Index, ...] = ()
    matrix: Annotated[tuple[Number, ...], Field(min_length=16, max_length=16)] | None = None
    translation: Triple = (0.0, 0.0, 0.0)
    rotation: Quadruple = (0.0, 0.0, 0.0, 1.0)
    scale: Triple = (1.0, 1.0, 1.0)
    weights: tuple[Number, ...] = ()


class Skin(_Part):
    """Nodes that move the vertices of a mesh, and matrices from the mesh to each of them (default: none)."""

    joints: Annotated[tuple[Index, ...], Field(min_length=1, max_length=MAX_JOINTS)]
    inverse_bind_matrices: Index | None = None


class Scene(_Part):
    nodes: tuple[Index, ...] = ()


class Image(_Part):
    uri: str | None = None
    buffer_view: Index | None = None
    mime_type: str | None = None
    name: str | None = None


class Texture(_Part):
    source: Index | None = None
    sampler: Index | None = None
    webp: Index | None = Field(default=None, validation_alias=AliasPath("extensions", "EXT_texture_webp", "source"))

    @property
    def image(self) -> Index | None:
        """The image in an encoding that is read."""
        return self.webp if self.source is None else self.source


class Sampler(_Part):
    """Wrapping of a texture: 10497 repeated, 33071 clamped, 33648 mirrored."""

    wrap_s: Literal[10497, 33071, 33648] = 10497
    wrap_t: Literal[10497, 33071, 33648] = 10497


class UvTransform(_Part):
    """KHR_texture_transform. ``rotation`` in radians."""

    offset: Pair = (0.0, 0.0)
    rotation: Number = 0.0
    scale: Pair = (1.0, 1.0)
    tex_coord: Index | None = None


class TextureInfo(_Part):
    """The use of a texture; ``scale`` is that of a normal map."""

    index: Index
    tex_coord: Index = 0
    scale: Number = 1.0
    transform: UvTransform | None = Field(
        default=None, validation_alias=AliasPath("extensions", "KHR_texture_transform")
    )

    @property
    def placement(self) -> tuple[int, UvTransform]:
        """The set of texture coordinates and their transform, which no longer names one."""
        transform = self.transform or UvTransform()
        which = self.tex_coord if transform.tex_coord is None else transform.tex_coord
        return which, transform.model_copy(update={"tex_coord": None})


class Pbr(_Part):
    """Metallic-roughness. ``base_color_factor`` is linear."""

    base_color_factor: tuple[Unit, Unit, Unit, Unit] = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: TextureInfo | None = None
    metallic_factor: Unit = 1.0
    roughness_factor: Unit = 1.0
    metallic_roughness_texture: TextureInfo | None = None


class Material(_Part):
    """The supported properties of a material."""

    name: str | None = None
    pbr: Pbr = Field(default=Pbr(), alias="pbrMetallicRoughness")
    normal_texture: TextureInfo | None = None
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: Annotated[float, Field(ge=0.0, le=1e3)] = 0.5
    double_sided: bool = False
    specular_glossiness: Any = Field(
        default=None, validation_alias=AliasPath("extensions", "KHR_materials_pbrSpecularGlossiness")
    )

    @property
    def colour_unread(self) -> bool:
        """Whether only the older specular-glossiness extension tells the colour."""
        return self.specular_glossiness is not None and self.pbr == Pbr()

    @property
    def maps(self) -> tuple[TextureInfo, ...]:
        """The supported textures."""
        all_maps = (self.pbr.base_color_texture, self.normal_texture, self.pbr.metallic_roughness_texture)
        return tuple(info for info in all_maps if info is not None)


class Document(_Part):
    asset: Asset
    extensions_required: tuple[str, ...] = ()
    extensions_used: tuple[str, ...] = ()
    scene: Index | None = None
    scenes: tuple[Scene, ...] = ()
    nodes: Annotated[tuple[Node, ...], Field(max_length=MAX_NODES)] = ()
    meshes: tuple[Mesh, ...] = ()
    skins: tuple[Skin, ...] = ()
    accessors: tuple[Accessor, ...] = ()
    buffer_views: tuple[BufferView, ...] = ()
    buffers: tuple[Buffer, ...] = ()
    materials: tuple[Material, ...] = ()
    textures: tuple[Texture, ...] = ()
    images: tuple[Image, ...] = ()
    samplers: tuple[Sampler, ...] = ()
