"""Meshes that Draco compresses in glTF files."""

from typing import Any

import DracoPy  # type: ignore[import-not-found]
import numpy as np
import pytest

from tests.made_objects import CORNERS, SQUARE, UVS, Scene, read
from tests.small_models import painted, refusal, same_paint
from trompe_server.formats import repaint_file
from trompe_server.formats.gltf_container import open_container
from trompe_server.formats.upload import Upload
from trompe_shared.object3d import Object3D

NAME = "KHR_draco_mesh_compression"
PLAIN = np.full((8, 8, 3), 99, np.uint8)


def compressed(*, uvs: bool = True, data: bytes | None = None) -> Scene:
    """A square of which the file holds only Draco's bytes."""
    scene = Scene()
    scene.square(scene.material(scene.texture(PLAIN) if uvs else None), uvs=UVS if uvs else None)
    primitive: Any = scene.document["meshes"][0]["primitives"][0]
    del primitive["attributes"]["NORMAL"]
    for index in (*primitive["attributes"].values(), primitive["indices"]):
        del scene.document["accessors"][index]["bufferView"]
    faces = CORNERS.reshape(-1, 3).astype("u4")
    own = DracoPy.encode(SQUARE.astype(float), faces, tex_coord=UVS.astype(float) if uvs else None)
    numbers = {"TEXCOORD_0": 0, "POSITION": 1} if uvs else {"POSITION": 0}
    view = scene.view(own if data is None else data)
    primitive["extensions"] = {NAME: {"bufferView": view, "attributes": numbers}}
    scene.document |= {"extensionsUsed": [NAME], "extensionsRequired": [NAME]}
    return scene


def shown(obj: Object3D) -> np.ndarray:
    """Positions and texture coordinates of the corners, in an order of their own."""
    rows = np.concatenate([np.hstack([part.vertices, part.uvs])[part.faces.ravel()] for part in obj.parts])
    return rows[np.lexsort(rows.round(3).T)]


def test_a_compressed_mesh_is_read_as_it_was() -> None:
    plain = Scene()
    plain.square(plain.material(plain.texture(PLAIN)))
    np.testing.assert_allclose(shown(read(compressed())), shown(read(plain)), atol=1e-3)


def test_of_a_compressed_copy_the_other_is_read_whatever_its_triangles() -> None:
    plain, both = compressed(), Scene()
    both.square(both.material(both.texture(PLAIN)))
    strip: Any = both.document["meshes"][0]["primitives"][0]
    strip |= {"mode": 5, "extensions": plain.document["meshes"][0]["primitives"][0]["extensions"]}
    strip["indices"] = both.accessor(np.array([1, 2, 0, 3], "<u2"))
    np.testing.assert_allclose(shown(read(both)), shown(read(plain)), atol=1e-3)


@pytest.mark.parametrize("uvs", [True, False], ids=["textured", "unwrapped here"])
def test_paint_leaves_a_mesh_compressed_unless_it_is_cut(uvs: bool) -> None:
    data = compressed(uvs=uvs).to_glb()
    new = painted(read(data))
    after = repaint_file(data, new, name="scene.glb").data
    same_paint(read(after), new)
    np.testing.assert_allclose(shown(read(after)), shown(new), atol=1e-6)
    document = open_container(Upload("scene.glb", {"scene.glb": after}, packed=False)).document
    assert (document.meshes[0].primitives[0].draco is not None) == (NAME in document.extensions_required) == uvs


def test_what_draco_cannot_tell_is_refused() -> None:
    def changed(**changes: Any) -> str:
        scene = compressed(data=changes.pop("data", None))
        scene.document["meshes"][0]["primitives"][0] |= changes.pop("primitive", {})
        scene.document["accessors"][1] |= changes  # the positions
        return refusal(scene.to_glb(), "scene.glb")

    assert "cannot be decompressed by Draco" in changed(data=b"DRACO but not really")
    assert "is no list of triangles" in changed(primitive={"mode": 5})
    assert "(9, 3) numbers, Draco's bytes (4, 3)" in changed(count=9)
    broken = {"bufferView": 0, "attributes": {"POSITION": 77}}
    assert "cannot be decompressed by Draco" in changed(primitive={"extensions": {NAME: broken}})
