"""The object format: reading, exact round trips, and refusals that name the place and the remedy."""

import io
import json
import tracemalloc
import zipfile
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from tests.small_models import large_png, zipped
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import (
    Object3D,
    decode_rgb,
    encode_png,
    load_object,
    object_from_files,
    roughness_metallic,
    unpack,
)
from trompe_shared.wavefront import parse_mtl, parse_obj

MESH = """# a triangle
mtllib thing.mtl
v 0 0 0
v 1 0 0
v 0 1 0
vt 0 0
vt 1 0
vt 0 1
usemtl paint
f 1/1 2/2 3/3
"""
TABLE = b'{"paint": {"albedo": "paint.png", "normal": null, "metallic": ""}}'
PAINT = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
FILES: dict[str, bytes] = {
    "thing.obj": MESH.encode(),
    "thing_mat_def.json": TABLE,
    "paint.png": encode_png(PAINT),
    "readme.txt": b"\x00 kept as it is \xff",
}


def with_files(**changes: bytes | None) -> dict[str, bytes]:
    """The files of a good object, some replaced or taken away; ``__`` stands for a dot."""
    changed = {name.replace("__", "."): data for name, data in changes.items()}
    return {name: data for name, data in {**FILES, **changed}.items() if data is not None}


def of_mtl(mtl: bytes, **pictures: bytes) -> Object3D:
    """The good object with its materials in an MTL alone, and with other pictures."""
    return object_from_files(with_files(thing_mat_def__json=None, thing__mtl=mtl, **pictures))


Source = bytes | Path | Mapping[str, bytes]


def refusal(source: Source) -> str:
    with pytest.raises(ObjectError) as raised:
        object_from_files(source) if isinstance(source, Mapping) else load_object(source)
    return str(raised.value)


def only_part(mesh: str) -> tuple[np.ndarray, np.ndarray]:
    """(corner positions, corner normals), each (F, 3, 3), of a mesh of one material."""
    (part,) = parse_obj(mesh, "thing.obj")
    return part.vertices[part.faces], part.normals[part.faces]


# What is read


def test_an_object_is_read_whole() -> None:
    obj = load_object(zipped(FILES))
    assert (obj.name, list(obj.files), list(obj.materials)) == ("thing", list(FILES), ["paint"])
    assert (obj.materials["paint"].normal, obj.materials["paint"].metallic) == (None, None)
    assert obj.albedo_of(obj.parts[0]) == "paint.png"
    assert (obj.textures["paint.png"] == PAINT).all()
    assert obj.textures["paint.png"].dtype == np.uint8
    assert (obj.n_texels, obj.radius) == (24, 1.0)


def test_a_zip_a_folder_and_the_obj_itself_are_the_same_object(tmp_path: Path) -> None:
    folder = tmp_path / "thing"
    folder.mkdir()
    (folder / "subfolder").mkdir()
    for name, data in FILES.items():
        (folder / name).write_bytes(data)
    archive = tmp_path / "other-name.zip"
    archive.write_bytes(zipped(FILES))
    in_a_folder = zipped({f"things/my thing/{name}": data for name, data in FILES.items()})
    littered = zipped(FILES | {"__MACOSX/._thing.obj": b"finder", "empty/": b""})
    sources: list[bytes | str | Path] = [folder, str(folder), archive, in_a_folder, littered]
    found = {(obj.name, frozenset(obj.files.items())) for obj in map(load_object, sources)}
    assert found == {("thing", frozenset(FILES.items()))}
    (folder / "other.obj").write_bytes(b"")
    assert load_object(folder / "thing.obj").files == with_files(readme__txt=None)
    (folder / "subfolder/paint.png").write_bytes(b"")
    (folder / "thing.mtl").write_bytes(b"norm subfolder/paint.png")
    assert "subfolder/paint.png" in refusal(folder / "thing.obj")


LIBRARY = b"newmtl paint\nmap_Kd paint.png\n"
OTHER = b"newmtl paint\nmap_Kd other.png\n"


