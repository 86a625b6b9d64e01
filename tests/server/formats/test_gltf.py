"""glTF in and out: what is shown is what was there, and only base colours come back changed."""

import base64
import json
import math
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from tests.made_objects import CORNERS, SQUARE, UVS, Scene, read
from tests.small_models import corners, painted, refusal, same_paint
from tests.surfaces import object_of
from trompe_server.formats import read_object, repaint_file, write_glb
from trompe_server.formats.gltf_container import split_glb
from trompe_server.renderers import SailenvTarget
from trompe_shared.errors import ObjectError
from trompe_shared.geometry import Camera, View
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import Object3D, decode_rgb, encode_png, load_object, unpack

Json = dict[str, Any]
Pixels = NDArray[np.uint8]

HALF = math.sqrt(0.5)
GRADIENT = np.arange(16 * 16 * 3, dtype=np.uint8).reshape(16, 16, 3)
VIEWS = [View(Camera(3.0, azimuth, 15.0)) for azimuth in (-30.0, 20.0, 170.0)]


def textured(picture: Pixels = GRADIENT, **material: Any) -> Scene:
    scene = Scene()
    scene.square(scene.material(scene.texture(picture), **material))
    return scene


def repainted(data: bytes, obj: Object3D) -> bytes:
    return repaint_file(data, obj, name="scene.glb").data


def painted_over(scene: Scene) -> tuple[Object3D, bytes]:
    """The object of ``scene`` with other paint, and the repainted file."""
    data = scene.to_glb()
    new = painted(read(data))
    return new, repainted(data, new)


def beside(scene: Scene) -> Scene:
    """The two meshes of ``scene`` side by side."""
    scene.document["nodes"] = [{"mesh": 0, "children": [1]}, {"mesh": 1, "translation": [3, 0, 0]}]
    return scene


def contents(data: bytes) -> tuple[Json, bytes]:
    chunks = split_glb(data)
    return json.loads(chunks[0][1]), chunks[1][1]


def seen_through(view: Json, buffer: bytes) -> bytes:
    return buffer[view["byteOffset"] :][: view["byteLength"]]


# What is read


def test_a_textured_square_is_read_as_it_is() -> None:
    obj = read(textured())
    assert (corners(obj) == SQUARE[CORNERS].reshape(2, 3, 3)).all()
    ((name, image),) = obj.textures.items()
    assert (image == GRADIENT).all()
    (part,) = obj.parts
    assert part.uvs[part.faces].reshape(-1, 2).tolist() == (np.array([0, 1], "<f4") + UVS[CORNERS] * [1, -1]).tolist()
    assert obj.materials[part.material].metallic is None
    assert name == "image_0.png"


def test_nodes_stand_where_the_tree_puts_them_and_mirrored_ones_face_outwards() -> None:
    scene = textured()
    scene.document["nodes"] = [
        {"children": [1, 2], "translation": [0, 0, 5]},
        {"mesh": 0, "rotation": [0, HALF, 0, HALF], "scale": [2, 2, 2]},
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 0, 0, 1]},
    ]
    turned, mirrored = read(scene).parts[0], read(scene).parts[0]
    faces = turned.vertices[turned.faces]
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    np.testing.assert_allclose(normals[:2], [[16, 0, 0]] * 2, atol=1e-5)  # a quarter turn about y: faces +x
    np.testing.assert_allclose(normals[2:], [[0, 0, 4]] * 2, atol=1e-5)  # mirrored, and still faces +z
    np.testing.assert_allclose(faces[:2].reshape(-1, 3)[:, 2].min(), 3, atol=1e-5)
    np.testing.assert_allclose(faces[2:].reshape(-1, 3)[:, 0].max(), 11, atol=1e-5)
    np.testing.assert_allclose(mirrored.normals[mirrored.faces][2:], np.tile([0, 0, 1], (2, 3, 1)), atol=1e-6)


