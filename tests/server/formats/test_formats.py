"""OBJ, SAILenv, FBX, PLY and STL: what is missing is made, what is there comes back as it was."""

import os
import re
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.small_models import corners, painted, refusal, same_paint, with_picture_inside
from trompe_server.formats import import_file, read_object, repaint_file, repaint_limited, write_glb
from trompe_server.formats.fbx import unit
from trompe_server.formats.fbx_tree import MAGIC, Node, Tree, parse_tree
from trompe_server.formats.pictures import cutout_alpha, encode_srgb, linear_rgb, tinted
from trompe_server.formats.unwrap import unwrap
from trompe_server.renderers import SailenvTarget
from trompe_shared.errors import ObjectError
from trompe_shared.geometry import Camera, View
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import Object3D, decode_alpha, decode_rgb, encode_png, load_object, unpack
from trompe_shared.wavefront import Part, obj_text, parse_obj

PICTURE = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
OBJ = (
    "mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl red\nf 1/1 2/2 3/3 4/4\n"
)
BARE = OBJ.replace("f 1/1 2/2 3/3 4/4", "f 1 2 3 4")
"""Without texture coordinates."""
MTL = "# by hand\nnewmtl red\nKd 0.5 0 0\nNs 12\n\nnewmtl other\nKd 0 0 1\n"
VIEWS = [View(Camera(3.0, azimuth, 20.0)) for azimuth in (-40.0, 10.0, 150.0)]
needs_assimp = pytest.mark.skipif(shutil.which("assimp") is None, reason="assimp-utils is not installed")


def comes_back(data: bytes, name: str) -> tuple[Object3D, bytes]:
    """The object and the repainted file of an upload, of which it is checked that it holds mesh and paint."""
    obj = read_object(data, name=name).obj
    new = painted(obj)
    exported = repaint_file(data, new, name=name)
    again = read_object(exported.data, name=f"again{exported.ending}").obj
    same_paint(again, new)
    assert repaint_file(data, obj, name=name).data == data
    return obj, exported.data


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=1)


def test_equal_copies_of_a_picture_are_one_and_both_are_repainted() -> None:
    files = {"m.obj": OBJ.encode(), "t.mtl": b"newmtl red\nmap_Kd tex/a.png", "tex/a.png": encode_png(PICTURE)}
    out = unpack(comes_back(pack_zip(files | {"old/a.png": files["tex/a.png"]}), "m.zip")[1])
    assert out["tex/a.png"] == out["old/a.png"] != files["tex/a.png"]
    others = {"b.png": b"1", "c/b.png": b"1", "d/b.png": b"2"}
    with pytest.raises(ObjectError, match=r"'b\.png' and 'd/b\.png' have the same name"):
        read_object(pack_zip(files | others), name="m.zip")


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"m.obj": OBJ, "t.mtl": "newmtl red\nmap_Kd a.<UDIM>.png"}, "bake them to one picture"),
        ({"m.obj": OBJ, "t.mtl": "newmtl red\nmap_Kd \u8272.png", "a.png": ""}, "save the material file in UTF-8"),
        ({"m.obj": re.sub("v (.) ", r"v 5000\g<1> ", OBJ), "t.mtl": MTL}, "Move it to the origin"),
        ({"source/m.zip": "", "readme.txt": ""}, "unpack 'source/m.zip' and send that model"),
    ],
    ids=["UDIM", "code page", "far away", "zip in a zip"],
)
def test_a_refusal_says_what_to_do(files: dict[str, str], words: str) -> None:
    with pytest.raises(ObjectError, match=re.escape(words)):
        read_object(pack_zip({name: text.encode() for name, text in files.items()}), name="m.zip")


# SAILenv and OBJ


def test_a_sailenv_zip_comes_back_with_other_albedos_and_nothing_else(mug: Object3D) -> None:
    data = mug.to_zip()
    assert read_object(data, name="mug.zip").format == "sailenv"
    _, out = comes_back(data, "mug.zip")
    before, after = unpack(data), unpack(out)
    assert {name for name in before if before[name] != after[name]} == set(mug.textures)


def test_pictures_in_other_capitals_are_found_where_only_one_is_meant() -> None:
    files = {"t.obj": OBJ.encode(), "t.mtl": b"newmtl red\nmap_Kd Maps\\Red.PNG\n", "red.png": encode_png(PICTURE)}
    obj = read_object(pack_zip(files), name="t.zip").obj
    assert (obj.textures["red.png"] == PICTURE).all()

    out = unpack(repaint_file(pack_zip(files), painted(obj), name="t.zip").data)
    assert out["t.mtl"] == b"newmtl red\nmap_Kd Maps\\red.png\n"
    assert (decode_rgb(out["red.png"], "red.png") == painted(obj).textures["red.png"]).all()

    assert "Red.PNG" in refusal(pack_zip(files | {"RED.png": encode_png(PICTURE)}), "t.zip")


@pytest.mark.parametrize(
    ("name", "mtl"),
    [
        pytest.param("e\u0301.png", "\xe9.png".encode(), id="split in the zip"),
        pytest.param("e\u0301.png", "\xe9.png".encode("latin-1"), id="Latin-1 in the MTL, which has no split ones"),
        pytest.param("\xe9.png", "e\u0301.png".encode(), id="split in the MTL"),
    ],
)
def test_pictures_with_accents_are_found_however_they_are_coded(name: str, mtl: bytes) -> None:
    files = {"t.obj": OBJ.encode(), "t.mtl": b"newmtl red\nmap_Kd %s\n" % mtl, name: encode_png(PICTURE)}
    assert (comes_back(pack_zip(files), "t.zip")[0].textures[name] == PICTURE).all()