NAMED = {
    "one": ("mtllib thing.mtl", {"thing.mtl": LIBRARY, "table.mtl": OTHER}),
    "folder": ("# mtllib table.mtl\nmtllib ./a/Thing.mtl", {"table.mtl": OTHER, "thing.mtl": LIBRARY}),
    "several": ("mtllib my thing.mtl b.mtl", {"b.mtl": OTHER, "my thing.mtl": LIBRARY, "c.mtl": OTHER}),
    "the first counts": ("mtllib b.mtl\nmtllib a.mtl", {"a.mtl": OTHER, "b.mtl": LIBRARY}),
    "none is there": ("mtllib gone.mtl", {"thing.mtl": LIBRARY, "table.mtl": b"newmtl x"}),
    "foreign mat_def": ("", {"thing.mtl": LIBRARY, "table_mat_def.json": b'{"x": {"albedo": "x.png"}}'}),
}


@pytest.mark.parametrize(("line", "mtls"), NAMED.values(), ids=NAMED)
def test_a_mesh_has_the_materials_that_it_names(line: str, mtls: dict[str, bytes]) -> None:
    mesh = MESH.replace("mtllib thing.mtl", line).encode()
    files = with_files(thing_mat_def__json=None, thing__obj=mesh) | mtls
    assert object_from_files(files).materials["paint"].albedo == "paint.png"


def test_materials_in_latin_1_stay_apart() -> None:
    mesh = MESH.replace("usemtl paint", "usemtl M\xe9") + "usemtl M\xe8\nf 1/1 2/2 3/3\n"
    mtl = "newmtl M\xe9\nmap_Kd paint.png\nnewmtl M\xe8\nmap_Kd b.png\n"
    texts = {"thing.obj": mesh.encode("latin-1"), "thing.mtl": mtl.encode("latin-1"), "b.png": FILES["paint.png"]}
    obj = object_from_files(with_files(thing_mat_def__json=None) | texts)
    assert {name: each.albedo for name, each in obj.materials.items()} == {"M\xe9": "paint.png", "M\xe8": "b.png"}


@pytest.mark.parametrize(
    ("key", "colour", "normal"),
    [
        pytest.param("map_Bump", (128, 128, 128), None, id="heights"),
        pytest.param("bump", (128, 128, 255), "n.png", id="normals"),
        pytest.param("norm", (128, 128, 128), "n.png", id="norm"),
        pytest.param("map_Kn", (128, 128, 255), "n.png", id="map_Kn"),
    ],
)
def test_a_grey_bump_map_is_no_normal_map(key: str, colour: tuple[int, ...], normal: str | None) -> None:
    picture = encode_png(np.full((2, 2, 3), colour, np.uint8))
    obj = of_mtl(LIBRARY + f"{key} n.png".encode(), n__png=picture)
    assert obj.materials["paint"].normal == normal
    assert obj.files["n.png"] == picture


def test_a_bump_map_that_is_the_albedo_is_no_normal_map() -> None:
    assert of_mtl(LIBRARY + b"map_bump paint.png").materials["paint"].normal is None


@pytest.mark.parametrize(
    ("words", "maps"),
    [
        ("-clamp on my tex.png", {"albedo": "my tex.png", "clamp": "on"}),
        ("-clamp off -bm 1.0 -o 0 0 -mm 0 1 -imfchan r maps\\my 2 tex.png ", {"albedo": "my 2 tex.png"}),
        ("-unknown my tex.png", {"albedo": "tex.png"}),
    ],
)
def test_options_of_a_map_are_no_part_of_its_name(words: str, maps: dict[str, str]) -> None:
    assert parse_mtl(f"newmtl m\nmap_Kd {words}\n") == {"m": maps}


def test_an_mtl_replaces_a_missing_material_definition() -> None:
    mtl = (
        "# blender\nnewmtl other\nmap_Kd other.png\nnewmtl paint\nKd 1 1 1\n"
        "map_Kd C:\\my textures\\paint.png\nbump -bm 1.0 ../maps/bumps.png\n"
    )
    obj = of_mtl(mtl.encode(), bumps__png=FILES["paint.png"])
    assert (obj.materials["paint"].albedo, obj.materials["paint"].normal) == ("paint.png", "bumps.png")
    assert list(obj.materials) == ["paint"]
    assert parse_mtl(mtl)["other"] == {"albedo": "other.png"}