def test_a_colour_factor_is_multiplied_in_linear_light() -> None:
    grey = np.full((4, 4, 3), 188, np.uint8)  # half of white, linear
    image = next(iter(read(textured(grey, factor=[1.0, 0.5, 0.0, 1.0])).textures.values()))
    assert image[0, 0].tolist() == [188, 137, 0]


@pytest.mark.parametrize(
    ("mode", "alpha", "expected"),
    [
        pytest.param({}, 40, None, id="opaque: alpha means nothing"),
        pytest.param({"alphaMode": "MASK"}, 40, 40, id="mask"),
        pytest.param({"alphaMode": "MASK", "alphaCutoff": 0.25}, 40, 80, id="mask with another cutoff"),
        pytest.param({"alphaMode": "MASK", "alphaCutoff": 0.0}, 0, 255, id="mask that cuts nothing"),
        pytest.param({"alphaMode": "BLEND", "factor": [1.0, 1.0, 1.0, 0.3]}, 40, 40, id="blend: its factor is apart"),
    ],
)
def test_alpha_cuts_where_the_material_says_so(mode: Json, alpha: int, expected: int | None) -> None:
    picture = np.dstack([GRADIENT, np.full((16, 16), alpha, np.uint8)])
    obj = read(textured(picture, **mode))
    ((name, _),) = obj.textures.items()
    with Image.open(BytesIO(obj.files[name])) as image:
        found = np.array(image.getchannel("A")).max() if "A" in image.getbands() else None
    assert found == expected


@pytest.mark.parametrize(
    ("mode", "alpha", "opacity"),
    [
        pytest.param({"alphaMode": "BLEND", "factor": [1.0, 1.0, 1.0, 0.25]}, 255, 0.25, id="a factor"),
        pytest.param({"alphaMode": "BLEND"}, 254, 1.0, id="an image"),
        pytest.param({"alphaMode": "BLEND"}, 255, None, id="opaque everywhere"),
        pytest.param({"alphaMode": "MASK", "factor": [1.0, 1.0, 1.0, 0.25]}, 255, None, id="mask"),
        pytest.param({"factor": [1.0, 1.0, 1.0, 0.25]}, 100, None, id="opaque"),
    ],
)
def test_a_blended_material_has_an_opacity_there_and_back(mode: Json, alpha: int, opacity: float | None) -> None:
    data = textured(np.dstack([GRADIENT, np.full((16, 16), alpha, np.uint8)]), **mode).to_glb()
    obj = read(data)
    (material,) = obj.materials.values()
    assert material.opacity == opacity
    out = repainted(data, painted(obj))
    assert contents(out)[0]["materials"] == contents(data)[0]["materials"]
    (again,) = read(out).materials.values()
    assert again == material
    (written,) = read(write_glb(obj)).materials.values()
    assert written.opacity == opacity


def test_both_sides_of_a_double_sided_material_are_there() -> None:
    (part,) = read(textured(doubleSided=True)).parts
    assert len(part.faces) == 4
    sides = part.normals[part.faces][:, 0, 2]
    assert sorted(sides.tolist()) == [-1, -1, 1, 1]


def test_metal_and_roughness_become_unitys_map() -> None:
    scene = textured()
    picture = np.dstack([np.zeros((4, 4), np.uint8), np.full((4, 4), 200, np.uint8), np.full((4, 4), 100, np.uint8)])
    scene.document["materials"][0]["pbrMetallicRoughness"] |= {
        "metallicRoughnessTexture": {"index": scene.texture(picture)},
        "metallicFactor": 0.5,
        "roughnessFactor": 1.0,
    }
    obj = read(scene)
    (material,) = obj.materials.values()
    assert material.metallic is not None
    with Image.open(BytesIO(obj.files[material.metallic])) as image:
        assert image.getpixel((0, 0)) == (50, 50, 50, 55)


def test_texture_coordinates_are_moved_by_khr_texture_transform() -> None:
    scene = textured()
    info = scene.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": {"offset": [0.5, 0.0], "scale": [2.0, 1.0], "rotation": math.pi / 2}}
    (part,) = read(scene).parts
    # (u, v) -> rotated counter-clockwise as seen on the image, where v grows downwards
    u, v = UVS[CORNERS][:, 0] * 2, UVS[CORNERS][:, 1]
    np.testing.assert_allclose(part.uvs[part.faces].reshape(-1, 2), np.stack([v + 0.5, 1 + u], axis=1), atol=1e-6)


