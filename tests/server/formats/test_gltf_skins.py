"""Skinned meshes of glTF files, in the pose of their joints."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.made_objects import SQUARE, UVS, Scene, read
from tests.small_models import painted, refusal, same_paint
from trompe_server.formats import repaint_file

Matrix = NDArray[np.float64]
SHARES = np.array([[1, 0, 0, 0], [0, 2, 0, 0], [0.5, 0.5, 0, 0], [0, 0, 0, 0]], "<f4")
"""Weights of the joints on the corners of the square: not all sum to 1."""

triple = st.tuples(*[st.floats(-2, 2)] * 3)
place = st.builds(
    lambda translation, turn, scale: {"translation": translation, "turn": turn, "scale": scale},
    triple,
    triple,
    st.tuples(*[st.floats(0.2, 2)] * 3),
)


def node(translation: Any, turn: Any, scale: Any) -> tuple[dict[str, Any], Matrix]:
    """A node's JSON, and its matrix."""
    rotation = Rotation.from_rotvec(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix() @ np.diag(scale)
    matrix[:3, 3] = translation
    return {"translation": translation, "rotation": rotation.as_quat().tolist(), "scale": scale}, matrix


def skinned(joints: list[dict[str, Any]], inverse: list[Matrix] | None = None, *, uvs: Any = UVS) -> Scene:
    """A square pulled by ``joints``, each a child of the one before, under a node that is somewhere else."""
    scene = Scene()
    numbers = np.tile(np.array([0, 1, 0, 0], "u1"), (4, 1))
    pull = {"JOINTS_0": scene.accessor(numbers), "WEIGHTS_0": scene.accessor(SHARES)}
    grey = np.full((8, 8, 3), 99, np.uint8)
    scene.square(scene.material(None if uvs is None else scene.texture(grey)), uvs=uvs, **pull)
    skin: dict[str, Any] = {"joints": [1 + k for k in range(len(joints))]}
    if inverse is not None:
        columns = np.array([matrix.T.ravel() for matrix in inverse], "<f4")
        entry = {"componentType": 5126, "count": len(columns), "bufferView": scene.view(columns.tobytes())}
        skin["inverseBindMatrices"] = scene.add("accessors", entry | {"type": "MAT4"})
    scene.add("skins", skin)
    chained = [{**each, "children": [k + 2]} for k, each in enumerate(joints[:-1])] + joints[-1:]
    scene.document["nodes"] = [{"mesh": 0, "skin": 0, "translation": [7, 8, 9]}, *chained]
    scene.document["scenes"] = [{"nodes": [0, 1]}]
    return scene


@given(place, place, place, place)
@settings(max_examples=20)
def test_vertices_are_where_the_joints_pull_them(one: Any, two: Any, bind: Any, other: Any) -> None:
    (first, above), (second, below) = node(**one), node(**two)
    inverse = [node(**each)[1] for each in (bind, other)]
    (part,) = read(skinned([first, second], inverse)).parts
    pulls = np.stack([above @ inverse[0], above @ below @ inverse[1]])
    shares = np.array([[1, 0], [0, 1], [0.5, 0.5], [1, 0]])  # a vertex without weights goes with the first joint
    moved = np.einsum("vk,kij,vj->vi", shares, pulls, np.column_stack([SQUARE, np.ones(4)]))
    np.testing.assert_allclose(part.vertices, moved[:, :3], atol=1e-3)


@given(triple, triple, st.tuples(*[st.floats(0.2, 2) | st.floats(-2, -0.2)] * 3))
@settings(max_examples=20)
def test_a_skin_of_one_place_is_a_mesh_at_that_place(translation: Any, turn: Any, scale: Any) -> None:
    there, still = node(translation, turn, scale)[0], node((0, 0, 0), (0, 0, 0), (1, 1, 1))[0]
    plain = skinned([there, still])
    plain.document["nodes"] = [{"mesh": 0, **there}]
    plain.document["scenes"] = [{"nodes": [0]}]
    (expected,), (part,) = read(plain).parts, read(skinned([there, still])).parts
    np.testing.assert_allclose(part.vertices, expected.vertices, atol=1e-5)
    np.testing.assert_allclose(part.normals, expected.normals, atol=1e-5)
    assert (part.faces == expected.faces).all()


@pytest.mark.parametrize("uvs", [UVS, None], ids=["textured", "unwrapped here"])
def test_a_repainted_skin_keeps_its_joints(uvs: Any) -> None:
    joints = [node((0, 1, 0), (0, 0, 0.5), (1, 1, 1))[0], node((1, 0, 0), (0.3, 0, 0), (1, 2, 1))[0]]
    data = skinned(joints, uvs=uvs).to_glb()
    new = painted(read(data))
    after = read(repaint_file(data, new, name="scene.glb").data)
    same_paint(after, new)
    for part, before in zip(after.parts, new.parts, strict=True):
        np.testing.assert_allclose(part.vertices[part.faces], before.vertices[before.faces], atol=1e-6)


def test_joints_that_are_not_there_are_refused() -> None:
    still = node((0, 0, 0), (0, 0, 0), (1, 1, 1))[0]

    def refused(**changes: Any) -> str:
        scene = skinned([still, still], [np.eye(4)] * 2)
        if "numbers" in changes:
            changes["attributes"] = {"JOINTS_0": scene.accessor(changes.pop("numbers"))}
        attributes = scene.document["meshes"][0]["primitives"][0]["attributes"]
        for name, accessor in changes.pop("attributes", {}).items():
            attributes[name] = accessor
            if accessor is None:
                del attributes[name]
        scene.document["skins"][0] |= changes
        return refusal(scene.to_glb(), "scene.glb")

    assert "Joint 9 of the glTF's skin 0 is not in the scene" in refused(joints=[1, 9])
    assert "names joint 1, but its skin has 1" in refused(joints=[1])
    below = np.full((4, 4), -3, "i2")
    assert "names joint -3, but its skin has 2" in refused(numbers=below)
    assert "3 joints and 2 inverse bind matrices" in refused(joints=[1, 2, 1])
    assert "no WEIGHTS_0" in refused(attributes={"WEIGHTS_0": None})
    assert "no JOINTS_0" in refused(attributes={"JOINTS_0": None})
    assert "components, expected 4" in refused(attributes={"JOINTS_0": 3})
