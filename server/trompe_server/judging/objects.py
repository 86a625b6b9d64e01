"""Where an object differs from what it should be a repaint of: shape, texture coordinates, materials, albedo.

The two may come from files of different formats: vertices may be split or merged, triangles and textures in another
order and under other names. So triangles are matched by their corners, those in one place by the name of their material
too, and textures by the triangles that show them.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from trompe_server.judging.metrics import difference
from trompe_shared.api import Finding, TextureChange, levels_within
from trompe_shared.object3d import PLAIN_ROUGHNESS, Material, Object3D, decode_rgb, open_image, roughness_metallic

TOLERANCE: Final = 1e-4
"""Distance of equal corners, as a share of the object's radius, and of equal texture coordinates."""

NAMED: Final = TOLERANCE / 10
"""Distance of triangles in one place that differ in the name of their material."""

BENT: Final = 0.02
"""Distance of normals, unit vectors, that counts as another shading: one degree."""

LEVELS: Final = 2
"""Difference of a map's levels that conversion between formats may cause."""

FLAT_NORMAL: Final = (128, 128, 255)
MATT: Final = (round(255 * PLAIN_ROUGHNESS), 0)
"""Roughness and metallic of a material without a map."""

Texture = UInt8[np.ndarray, "H W 3"]
Textures = Mapping[str, Texture]


@dataclass(frozen=True)
class _Triangles:
    """Triangles of all parts: corners in radii of the object, coordinates, normals; name of material of each.

    Without those with two corners in one place: they show nothing, and programs drop them.
    """

    corners: Float[np.ndarray, "F 3 3"]
    uvs: Float[np.ndarray, "F 3 2"]
    normals: Float[np.ndarray, "F 3 3"]
    materials: NDArray[np.str_]

    @classmethod
    def of(cls, obj: Object3D, radius: float) -> "_Triangles":
        def gathered(name: str) -> NDArray[np.float64]:
            return np.concatenate([getattr(part, name)[part.faces] for part in obj.parts]).astype(np.float64)

        names = np.repeat([part.material for part in obj.parts], [len(part.faces) for part in obj.parts])
        corners = gathered("vertices")
        shown = (corners != np.roll(corners, 1, axis=1)).any(axis=2).all(axis=1)
        return cls(corners[shown] / radius, gathered("uvs")[shown], gathered("normals")[shown], names[shown])

    def __len__(self) -> int:
        return len(self.corners)

    def fronts(self) -> "_Triangles":
        """Without backs: the later ones of two with the same corners in opposite order."""
        back, _ = _matched(self.corners, self.corners[:, ::-1])
        first = (back < 0) | (back >= np.arange(len(self)))
        return _Triangles(self.corners[first], self.uvs[first], self.normals[first], self.materials[first])

    def mapped(self, names: list[str]) -> Float[np.ndarray, "F 3 10"]:
        """Corners with their texture coordinates, and a small step for the place of their material in ``names``.

        Textures repeat: coordinates are places on circles, with their steps to the next corner.
        """
        turns = 2 * np.pi * self.uvs
        circles = np.concatenate([np.cos(turns), np.sin(turns)], axis=2) / (2 * np.pi)
        along = np.roll(self.uvs, -1, axis=1) - self.uvs
        steps = np.searchsorted(names, self.materials) * (NAMED / len(names))
        return np.concatenate([self.corners, circles, along, np.tile(steps[:, None, None], (1, 3, 1))], axis=2)