def test_faces_without_a_material_are_grey_beside_others() -> None:
    for line in ("", "usemtl \n"):
        mesh = OBJ.replace("usemtl red\n", f"{line}f 1/1 2/2 3/3\nusemtl red\n")
        files = {"t.obj": mesh.encode(), "t.mtl": b"newmtl red\nmap_Kd red.png\n", "red.png": encode_png(PICTURE)}
        obj, out = comes_back(pack_zip(files), "t.zip")
        assert obj.textures["default_albedo.png"][0, 0].tolist() == [204] * 3
        assert b"usemtl default\n" in unpack(out)["t.obj"]
        assert b"newmtl default\n" in unpack(out)["t.mtl"]
    nameless = pack_zip(files | {"t.obj": OBJ.replace("usemtl red\n", "").encode()})
    assert "names no material (usemtl), though the .mtl defines ['red']" in refusal(nameless, "t.zip")
    plain = {"t.obj": OBJ.replace("usemtl red\n", "").encode(), "t.mtl": b"# no material\n"}
    assert comes_back(pack_zip(plain), "t.zip")[0].textures["default_albedo.png"][0, 0].tolist() == [204] * 3


@pytest.mark.parametrize("path", ["/home/me/src/red.png", "C:\\src\\red.png", "\\\\host\\red.png"])
def test_paint_is_found_where_the_mtl_names_the_picture_of_another_machine(path: str) -> None:
    picture = encode_png(PICTURE)
    mtl = f"newmtl red\r\nKd 1 1 1\r\nmap_Kd {path}\r\nmap_Ks /home/me/other.png\r\n"
    files = {"t.obj": OBJ.encode(), "t.mtl": mtl.encode(), "src/red.png": picture}
    data = pack_zip(files)
    obj = read_object(data, name="t.zip").obj
    assert unpack(repaint_file(data, obj, name="t.zip").data) == files
    out = unpack(repaint_file(data, obj.with_textures({"red.png": 255 - obj.textures["red.png"]}), name="t.zip").data)
    assert out["src/red.png"] != picture
    assert out["t.mtl"].decode() == mtl.replace(path, "src/red.png")


def test_capitals_change_in_whole_names_alone_and_an_mtl_keeps_its_encoding() -> None:
    mtl = "newmtl red\nmap_Kd \xe9\\a.png\nnewmtl other\nmap_Kd data.png\nmap_d my a.png\n".encode("latin-1")
    pictures = dict.fromkeys(("A.png", "data.png", "my a.png"), encode_png(PICTURE))
    files = {"t.obj": OBJ.encode(), "t.mtl": mtl, "table.mtl": b"newmtl red\nmap_Kd DATA.PNG", **pictures}
    out = unpack(comes_back(pack_zip(files), "t.zip")[1])
    assert [name for name in files if files[name] != out[name]] == ["t.mtl", "A.png"]
    assert out["t.mtl"] == mtl.replace(b"\\a.png", b"\\A.png")


def test_two_files_of_one_name_are_named_unless_the_system_left_them() -> None:
    litter = dict.fromkeys(("a/.DS_Store", "b/.DS_Store", "._t.obj", "a/Thumbs.db", "b/desktop.ini"), b"?")
    files = {"t.obj": OBJ.encode(), "t.mtl": MTL.encode(), **litter}
    assert litter.items() <= unpack(comes_back(pack_zip(files), "t.zip")[1]).items()
    notes = {"a/x.txt": b"1", "b/x.txt": b"2"}
    assert notes.items() <= unpack(comes_back(pack_zip(files | notes), "t.zip")[1]).items()
    assert "'a/x.png' and 'b/x.png'" in refusal(pack_zip(files | {"a/x.png": b"1", "b/x.png": b"2"}), "t.zip")


def test_an_obj_with_textures_in_a_folder_of_their_own_keeps_its_folders() -> None:
    files = {"t.obj": OBJ.encode(), "t.mtl": b"newmtl red\nmap_Kd maps/red.png\n", "maps/red.png": encode_png(PICTURE)}
    _, out = comes_back(pack_zip(files), "t.zip")
    after = unpack(out)
    assert [name for name in files if files[name] != after[name]] == ["maps/red.png"]


def test_a_colour_becomes_a_texture_and_the_obj_stays() -> None:
    files = {"t.obj": OBJ.encode(), "t.mtl": MTL.encode()}
    obj, out = comes_back(pack_zip(files), "t.zip")
    after = unpack(out)
    assert after["t.obj"] == files["t.obj"]
    assert after["t.mtl"].decode() == MTL.replace("Kd 0.5 0 0", "map_Kd red_albedo.png\nKd 1 1 1")
    assert obj.textures["red_albedo.png"][0, 0].tolist() == [188, 0, 0]


def test_a_picture_that_no_material_names_is_refused() -> None:
    files = {"t.obj": OBJ.encode(), "t.png": encode_png(PICTURE)}
    assert "no .mtl beside 't.obj'" in refusal(pack_zip(files), "t.zip")


def test_a_byte_order_mark_costs_no_first_line() -> None:
    mesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nmtllib o.mtl\nusemtl m\nf 1 2 3\n".encode("utf-8-sig")
    files = {"o.obj": mesh, "o.mtl": "newmtl m\nKd 1 0 0\n".encode("utf-8-sig")}
    obj = read_object(pack_zip(files), name="o.zip").obj
    assert [len(part.vertices) for part in obj.parts] == [3]
    assert [texture[0, 0].tolist() for texture in obj.textures.values()] == [[255, 0, 0]]


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        pytest.param("-s 1.000 1.0 1 -o 0.0 0 0 -mm 0 1.0 -bm 2", "", id="the defaults"),
        pytest.param("-s 1..2 1", "", id="no number"),
        pytest.param("-s 2 2 1", "scales or moves", id="scaled"),
        pytest.param("-clamp on -o 0.25 0 0", "scales or moves", id="moved"),
        pytest.param("-mm 0.2 0.5", "changes the levels of", id="dimmed"),
    ],
)
def test_a_texture_that_the_mtl_changes_is_refused(options: str, wrong: str) -> None:
    mtl = f"newmtl red\nmap_Kd {options} red.png\n".encode()
    data = pack_zip({"t.obj": OBJ.encode(), "t.mtl": mtl, "red.png": encode_png(PICTURE)})
    if wrong:
        assert f"{wrong} the texture 'red.png' ({options} red.png)" in refusal(data, "t.zip")
    else:
        assert (next(iter(read_object(data, name="t.zip").obj.textures.values())) == PICTURE).all()