def test_maps_in_one_place_may_say_so_in_different_ways() -> None:
    scene = textured()
    material, shift = scene.document["materials"][0], {"offset": [0.5, 0.0]}
    info = material["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": shift | {"texCoord": 0}}
    material["normalTexture"] = {"index": 0, "extensions": {"KHR_texture_transform": shift}}
    assert read(scene).parts[0].uvs[:, 0].max() == 1.5


def test_the_set_of_texture_coordinates_that_the_material_names_is_read() -> None:
    scene = Scene()
    material = scene.material(scene.texture(GRADIENT))
    scene.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1
    scene.square(material, TEXCOORD_1=scene.accessor(UVS * np.float32(0.5)))
    (part,) = read(scene).parts
    assert part.uvs[:, 0].max() == 0.5


def test_strips_and_fans_are_the_triangles_they_stand_for() -> None:
    found = []
    for mode, order in ((4, [0, 1, 2, 0, 2, 3]), (5, [1, 2, 0, 3]), (6, [0, 1, 2, 3])):
        scene = textured()
        primitive = scene.document["meshes"][0]["primitives"][0]
        primitive |= {"mode": mode, "indices": scene.accessor(np.array(order, "<u2"))}
        triangles = corners(read(scene))
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        assert (normals == [0, 0, 4]).all()
        found.append({frozenset(map(tuple, triangle)) for triangle in triangles.tolist()})
    assert found[0] == found[1] == found[2]


def test_whole_numbers_stand_for_fractions_where_they_are_normalized() -> None:
    scene = textured()
    primitive = scene.document["meshes"][0]["primitives"][0]
    primitive["attributes"]["TEXCOORD_0"] = scene.accessor((UVS * 65535).astype("<u2"), normalized=True)
    (part,) = read(scene).parts
    assert sorted(set(part.uvs[:, 0].tolist())) == [0.0, 1.0]


def test_without_normals_faces_are_flat() -> None:
    scene = textured()
    del scene.document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    (part,) = read(scene).parts
    assert (part.normals == [0, 0, 1]).all()


def test_colours_of_vertices_are_baked_into_a_texture_of_their_own() -> None:
    scene = Scene()
    shades = np.array([[0, 0, 0], [255, 0, 0], [255, 255, 0], [0, 255, 0]], np.uint8)
    opaque = np.column_stack([shades, np.full(4, 255, np.uint8)])
    scene.square(scene.material(), COLOR_0=scene.accessor(opaque, normalized=True))
    obj = read(scene)
    (part,) = obj.parts
    (image,) = obj.textures.values()
    height, width = image.shape[:2]
    for corner, shade in zip(SQUARE, shades, strict=True):
        u, v = part.uvs[(part.vertices == corner).all(axis=1)][0]
        inward = (np.array([0.5, 0.5]) - [u, v]) * 0.02
        texel = image[int((1 - v - inward[1]) * height - 0.01), int((u + inward[0]) * width - 0.01)]
        assert np.abs(texel.astype(int) - shade).max() < 60, (corner, texel, shade)


def test_textures_are_made_smaller_on_request() -> None:
    obj = read_object(textured().to_glb(), name="scene.glb", max_texture=8).obj
    assert [image.shape for image in obj.textures.values()] == [(8, 8, 3)]


