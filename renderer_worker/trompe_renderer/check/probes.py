"""Objects whose pictures answer one question each. Their meshes differ, so no cache can take one for another."""

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.object3d import Object3D, encode_png, object_from_files
from trompe_shared.wavefront import Part, obj_text

TEXTURE: Final = "paint.png"
"""The only texture of all probes but the cube."""
Triple = tuple[int, int, int]
FACES: Final[Mapping[str, tuple[Triple, Triple, Triple]]] = {
    "right": ((1, 0, 0), (0, 1, 0), (230, 25, 25)),
    "left": ((-1, 0, 0), (0, 1, 0), (25, 230, 230)),
    "top": ((0, 1, 0), (0, 0, -1), (25, 230, 25)),
    "bottom": ((0, -1, 0), (0, 0, 1), (230, 25, 230)),
    "front": ((0, 0, 1), (0, 1, 0), (25, 25, 230)),
    "back": ((0, 0, -1), (0, 1, 0), (230, 230, 25)),
}
"""Outward normal of each face of the cube, the direction in which v grows, and its colour: complementary ones opposite
each other."""
RINGS: Final = (1.0, 0.8, 0.65, 0.5, 0.35)
"""sRGB levels of the chart's rings, all equally wide, from the middle outwards."""

Colours = NDArray[np.uint8]


def plain(*colour: int) -> Colours:
    """A texture of one colour, (4, 4, 3)."""
    return np.full((4, 4, 3), colour, np.uint8)


def cube(half: float) -> Object3D:
    """A cube with a colour, a texture and a material for each face. ``half`` of an edge, metres."""
    parts = [_face(normal, up, half, name) for name, (normal, up, _) in FACES.items()]
    return _object(parts, {f"{name}.png": plain(*colour) for name, (_, _, colour) in FACES.items()})


def plate(half: float, texture: Colours, *, corner: tuple[int, int] = (0, 0)) -> Object3D:
    """A square that faces +z, seen from the front only. ``half`` of an edge, metres. ``corner``: u, v lower left."""
    face = _face((0, 0, 1), (0, 1, 0), half, "paint")
    flat, uvs = face.vertices * np.array([1, 1, 0], np.float32), face.uvs + np.array(corner, np.float32)
    return _object([replace(face, vertices=flat, uvs=uvs)], {TEXTURE: texture})


def layers(half: float, texture: Colours) -> Object3D:
    """Two pairs of squares that face +z, at the left and right; in each, one hides the other, 0.1 m behind.

    The front ones have the texture's first and last quarter, the others its middle. The left pair is drawn from the
    front, the right one from the back.
    """
    square = _face((0, 0, 1), (0, 1, 0), half, "paint")
    places = ((-1.2, 0.1, 0.0), (-1.2, 0.0, 0.25), (1.2, 0.0, 0.5), (1.2, 0.1, 0.75))
    points = [square.vertices * [1, 1, 0] + [x * half, 0, z] for x, z, _ in places]
    uvs = [square.uvs * [0.25, 1] + [u, 0] for _, _, u in places]
    faces = [square.faces + k * len(square.vertices) for k in range(len(places))]
    part = _part("paint", np.concatenate(points), [0, 0, 1], np.concatenate(uvs), np.concatenate(faces))
    return _object([part], {TEXTURE: texture})


def disc(radius: float, texture: Colours, *, corners: int = 90, z: float = 0.0) -> Object3D:
    """A regular polygon that faces +z, at a height ``z``; its circumscribed square is the texture's."""
    angles = np.arange(corners) * 2 * np.pi / corners
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    points = np.concatenate([np.zeros((1, 3)), points]) + np.array([0, 0, z / radius])
    rim = np.arange(1, corners + 1)
    faces = np.stack([0 * rim, rim, np.roll(rim, -1)], axis=1)
    return _object([_part("paint", radius * points, [0, 0, 1], 0.5 + 0.5 * points[:, :2], faces)], {TEXTURE: texture})


def ball(radius: float, texture: Colours, *, middle: float = 0.0) -> Object3D:
    """A smooth sphere: a cube of finely divided faces, blown up. ``middle``: its x, metres."""
    faces = [_face(normal, up, 1.0, "paint", steps=8) for normal, up, _ in FACES.values()]
    points = np.concatenate([each.vertices for each in faces])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    triangles = [each.faces + k * len(each.vertices) for k, each in enumerate(faces)]
    uvs = np.concatenate([each.uvs for each in faces])
    places = radius * points + np.array([middle, 0, 0])
    return _object([_part("paint", places, points, uvs, np.concatenate(triangles))], {TEXTURE: texture})


def chart(radius: float) -> Object3D:
    """A disc with a ring for each of ``RINGS``."""
    side = 128
    x = (np.arange(side) + 0.5) / side * 2 - 1
    ring = (np.hypot(x, x[:, None]) * len(RINGS)).astype(int).clip(0, len(RINGS) - 1)
    grey = np.round(255 * np.array(RINGS))[ring].astype(np.uint8)
    return disc(radius, np.repeat(grey[..., None], 3, axis=2), corners=80)


def _face(normal: tuple[int, ...], up: tuple[int, ...], half: float, material: str, *, steps: int = 1) -> Part:
    """A face of a cube around the origin, in ``steps`` x ``steps`` squares."""
    n, v = np.array(normal), np.array(up)
    grid = np.linspace(0, 1, steps + 1)
    uvs = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    points = half * (n + (2 * uvs[:, :1] - 1) * np.cross(v, n) + (2 * uvs[:, 1:] - 1) * v)
    corner = (np.arange(steps) + np.arange(steps)[:, None] * (steps + 1)).ravel()
    one, two, three, four = corner, corner + 1, corner + steps + 2, corner + steps + 1
    return _part(
        material, points, n, uvs, np.concatenate([np.stack([one, two, three], 1), np.stack([one, three, four], 1)])
    )


def _part(material: str, points: NDArray[np.float64], normals: object, uvs: NDArray[np.float64], faces: object) -> Part:
    directions = np.broadcast_to(np.asarray(normals, np.float32), points.shape)
    return Part(material, points.astype(np.float32), directions, uvs.astype(np.float32), np.asarray(faces, np.int32))


def _object(parts: list[Part], textures: Mapping[str, Colours]) -> Object3D:
    """All probes have the same name: caches must not go by it."""
    files = {"probe.obj": obj_text(tuple(parts)).encode()}
    table = {part.material: {"albedo": f"{part.material}.png"} for part in parts}
    files["probe_mat_def.json"] = json.dumps(table).encode()
    return object_from_files(files | {name: encode_png(texture) for name, texture in textures.items()})
