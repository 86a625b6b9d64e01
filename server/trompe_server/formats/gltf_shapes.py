"""Meshes of a glTF scene: transforms of their instances, and geometry of their primitives."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import check_numbers
from trompe_server.formats.gltf_container import Container, at
from trompe_server.formats.gltf_schema import Document, Node, Primitive, TextureInfo, UvTransform
from trompe_server.formats.unwrap import Unwrapped
from trompe_shared.errors import ObjectError
from trompe_shared.wavefront import MAX_FACES, Part, beyond_edges

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Instance:
    """A mesh in the scene. matrix: (4, 4), to the world; joints: (J, 4, 4), those of its skin, in place of it."""

    mesh: int
    matrix: Matrix
    joints: Matrix | None = None


@dataclass(frozen=True)
class Shape:
    """One primitive of the file. ``cut``: its unwrapping, if any.

    uvs: (V, 2), v upwards. colours: (V, 3), linear. pull: numbers (V, n) of the joints that move each vertex, and their
    weights (V, n), which sum to 1.
    """

    material: int | None
    vertices: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    uvs: NDArray[np.float32] | None
    colours: NDArray[np.float64] | None
    faces: NDArray[np.int32]
    cut: Unwrapped | None = None
    pull: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None


def instances(container: Container) -> Iterator[Instance]:
    """Each mesh of the scene. Raises ``ObjectError`` unless the nodes form a tree."""
    document = container.document
    world = _worlds(document)
    triangles, count_of = 0, cache(partial(_triangles, container))
    for index, matrix in world.items():
        node = document.nodes[index]
        if node.mesh is None:
            continue
        if any(node.weights or at(document.meshes, node.mesh, "mesh").weights):
            raise ObjectError("The glTF has morph targets; apply them and export it again.")
        triangles += count_of(node.mesh)
        if triangles > MAX_FACES:
            raise ObjectError(f"The glTF has more than {MAX_FACES} triangles; simplify it.")
        yield Instance(node.mesh, matrix, None if node.skin is None else _joints(container, node.skin, world))


def _worlds(document: Document) -> dict[int, Matrix]:
    """World transform of each node of the scene, parents first."""
    waiting = [(index, np.eye(4)) for index in reversed(_roots(document))]
    found: dict[int, Matrix] = {}
    while waiting:
        index, above = waiting.pop()
        if index in found:
            raise ObjectError(f"Node {index} of the glTF has two parents or contains itself; nodes must form a tree.")
        node = at(document.nodes, index, "node")
        found[index] = above @ _local(node)
        waiting += [(child, found[index]) for child in reversed(node.children)]
    return found


def _joints(container: Container, index: int, world: Mapping[int, Matrix]) -> Matrix:
    """What each joint of a skin does to the vertices in its pose, (joints, 4, 4)."""
    skin = at(container.document.skins, index, "skin")
    if lost := [joint for joint in skin.joints if joint not in world]:
        raise ObjectError(f"Joint {lost[0]} of the glTF's skin {index} is not in the scene; export it again.")
    joints = np.stack([world[joint] for joint in skin.joints])
    if skin.inverse_bind_matrices is None:
        return joints
    columns = container.numbers(skin.inverse_bind_matrices, 16).astype(np.float64)
    if len(columns) < len(joints):
        raise ObjectError(
            f"Skin {index} of the glTF has {len(joints)} joints and {len(columns)} inverse bind matrices."
        )
    return joints @ columns[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)


def _roots(document: Document) -> Sequence[int]:
    if document.scenes:
        return at(document.scenes, document.scene or 0, "scene").nodes
    children = {child for node in document.nodes for child in node.children}
    return [index for index in range(len(document.nodes)) if index not in children]


def _triangles(container: Container, mesh: int) -> int:
    """Approximate number of triangles of a mesh; double-sided ones count twice."""
    count = 0
    for primitive in at(container.document.meshes, mesh, "mesh").primitives:
        source = primitive.attributes.get("POSITION", 0) if primitive.indices is None else primitive.indices
        corners = at(container.document.accessors, source, "accessor").count
        sides = 2 if container.material(primitive.material).double_sided else 1
        count += sides * (corners // 3 if primitive.mode == 4 else corners)
    return count


def _local(node: Node) -> Matrix:
    """Transform (4, 4) of a node."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    x, y, z, w = np.array(node.rotation) / max(np.linalg.norm(node.rotation), 1e-12)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.scale)
    matrix[:3, 3] = node.translation
    return matrix