@pytest.mark.parametrize(("option", "refused"), [("-clamp on", True), ("-clamp off", False)])
def test_a_texture_that_does_not_repeat_is_refused_beyond_its_edges(option: str, refused: bool) -> None:
    files = {"t.mtl": f"newmtl red\nmap_Kd {option} red.png\n".encode(), "red.png": encode_png(PICTURE)}
    within, beyond = (pack_zip(files | {"t.obj": text.encode()}) for text in (OBJ, OBJ.replace("vt 1 1", "vt 1 1.5")))
    read_object(within, name="t.zip")
    if refused:
        assert "Material 'red' clamps its texture beyond the edges" in refusal(beyond, "t.zip")
    else:
        read_object(beyond, name="t.zip")


@pytest.mark.parametrize(
    ("lines", "opacity", "alpha"),
    [
        pytest.param("d 0.3", 0.3, None, id="d"),
        pytest.param("d -halo 0.3", 0.3, None, id="d with an option"),
        pytest.param("Tr 0.75", 0.25, None, id="Tr"),
        pytest.param("Tr 0.75\nd 0.5", 0.5, None, id="d counts more than Tr"),
        pytest.param("d 1.0", None, None, id="opaque"),
        pytest.param("Tr 1.0", None, None, id="opaque, as MeshLab writes it"),
        pytest.param("d 0", None, None, id="opaque, by a slip of the program"),
        pytest.param("map_d mask.png", 1.0, 100, id="a grey picture"),
        pytest.param("d 0.5\nmap_d clear.png", 0.5, 80, id="the alpha of a picture, and d"),
        pytest.param("map_d red.png", None, None, id="the texture itself, without alpha"),
        pytest.param("map_d elsewhere.png", None, None, id="a picture that is not there"),
    ],
)
def test_an_mtl_says_how_transparent_its_materials_are(lines: str, opacity: float | None, alpha: int | None) -> None:
    clear = np.dstack([PICTURE, np.full((8, 8), 80, np.uint8)])
    files = {
        "t.obj": OBJ.encode(),
        "t.mtl": f"newmtl red\nmap_Kd red.png\n{lines}\n".encode(),
        "red.png": encode_png(PICTURE),
        "mask.png": encode_png(np.full((4, 4, 3), 100, np.uint8)),
        "clear.png": encode_png(clear),
    }
    obj, out = comes_back(pack_zip(files), "t.zip")
    assert obj.materials["red"].opacity == opacity
    found = decode_alpha(obj.files["red.png"], "red.png")
    assert found is None if alpha is None else set(np.unique(found)) == {alpha}  # type: ignore[arg-type]
    after = unpack(out)
    assert [name for name in files if files[name] != after[name]] == ["red.png"]
    assert decode_alpha(after["red.png"], "red.png") is None


def test_one_texture_with_two_opacity_maps_is_refused_with_a_remedy() -> None:
    mtl = "".join(f"newmtl {k}\nmap_Kd red.png\nmap_d {k}.png\n" for k in ("red", "other"))
    pictures = dict.fromkeys(("red.png", "other.png"), encode_png(PICTURE))
    files = {"t.obj": OBJ.encode(), "t.mtl": mtl.encode(), **pictures}
    assert "under a name for each" in refusal(pack_zip(files), "t.zip")
    wrong = files | {"t.mtl": b"newmtl red\nmap_Kd red.png\nd half\n"}
    assert "expected 0 to 1" in refusal(pack_zip(wrong), "t.zip")


@pytest.mark.parametrize("mesh", [BARE, re.sub("vt . .", "vt 0 0", OBJ)], ids=["none", "all in one point"])
def test_a_mesh_without_texture_coordinates_is_unwrapped_and_written_anew(mesh: str) -> None:
    obj, out = comes_back(pack_zip({"t.obj": mesh.encode(), "t.mtl": MTL.encode(), "notes.txt": b"kept"}), "t.zip")
    assert unpack(out)["notes.txt"] == b"kept"
    (part,) = obj.parts
    assert part.uvs.min() >= 0
    assert part.uvs.max() <= 1
    assert np.ptp(part.uvs, axis=0).min() > 0.2


def test_a_mesh_written_anew_keeps_its_encoding_and_names_all_its_mtls() -> None:
    mesh = "mtllib Mats/A.mtl my b.mtl\n" + BARE.replace("usemtl red", "usemtl r\xe9d")
    files = {"t.obj": mesh.encode("latin-1"), "Mats/a.mtl": "newmtl r\xe9d\n".encode("latin-1"), "my b.mtl": b""}
    _, out = comes_back(pack_zip(files | {"t.mtl": b""}), "t.zip")
    written = unpack(out)["t.obj"].decode("latin-1")
    assert written.startswith("mtllib Mats/a.mtl\nmtllib my b.mtl\nmtllib t.mtl\nusemtl r\xe9d\n")


def test_a_bare_obj_is_grey_and_comes_back_with_its_texture() -> None:
    obj, out = comes_back(OBJ.replace("mtllib t.mtl\n", "").encode(), "t.obj")
    assert set(np.unique(next(iter(obj.textures.values())))) == {204}
    assert sorted(unpack(out)) == ["red_albedo.png", "t.mtl", "t.obj"]
    assert "names the materials file 't.mtl', which did not come with it" in refusal(OBJ.encode(), "t.obj")