@dataclass(frozen=True)
class ObjectPair:
    """An object before and after a repaint, and how the second differs in more than its albedo."""

    before: Object3D
    after: Object3D

    def findings(self) -> list[Finding]:
        """Differences other than of the albedo's colours, each in one sentence."""
        return self._shape or [*self._sides(), *self._layout(), *self._shading(), *self._maps(), *self._sizes()]

    @property
    def is_one(self) -> bool:
        """Whether the two have as many triangles, backs aside. If not, no difference between their images has a
        meaning."""
        return len(self._old) == len(self._new)

    @cached_property
    def textures(self) -> tuple[Textures, Textures]:
        """Albedo textures that belong together and have one size, by the first object's name: before and after.

        One with several partners comes once for each, the second object's name added to its own.
        """
        parts = Counter(name for name, _ in self._albedos)
        pairs = {
            f"{name} ({other})" if parts[name] > 1 else name: (self.before.textures[name], self.after.textures[other])
            for name, other in self._albedos
        }
        same = {name: pair for name, pair in pairs.items() if pair[0].shape == pair[1].shape}
        return {name: old for name, (old, _) in same.items()}, {name: new for name, (_, new) in same.items()}

    @cached_property
    def _all(self) -> tuple[_Triangles, _Triangles]:
        old, new = (_Triangles.of(each, self.before.sphere[1]) for each in (self.before, self.after))
        return old, new

    @cached_property
    def _compared(self) -> tuple[_Triangles, _Triangles]:
        """All triangles before and after; without backs if they are as many only then, as programs add these."""
        old, new = (each.fronts() for each in self._all) if len(self._all[0]) != len(self._all[1]) else self._all
        return (old, new) if len(old) == len(new) else self._all

    @property
    def _old(self) -> _Triangles:
        return self._compared[0]

    @property
    def _new(self) -> _Triangles:
        return self._compared[1]

    @cached_property
    def _shape(self) -> list[Finding]:
        """Why the two are not one shape; empty if they are."""
        old, new = self._old, self._new
        if not self.is_one:
            text = (
                f"These are not one object: the first has {len(old)} triangles, the second {len(new)}. Each is judged "
                "by itself; there is no A_drop, and neither textures nor images are compared."
            )
            return [Finding(kind="object", text=text)]
        places, _ = _matched(old.corners, new.corners)
        back, _ = _matched(new.corners, old.corners)
        moved = max(int((places < 0).sum()), int((back < 0).sum()))
        if not moved:
            return []
        distance = _farthest(old.corners, new.corners)
        how = (
            f"moved: {moved} of {len(new)} triangles are not where the first object has them, "
            f"by up to {1000 * self.before.sphere[1] * distance:.3g} mm"
            if distance > TOLERANCE / 3  # below it, equal triangles match
            else f"changed: {moved} of {len(new)} triangles join the same corners in another way, or face the other way"
        )
        text = f"The geometry {how}. A repaint keeps the mesh; textures are not compared."
        return [Finding(kind="geometry", text=text)]

    def _sides(self) -> Iterator[Finding]:
        more = len(self._all[1]) - len(self._all[0])
        if more:
            yield Finding(
                kind="geometry",
                text=f"The {'second' if more > 0 else 'first'} object shows both sides of {abs(more)} triangles of "
                "which the other shows one: views of their backs differ.",
            )

    @cached_property
    def _places(self) -> tuple[Int[np.ndarray, " F"], Int[np.ndarray, " F"]]:
        names = sorted({*self.before.materials, *self.after.materials})
        return _matched(self._old.mapped(names), self._new.mapped(names))

    def _layout(self) -> Iterator[Finding]:
        wrong = int((self._places[0] < 0).sum())
        if wrong:
            yield Finding(
                kind="uv",
                text=f"The UV layout differs: {wrong} of {len(self._new)} triangles read other places of their "
                "texture. Textures that these triangles show are not compared.",
            )

    def _shading(self) -> Iterator[Finding]:
        index, turn = self._places
        found = index >= 0
        normals = _turned(self._old.normals[index[found]], turn[found])
        bent = int((np.linalg.norm(normals - self._new.normals[found], axis=2) > BENT).any(axis=1).sum())
        if bent:
            yield Finding(
                kind="geometry",
                text=f"The normals of {bent} of {len(self._new)} triangles differ: the second object is shaded in "
                "another way where it has the same paint.",
            )

    @cached_property
    def _materials(self) -> list[tuple[str, str]]:
        """Materials of matched triangles, before and after."""
        index, found = self._places[0], self._places[0] >= 0
        pairs = zip(self._old.materials[index[found]], self._new.materials[found], strict=True)
        return list(dict.fromkeys((str(one), str(other)) for one, other in pairs))

    @cached_property
    def _albedos(self) -> list[tuple[str, str]]:
        """Albedo textures of matched triangles, before and after; without those that triangles with other coordinates
        show."""
        if self._shape:
            return []
        pairs = list(
            dict.fromkeys(
                (self.before.materials[one].albedo, self.after.materials[other].albedo)
                for one, other in self._materials
            )
        )
        unmatched = {
            self.after.materials[str(name)].albedo for name in np.unique(self._new.materials[self._places[0] < 0])
        }
        return [(one, other) for one, other in pairs if other not in unmatched]

    def _maps(self) -> Iterator[Finding]:
        for one, other in self._materials:
            old, new = self.before.materials[one], self.after.materials[other]
            for what, changed in (
                ("normal map", _differ(_normal(self.before, old), _normal(self.after, new))),
                ("map of metal and smoothness", _differ(_metallic(self.before, old), _metallic(self.after, new))),
                ("opacity", _differ(_alpha(self.before, old), _alpha(self.after, new)) or old.opacity != new.opacity),
            ):
                if changed:
                    yield Finding(
                        kind="material",
                        text=f"The {what} of the material {one!r} differs: more than albedo has changed.",
                    )

    def _sizes(self) -> Iterator[Finding]:
        for name, other in self._albedos:
            old, new = self.before.textures[name].shape, self.after.textures[other].shape
            if old != new:
                yield Finding(
                    kind="size",
                    text=f"The texture {name!r} is {old[1]} x {old[0]} texels before and {new[1]} x {new[0]} after: "
                    "its change per texel has no figure.",
                )