def read_shape(container: Container, primitive: Primitive) -> Shape:
    if "POSITION" not in primitive.attributes:
        raise ObjectError("A mesh of the glTF has no positions; export it again.")
    vertices = container.numbers(primitive.attributes["POSITION"], 3)
    check_numbers(vertices, "The glTF")
    normals = container.numbers(primitive.attributes["NORMAL"], 3) if "NORMAL" in primitive.attributes else None
    faces = _faces(container, primitive, len(vertices))
    uvs = _uvs(container, primitive)
    colours = _vertex_colours(container, primitive)
    for values, what in ((normals, "normals"), (uvs, "texture coordinates"), (colours, "colours")):
        if values is not None and len(values) != len(vertices):
            raise ObjectError(f"A mesh of the glTF has {len(vertices)} positions and {len(values)} {what}.")
        if values is not None:
            check_numbers(values, "The glTF")
    pull = _pull(container, primitive, len(vertices)) if "JOINTS_0" in primitive.attributes else None
    return Shape(primitive.material, vertices, normals, uvs, colours, faces, pull=pull)


def _faces(container: Container, primitive: Primitive, count: int) -> NDArray[np.int32]:
    """Triangles (F, 3) of a list, strip or fan. Raises ``ObjectError`` for indices out of range."""
    corners: NDArray[np.int64] = np.arange(count)
    if primitive.indices is not None:
        raw = container.raw(primitive.indices)
        if raw.dtype.kind != "u" or raw.shape[1] != 1:
            raise ObjectError("A mesh of the glTF has indices that are not whole numbers; export it again.")
        corners = raw[:, 0].astype(np.int64)
    if corners.max(initial=0) >= count:
        raise ObjectError(f"A mesh of the glTF names vertex {corners.max()}, but has {count}; export it again.")
    if primitive.mode == 4:
        faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
    elif primitive.mode == 5:
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
    else:
        faces = np.stack([np.full(max(len(corners) - 2, 0), corners[0]), corners[1:-1], corners[2:]], axis=1)
    if not len(faces):
        raise ObjectError("A mesh of the glTF has fewer than three corners; export it again.")
    return faces.astype(np.int32)


def _uvs(container: Container, primitive: Primitive) -> NDArray[np.float32] | None:
    """Texture coordinates (V, 2) of the material's maps, v upwards, or ``None``."""
    material = container.material(primitive.material)
    if not material.maps:
        which, transform = 0, UvTransform()
    else:
        which, transform = material.maps[0].placement
        if any(info.placement != material.maps[0].placement for info in material.maps):
            raise ObjectError(
                f"Material {material.name or primitive.material!r} places its maps differently (texCoord or "
                "KHR_texture_transform); bake them to one set of texture coordinates."
            )
    if f"TEXCOORD_{which}" not in primitive.attributes:
        if material.maps:
            raise ObjectError(
                f"Material {material.name or primitive.material!r} has textures, but one of its meshes has no "
                f"TEXCOORD_{which}; unwrap it in a modelling program."
            )
        return None
    uvs = _moved(container.numbers(primitive.attributes[f"TEXCOORD_{which}"], 2), transform)
    _check_wrapping(container.document, f"Material {material.name or primitive.material!r}", material.maps, uvs)
    return np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1)


def _moved(uvs: NDArray[np.float32], transform: UvTransform) -> NDArray[np.float32]:
    if (transform.offset, transform.rotation, transform.scale) == ((0.0, 0.0), 0.0, (1.0, 1.0)):
        return uvs
    cosine, sine = np.cos(transform.rotation), np.sin(transform.rotation)
    turn = np.array([[cosine, sine], [-sine, cosine]]) * np.array(transform.scale)
    return np.asarray(uvs @ turn.T + transform.offset, np.float32)


def _check_wrapping(document: Document, what: str, maps: Sequence[TextureInfo], uvs: NDArray[np.float32]) -> None:
    """Raise ``ObjectError`` for wrapping other than repetition, unless all coordinates are within [0, 1]."""
    if not beyond_edges(uvs):
        return
    for info in maps:
        texture = at(document.textures, info.index, "texture")
        if texture.sampler is None:
            continue
        sampler = at(document.samplers, texture.sampler, "sampler")
        if (sampler.wrap_s, sampler.wrap_t) != (10497, 10497):
            raise ObjectError(
                f"{what} clamps or mirrors a texture beyond its edges, which is not supported; use "
                "repetition, or texture coordinates within [0, 1]."
            )