def test_several_materials_become_parts_in_the_order_of_their_first_use() -> None:
    mesh = MESH + "usemtl glaze\nf 1/1 2/2 3/3\nusemtl paint\nf 3/3 2/2 1/1\n"
    table = {"glaze": {"albedo": "folder/glaze.png"}, "paint": {"albedo": "paint.png"}, "unused": {"albedo": "no.png"}}
    obj = object_from_files(
        with_files(
            thing__obj=mesh.encode(),
            thing_mat_def__json=json.dumps(table).encode(),
            glaze__png=encode_png(np.zeros((2, 2, 3), np.uint8)),
        )
    )
    assert [(part.material, len(part.faces)) for part in obj.parts] == [("paint", 2), ("glaze", 1)]
    shapes = {name: image.shape for name, image in obj.textures.items()}
    assert shapes == {"paint.png": (4, 6, 3), "glaze.png": (2, 2, 3)}
    assert obj.n_texels == 28


@given(st.integers(0, 2**31), st.integers(3, 60))
@settings(max_examples=40)
def test_the_sphere_holds_all_vertices_and_is_hardly_larger_than_needed(seed: int, n: int) -> None:
    """Jung (1901): points at most d apart fit into a sphere of radius d * sqrt(3 / 8), and need at least d / 2."""
    random = np.random.default_rng(seed)
    points = (random.normal(size=(n, 3)) * random.uniform(0.1, 1, 3) + random.normal(size=3)).astype(np.float32)
    obj = object_from_files(FILES)
    part = replace(obj.parts[0], vertices=points)
    centre, radius = replace(obj, parts=(part,)).sphere
    apart = np.linalg.norm(points[:, None] - points, axis=2).max()
    assert np.linalg.norm(points - np.array(centre), axis=1).max() <= radius + 1e-6
    assert 0.5 * apart <= radius * (1 + 1e-6) <= 1.01 * np.sqrt(3 / 8) * apart


def test_polygons_are_split_into_fans() -> None:
    mesh = MESH + "v 1 1 0\nvt 1 1\nv -1 0 0\nf 1/1 2/2 4/4 3/3 5/3\n"
    corners, _ = only_part(mesh)
    fan = [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)], [(0, 0), (0, 1), (-1, 0)]]
    assert corners[1:, :, :2].tolist() == np.array(fan, float).tolist()


STAR = [(float(np.cos(k * np.pi / 5)) * (1 + k % 2), float(np.sin(k * np.pi / 5)) * (1 + k % 2)) for k in range(10)]


@pytest.mark.parametrize(
    "outline",
    [
        pytest.param([(0, 0), (2, 2), (0, 1), (-2, 2)], id="an arrow head"),
        pytest.param([(2, 2), (0, 1), (-2, 2), (0, 0)], id="an arrow head from another corner"),
        pytest.param([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], id="an L"),
        pytest.param([(0, 0), (1, 0), (2, 0), (2, 1), (1, 0.2), (0, 1)], id="corners on a line"),
        pytest.param([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)], id="a hole"),
        pytest.param(STAR, id="a star"),
    ],
)
@pytest.mark.parametrize("mirror", [1, -1])
def test_triangles_of_a_concave_polygon_cover_it_once(outline: list[tuple[float, float]], mirror: int) -> None:
    mesh = "".join(f"v {x} {mirror * y} {x - y}\nvt {x} {y}\n" for x, y in outline)
    mesh += "f " + " ".join(f"{k}/{k}" for k in range(1, len(outline) + 1))
    corners, normals = only_part(mesh)
    x, y = np.array(outline).T
    areas = mirror * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert areas.min() >= -1e-6
    assert areas.sum() == pytest.approx((x * np.roll(y, -1) - y * np.roll(x, -1)).sum(), rel=1e-5)
    assert (mirror * normals[..., 2] > 0).all()


def test_a_concave_polygon_with_too_many_corners_is_refused() -> None:
    ring = [(np.cos(k / 200) * (1 + k % 2), np.sin(k / 200) * (1 + k % 2)) for k in range(1200)]
    mesh = "".join(f"v {x} {y} 0\nvt 0 0\n" for x, y in ring)
    with pytest.raises(ObjectError, match="concave polygon with 1200 corners; at most 1000"):
        parse_obj(mesh + "f " + " ".join(f"{k}/{k}" for k in range(1, 1201)), "thing.obj")


