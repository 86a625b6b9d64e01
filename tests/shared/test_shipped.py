"""The shipped objects are complete, well-formed and equal to their script's output."""

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from trompe_shared.object3d import Object3D, decode_rgb, load_object
from trompe_shared.shipped import ShippedObject, shipped_objects
from trompe_shared.wavefront import Part

ROOT = Path(__file__).parents[2]
SIDE = 512


@pytest.fixture(params=shipped_objects())
def shipped(request: pytest.FixtureRequest) -> ShippedObject:
    return shipped_objects()[request.param]


@cache
def loaded(name: str) -> Object3D:
    return load_object(shipped_objects()[name].read())


def test_the_eight_kinds_are_shipped_under_their_names_and_stay_small() -> None:
    assert list(shipped_objects()) == ["ball", "book", "bottle", "chair", "lamp", "mug", "table", "teapot"]
    assert sum(len(shipped.read()) for shipped in shipped_objects().values()) < 3e6


def test_an_object_is_small_centred_and_of_the_size_of_the_real_thing(shipped: ShippedObject) -> None:
    obj = loaded(shipped.name)
    points = np.concatenate([part.vertices for part in obj.parts])
    assert obj.name == shipped.name
    assert 300 <= sum(len(part.faces) for part in obj.parts) <= 3000
    assert np.abs(points.min(axis=0) + points.max(axis=0)).max() < 1e-5
    assert 0.05 < obj.radius < 1.0
    assert 2.0 < shipped.distance / obj.radius < 2.5  # the camera sees all of it
    assert -90 <= shipped.elevation[0] < shipped.elevation[1] <= 90


def test_every_material_has_an_albedo_and_only_maps_of_one_size(shipped: ShippedObject) -> None:
    obj = loaded(shipped.name)
    maps = {file for m in obj.materials.values() for file in (m.albedo, m.normal, m.metallic) if file is not None}
    assert {decode_rgb(obj.files[file], file).shape for file in maps} == {(SIDE, SIDE, 3)}
    assert maps == {file for file in obj.files if file.endswith(".png")}


def test_faces_look_outwards_and_use_most_texels_once_and_unmirrored(shipped: ShippedObject) -> None:
    for part in loaded(shipped.name).parts:
        a, b, c = (part.vertices[part.faces[:, k]].astype(float) for k in range(3))
        across = np.cross(b - a, c - a)
        assert (np.einsum("fi,fki->fk", across, part.normals[part.faces]) > 0).all()
        u, v, w = (part.uvs[part.faces[:, k]].astype(float) for k in range(3))
        assert (_cross(v - u, w - u) > 0).all()
        uses = _uses(part)
        assert (uses > 1).mean() < 1e-3
        assert (uses > 0).mean() > 0.6


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.asarray(p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0])


def _uses(part: Part) -> np.ndarray:
    """How many triangles cover the centre of each texel, (SIDE, SIDE)."""
    uses = np.zeros((SIDE, SIDE), dtype=int)
    for triangle in part.uvs[part.faces].astype(float) * SIDE - 0.5:
        low, high = np.ceil(triangle.min(axis=0)).astype(int), np.floor(triangle.max(axis=0)).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        centres = np.stack([x, y], axis=-1)
        edges = [(triangle[k], triangle[(k + 1) % 3]) for k in range(3)]
        inside = np.logical_and.reduce([_cross(end - start, centres - start) > 1e-3 for start, end in edges])
        uses[y, x] += inside
    return uses


def test_the_script_makes_the_shipped_objects_again(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "make_objects.py"), "--out", str(tmp_path), "--only", "bottle"]
    subprocess.run(command, check=True, capture_output=True)
    # Another zlib packs the same texels into other bytes, and another NumPy may round one of them differently.
    made, shipped = load_object(tmp_path / "bottle.zip"), loaded("bottle")
    assert list(made.files) == list(shipped.files)
    assert _mesh_difference(made, shipped) < 1e-5
    for file in (file for file in made.files if file.endswith(".png")):
        texels = [decode_rgb(obj.files[file], file).astype(int) for obj in (made, shipped)]
        assert (texels[0] != texels[1]).mean() < 1e-3


def _mesh_difference(made: Object3D, shipped: Object3D) -> float:
    """Largest difference of a vertex position or texture coordinate."""
    pairs = list(zip(made.parts, shipped.parts, strict=True))
    assert all((one.faces == other.faces).all() for one, other in pairs)
    return max(float(max(np.abs(p.vertices - q.vertices).max(), np.abs(p.uvs - q.uvs).max())) for p, q in pairs)
