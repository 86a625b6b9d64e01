"""Model files as a user names them."""

import json
from pathlib import Path

import pytest
from PIL import Image

from trompe_shared.local_files import PICTURE_SUFFIXES, is_split, model_file
from trompe_shared.object3d import IMAGE_FORMATS, unpack


def written(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def packed(path: Path) -> set[str]:
    _, content = model_file(path)
    assert isinstance(content, bytes)
    return set(unpack(content))


@pytest.mark.parametrize("suffix", [".png", ".tga", ".TIF", ".gif"])
def test_a_mesh_takes_the_files_that_it_names_along_and_no_others(tmp_path: Path, suffix: str) -> None:
    named = {"mug.obj": "mtllib mug.mtl\n", "mug.mtl": f"map_Kd -s 1 1 1 my paint{suffix}\n", f"my paint{suffix}": ""}
    written(tmp_path, named | dict.fromkeys(("notes.doc", "holiday.jpg", "secrets.json", "table.mtl"), ""))
    assert model_file(tmp_path / "mug.obj")[0] == "mug.zip"
    assert packed(tmp_path / "mug.obj") == named.keys()


TABLE = '{"m": {"albedo": "tex/a.png", "normal": null}}'
SPLIT = {
    "glTF": {"m.gltf": '{"buffers": [{"uri": "m.bin"}], "images": [{"uri": "my%20tex/a.png"}, {"uri": "data:,a"}, {}]}',
             "m.bin": "", "my tex/a.png": ""},
    "mtllib": {"m.obj": "mtllib mats\\\\a.mtl B b.mtl\n", "mats/a.mtl": "bump ../tex/a.png\nmap_Kd C:\\\\x\\\\a b.png",
               "b B.MTL": "", "tex/a.png": "", "a b.png": ""},
    "no mtllib": {"m.obj": "", "other.mtl": "map_Kd A.png\nmap_Ks none.png", "a.png": ""},
    "mat_def": {"m.obj": "", "m_mat_def.json": TABLE, "tex/a.png": ""},
    "nothing readable": {"m.gltf": "{"},
    "PLY": {"m.ply": "ply\ncomment TextureFile \u00dcbung.PNG\nend_header", "\u00dcbung.png": ""},
    "PLY with blanks": {"m.ply": "ply\ncomment TextureFile A b.png\nend_header", "a b.png": ""},
    "FBX": {"m.fbx": 'RelativeFilename: "C:\\x\\Skin.TGA", "beta-a.png"', "tex/skin.tga": "", "beta-a.png": ""},
}  # fmt: skip


@pytest.mark.parametrize("files", SPLIT.values(), ids=SPLIT)
def test_files_that_a_model_names_keep_their_folders(tmp_path: Path, files: dict[str, str]) -> None:
    written(tmp_path, files | {"unnamed/a.png": ""})
    assert packed(tmp_path) == files.keys()
    written(tmp_path, {"m_mat_def.jsn": "", "holiday.jpg": ""})
    assert packed(tmp_path / next(iter(files))) == files.keys()
    assert packed(tmp_path) == {*files, "m_mat_def.jsn", "holiday.jpg"}


@pytest.mark.parametrize("suffix", [".fbx", ".ply"])
def test_a_model_without_pictures_beside_it_is_sent_as_it_is(tmp_path: Path, suffix: str) -> None:
    written(tmp_path, {f"m{suffix}": "comment TextureFile banana.png", "a.png": "", "notes/banana.txt": ""})
    assert model_file(tmp_path / f"m{suffix}") == (f"m{suffix}", tmp_path / f"m{suffix}")
    assert not is_split(tmp_path / f"m{suffix}")
    assert not is_split(Path(f"stored{suffix}"))


def test_a_picture_of_another_machine_is_found_where_only_one_folder_has_it(tmp_path: Path) -> None:
    files = {"m.obj": "mtllib m.mtl", "m.mtl": "map_Kd C:\\work\\tex\\Base.png", "pictures/2k/base.png": ""}
    written(tmp_path, files)
    assert packed(tmp_path / "m.obj") == files.keys()
    written(tmp_path, {"old/base.png": ""})
    assert packed(tmp_path / "m.obj") == {"m.obj", "m.mtl"}, "which of the two?"


def test_a_model_below_the_folder_is_sent_with_the_pictures_of_all_folders(tmp_path: Path) -> None:
    files = {"source/m.obj": "mtllib m.mtl", "source/m.mtl": "map_Kd ../textures/a.png", "textures/a.png": ""}
    written(tmp_path / "download", files | dict.fromkeys(("notes.doc", "textures/._a.png", ".git/b.png"), ""))
    (tmp_path / "key.png").write_text("")
    (tmp_path / "download/textures/link.png").symlink_to(tmp_path / "key.png")
    assert packed(tmp_path / "download") == files.keys()


def test_no_file_outside_of_the_models_folder_is_packed(tmp_path: Path) -> None:
    uris = ["../key.png", str(tmp_path / "key.png"), "link.png", "linked/key.png", "own.png"]
    document = json.dumps({"images": [{"uri": uri} for uri in uris]})
    written(tmp_path, {"key.png": "", "m/m.gltf": document, "m/own.png": ""})
    (tmp_path / "m/link.png").symlink_to(tmp_path / "key.png")
    (tmp_path / "m/linked").symlink_to(tmp_path)
    assert packed(tmp_path / "m/m.gltf") == {"m.gltf", "own.png"}
    written(tmp_path, {"m/m.ply": "key.png link.png own.png"})
    assert packed(tmp_path / "m/m.ply") == {"m.ply", "own.png"}


def test_pictures_are_those_that_textures_may_be() -> None:
    assert {Image.registered_extensions()[suffix] for suffix in PICTURE_SUFFIXES} == set(IMAGE_FORMATS)