def test_negative_indices_count_from_the_last_statement() -> None:
    relative = MESH.replace("f 1/1 2/2 3/3", "f -3/-3 -2/-2 -1/-1")
    mesh = relative + "v 5 5 5\nvt 1 1\nf -1/-1 -2/2 -3/-4\n"
    corners, _ = only_part(mesh)
    assert (corners[0] == only_part(MESH)[0][0]).all()
    assert corners[1].tolist() == [[5, 5, 5], [0, 1, 0], [1, 0, 0]]


def test_given_normals_are_made_unit_and_missing_ones_computed() -> None:
    given = MESH.replace("f 1/1 2/2 3/3", "vn 0 3 4\nvn 0 0 0\nf 1/1/1 2/2/1 3/3/2")
    for missing in ("0 0 0", "nan nan nan", "0 inf 0"):
        normals = only_part(given.replace("vn 0 0 0", f"vn {missing}"))[1][0]
        np.testing.assert_allclose(normals, np.array([[0, 0.6, 0.8], [0, 0.6, 0.8], [0, 0, 1]]), atol=1e-6)
    assert (only_part(MESH)[1] == [0, 0, 1]).all()


@pytest.mark.parametrize("off", ["off", "0"])
def test_computed_normals_are_flat_where_smoothing_is_off(off: str) -> None:
    roof = "v 0 0 0\nv 0 0 1\nv 1 1 1\nv 1 1 0\nv -1 1 0\nvt 0 0\ns %s\nf 1/1 2/1 3/1 4/1\nf 2/1 1/1 5/1\n"
    corners, flat = only_part(roof % off)
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    np.testing.assert_allclose(flat, np.repeat(own[:, None], 3, axis=1), atol=1e-6)
    assert np.abs(only_part(roof % "1")[1] - flat).max() > 0.1
    assert (only_part(roof.replace("s %s\n", ""))[1] == only_part(roof % "1")[1]).all()


def test_computed_normals_are_smooth_across_a_shared_edge() -> None:
    roof = "v 0 0 0\nv 0 0 1\nv 1 1 0\nv -1 1 0\nvt 0 0\nf 1/1 2/1 3/1\nf 2/1 1/1 4/1\n"
    corners, normals = only_part(roof)
    on_the_edge = (corners[..., 0] == 0).all(axis=1, keepdims=True) | (corners[..., :2] == 0).all(axis=2)
    np.testing.assert_allclose(np.abs(normals[on_the_edge]), np.tile([0, 1, 0], (4, 1)), atol=1e-6)
    for mesh in (roof, MESH.replace("v 0 1 0", "v 2 0 0")):  # the second has no area
        np.testing.assert_allclose(np.linalg.norm(only_part(mesh)[1], axis=2), 1, atol=1e-6)


def test_long_lines_comments_and_single_texture_coordinates_are_read() -> None:
    mesh = (
        MESH.replace("f 1/1 2/2 3/3", "f 1/1 \\\n2/2 \\\r\n 3/3 # three")
        .replace("vt 0 0", "vt 0 # u")
        .replace("v 0 1 0", "v 0 1 0#")
    )
    mesh = mesh.replace("# a triangle", "# C:\\")
    np.testing.assert_array_equal(only_part(mesh)[0], only_part(MESH)[0])
    with pytest.raises(ObjectError, match="line 13: 'f 9'"):
        parse_obj(mesh + "f 9", "thing.obj")
    assert parse_obj(MESH.replace("paint", "Material #25"), "thing.obj")[0].material == "Material #25"


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "1"])
def test_images_of_every_mode_are_read_as_rgb(mode: str) -> None:
    """Transparent pixels keep the colour that they have beneath."""
    colours = np.array([[[0, 0, 0], [255, 255, 255], [90, 90, 90]], [[200, 10, 30], [10, 200, 30], [10, 30, 200]]])
    if mode in {"L", "LA"}:
        colours = colours[:1]
    if mode == "1":
        colours = colours[:1, :2]
    picture = Image.fromarray(colours.astype(np.uint8)).convert(mode, palette=Image.Palette.ADAPTIVE)
    if "A" in mode:
        picture.putalpha(0)
    decoded = decode_rgb(encode_png(picture), "paint.png")
    assert decoded.dtype == np.uint8
    np.testing.assert_array_equal(decoded, colours)


