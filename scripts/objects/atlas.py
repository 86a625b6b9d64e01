"""From patches to an archive: pack their rectangles into one texture per material, paint them, write the files."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from objects.mesh import Array, Materials, Patch, Texels
from trompe_shared.local_files import pack_zip

SIDE: Final = 512
"""Width and height of every texture, texels."""
MARGIN: Final = 2
"""Texels around each rectangle that repeat its edge, so that filtering does not bleed."""
CREASE: Final = 52.0
"""Faces that meet at a larger angle (degrees) are shaded as an edge."""


@dataclass(frozen=True)
class _Slot:
    """Where a patch lies in the texture: inner rectangle in texels, row 0 at the bottom; ``turned`` by 90 degrees."""

    x: int
    y: int
    width: int
    height: int
    turned: bool

    def texture_coordinates(self, patch: Patch) -> Array:
        """(V, 2) in [0, 1]."""
        s, t = (patch.plane / patch.size).T
        u, v = (1 - t, s) if self.turned else (s, t)
        return np.stack([self.x + u * self.width, self.y + v * self.height], axis=1) / SIDE


def archive(name: str, materials: Materials) -> bytes:
    """The zip of an object in SAILenv's format; ``materials`` maps material names to their patches.

    The object is moved so that the middle of its bounding box is the origin.
    """
    points = np.concatenate([patch.points for patches in materials.values() for patch in patches])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    slots = {material: _pack(patches) for material, patches in materials.items()}
    definition: dict[str, dict[str, str]] = {}
    textures: dict[str, bytes] = {}
    for material, patches in materials.items():
        images = _images(patches, slots[material])
        textures |= {f"{material}_{kind}.png": _png(image) for kind, image in images.items()}
        names = (("albedo", "AlbedoTransparency"), ("normal", "Normal"), ("metallic", "MetallicSmoothness"))
        definition[material] = {key: f"{material}_{kind}.png" for key, kind in names if kind in images}
    texts = {
        f"{name}.obj": _obj(name, materials, slots, middle),
        f"{name}.mtl": _mtl(definition),
        f"{name}_mat_def.json": json.dumps(definition, indent=2) + "\n",
    }
    return pack_zip({file: text.encode() for file, text in texts.items()} | textures)


def _png(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


# --- packing ---


def _pack(patches: Sequence[Patch]) -> list[_Slot]:
    """Rectangles at the largest common scale that fits, trying both orientations and slightly stretched axes."""
    best: tuple[float, list[_Slot]] = (0.0, [])
    for stretch in (0.85, 0.92, 1.0, 1.08, 1.18):
        for wide in (True, False):
            slots = _pack_largest(patches, stretch, wide)
            covered = float(sum(slot.width * slot.height for slot in slots))
            best = max(best, (covered, slots), key=lambda found: found[0])
    return best[1]


def _pack_largest(patches: Sequence[Patch], stretch: float, wide: bool) -> list[_Slot]:
    low, high, best = 0.0, SIDE / max(max(p.size) * p.density for p in patches) * 2, None
    for _ in range(14):
        scale = (low + high) / 2
        slots = _pack_at(patches, scale, stretch, wide)
        low, high, best = (low, scale, best) if slots is None else (scale, high, slots)
    if best is None:
        raise ValueError(f"{len(patches)} patches do not fit a texture of {SIDE} texels; use fewer")
    return best


def _pack_at(patches: Sequence[Patch], scale: float, stretch: float, wide: bool) -> list[_Slot] | None:
    """Skyline packing, lowest place first; ``None`` where the texture is too small."""
    sizes = []
    for patch in patches:
        turned = (patch.size[0] >= patch.size[1]) != wide
        w, h = patch.size[::-1] if turned else patch.size
        grow = scale * patch.density
        sizes.append((max(2, round(w * grow * stretch)), max(2, round(h * grow / stretch)), turned))
    sky, slots = np.zeros(SIDE, dtype=np.int64), {}
    for i in sorted(range(len(patches)), key=lambda i: (-sizes[i][1], -sizes[i][0], i)):
        w, h, turned = sizes[i]
        full_w, full_h = w + 2 * MARGIN, h + 2 * MARGIN
        if full_w > SIDE:
            return None
        floor = np.lib.stride_tricks.sliding_window_view(sky, full_w).max(axis=1)
        x = int(floor.argmin())
        if floor[x] + full_h > SIDE:
            return None
        slots[i] = _Slot(x + MARGIN, int(floor[x]) + MARGIN, w, h, turned)
        sky[x : x + full_w] = floor[x] + full_h
    return [slots[i] for i in range(len(patches))]


# --- painting ---


def _images(patches: Sequence[Patch], slots: Sequence[_Slot]) -> dict[str, NDArray[np.uint8]]:
    """Images by kind, row 0 on top. Kinds on which nothing is painted are left out."""
    layers, painted = np.zeros((SIDE, SIDE, 6)), np.zeros((SIDE, SIDE), dtype=bool)
    for patch, slot in zip(patches, slots, strict=True):
        coat = _painted(patch, slot)
        area = _area(slot)
        layers[area], painted[area] = coat, True
    layers[~painted] = layers[painted].mean(axis=0)
    layers = layers[::-1]
    metal_and_gloss = layers[..., [4, 4, 4, 5]]
    images = {"AlbedoTransparency": _bytes(layers[..., :3], step=2)}
    normal = _bytes(_normals(layers[..., 3], painted[::-1]) * 0.5 + 0.5, step=4)
    if normal[..., :2].min() < 124:
        images["Normal"] = normal
    if np.ptp(layers[..., 4]) + np.ptp(layers[..., 5]) > 0:
        images["MetallicSmoothness"] = _bytes(metal_and_gloss, step=4)
    return images


def _bytes(values: Array, *, step: int) -> NDArray[np.uint8]:
    """[0, 1] to uint8 in steps of ``step`` levels, which no eye sees and which halves the files."""
    return np.clip(np.round(values * 255 / step) * step, 0, 255).astype(np.uint8)


def _area(slot: _Slot) -> tuple[slice, slice]:
    x, y = slot.x - MARGIN, slot.y - MARGIN
    return slice(y, y + slot.height + 2 * MARGIN), slice(x, x + slot.width + 2 * MARGIN)


def _painted(patch: Patch, slot: _Slot) -> Array:
    """Colour, height in texels, metallic and smoothness (h, w, 6) of a slot and its margin, row 0 at the bottom."""
    w, h = (slot.height, slot.width) if slot.turned else (slot.width, slot.height)
    s = np.clip((np.arange(-MARGIN, w + MARGIN) + 0.5) / w, 0, 1) * patch.size[0]
    t = np.clip((np.arange(-MARGIN, h + MARGIN) + 0.5) / h, 0, 1) * patch.size[1]
    grid_s, grid_t = np.meshgrid(s, t)
    pitch = float(np.sqrt(patch.size[0] * patch.size[1] / (w * h)))
    coat = patch.paint(Texels(grid_s, grid_t, patch.size, patch.locate(grid_s, grid_t), pitch))
    layers = np.zeros((*grid_s.shape, 6))
    layers[..., :3] = coat.colour
    layers[..., 3] = np.asarray(coat.height) / pitch
    layers[..., 4], layers[..., 5] = coat.metallic, coat.smoothness
    # Row 0 is at the bottom here, where a turn to the left is one to the right of the array.
    return np.rot90(layers, -1) if slot.turned else layers


def _normals(height: Array, painted: NDArray[np.bool_]) -> Array:
    """Tangent-space normals (H, W, 3), +y up, of a height map in texels, row 0 on top."""
    down, right = np.gradient(height)
    inside = (
        painted & np.roll(painted, 1, 0) & np.roll(painted, -1, 0) & np.roll(painted, 1, 1) & np.roll(painted, -1, 1)
    )
    slope = np.where(inside[..., None], np.stack([-right, down], axis=-1), 0.0)
    normals = np.concatenate([slope, np.ones((*height.shape, 1))], axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


# --- the mesh file ---


def _obj(name: str, materials: Materials, slots: Mapping[str, list[_Slot]], middle: Array) -> str:
    patches = [patch for group in materials.values() for patch in group]
    places = [slot for group in slots.values() for slot in group]
    starts = np.cumsum([0, *(len(patch.points) for patch in patches)])
    points = np.round(np.concatenate([patch.points for patch in patches]) - middle, 6) + 0.0
    faces = [_solid_faces(patch.faces + start, points) for patch, start in zip(patches, starts, strict=False)]
    normals = np.round(_corner_normals(points, np.concatenate(faces)), 4) + 0.0
    unique, corner_normals = np.unique(normals.reshape(-1, 3), axis=0, return_inverse=True)
    pairs = zip(patches, places, strict=True)
    lines = [f"mtllib {name}.mtl", f"o {name}"]
    lines += ["v {:.6f} {:.6f} {:.6f}".format(*point) for point in points]
    lines += ["vt {:.5f} {:.5f}".format(*uv) for patch, slot in pairs for uv in slot.texture_coordinates(patch)]
    lines += ["vn {:.4f} {:.4f} {:.4f}".format(*normal) for normal in unique]
    unwritten, indices = iter(faces), iter(corner_normals.reshape(-1, 3) + 1)
    for material, group in materials.items():
        lines.append(f"usemtl {material}")
        for face in np.concatenate([next(unwritten) for _ in group]) + 1:
            lines.append("f " + " ".join(f"{v}/{v}/{n}" for v, n in zip(face, next(indices), strict=True)))
    return "\n".join(lines) + "\n"


def _solid_faces(faces: NDArray[np.int64], points: Array) -> NDArray[np.int64]:
    """Faces without those that have no area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    solid = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-10
    return np.asarray(faces[solid])