def texture_changes(before: Textures, after: Textures, *, epsilon: float | None) -> list[TextureChange]:
    """The change of each texture in levels of 255. ``epsilon``: the stated budget, in [0, 1] units."""
    return [_texture_change(name, before[name], after[name], epsilon) for name in sorted(before)]


def _texture_change(name: str, before: Texture, after: Texture, epsilon: float | None) -> TextureChange:
    levels = difference(before, after)
    change = levels.max(axis=2)
    altered = change > 0
    beyond = None if epsilon is None else int((change > levels_within(epsilon)).sum())
    return TextureChange(
        texture=name,
        size=(before.shape[0], before.shape[1]),
        texels_altered=float(altered.mean()),
        mean_levels=float(levels[altered].mean()) if altered.any() else 0.0,
        max_levels=int(change.max()),
        texels_beyond_epsilon=beyond,
    )


def _matched(
    old: Float[np.ndarray, "F 3 k"], new: Float[np.ndarray, "G 3 k"]
) -> tuple[Int[np.ndarray, " G"], Int[np.ndarray, " G"]]:
    """For each of ``new`` the triangle of ``old`` with the same corners, -1 without one, and the turn that gives their
    order."""
    turns = np.concatenate([np.roll(old, -turn, axis=1) for turn in range(3)]).reshape(3 * len(old), -1)
    distances, found = cKDTree(turns).query(new.reshape(len(new), -1), distance_upper_bound=TOLERANCE)
    missing = np.isinf(distances)
    return np.where(missing, -1, found % len(old)), np.where(missing, 0, found // len(old))


def _turned(corners: Float[np.ndarray, "F 3 k"], turn: Int[np.ndarray, " F"]) -> Float[np.ndarray, "F 3 k"]:
    order = (np.arange(3) + turn[:, None]) % 3
    turned: NDArray[np.float64] = np.take_along_axis(corners, order[..., None], axis=1)
    return turned


def _farthest(old: Float[np.ndarray, "F 3 3"], new: Float[np.ndarray, "F 3 3"]) -> float:
    """Largest distance of a corner of one to the nearest corner of the other."""
    one, other = (np.unique(each.reshape(-1, 3), axis=0) for each in (old, new))
    return float(max(cKDTree(one).query(other)[0].max(), cKDTree(other).query(one)[0].max()))


def _normal(obj: Object3D, material: Material) -> NDArray[np.uint8]:
    return (
        np.array([[FLAT_NORMAL]], np.uint8)
        if material.normal is None
        else decode_rgb(obj.files[material.normal], material.normal)
    )


def _metallic(obj: Object3D, material: Material) -> NDArray[np.uint8]:
    """Roughness and metallic, as renderers read them: a map without alpha is matt."""
    return (
        np.array([[MATT]], np.uint8)
        if material.metallic is None
        else roughness_metallic(obj.files[material.metallic], material.metallic)
    )


def _alpha(obj: Object3D, material: Material) -> NDArray[np.uint8]:
    with open_image(obj.files[material.albedo], material.albedo) as image:
        return np.array(image.convert("RGBA").getchannel("A"))[..., None]


def _differ(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Whether two maps differ; an even one fits any size."""
    if one.shape != other.shape:
        one, other = (each[:1, :1] if not np.ptp(each, axis=(0, 1)).any() else each for each in (one, other))
        if one.shape != other.shape and 1 not in (one.shape[0], other.shape[0]):
            return True
    worst: Bool[np.ndarray, ""] = difference(one, other).max() > LEVELS
    return bool(worst)