@pytest.mark.parametrize("based", [True, False])
def test_sparse_accessors_change_some_rows(based: bool) -> None:
    """Of the square, or of zeros: the corners named have other values."""
    scene = textured()
    rows, values = np.array([1, 2], "<u2"), np.array([[5, -1, 0], [5, 1, 0]], "<f4")
    positions = scene.document["accessors"][scene.document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    positions["sparse"] = {
        "count": 2,
        "indices": {"bufferView": scene.view(rows.tobytes()), "componentType": 5123},
        "values": {"bufferView": scene.view(values.tobytes())},
    }
    expected = SQUARE.copy()
    if not based:
        expected[:] = 0
        del positions["bufferView"]
    expected[rows] = values
    assert (corners(read(scene)) == expected[CORNERS].reshape(2, 3, 3)).all()


# What is not read


def test_what_cannot_be_shown_is_refused_with_a_reason() -> None:
    mirrored = textured()
    mirrored.document["textures"][0]["sampler"] = mirrored.add("samplers", {"wrapS": 33648})
    mirrored.document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = mirrored.accessor(UVS * np.float32(3))
    assert "Material 0 clamps or mirrors" in refusal(mirrored.to_glb(), "scene.glb")

    apart = textured()
    apart.document["materials"][0]["normalTexture"] = {"index": apart.texture(GRADIENT), "texCoord": 1}
    assert "one set" in refusal(apart.to_glb(), "scene.glb")

    both = Scene()
    shade = both.accessor(np.full((4, 3), 0.5, "<f4"))
    both.square(both.material(both.texture(GRADIENT)), COLOR_0=shade)
    assert "Material 0 has textures and vertex colours; bake" in refusal(both.to_glb(), "scene.glb")

    for mode in ("BLEND", "MASK"):
        faded = Scene()
        alpha = faded.accessor(np.array([[1, 1, 1, a] for a in (1, 1, 0, 1)], "<f4"))
        faded.square(faded.material(faded.texture(GRADIENT), alphaMode=mode), COLOR_0=alpha)
        assert "vertex colours with alpha" in refusal(faded.to_glb(), "scene.glb")

    older = textured(extensions={"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}})
    del older.document["materials"][0]["pbrMetallicRoughness"]
    assert "convert them to metallic-roughness" in refusal(older.to_glb(), "scene.glb")

    empty = textured()
    empty.document["nodes"] = [{}]
    assert "no triangles" in refusal(empty.to_glb(), "scene.glb")


# What comes back


@pytest.mark.parametrize("end", [b"", b"!"], ids=["padded buffer", "buffer without padding"])
def test_an_unchanged_object_gives_the_same_bytes(end: bytes) -> None:
    scene = textured(factor=[0.5, 1.0, 1.0, 1.0])
    scene.data += end
    data = scene.to_glb()
    assert repainted(data, read(data)) == data


def test_paint_as_long_as_the_image_before_comes_back() -> None:
    """Incompressible pictures of one size are PNGs of one length, so that nothing changes in the JSON."""
    random = np.random.default_rng(0)
    before, after = (random.integers(0, 256, (16, 16, 3), dtype=np.uint8) for _ in range(2))
    assert len(encode_png(before)) == len(encode_png(after))
    data = textured(before).to_glb()
    obj = read(data)
    (name,) = obj.textures
    (image,) = read(repainted(data, obj.with_textures({name: after}))).textures.values()
    assert (image == after).all()


def webp(scene: Scene, picture: Pixels) -> int:
    """An image of ``scene`` in WebP, without loss."""
    file = BytesIO()
    Image.fromarray(picture).save(file, "WEBP", lossless=True)
    return scene.add("images", {"bufferView": scene.view(file.getvalue()), "mimeType": "image/webp"})


@pytest.mark.parametrize("beside", [True, False])
def test_webp_is_read_and_comes_back_as_png_that_every_reader_shows(beside: bool) -> None:
    """Whether a PNG is there for readers without WebP, or not. Another texture keeps its WebP."""
    scene = textured()
    (first,) = scene.document["textures"]
    first["extensions"] = {"EXT_texture_webp": {"source": webp(scene, GRADIENT)}}
    if not beside:
        del first["source"]
    scene.document["extensionsUsed"] = ["EXT_texture_webp"]
    scene.document["extensionsRequired"] = ["EXT_texture_webp"]
    ((name, image),) = read(scene).textures.items()
    assert (image == GRADIENT).all(), name

    new, out = painted_over(scene)
    same_paint(read(out), new)
    document = contents(out)[0]
    assert [texture.keys() for texture in document["textures"]] == [{"source"}]
    assert document["images"][document["textures"][0]["source"]]["mimeType"] == "image/png"
    assert "extensionsRequired" not in document
    assert document.get("extensionsUsed") == (["EXT_texture_webp"] if beside else None)  # its image is still there

    scene.material(scene.add("textures", {"extensions": {"EXT_texture_webp": {"source": webp(scene, 255 - GRADIENT)}}}))
    kept = contents(painted_over(scene)[1])[0]
    assert kept["extensionsRequired"] == ["EXT_texture_webp"]
    assert "source" not in kept["textures"][1]


def test_only_the_base_colour_image_changes() -> None:
    scene = textured()
    normals = scene.texture(np.full((4, 4, 3), (128, 128, 255), np.uint8))
    scene.document["materials"][0]["normalTexture"] = {"index": normals}
    new, out = painted_over(scene)
    before, after = contents(scene.to_glb()), contents(out)
    assert before[0].keys() == after[0].keys()
    assert {name for name in before[0] if before[0][name] != after[0][name]} <= {"bufferViews", "buffers"}
    image_view = before[0]["images"][0]["bufferView"]
    for number, (one, other) in enumerate(zip(before[0]["bufferViews"], after[0]["bufferViews"], strict=True)):
        same = seen_through(one, before[1]) == seen_through(other, after[1])
        assert same == (number != image_view)
        assert other["byteOffset"] % 4 == 0
    same_paint(read(out), new)


def test_a_factor_that_was_taken_in_becomes_one_and_its_alpha_stays() -> None:
    new, out = painted_over(textured(factor=[0.5, 0.25, 1.0, 0.75], alphaMode="MASK"))
    assert contents(out)[0]["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] == [1.0, 1.0, 1.0, 0.75]
    assert (next(iter(read(out).textures.values())) == next(iter(new.textures.values()))).all()


def test_an_image_used_with_two_factors_becomes_two_and_each_keeps_its_paint() -> None:
    scene = Scene()
    texture = scene.texture(GRADIENT)
    scene.square(scene.material(texture))
    scene.square(scene.material(texture, factor=[0.2, 0.9, 0.2, 1.0]))
    new, out = painted_over(beside(scene))
    assert len(new.textures) == 2
    again = read(out)
    shown = [[obj.textures[obj.albedo_of(part)].tolist() for part in obj.parts] for obj in (again, new)]
    assert shown[0] == shown[1]


def test_materials_that_look_alike_share_their_texels() -> None:
    scene = Scene()
    texture = scene.texture(GRADIENT)
    scene.square(scene.material(texture))
    scene.square(scene.material(texture, doubleSided=True))
    new, out = painted_over(beside(scene))
    assert len(new.textures) == 1
    document, _ = contents(out)
    assert (len(document["images"]), len(document["textures"])) == (1, 1)


def test_an_image_that_is_more_than_a_base_colour_is_left_alone() -> None:
    scene = textured(emissiveFactor=[1, 1, 1])
    scene.document["materials"][0]["emissiveTexture"] = {"index": 0}
    document, chunk = contents(painted_over(scene)[1])
    assert document["materials"][0]["emissiveTexture"]["index"] == 0
    assert document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"] == 1
    view = document["bufferViews"][document["images"][document["textures"][0]["source"]]["bufferView"]]
    assert (decode_rgb(seen_through(view, chunk), "x") == GRADIENT).all()


def test_a_new_image_is_sampled_in_each_material_as_the_old_one() -> None:
    scene = textured()
    samplers = [scene.add("samplers", {"wrapS": wrap, "wrapT": wrap}) for wrap in (33071, 10497)]
    scene.document["textures"][0]["sampler"] = samplers[0]
    again = scene.add("textures", {"source": 0, "sampler": samplers[1]})
    scene.square(scene.material(again, emissiveTexture={"index": 0}), uvs=3 * UVS)
    new, out = painted_over(beside(scene))
    same_paint(read(out), new)
    document, _ = contents(out)
    assert [texture["sampler"] for texture in document["textures"]] == 2 * samplers
    assert len(document["images"]) == 2


def test_colours_of_the_older_kind_go_with_the_first_paint() -> None:
    older = "KHR_materials_pbrSpecularGlossiness"
    scene = textured(extensions={older: {"diffuseTexture": {"index": 0}}, "other": {}})
    scene.document["extensionsUsed"] = [older, "other"]
    scene.add("images", {"uri": "data:image/png;base64,"})  # needs no type
    document, _ = contents(painted_over(scene)[1])
    assert document["materials"][0]["extensions"] == {"other": {}}
    assert document["extensionsUsed"] == ["other"]

    scene.material(extensions={older: {}})
    document, _ = contents(painted_over(scene)[1])
    assert document["extensionsUsed"] == [older, "other"]


def test_paint_of_vertices_beside_other_maps_is_refused() -> None:
    scene = Scene()
    shade = scene.accessor(np.linspace(0, 1, 12, dtype="<f4").reshape(4, 3))
    scene.square(scene.material(emissiveTexture={"index": scene.texture(GRADIENT)}), COLOR_0=shade)
    data = scene.to_glb()
    assert repainted(data, read(data)) == data
    with pytest.raises(ObjectError, match="vertex colours and other maps on one material; take the GLB"):
        repainted(data, painted(read(data)))


def test_alpha_of_the_image_is_kept_whatever_it_means() -> None:
    alpha = np.arange(256, dtype=np.uint8).reshape(16, 16)
    document, chunk = contents(painted_over(textured(np.dstack([GRADIENT, alpha])))[1])
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    with Image.open(BytesIO(seen_through(view, chunk))) as image:
        assert (np.array(image.getchannel("A")) == alpha).all()


@pytest.mark.parametrize("uvs", [None, UVS, 0 * UVS], ids=["without texture coordinates", "with them", "in one point"])
@pytest.mark.parametrize("colours", [False, True])
def test_a_flat_colour_becomes_a_texture_with_missing_coordinates(uvs: NDArray[Any] | None, colours: bool) -> None:
    scene = Scene()
    shade = {"COLOR_0": scene.accessor(np.linspace(0, 1, 12, dtype="<f4").reshape(4, 3))} if colours else {}
    scene.square(scene.material(factor=[0.5, 0.1, 0.1, 1.0]), uvs=uvs, **shade)
    scene.square(0)
    new, out = painted_over(beside(scene))
    same_paint(read(out), new)
    assert all(np.ptp(part.uvs, axis=0).all() for part in new.parts)


def test_compressed_copies_are_moved_or_dropped_with_what_they_are_copies_of() -> None:
    scene = Scene()
    scene.square(scene.material(scene.texture(GRADIENT)))
    scene.square(scene.material(), uvs=None)
    copied = {"buffer": 0, "byteOffset": len(scene.data), "byteLength": 8}
    scene.data += b"a copy: "
    scene.document["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": copied, "other": {}}
    draco = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    scene.document["meshes"][1]["primitives"][0]["extensions"] = draco
    scene.document["extensionsUsed"] = ["EXT_meshopt_compression", "KHR_draco_mesh_compression"]
    document, data = contents(painted_over(beside(scene))[1])
    (moved, other) = document["bufferViews"][0]["extensions"].values()
    assert seen_through(moved, data) == b"a copy: "
    assert other == {}
    assert document["extensionsUsed"] == ["EXT_meshopt_compression"]
    assert "extensions" not in document["meshes"][1]["primitives"][0]


def test_weights_of_a_node_replace_those_of_its_mesh_and_colours_are_rounded() -> None:
    scene = textured(factor=[1.0000001, 1, 1, -1e-9], extensions=None)
    scene.document["meshes"][0]["weights"] = [0.5]
    assert "morph targets" in refusal(scene.to_glb(), "scene.glb")
    scene.document["nodes"][0]["weights"] = [0.0]
    scene.document["textures"][0]["extensions"] = None
    new, out = painted_over(scene)
    same_paint(read(out), new)


def test_paint_for_another_mesh_is_refused() -> None:
    data = textured().to_glb()
    other = textured()
    other.document["nodes"][0]["scale"] = [2, 2, 2]
    with pytest.raises(ObjectError, match="is not the uploaded one"):
        repainted(data, painted(read(other)))


def external(ending: str = "png") -> dict[str, bytes]:
    """The textured square in a folder: JSON, buffer, and the picture in a folder of its own."""
    scene = textured()
    picture, buffers = f"my maps/skin.{ending}", [{"byteLength": len(scene.data), "uri": "square.bin"}]
    document = scene.document | {"images": [{"uri": picture.replace(" ", "%20")}], "buffers": buffers}
    text = json.dumps(document, indent=1).encode()
    return {"square.gltf": text, "square.bin": scene.data, picture: encode_png(GRADIENT), "notes.txt": b"!"}


@pytest.mark.parametrize("uri", ["C:\\\\scans\\\\skin.png", "file:///home/me/skin.png", "/me/skin.png", "../skin.png"])
def test_a_picture_is_found_by_its_name_if_its_path_is_of_another_machine(uri: str) -> None:
    files = external()
    files["square.gltf"] = files["square.gltf"].replace(b"my%20maps/skin.png", uri.encode())
    obj = read_object(pack_zip(files), name="square.zip").obj
    out = unpack(repaint_file(pack_zip(files), painted(obj), name="square.zip").data)
    assert [name for name in files if files[name] != out[name]] == ["my maps/skin.png"]


@pytest.mark.parametrize("picture", ["my maps/skin.png", "My Maps/SKIN.png", "Skin.png", "other/skin.png"])
def test_of_a_folder_only_the_picture_changes_whatever_its_capitals_and_place(picture: str) -> None:
    files = external()
    files[picture] = files.pop("my maps/skin.png")
    data = pack_zip(files)
    exported = repaint_file(data, painted(read_object(data, name="square.zip").obj), name="square.zip")
    after = unpack(exported.data)
    assert exported.ending == ".zip"
    assert [name for name in files if after[name] != files[name]] == [picture]
    assert list(after) == list(files)


@pytest.mark.parametrize("place", ["my maps/skin.jpg", "skin.jpg"])
def test_a_picture_that_was_no_png_becomes_one_and_is_named_so(place: str) -> None:
    files = external("jpg")
    files[place] = files.pop("my maps/skin.jpg")
    data = pack_zip(files)
    after = unpack(repaint_file(data, painted(read_object(data, name="s.zip").obj), name="s.zip").data)
    renamed = place.replace("jpg", "png")
    assert json.loads(after["square.gltf"])["images"] == [{"uri": renamed.replace(" ", "%20")}]
    assert after[renamed][:4] == b"\x89PNG"
    assert place not in after


def test_a_file_with_another_use_under_another_uri_stays() -> None:
    files = external("jpg")
    document = json.loads(files["square.gltf"])
    document["images"].append({"uri": "./My maps/skin.jpg"})
    document["textures"].append({"source": 1})
    document["materials"][0]["emissiveTexture"] = {"index": 1}
    data = pack_zip(files | {"square.gltf": json.dumps(document).encode()})
    after = unpack(repaint_file(data, painted(read_object(data, name="s.zip").obj), name="s.zip").data)
    assert after["my maps/skin.jpg"] == files["my maps/skin.jpg"]


def test_data_uris_stay_inside() -> None:
    scene = textured()
    picture = "data:image/png;base64," + base64.b64encode(encode_png(GRADIENT)).decode()
    buffer = "data:application/octet-stream;base64," + base64.b64encode(scene.data).decode()
    buffers = [{"byteLength": len(scene.data), "uri": buffer}]
    document = scene.document | {"images": [{"uri": picture}], "buffers": buffers}
    data = json.dumps(document).encode()
    new = painted(read_object(data, name="s.gltf").obj)
    exported = repaint_file(data, new, name="s.gltf")
    assert exported.ending == ".gltf"
    after = json.loads(exported.data)
    assert after["buffers"] == document["buffers"]
    again = read_object(exported.data, name="s.gltf").obj
    assert (next(iter(again.textures.values())) == next(iter(new.textures.values()))).all()


# GLB from any object


def test_any_object_becomes_a_glb_that_is_the_same_object(mug: Object3D) -> None:
    again = read(write_glb(mug))
    assert (corners(again) == corners(mug)).all()
    for one, other in zip(again.parts, mug.parts, strict=True):
        np.testing.assert_allclose(one.uvs[one.faces], other.uvs[other.faces], atol=6e-8)
        np.testing.assert_allclose(one.normals[one.faces], other.normals[other.faces], atol=1.2e-7)
        assert (again.textures[again.albedo_of(one)] == mug.textures[mug.albedo_of(other)]).all()


def test_an_object_looks_the_same_as_glb(target: SailenvTarget) -> None:
    random = np.random.default_rng(3)
    side = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0.2], [0.5, 0.5, 0], [-0.5, 0.5, 0.2]])
    uvs = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.5], [0.0, 1.5]])
    rows = [0, 1, 2, 0, 2, 3]
    surface = side[rows].reshape(-1, 3, 3), uvs[rows].reshape(-1, 3, 2)
    plain = object_of((*surface, random.integers(0, 256, (32, 32, 3), dtype=np.uint8)))
    maps = {"normal": random.integers((100, 100, 199), (156, 156, 255), (16, 16, 3), dtype=np.uint8)}
    maps["metallic"] = random.integers(0, 256, (16, 16, 4), dtype=np.uint8)
    files = dict(plain.files) | {f"{name}.png": encode_png(image) for name, image in maps.items()}
    cut = np.dstack([plain.textures["m0.png"], random.integers(0, 256, (32, 32), dtype=np.uint8)])
    files["m0.png"] = encode_png(cut)
    table = {"m0": {"albedo": "m0.png", "normal": "normal.png", "metallic": "metallic.png"}}
    files["made_mat_def.json"] = json.dumps(table).encode()
    obj = load_object(pack_zip(files))
    before = target.render(obj, VIEWS, size=(64, 64))
    after = target.render(read(write_glb(obj)), VIEWS, size=(64, 64))
    assert np.abs(before.astype(int) - after).max() <= 1
    assert (before != 255).any()