def _vertex_colours(container: Container, primitive: Primitive) -> NDArray[np.float64] | None:
    """Linear colours (V, 3) of vertices; ``None`` if there are none or all are white.

    Raises ``ObjectError`` for alpha that shows.
    """
    if "COLOR_0" not in primitive.attributes:
        return None
    index = primitive.attributes["COLOR_0"]
    width = 4 if at(container.document.accessors, index, "accessor").type == "VEC4" else 3
    colours, alpha = np.split(container.numbers(index, width).astype(np.float64), [3], axis=1)
    material = container.material(primitive.material)
    if material.alpha_mode != "OPAQUE" and (alpha < 0.999).any():
        raise ObjectError(
            f"Material {material.name or primitive.material!r} has vertex colours with alpha, which is not supported; "
            "bake it into its base colour texture."
        )
    return None if (colours > 0.999).all() else np.clip(colours, 0.0, 1.0)


def _pull(container: Container, primitive: Primitive, count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """``Shape.pull`` of a primitive with joints. The first joint holds vertices without weights."""
    joints, weights = [], []
    for k in range(len(primitive.attributes)):
        if f"JOINTS_{k}" not in primitive.attributes:
            break
        if f"WEIGHTS_{k}" not in primitive.attributes:
            raise ObjectError(f"A mesh of the glTF has JOINTS_{k} and no WEIGHTS_{k}; export it again.")
        joints.append(container.numbers(primitive.attributes[f"JOINTS_{k}"], 4).astype(np.int64))
        weights.append(container.numbers(primitive.attributes[f"WEIGHTS_{k}"], 4).astype(np.float64))
    if any(len(each) != count for each in joints + weights):
        raise ObjectError("A mesh of the glTF has another number of joints or weights than of positions.")
    shares = np.concatenate(weights, axis=1)
    check_numbers(shares, "The glTF")
    shares[shares.sum(1) <= 0] = np.eye(1, shares.shape[1])
    return np.concatenate(joints, axis=1), shares / shares.sum(1, keepdims=True)


def _blended(shape: Shape, joints: Matrix) -> Matrix:
    """World transform of each vertex, (V, 4, 4), as the ``joints`` of a skin pull it (glTF 2.0, section 3.7.3)."""
    if shape.pull is None:
        raise ObjectError("A mesh of the glTF has a skin, but no JOINTS_0; export it again.")
    numbers, weights = shape.pull
    if wrong := {int(number) for number in (numbers.min(), numbers.max()) if not 0 <= number < len(joints)}:
        raise ObjectError(
            f"A mesh of the glTF names joint {wrong.pop()}, but its skin has {len(joints)}; export it again."
        )
    blended = np.zeros((len(numbers), 4, 4))
    for column in range(numbers.shape[1]):
        blended += weights[:, column, None, None] * joints[numbers[:, column]]
    return blended


def placed(shape: Shape, instance: Instance, material: str) -> Part:
    """The shape of an instance in the world, with its own texture coordinates or those of its unwrapping."""
    matrix = instance.matrix if instance.joints is None else _blended(shape, instance.joints)
    if (cut := shape.cut) is not None:
        normals = None if shape.normals is None else shape.normals[cut.source]
        shape = replace(shape, vertices=shape.vertices[cut.source], normals=normals, uvs=cut.uvs, faces=cut.faces)
        matrix = matrix if instance.joints is None else matrix[cut.source]
    assert shape.uvs is not None
    moved = (matrix[..., :3, :3] @ shape.vertices[..., None])[..., 0] + matrix[..., :3, 3]
    check_numbers(moved, "The glTF")
    vertices = moved.astype(np.float32)
    mirrored = np.median(np.linalg.det(matrix[..., :3, :3])) < 0
    faces = np.ascontiguousarray(shape.faces[:, ::-1]) if mirrored else shape.faces
    if shape.normals is None:
        return _faceted(material, vertices[faces], shape.uvs[faces])
    return Part(material, vertices, _transformed(shape.normals, matrix), shape.uvs, faces)


def _transformed(normals: NDArray[np.float32], matrix: Matrix) -> NDArray[np.float32]:
    """Unit normals after ``matrix``, one for all (4, 4) or for each (V, 4, 4), by cofactors: it may be singular."""
    a, b, c = (matrix[..., :3, column] for column in range(3))
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    sign = np.where(np.linalg.det(matrix[..., :3, :3]) < 0, -1.0, 1.0)[..., None]
    turned = sign * (cofactors @ normals.astype(np.float64)[..., None])[..., 0]
    lengths = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.asarray(turned / np.maximum(lengths, 1e-30), np.float32)


def _faceted(material: str, corners: NDArray[np.float32], uvs: NDArray[np.float32]) -> Part:
    """Triangles (F, 3, 3) with one normal for each face, glTF's rule for missing normals."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    flat = np.repeat(normals, 3, axis=0).astype(np.float32)
    return Part(material, corners.reshape(-1, 3), flat, uvs.reshape(-1, 2), faces)