@pytest.mark.parametrize("scale", [1, 255])
def test_colours_of_an_objs_vertices_are_baked(scale: int) -> None:
    colours = np.round(scale * np.abs(ball().vertices), 6).tolist()
    points = zip(ball().vertices.tolist(), colours, strict=True)
    lines = [f"v {x:g} {y:g} {z:g} {r:g} {g:g} {b:g}" for (x, y, z), (r, g, b) in points]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in ball().faces]
    obj, _ = comes_back("\n".join(lines + faces).encode(), "ball.obj")
    (image,) = obj.textures.values()
    assert image.reshape(-1, 3).max(axis=0).min() > 230
    assert image.reshape(-1, 3).min(axis=0).max() < 25
    assert ((image > 25) & (image < 230)).mean() > 0.5


def test_a_texture_without_texture_coordinates_is_refused() -> None:
    files = {"t.obj": BARE.encode(), "t.mtl": b"newmtl red\nmap_Kd a.png\n", "a.png": encode_png(PICTURE)}
    assert "unwrap" in refusal(pack_zip(files), "t.zip")


def test_smaller_textures_come_back_at_their_size_and_other_maps_at_their_own(mug: Object3D) -> None:
    data = mug.to_zip()
    small = read_object(data, name="mug.zip", max_texture=64).obj
    assert {max(image.shape) for image in small.textures.values()} == {64}
    after = unpack(repaint_file(data, painted(small), name="mug.zip").data)
    before = unpack(data)
    assert {name for name in before if before[name] != after[name]} == set(mug.textures)
    assert {max(image.shape) for image in load_object(pack_zip(after)).textures.values()} == {64}
    assert repaint_file(data, small, name="mug.zip").data == data


# FBX


def fbx_of(materials: str, folder: Path, *, kind: str = "fbxa", mesh: str = OBJ) -> bytes:
    """An FBX of the square or another mesh, as assimp writes it: in text, or in binary (``fbx``)."""
    (folder / "t.obj").write_text(mesh)
    (folder / "t.mtl").write_text(materials)
    subprocess.run(["assimp", "export", "t.obj", "t.fbx", f"-f{kind}"], cwd=folder, check=True, capture_output=True)
    return (folder / "t.fbx").read_bytes()


@needs_assimp
@pytest.mark.parametrize("picture", ["red.png", "Red.PNG"])
def test_an_fbx_comes_back_as_it_was_with_another_texture_file(picture: str, tmp_path: Path) -> None:
    files = {"t.fbx": fbx_of(f"newmtl red\nmap_Kd {picture}\nd 0.5\n", tmp_path), "red.png": encode_png(PICTURE)}
    obj, out = comes_back(pack_zip(files), "t.zip")
    assert obj.materials["red"].opacity == 0.5
    assert [name for name, data in unpack(out).items() if files[name] != data] == ["red.png"]
    np.testing.assert_allclose(np.ptp(corners(obj).reshape(-1, 3), axis=0), [unit(files["t.fbx"])] * 2 + [0], rtol=1e-6)
    assert picture in refusal(files["t.fbx"], "t.fbx")


@needs_assimp
@pytest.mark.parametrize("beside", [None, "red.png", "Red.PNG"])
def test_a_picture_inside_an_fbx_is_painted_there_and_beside(beside: str | None, tmp_path: Path) -> None:
    plain = fbx_of("newmtl red\nmap_Kd red.png\n", tmp_path, kind="fbx")
    inside = with_picture_inside(parse_tree(plain), encode_png(PICTURE))
    files = {"t.fbx": inside} | ({beside: encode_png(255 - PICTURE)} if beside else {})
    obj, out = comes_back(pack_zip(files), "t.zip")
    assert (obj.textures["red.png"] == PICTURE).all()
    after = unpack(out)
    new = painted(obj).textures["red.png"]
    for data in (*parse_tree(after["t.fbx"]).pictures().values(), *(after[name] for name in files if name != "t.fbx")):
        assert (decode_rgb(data, "red.png") == new).all()


@needs_assimp
@pytest.mark.parametrize("kind", ["fbxa", "fbx"])
def test_an_fbx_stands_upright_whatever_its_axes(kind: str, tmp_path: Path) -> None:
    data = fbx_of("newmtl red\n", tmp_path, kind=kind)
    data = data if kind == "fbxa" else parse_tree(data).to_bytes()  # assimp does not read what it wrote

    def turned(axes: dict[str, int]) -> NDArray[np.float32]:
        changed = data
        for name, value in axes.items():
            head = rb'"%s"(?:[^,]*,){4}|\0%s(?:S.\0\0\0\w*){3}I' % (name.encode(), name.encode())
            new = str(value).encode() if kind == "fbxa" else struct.pack("<i", value)
            changed = re.sub(rb"(?s)(%s)(?:-?\d|.{4})" % head, rb"\g<1>" + new, changed)
        return corners(read_object(changed, name="t.fbx").obj)

    x, y, z = np.moveaxis(turned({}), -1, 0)
    lying = turned({"UpAxis": 2, "FrontAxis": 1, "FrontAxisSign": -1})
    np.testing.assert_array_equal(lying, np.stack([x, z, -y], axis=-1))
    mirrored = turned({"CoordAxisSign": -1})[:, ::-1]  # its triangles face outwards, too
    np.testing.assert_array_equal(mirrored, np.stack([-x, y, z], axis=-1))
    with pytest.raises(ObjectError, match="not three directions"):
        turned({"UpAxis": 2})