# What comes back


@pytest.mark.parametrize(
    ("orientation", "refused"), [(1, nullcontext()), (6, pytest.raises(ObjectError, match="turned"))]
)
def test_a_photograph_that_some_programs_turn_is_refused(orientation: int, refused: Any) -> None:
    exif, jpeg = Image.Exif(), io.BytesIO()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(PAINT).save(jpeg, "JPEG", exif=exif)
    with refused:
        assert decode_rgb(jpeg.getvalue(), "photo.jpg").shape == PAINT.shape


@pytest.mark.parametrize(("form", "mode"), [("PNG", "I;16"), ("TIFF", "I;16"), ("TIFF", "I;16B")])
def test_greys_of_16_bits_are_scaled_to_8_not_clipped(form: str, mode: str) -> None:
    grey = np.array([[0, 255, 256, 0x7FFF], [0x8000, 0xFE00, 0xFEFF, 0xFFFF]], np.uint16)
    buffer = io.BytesIO()
    big = mode.endswith("B")
    Image.frombytes(mode, (4, 2), grey.astype(">u2" if big else "<u2").tobytes()).save(buffer, form)
    read = decode_rgb(buffer.getvalue(), "grey.png")
    assert read.dtype == np.uint8
    assert (read == (grey >> 8)[..., None]).all()
    assert read.shape == (2, 4, 3)
    assert (roughness_metallic(buffer.getvalue(), "grey.png")[..., 1] == grey >> 8).all()


def test_every_file_comes_back_byte_for_byte_and_the_same_content_gives_the_same_bytes() -> None:
    one, other = load_object(zipped(FILES)), load_object(zipped(FILES, method=zipfile.ZIP_STORED))
    assert dict(load_object(one.to_zip()).files) == FILES
    assert one.to_zip() == other.to_zip() == pack_zip(FILES)