def test_a_glb_and_the_zip_of_it_look_the_same_after_repainting(target: SailenvTarget) -> None:
    scene = textured(factor=[0.9, 0.6, 0.6, 1.0], doubleSided=True)
    scene.square(scene.material(factor=[0.1, 0.4, 0.1, 1.0]), uvs=None)
    scene.document["nodes"] = [
        {"mesh": 0, "children": [1], "scale": [0.5, 0.5, 0.5]},
        {"mesh": 1, "scale": [-1, 1, 1], "translation": [0.5, 0.5, -0.5]},
    ]
    new, out = painted_over(scene)
    before = target.render(new, VIEWS, size=(64, 64))
    after = target.render(read(out), VIEWS, size=(64, 64))
    assert np.abs(before.astype(int) - after).max() <= 1


@given(
    st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3)),
    st.tuples(*[st.floats(0.1, 3) | st.floats(-3, -0.1)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01),
)
@settings(max_examples=30)
def test_any_place_keeps_normals_on_the_side_that_triangles_face(
    translation: tuple[float, ...], scale: tuple[float, ...], rotation: tuple[float, ...]
) -> None:
    scene = textured()
    length = math.sqrt(sum(x * x for x in rotation))
    unit = [x / length for x in rotation]
    scene.document["nodes"] = [{"mesh": 0, "translation": translation, "scale": scale, "rotation": unit}]
    (part,) = read(scene).parts
    faces = part.vertices[part.faces].astype(np.float64)
    facing = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    np.testing.assert_allclose(facing, part.normals[part.faces][:, 0], atol=1e-3)