@needs_assimp
@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1), (-1, -1, 1), (-1, -1, -1), (2, -0.5, 1)])
def test_faces_of_a_mirrored_node_of_an_fbx_face_where_their_normals_do(
    scale: tuple[float, ...], tmp_path: Path
) -> None:
    upright = OBJ.replace("usemtl", "vn 0 0 1\nusemtl").replace("f 1/1 2/2 3/3 4/4", "f 1/1/1 2/2/1 3/3/1 4/4/1")
    data = fbx_of("newmtl red\n", tmp_path, mesh=upright)
    node = rb'("Mesh" \{\s+Version: 232\s+Properties70:  \{)'
    scaling = b'P: "Lcl Scaling", "Lcl Scaling", "", "A", %g, %g, %g' % scale
    data, count = re.subn(node, rb"\g<1>\n" + scaling, data)
    (part,) = read_object(data, name="t.fbx").obj.parts
    first, second, third = np.moveaxis(part.vertices[part.faces], 1, 0)
    across = np.cross(second - first, third - first)
    assert count == 1
    assert np.ptp(part.vertices[:, 0]) == pytest.approx(abs(scale[0]) * unit(data))
    assert (across[:, 2] * np.sign(scale[2]) > 0).all()
    assert (np.einsum("fk,fck->fc", across, part.normals[part.faces]) > 0).all()


@needs_assimp
@pytest.mark.parametrize("kind", ["fbxa", "fbx"])
@pytest.mark.parametrize("name", ["Maya|baseColor", "3dsMax|main|base_color_map", "Maya|TEX_color_map|file"])
def test_the_base_colour_of_a_physical_material_in_an_fbx_is_read(name: str, kind: str, tmp_path: Path) -> None:
    data = fbx_of("newmtl red\nmap_Kd red.png\n", tmp_path, kind=kind)
    if kind == "fbx":
        link = re.compile(rb"S\x0c\0\0\0DiffuseColor\Z")
        data = parse_tree(data).with_links(link, name.encode()).to_bytes()
    else:
        data = re.sub(rb'("OP".*)"DiffuseColor"', lambda found: found[1] + b'"%s"' % name.encode(), data)
    assert name.encode() in data
    obj, _ = comes_back(pack_zip({"t.fbx": data, "red.png": encode_png(PICTURE)}), "t.zip")
    assert (obj.textures["red.png"] == PICTURE).all()


@needs_assimp
def test_two_materials_of_one_name_in_an_fbx_are_refused(tmp_path: Path) -> None:
    data = fbx_of(MTL, tmp_path, mesh=f"{OBJ}usemtl other\nf 1/1 2/2 3/3\n")
    assert read_object(data, name="t.fbx").obj.materials.keys() == {"red", "other"}
    alike = data.replace(b"Material::other", b"Material::red")
    assert "two materials called 'red'; rename one" in refusal(alike, "t.fbx")


def test_a_texture_that_an_fbx_scales_or_moves_is_refused() -> None:
    text = b'; FBX 7.3.0\nP: "Translation", "Vector", "", "A",0,0,0\nP: "Scaling", "Vector", "", "A",2,1,1\n'
    assert "scales, turns or moves a texture (Scaling (2.0, 1.0, 1.0))" in refusal(text, "t.fbx")


@pytest.mark.parametrize("kind", ["fbxa", "fbx"])
def test_shape_keys_in_use_in_an_fbx_are_refused(kind: str) -> None:
    def file(share: float) -> bytes:
        if kind == "fbxa":
            return b"; FBX 7.3.0\nDeformPercent: %d\n" % share
        return Tree(7400, (Node(b"DeformPercent", 1, b"D" + struct.pack("<d", share), None),), b"").to_bytes()

    assert "shape keys in use" not in refusal(file(0), "t.fbx")
    assert "shape keys in use (blend shapes); apply them" in refusal(file(40), "t.fbx")


@needs_assimp
def test_a_texture_of_an_fbx_that_does_not_repeat_beyond_its_edges_is_refused(tmp_path: Path) -> None:
    clamped = b'\n; P: "WrapModeU", "enum", "", "",1\n'
    beyond = OBJ.replace("vt 1 1", "vt 3 1")
    assert beyond != OBJ
    inside, outside = (fbx_of("newmtl red\n", tmp_path, mesh=mesh) for mesh in (OBJ, beyond))
    for sound in (inside, outside, inside + clamped):
        assert read_object(sound, name="t.fbx").obj.parts
    assert "does not repeat" in refusal(outside + clamped, "t.fbx")


def test_two_pictures_of_one_name_inside_an_fbx_are_refused() -> None:
    def video(picture: bytes) -> Node:
        name = Node(b"RelativeFilename", 1, b"S\0\0\0\0C:\\a\\x.png", None)
        return Node(b"Video", 0, b"", (name, Node(b"Content", 1, b"R\0\0\0\0" + picture, None)))

    def pictures(*contents: bytes) -> dict[str, bytes]:
        return Tree(7400, (Node(b"Objects", 0, b"", tuple(map(video, contents))),), b"").pictures()

    assert pictures(b"one", b"one") == {"x.png": b"one"}
    with pytest.raises(ObjectError, match=r"two pictures called 'x\.png'; rename one"):
        pictures(b"one", b"two")


@needs_assimp
def test_paint_that_an_fbx_has_no_file_for_is_refused(tmp_path: Path) -> None:
    data = fbx_of(MTL, tmp_path)
    obj = read_object(data, name="t.fbx").obj
    with pytest.raises(ObjectError, match="take the GLB"):
        repaint_file(data, painted(obj), name="t.fbx")
    assert corners(read_object(write_glb(painted(obj)), name="t.glb").obj).shape == (2, 3, 3)


def test_without_assimp_an_fbx_is_refused_with_the_name_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert "assimp-utils" in refusal(b"; FBX 7.3.0 project file\n", "t.fbx")


def test_an_fbx_says_what_its_unit_is() -> None:
    binary = b"S\x0f\0\0\0UnitScaleFactorS\x06\0\0\0doubleS\x06\0\0\0NumberS\0\0\0\0D"
    original = binary.replace(b"\x0f\0\0\0Unit", b"\x17\0\0\0OriginalUnit")
    assert unit(original + np.float64(7).tobytes() + binary + np.float64(2.54).tobytes()) == pytest.approx(0.0254)
    assert unit(b'P: "UnitScaleFactor", "double", "Number", "",100\n') == pytest.approx(1.0)
    assert unit(b"nothing of the kind") == pytest.approx(0.01)


