"""Two objects: the same but for their paint, or not, in whatever format they come."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trompe_server.formats import read_object, write_glb
from trompe_server.judging.objects import ObjectPair, texture_changes
from trompe_shared.object3d import Object3D, encode_png, load_object
from trompe_shared.shipped import shipped_objects
from trompe_shared.wavefront import Part

NAMES = sorted(shipped_objects())


def shipped(name: str) -> Object3D:
    return load_object(shipped_objects()[name].read())


def repainted(obj: Object3D, *, by: int, seed: int = 0) -> Object3D:
    """The object with each level changed by at most ``by``."""
    random = np.random.default_rng(seed)
    change = {name: random.integers(-by, by + 1, texture.shape) for name, texture in obj.textures.items()}
    painted = {name: (obj.textures[name] + each).clip(0, 255).astype(np.uint8) for name, each in change.items()}
    return obj.with_textures(painted)


def with_parts(obj: Object3D, change: Callable[[Part], Part]) -> Object3D:
    return replace(obj, parts=tuple(map(change, obj.parts)))


def shuffled(part: Part) -> Part:
    """The part with its triangles in another order, each from another corner."""
    random = np.random.default_rng(0)
    faces = np.stack([np.roll(face, random.integers(3)) for face in part.faces[random.permutation(len(part.faces))]])
    return replace(part, faces=faces)


def backs(part: Part) -> Part:
    """The part from behind."""
    return replace(part, faces=part.faces[:, ::-1], normals=-part.normals)


def a_tile_further(part: Part) -> Part:
    """The part with coordinates that read the same texels, as textures repeat."""
    return replace(part, uvs=part.uvs + np.array([1, -1], np.float32))


@pytest.mark.parametrize("name", NAMES)
def test_a_repaint_differs_in_its_albedo_only_in_another_format_too(name: str) -> None:
    obj = shipped(name)
    painted = repainted(obj, by=12)
    glb = read_object(write_glb(painted), name="other.glb").obj
    for after in (painted, glb, with_parts(painted, shuffled), with_parts(painted, a_tile_further)):
        pair = ObjectPair(obj, after)
        assert pair.findings() == []
        before, compared = pair.textures
        assert before.keys() == obj.textures.keys()
        assert all(np.array_equal(compared[texture], painted.textures[texture]) for texture in compared)


@settings(max_examples=25)
@given(st.integers(1, 60), st.floats(0.005, 0.25), st.integers(0, 2**16))
def test_texels_beyond_epsilon_are_those_with_a_larger_change(by: int, epsilon: float, seed: int) -> None:
    before = np.random.default_rng(seed).integers(0, 256, (6, 7, 3), np.uint8)
    after = (before.astype(np.int16) + np.random.default_rng(seed + 1).integers(-by, by + 1, before.shape)).clip(0, 255)
    (found,) = texture_changes({"a": before}, {"a": after.astype(np.uint8)}, epsilon=epsilon)
    change = np.abs(after - before).max(axis=2) / 255
    assert found.texels_beyond_epsilon == (change > epsilon + 1e-9).sum()
    assert found.max_levels == round(255 * change.max())
    assert found.texels_altered == (change > 0).mean()


def moved(part: Part) -> Part:
    return replace(part, vertices=part.vertices + np.float32(0.002) * (part.vertices[:, 1:2] > 0.02).astype(np.float32))


def repeating(obj: Object3D, times: float) -> Object3D:
    return with_parts(obj, lambda part: replace(part, uvs=part.uvs * np.float32(times)))


def lighter(obj: Object3D, *, map_of: str) -> Object3D:
    """The object with a plain picture in place of one of its maps."""
    (material,) = obj.materials.values()
    file = getattr(material, map_of)
    return replace(obj, files={**obj.files, file: encode_png(np.full((8, 8, 4), 200, np.uint8))})


def with_smoothness(obj: Object3D, alpha: int | None) -> Object3D:
    """The object with one metal and smoothness everywhere; ``None``: a map without alpha."""
    (material,) = obj.materials.values()
    assert material.metallic is not None
    pixel = (0, 0, 0) if alpha is None else (0, 0, 0, alpha)
    return replace(
        obj, files={**obj.files, material.metallic: encode_png(np.full((8, 8, len(pixel)), pixel, np.uint8))}
    )


MUG = shipped("mug")
CHANGES = {
    "another object": (shipped("ball"), "object", "2368 triangles, the second 1728"),
    "moved": (with_parts(MUG, moved), "geometry", r"839 of 2368 triangles .* by up to 3\.46 mm"),
    "from behind": (with_parts(MUG, backs), "geometry", "changed: 2368 of 2368 .* face the other way"),
    "another layout": (repeating(MUG, 0.5), "uv", "2368 of 2368 triangles"),
    "a texture twice": (repeating(MUG, 2.0), "uv", r"2\d\d\d of 2368 triangles"),
    "other normals": (with_parts(MUG, lambda part: replace(part, normals=-part.normals)), "geometry", "shaded"),
    "another normal map": (lighter(MUG, map_of="normal"), "material", "The normal map of the material 'mug_ceramic'"),
    "other metal": (lighter(MUG, map_of="metallic"), "material", "metal and smoothness"),
    "a hole": (lighter(MUG, map_of="albedo"), "material", "The opacity"),
    "half the texels": (
        MUG.with_textures({name: texture[::2, ::2] for name, texture in MUG.textures.items()}),
        "size",
        "512 x 512 texels before and 256 x 256 after",
    ),
}


@pytest.mark.parametrize(("after", "kind", "text"), CHANGES.values(), ids=CHANGES.keys())
def test_each_other_difference_is_one_clear_sentence(after: Object3D, kind: str, text: str) -> None:
    pair = ObjectPair(MUG, after)
    (found,) = pair.findings()
    assert found.kind == kind
    assert re.search(text, found.text)
    comparable = kind == "material" or "shaded" in found.text
    assert bool(pair.textures[0]) == bool(pair.textures[1]) == comparable


def test_a_map_without_alpha_is_matt_not_a_mirror() -> None:
    mirror, matt, plain = (with_smoothness(MUG, alpha) for alpha in (255, 25, None))
    (found,) = ObjectPair(mirror, plain).findings()
    assert "metal and smoothness" in found.text
    assert ObjectPair(matt, plain).findings() == []


def test_triangles_that_keep_their_layout_keep_their_figures() -> None:
    lamp = shipped("lamp")
    first, second = lamp.parts
    pair = ObjectPair(lamp, replace(lamp, parts=(first, replace(second, uvs=second.uvs / np.float32(2)))))
    assert [found.kind for found in pair.findings()] == ["uv"]
    assert pair.textures[0].keys() == {lamp.albedo_of(first)}


def test_each_two_textures_of_the_same_triangles_are_compared() -> None:
    lamp = shipped("lamp")
    one, other = lamp.textures
    split = lamp.with_textures({one: lamp.textures[one], other: 255 - lamp.textures[one]})
    shared = replace(split, materials={name: replace(each, albedo=one) for name, each in split.materials.items()})
    for pair, names in (
        (ObjectPair(shared, split), [f"{one} ({one})", f"{one} ({other})"]),
        (ObjectPair(split, shared), [one, other]),
    ):
        assert pair.findings() == []
        changes = texture_changes(*pair.textures, epsilon=0.01)
        assert [(each.texture, each.texels_altered > 0.9) for each in changes] == [(names[0], False), (names[1], True)]


def test_triangles_that_show_nothing_may_come_and_go() -> None:
    collapsed = with_parts(MUG, lambda part: replace(part, faces=np.vstack([part.faces, part.faces[:9, [0, 0, 1]]])))
    for pair in (ObjectPair(MUG, collapsed), ObjectPair(collapsed, MUG)):
        assert pair.is_one
        assert pair.findings() == []


def test_a_program_that_adds_or_drops_backs_leaves_one_object() -> None:
    painted = repainted(MUG, by=12)
    double = replace(painted, parts=(*painted.parts, *map(backs, painted.parts)))
    for pair, which in ((ObjectPair(MUG, double), "second"), (ObjectPair(double, MUG), "first")):
        (found,) = pair.findings()
        assert found.text.startswith(f"The {which} object shows both sides of 2368 triangles")
        (change,) = texture_changes(*pair.textures, epsilon=0.05)
        assert (change.max_levels, change.texels_beyond_epsilon) == (12, 0)


def test_triangles_in_one_place_are_told_apart_by_their_materials() -> None:
    (part,), (material,) = MUG.parts, MUG.materials.values()
    decal = encode_png(255 - MUG.textures[material.albedo])
    covered = replace(
        MUG,
        parts=(part, replace(part, material="decal")),
        materials={**MUG.materials, "decal": replace(material, name="decal", albedo="decal.png")},
        files={**MUG.files, "decal.png": decal},
        textures={**MUG.textures, "decal.png": 255 - MUG.textures[material.albedo]},
    )
    for after in (covered, replace(covered, parts=covered.parts[::-1])):
        pair = ObjectPair(covered, after)
        assert pair.findings() == []
        largest = {each.texture: each.max_levels for each in texture_changes(*pair.textures, epsilon=None)}
        assert largest == dict.fromkeys(covered.textures, 0)