@given(st.dictionaries(st.text("abc.é_-", min_size=1, max_size=8), st.binary(max_size=200), max_size=5))
@settings(max_examples=30)
def test_a_packed_zip_holds_what_was_put_in(files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(io.BytesIO(pack_zip(files))) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == files
        assert archive.namelist() == list(files)


def test_a_repainted_object_differs_in_its_albedo_file_alone_and_no_other_file_can_be_painted() -> None:
    obj, other = load_object(zipped(FILES)), 255 - PAINT
    painted = obj.with_textures({"paint.png": other})
    again = load_object(painted.to_zip())
    assert (painted.textures["paint.png"] == other).all()
    assert (again.textures["paint.png"] == other).all()
    assert {name for name in FILES if again.files[name] != FILES[name]} == {"paint.png"}
    assert (obj.textures["paint.png"] == PAINT).all()
    with pytest.raises(ObjectError, match=r"readme\.txt.*paint\.png"):
        obj.with_textures({"readme.txt": PAINT})


def test_a_texture_of_equal_pixels_keeps_its_file() -> None:
    jpeg = io.BytesIO()
    Image.fromarray(PAINT).save(jpeg, "JPEG")
    obj = object_from_files(with_files(paint__png=jpeg.getvalue()))
    assert obj.with_textures(obj.textures).files == obj.files


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_a_repainted_texture_keeps_its_opacity_and_may_change_its_size(mode: str) -> None:
    alpha = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
    picture = Image.fromarray(PAINT)
    picture.putalpha(Image.fromarray(alpha))
    obj = object_from_files(with_files(paint__png=encode_png(picture.convert(mode))))
    painted = obj.with_textures({"paint.png": 255 - PAINT})
    with Image.open(io.BytesIO(painted.files["paint.png"])) as image:
        assert (np.array(image.getchannel("A")) == alpha).all()
        assert (np.array(image.convert("RGB")) == 255 - PAINT).all()
    resized = obj.with_textures({"paint.png": np.full((1, 1, 3), 7, np.uint8)})
    assert load_object(resized.to_zip()).textures["paint.png"].tolist() == [[[7, 7, 7]]]
    with Image.open(io.BytesIO(resized.files["paint.png"])) as image:
        assert 0 < np.array(image.getchannel("A"))[0, 0] < 230


# What is refused


def faulty_mesh(line: str) -> dict[str, bytes]:
    return with_files(thing__obj=(MESH + line + "\n").encode())


def scrambled() -> bytes:
    """A zip with other bytes in the middle of a deflated member."""
    files = {"thing.obj": bytes(np.random.default_rng(0).integers(0, 40, 5000, dtype=np.uint8))}
    data = bytearray(zipped(files))
    data[300:600] = b"\xff" * 300
    return bytes(data)


REFUSED: dict[str, tuple[Source, list[str]]] = {
    "no mesh": (with_files(thing__obj=None), ["exactly one .obj", "readme.txt"]),
    "nothing at all": ({}, ["exactly one .obj"]),
    "two meshes": (with_files(other__obj=b""), ["exactly one .obj", "other.obj", "thing.obj"]),
    "an empty mesh": (with_files(thing__obj=b""), ["thing.obj", "no faces"]),
    "points without faces": (with_files(thing__obj=b"v 0 0 0\n"), ["thing.obj", "no faces"]),
    "a missing texture": (with_files(paint__png=None), ["paint.png", "put it beside the model"]),
    "an empty texture": (with_files(paint__png=b""), ["paint.png", "PNG"]),
    "a texture that is text": (with_files(paint__png=b"hello"), ["paint.png", "PNG"]),
    "half a texture": (with_files(paint__png=FILES["paint.png"][:-30]), ["paint.png", "PNG"]),
    "an undefined material": (with_files(thing_mat_def__json=b"{}"), ["'paint'", "thing_mat_def.json", "none"]),
    "no materials": (with_files(thing_mat_def__json=None), ["'paint'", ".mtl", "none"]),
    "an mtl without a map": (with_files(thing_mat_def__json=None, a__mtl=b"newmtl paint\nKd 1 1 1"), ["'paint'"]),
    "a table cut short": (with_files(thing_mat_def__json=TABLE[:-1]), ["thing_mat_def.json", '"albedo"']),
    "a table that is a list": (with_files(thing_mat_def__json=b"[1]"), ["thing_mat_def.json", '"albedo"']),
    "a material that is a text": (with_files(thing_mat_def__json=b'{"paint": "x"}'), ["thing_mat_def.json", "albedo"]),
    "an opacity beyond 1": (
        with_files(thing_mat_def__json=b'{"paint": {"albedo": "paint.png", "opacity": 2}}'),
        ["opacity 2", "from 0 to 1"],
    ),
    "a material without albedo": (with_files(thing_mat_def__json=b'{"paint": {}}'), ["albedo"]),
    "an albedo that is a number": (with_files(thing_mat_def__json=b'{"paint": {"albedo": 3}}'), ["albedo"]),
    "a table that is no text": (with_files(thing_mat_def__json=b"\xff\xfe\x00"), ["thing_mat_def.json"]),
    "a table nested too deep": (with_files(thing_mat_def__json=b"[" * 100_000), ["thing_mat_def.json"]),
    "faces without uvs": (with_files(thing__obj=MESH.replace("1/1 2/2 3/3", "1 2 3").encode()), ["vt", "unwrap"]),
    "one corner without uv": (faulty_mesh("f 1/1 2/2 3"), ["vt", "unwrap", "'paint'"]),
    "an index too large": (faulty_mesh("f 1/1 2/2 4/3"), ["thing.obj, line 11", "v 4", "3 are defined"]),
    "a uv index too large": (faulty_mesh("f 1/1 2/2 3/9"), ["line 11", "vt 9"]),
    "an index too far back": (faulty_mesh("f 1/1 2/2 -4/3"), ["line 11", "v -4"]),
    "index zero": (faulty_mesh("f 0/1 2/2 3/3"), ["line 11", "v 0"]),
    "an index that is no number": (faulty_mesh("f 1/1 2/2 x/3"), ["line 11", "'f 1/1 2/2 x/3'"]),
    "a face of two corners": (faulty_mesh("f 1/1 2/2"), ["line 11", "three corners"]),
    "a vertex of two numbers": (faulty_mesh("v 1 2"), ["line 11", "expected 3"]),
    "a vertex of words": (faulty_mesh("v a b c"), ["line 11"]),
    "a vertex that is not a number": (faulty_mesh("v nan 0 0"), ["thing.obj", "'v'", "not finite"]),
    "an infinite uv": (faulty_mesh("vt 0 inf"), ["thing.obj", "'vt'", "not finite"]),
    "a vertex beyond single precision": (faulty_mesh("v 1e50 0 0"), ["thing.obj", "'v'", "not finite"]),
    "nothing": (b"", ["not a zip", "Zip the folder"]),
    "an obj": (MESH.encode(), ["not a zip", "Zip the folder"]),
    "scrambled": (scrambled(), ["damaged or encrypted", "Zip the folder"]),
    "two folders": (zipped(FILES | {"more/x.png": b""}), ["flat", "one folder"]),
    "more files than an archive may have": (FILES | {f"{k}.png": b"" for k in range(256)}, ["260 files", "Merge"]),
    "no such file": (Path("nowhere.zip"), ["nowhere.zip"]),
    "a folder without a mesh": (Path(__file__).parent, ["exactly one .obj"]),
}


@pytest.mark.parametrize(("source", "words"), REFUSED.values(), ids=REFUSED)
def test_an_inconsistent_object_is_refused_with_place_and_remedy(source: Source, words: list[str]) -> None:
    message = refusal(source)
    assert [word for word in words if word not in message] == []


def test_a_file_of_another_format_is_refused_with_the_function_that_reads_it(tmp_path: Path) -> None:
    (tmp_path / "chair.glb").write_bytes(b"glTF")
    assert "read_object(data, name='chair.glb')" in refusal(tmp_path / "chair.glb")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"], ids=repr)
def test_lines_may_end_in_any_way_and_are_counted_with_the_empty_ones(end: str) -> None:
    obj = object_from_files(with_files(thing__obj=MESH.replace("\n", end).encode()))
    np.testing.assert_array_equal(obj.parts[0].vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(ObjectError, match="line 70004: 'f 9'"):
        parse_obj(f"v 0 0 0{end}" + end * 70_000 + f"v 1 0 0{end}# nothing{end}f 9{end}", "thing.obj")


def test_empty_lines_take_no_more_memory_than_text_and_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "\n" * 2**23
    tracemalloc.start()
    with pytest.raises(ObjectError, match="no faces"):
        parse_obj(text, "bomb.obj")
    assert tracemalloc.get_traced_memory()[1] < len(text)
    tracemalloc.stop()
    monkeypatch.setattr("trompe_shared.wavefront.MAX_LINES", 100)
    with pytest.raises(ObjectError, match=r"'thing\.obj' has more than 100 lines; simplify"):
        parse_obj("#\n" * 101, "thing.obj")


@pytest.mark.parametrize("side", [8193, 12_000, 30_000, 0])
def test_an_image_that_is_too_large_or_empty_is_refused_undecoded(side: int) -> None:
    message = refusal(with_files(paint__png=large_png(side, side)))
    assert "paint.png" in message
    assert ("8192" in message) == (side > 0)


def test_names_in_utf_8_are_read_whether_the_zip_says_so_or_not() -> None:
    """macOS does not; others write code page 437."""
    names = {b"caf\xc3\xa9.png": "caf\xe9.png", b"caf\x82.png": "caf\xe9.png"}
    for raw, name in names.items():
        data = zipped({"x" * len(raw): b"picture"}).replace(b"x" * len(raw), raw)
        assert unpack(data) == {name: b"picture"}
    assert unpack(zipped({"\u6728.png": b"wood"})) == {"\u6728.png": b"wood"}


ARCHIVE = zipped(FILES)


@given(place=st.integers(0, len(ARCHIVE) - 1), value=st.integers(0, 255))
@settings(max_examples=400)
def test_a_texture_or_archive_with_any_byte_changed_is_read_or_refused(place: int, value: int) -> None:
    texture, archive = bytearray(FILES["paint.png"]), bytearray(ARCHIVE)
    texture[place % len(texture)] = archive[place] = value
    try:
        assert decode_rgb(bytes(texture), "paint.png").shape[2] == 3
    except ObjectError as error:
        assert "paint.png" in str(error)  # noqa: PT017
    try:
        assert load_object(bytes(archive)).parts
    except ObjectError as error:
        assert str(error)  # noqa: PT017