# PLY and STL


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_ply_comes_back_with_a_texture_it_names(encoding: str) -> None:
    obj, out = comes_back(ball().export(file_type="ply", encoding=encoding), "ball.ply")
    after = unpack(out)
    assert sorted(after) == ["ball.ply", "ball_albedo.png"]
    assert len(corners(obj)) == len(ball().faces)
    _, again = comes_back(out, "ball.zip")  # and this one keeps its mesh byte for byte
    assert unpack(again)["ball.ply"] == after["ball.ply"]


@pytest.mark.parametrize("files", [{}, {"foo.png": encode_png(PICTURE)}], ids=["missing", "there"])
def test_a_ply_without_texture_coordinates_leaves_the_texture_that_it_names(files: dict[str, bytes]) -> None:
    mesh = ply(SQUARE, "4 0 1 2 3", texture="foo.png")
    _, out = comes_back(pack_zip({"t.ply": mesh, **files}), "t.zip")
    after = unpack(out)
    assert after.keys() == {"t.ply", "t_albedo.png", *files}
    assert files.items() <= after.items()


def test_a_ply_with_two_textures_is_refused() -> None:
    mesh = ply("0 0 0 0 0, 1 0 0 1 0, 1 1 0 1 1", "3 0 1 2", columns="s t", texture="a.png\ncomment TextureFile b.png")
    assert "2 textures, a.png, b.png; one is supported" in refusal(mesh, "t.ply")


def test_a_ply_that_names_none_of_the_pictures_beside_it_is_refused() -> None:
    mesh = ply("0 0 0 0 0, 1 0 0 1 0, 1 1 0 1 1", "3 0 1 2", columns="s t")
    for each in (mesh, ply(SQUARE, "3 0 1 2 6 0 0 1 0 1 1, 3 0 2 3 6 0 0 1 1 0 1", corners="texcoord")):
        assert "does not say what ['t.png'] is for" in refusal(pack_zip({"t.ply": each, "t.png": b""}), "t.zip")
    assert (read_object(mesh, name="t.ply").obj.textures["t_albedo.png"] == 204).all()
    named = mesh.replace(b"comment", b"comment texturefile t.png")
    obj, _ = comes_back(pack_zip({"t.ply": named, "t.png": encode_png(PICTURE)}), "t.zip")
    assert (obj.textures["t.png"] == PICTURE).all()


def test_a_ply_with_colours_of_faces_alone_is_refused() -> None:
    mesh = ply("0 0 0, 1 0 0, 1 1 0", "3 0 1 2 9 9 9")
    rgb = b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue"))
    coloured = mesh.replace(b"vertex_indices\n", b"vertex_indices\n" + rgb)
    assert "colours of faces" in refusal(coloured, "t.ply")
    both = re.sub(rb"\n(\d \d 0)", rb"\n\1 7 7 7", coloured).replace(b"element face", rgb + b"element face")
    assert (read_object(both, name="t.ply").obj.textures["t_albedo.png"] == 7).all()


@pytest.mark.parametrize(
    ("old", "new"),
    [pytest.param(b"\n", end, id=repr(end)) for end in (b"\r", b"\r\n")]
    + [pytest.param(b"end_header\n", b"end_header\n\n", id="an empty line")],
)
def test_lines_of_a_ply_may_end_in_any_way(old: bytes, new: bytes) -> None:
    obj, _ = comes_back(ply(SQUARE, "4 0 1 2 3").replace(old, new), "t.ply")
    assert corners(obj).shape == (2, 3, 3)


def test_colours_of_a_plys_vertices_are_baked() -> None:
    mesh = ball()
    mesh.visual.vertex_colors = (255 * np.abs(mesh.vertices)).astype(np.uint8)
    obj, _ = comes_back(mesh.export(file_type="ply"), "ball.ply")
    (image,) = obj.textures.values()
    assert image.reshape(-1, 3).max(axis=0).min() > 230


def ply(vertices: str, faces: str, *, columns: str = "", corners: str = "", texture: str = "") -> bytes:
    """A PLY in text; ``columns`` are those after x, y, z, ``corners`` a list of each face beside its vertices."""
    named = "".join(f"property float {name}\n" for name in ("x", "y", "z", *columns.split()))
    lists = "property list uchar int vertex_indices\n" + (f"property list uchar float {corners}\n" if corners else "")
    return (
        f"ply\nformat ascii 1.0\n{f'comment TextureFile {texture}' if texture else 'comment'}\n"
        f"element vertex {vertices.count(',') + 1}\n{named}element face {faces.count(',') + 1}\n{lists}end_header\n"
        + f"{vertices}, {faces}\n".replace(", ", "\n")
    ).encode()


SQUARE = "0 0 0, 1 0 0, 1 1 0, 0 1 0"


def binary(text: bytes, order: str) -> bytes:
    """A PLY of ``ply`` in binary, with an element and bytes after its faces."""
    header, _, rows = text.partition(b"end_header\n")
    name = {"<": b"binary_little_endian", ">": b"binary_big_endian"}[order]
    body = b""
    for row in rows.decode().splitlines():
        numbers = [float(word) for word in row.split()]
        if len(numbers) == 3:
            body += struct.pack(f"{order}3f", *numbers)
        else:
            body += struct.pack(f"{order}B{len(numbers) - 1}i", *map(int, numbers))
    edges = b"element edge 1\nproperty int vertex1\nproperty uchar kind\nend_header\n"
    return header.replace(b"ascii", name) + edges + body + bytes(5) + b"more"