def _corner_normals(points: Array, faces: NDArray[np.int64]) -> Array:
    """Normals (F, 3, 3) of the corners: area-weighted over the faces that meet there at less than ``CREASE``."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    flat = areas / np.linalg.norm(areas, axis=1, keepdims=True)
    _, place = np.unique(points, axis=0, return_inverse=True)
    around: dict[int, list[int]] = {}
    for face, corners in enumerate(place.ravel()[faces]):
        for corner in corners:
            around.setdefault(int(corner), []).append(face)
    normals = np.empty((len(faces), 3, 3))
    for face, corners in enumerate(place.ravel()[faces]):
        for k, corner in enumerate(corners):
            near = around[int(corner)]
            smooth = flat[near] @ flat[face] > np.cos(np.radians(CREASE))
            normals[face, k] = areas[near][smooth].sum(axis=0)
    return np.asarray(normals / np.linalg.norm(normals, axis=2, keepdims=True))


def _mtl(definition: Mapping[str, Mapping[str, str]]) -> str:
    lines = []
    for material, maps in definition.items():
        lines += [f"newmtl {material}", "Kd 1.0 1.0 1.0", f"map_Kd {maps['albedo']}"]
        lines += [f"map_Bump {maps['normal']}"] if "normal" in maps else []
    return "\n".join(lines) + "\n"