@pytest.mark.parametrize("order", ["", "<", ">"], ids=["text", "little", "big"])
@pytest.mark.parametrize(
    ("faces", "count"),
    [
        pytest.param("4 0 1 2 3, 3 1 4 2", 3, id="a square and a triangle"),
        pytest.param("4 0 1 2 3, 3 0 1 2, 5 0 1 4 2 3", 6, id="on average squares"),
        pytest.param("5 0 1 4 2 3", 3, id="a pentagon"),
        pytest.param("4 0 1 2 3, 4 1 4 2 3", 4, id="squares"),
        pytest.param("4 1 2 3 5, 4 0 1 2 3", 4, id="concave"),
        pytest.param("4 1 2 3 5, 3 0 1 3", 3, id="concave, and a triangle"),
    ],
)
def test_polygons_of_any_size_are_split_in_a_ply(faces: str, count: int, order: str) -> None:
    text = ply(f"{SQUARE}, 2 0 0, 0.8 0.8 0", faces)
    found = corners(read_object(binary(text, order) if order else text + b"more\n", name="t.ply").obj)
    assert len(found) == count
    area = np.linalg.norm(np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0]), axis=1).sum() / 2
    polygons = [[int(word) for word in face.split()[1:]] for face in faces.split(", ")]
    points = np.array([*(row.split() for row in SQUARE.split(", ")), (2, 0, 0), (0.8, 0.8, 0)], float)
    rings = [points[polygon] for polygon in polygons]
    assert area == pytest.approx(sum(abs(np.cross(ring, np.roll(ring, -1, 0)).sum(0)[2]) / 2 for ring in rings))


@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(
            ply("0 0 0 0 0, 1 0 0 1 0, 1 1 0 1 1, 0 1 0 0 1", "4 0 1 2 3", columns="s t", texture="my red.png"),
            id="of vertices",
        ),
        pytest.param(
            ply(SQUARE, "3 0 1 2 6 0 0 1 0 1 1, 3 0 2 3 6 0 0 1 1 0 1", corners="texcoord", texture="my red.png"),
            id="of corners, as MeshLab writes them",
        ),
    ],
)
def test_a_texture_that_a_ply_names_is_the_only_thing_that_changes(mesh: bytes) -> None:
    files = {"t.ply": mesh, "my red.png": encode_png(PICTURE)}
    obj, out = comes_back(pack_zip(files), "t.zip")
    assert [name for name, data in unpack(out).items() if files[name] != data] == ["my red.png"]
    (part,) = obj.parts
    np.testing.assert_array_equal(part.uvs, part.vertices[:, :2])
    assert part.normals.tolist() == [[0, 0, 1]] * 4


def test_normals_of_a_ply_are_smooth_across_the_seams_of_its_texture() -> None:
    roof = "0 0 0, 0 0 1, 1 1 0, -1 1 0"
    faces = "3 0 1 2 6 0 0 1 0 1 1, 3 1 0 3 6 0 0.5 1 0.5 1 1"
    files = {"t.ply": ply(roof, faces, corners="texcoord", texture="a.png"), "a.png": encode_png(PICTURE)}
    (part,) = read_object(pack_zip(files), name="t.zip").obj.parts
    ridge = part.vertices[:, 1] == 0
    assert ridge.sum() == 4
    np.testing.assert_allclose(np.abs(part.normals[ridge]), np.tile([0, 1, 0], (4, 1)), atol=1e-6)


@pytest.mark.parametrize("columns", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"])
@pytest.mark.parametrize(
    ("scale", "kind"),
    [(1, "float"), (255, "float"), (255, "uchar"), (65535, "ushort"), (1, "double"), (1.0000001, "double")],
)
def test_colours_of_a_ply_are_those_of_its_numbers(scale: float, kind: str, columns: str) -> None:
    rows = ", ".join(f"{point} {scale} {scale * 3 // 5} 0" for point in SQUARE.split(", "))
    data = ply(rows, "4 0 1 2 3", columns=columns)
    for name in columns.encode().split():
        data = data.replace(b"float " + name, kind.encode() + b" " + name)
    (image,) = read_object(data, name="t.ply").obj.textures.values()
    assert np.unique(image.reshape(-1, 3), axis=0).tolist() == [[255, 153 if scale > 2 else 0, 0]]


@pytest.mark.parametrize("file_type", ["stl", "stl_ascii"])
def test_an_stl_is_read_in_a_grey_of_its_own_and_goes_out_as_glb(file_type: str) -> None:
    data = ball().export(file_type=file_type)
    data = data if isinstance(data, bytes) else data.encode()
    obj = read_object(data, name="ball.stl").obj
    np.testing.assert_allclose(np.sort(corners(obj).ravel()), np.sort(ball().triangles.ravel()), atol=1e-6)
    edges = np.diff(corners(obj), axis=1)
    facing = np.cross(edges[:, 0], edges[:, 1])
    assert (np.einsum("ij,ij->i", facing, corners(obj).mean(axis=1)) > 0).all()
    with pytest.raises(ObjectError, match="take the GLB"):
        repaint_file(data, painted(obj), name="ball.stl")
    assert (corners(read_object(write_glb(painted(obj)), name="t.glb").obj) == corners(obj)).all()


@pytest.mark.parametrize("packed", [False, True])
def test_an_stl_may_be_in_capitals_or_have_bytes_after_its_triangles(packed: bool) -> None:
    for data in (ball().export(file_type="stl") + b"\0\0", ball().export(file_type="stl_ascii").upper().encode()):
        upload, name = (pack_zip({"b.stl": data}), "b.zip") if packed else (data, "b.STL")
        assert len(corners(read_object(upload, name=name).obj)) == len(ball().faces)
    assert "no triangles" in refusal(b"nonsense", "b.stl")


def test_all_solids_of_an_stl_are_one_object() -> None:
    text = ball().export(file_type="stl_ascii").encode()
    assert len(corners(read_object(text + text, name="balls.stl").obj)) == 2 * len(ball().faces)


# What they have in common


def test_every_format_is_known_by_its_content() -> None:
    for name, ending in (("stl", "stl"), ("ply", "ply"), ("gltf", "glb")):
        data = ball().export(file_type=ending)
        assert read_object(data, name="upload").format == name
        assert read_object(pack_zip({f"x.{ending}": data}), name="u.zip").format == name


def test_unwrapping_the_same_mesh_twice_gives_the_same() -> None:
    first, second = (unwrap([(ball().vertices.astype(np.float32), ball().faces.astype(np.int32))]) for _ in range(2))
    assert first[1] == second[1]
    assert (first[0][0].uvs == second[0][0].uvs).all()
    assert (first[0][0].source[first[0][0].faces] == ball().faces).all()


def test_an_unwrapped_object_looks_the_same_in_its_own_format_and_as_glb(target: SailenvTarget) -> None:
    mesh = ball()
    mesh.visual.vertex_colors = (255 * np.abs(mesh.vertices)).astype(np.uint8)
    data = mesh.export(file_type="ply")
    new = painted(read_object(data, name="ball.ply").obj)
    images = target.render(new, VIEWS, size=(64, 64)).astype(int)
    for out, name in ((repaint_file(data, new, name="ball.ply").data, "b.zip"), (write_glb(new), "b.glb")):
        again = target.render(read_object(out, name=name).obj, VIEWS, size=(64, 64))
        assert np.abs(images - again).max() <= 1
    assert (images != 255).any()


@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=9, max_size=9, unique=True))
@settings(max_examples=50)
def test_every_number_of_a_part_survives_the_obj_it_is_written_to(numbers: list[float]) -> None:
    vertices = np.array(numbers, np.float32).reshape(3, 3)
    part = Part("m", vertices, np.eye(3, dtype=np.float32), vertices[:, :2].copy(), np.array([[2, 0, 1]], np.int32))
    (again,) = parse_obj(obj_text((part,)), "t.obj")
    assert (again.vertices[again.faces] == part.vertices[part.faces]).all()
    assert (again.uvs[again.faces] == part.uvs[part.faces]).all()


def test_a_texture_multiplied_by_one_is_itself_and_by_black_is_black() -> None:
    assert tinted(PICTURE, (1.0, 1.0, 1.0)) is PICTURE
    assert not tinted(PICTURE, (0.0, 0.0, 0.0)).any()
    assert (encode_srgb(linear_rgb(np.arange(256, dtype=np.uint8))) == np.arange(256)).all()


@given(st.integers(0, 255), st.floats(0.05, 1.0), st.floats(0.05, 1.0))
def test_alpha_is_cut_on_the_same_side_of_one_half_as_of_the_cutoff(alpha: int, factor: float, cutoff: float) -> None:
    if abs(alpha / 255 * factor - cutoff) < 0.005:
        return
    (mapped,) = cutout_alpha(np.array([alpha], np.uint8), factor=factor, cutoff=cutoff)
    assert (mapped / 255 >= 0.5) == (alpha / 255 * factor >= cutoff)


# In a process of its own


def test_a_file_is_read_and_repainted_in_another_process_as_in_this_one(mug: Object3D) -> None:
    data = mug.to_zip()
    converted = import_file(data, name="mug.zip")
    assert load_object(converted.archive).files == mug.files
    assert converted.facts["format"] == "sailenv"
    assert converted.facts["textures"] == {name: [*image.shape[:2]] for name, image in mug.textures.items()}
    assert converted.facts["radius"] == pytest.approx(mug.radius)
    new = painted(mug)
    assert repaint_limited(data, new, name="mug.zip") == repaint_file(data, new, name="mug.zip")


# The real objects


@pytest.fixture
def assets() -> Path:
    return Path(os.environ["TROMPE_ASSETS"])


@pytest.mark.assets
@needs_assimp
def test_the_fbx_of_the_cube_is_the_cube_that_was_published_as_obj(assets: Path, target: SailenvTarget) -> None:
    names = ("cube_of_power.fbx", "Cube_AlbedoTransparency.png")
    cube = read_object(pack_zip({name: (assets / "fbx" / name).read_bytes() for name in names}), name="cube.zip").obj
    published = load_object(assets / "fbx" / "cube_of_power.obj")
    assert cube.radius == pytest.approx(published.radius, rel=1e-6)
    images = [target.render(obj, VIEWS, size=(96, 96)).astype(int) for obj in (cube, published)]
    assert np.abs(images[0] - images[1]).max() <= 1


@pytest.mark.assets
@pytest.mark.parametrize("name", ["candle", "pot", "tennis_racket", "toilet_paper"])
def test_a_published_object_looks_the_same_as_glb(name: str, assets: Path, target: SailenvTarget) -> None:
    obj = load_object(assets / "objects" / name)
    views = [View(Camera(3 * obj.radius, azimuth, 20.0)) for azimuth in (0.0, 130.0)]
    again = read_object(write_glb(obj), name="t.glb").obj
    images = [target.render(each, views, size=(128, 128)).astype(int) for each in (obj, again)]
    assert np.abs(images[0] - images[1]).max() <= 1


@pytest.mark.assets
@needs_assimp
def test_a_picture_inside_an_fbx_is_painted_there(assets: Path) -> None:
    plain = (assets / "fbx" / "cube_of_power.fbx").read_bytes()
    picture = (assets / "fbx" / "Cube_AlbedoTransparency.png").read_bytes()
    tree = parse_tree(plain)
    assert tree.to_bytes() == plain
    data = with_picture_inside(tree, picture)
    assert parse_tree(data).pictures() == {"Cube_AlbedoTransparency.png": picture}
    _, out = comes_back(data, "cube.fbx")
    assert parse_tree(out).with_pictures({"Cube_AlbedoTransparency.png": None}).to_bytes() == plain


@pytest.mark.parametrize("cut", [30, 60, 200])
def test_a_binary_fbx_that_is_no_tree_is_refused(cut: int) -> None:
    head = MAGIC + (7400).to_bytes(4, "little") + bytes([cut, 0, 0, 0, 1, 0, 0, 0, 99, 0, 0, 0, 4])
    assert "FBX" in refusal(head + b"Node" + bytes(20), "t.fbx")
