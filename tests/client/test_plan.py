"""Files the user points at: what is sent for them."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.client.conftest import zipped
from trompe_client._plan import (
    Upload,
    background_source,
    classifier_source,
    classifier_upload,
    object_source,
    object_upload,
    plan_attack,
)
from trompe_shared.api import BackgroundInfo, ClassifierInfo
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.local_files import CLASSIFIER_SUFFIXES


def names(source: Path) -> list[str]:
    """Names in the archive that is sent."""
    return zipfile.ZipFile(io.BytesIO(zipped(source))).namelist()


def test_a_folder_or_its_obj_file_is_zipped_flat_sorted_and_without_other_files(mug_folder: Path) -> None:
    assert names(mug_folder) == ["a.png", "mug.obj", "mug_mat_def.json"]  # none that is hidden
    (mug_folder / "mug_mat_def.json").write_text('{"mug": {"albedo": "a.png"}}')
    (mug_folder / "other.obj").write_text("o other")
    (mug_folder / "notes.txt").write_text("mine")
    assert names(mug_folder / "mug.obj") == ["a.png", "mug.obj", "mug_mat_def.json"]


def test_the_same_folder_gives_the_same_bytes_whatever_its_dates(mug_folder: Path) -> None:
    before = zipped(str(mug_folder))
    for file in mug_folder.iterdir():
        file.write_bytes(file.read_bytes())
    assert zipped(mug_folder.rename(mug_folder.with_name("elsewhere"))) == before


@pytest.mark.parametrize("ending", ["glb", "FBX", "ply", "stl", "zip"])
def test_a_model_in_one_file_is_sent_as_it_is(mug_folder: Path, tmp_path: Path, ending: str) -> None:
    model = tmp_path / f"cup.{ending}"
    model.write_bytes(zipped(mug_folder) if ending == "zip" else b"any bytes: the server reads them")
    assert object_source(model) == object_source(str(model)) == Upload(model.name, model)


def test_a_gltf_file_takes_its_buffers_and_pictures_along(tmp_path: Path) -> None:
    for name in ("cup.gltf", "cup.bin", "paint.png", "notes.txt"):
        (tmp_path / name).write_text('{"buffers": [{"uri": "cup.bin"}], "images": [{"uri": "paint.png"}]}')
    assert names(tmp_path / "cup.gltf") == ["cup.bin", "cup.gltf", "paint.png"]
    assert "cup.gltf" in names(tmp_path)


def test_a_word_is_the_name_of_a_stored_object_even_where_a_folder_of_that_name_holds_no_mesh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mug").mkdir()
    assert object_source("mug") == "mug"


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("missing.zip", "There is no file"),
        ("missing/mug.obj", "There is no file"),
        (Path("wrong.zip"), "not a zip archive"),
        (Path(), r"holds no \.obj"),
        ("", "name is empty"),
    ],
)
def test_what_is_no_object_is_not_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str | Path, why: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wrong.zip").write_text("<html>")
    for read in (object_source, object_upload):
        with pytest.raises(ObjectError, match=why):
            read(source)


def test_the_class_names_nearest_to_the_classifier_win(tmp_path: Path) -> None:
    victim = tmp_path / "net.v2.pt2"
    victim.write_bytes(b"")
    assert classifier_upload(victim).form == {}
    for file, name in {"classes.json": "c", "imagenet_classes.json": "i", "net.v2.classes.json": "own"}.items():
        (tmp_path / file).write_text(json.dumps([name]), "utf-8-sig")  # as Windows writes it
        assert json.loads(classifier_upload(victim).form["classes"]) == [name]
    assert json.loads(classifier_upload(victim, classes=["given"]).form["classes"]) == ["given"]


@pytest.mark.parametrize("text", ['{"0": "mug"}', "[1, 2]", "mug"])
def test_class_names_that_are_no_list_of_strings_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "net.onnx").write_bytes(b"")
    (tmp_path / "classes.json").write_text(text)
    with pytest.raises(ClassifierError, match=r"class names.* list of strings, in the order"):
        classifier_source(tmp_path / "net.onnx")


@pytest.mark.parametrize("ending", CLASSIFIER_SUFFIXES)
def test_a_classifier_is_a_file_by_its_ending(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"net{ending.upper()}"
    with pytest.raises(ClassifierError, match="There is no classifier file"):
        classifier_source(file)
    file.write_bytes(b"net")
    assert classifier_source(str(file)) == Upload(file.name, file, kind=ClassifierInfo)


@pytest.mark.parametrize("name", ["net.keras", "net.tflite", "model.safetensors"])
def test_a_file_of_another_kind_is_refused_with_the_remedy(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"net")
    with pytest.raises(ClassifierError, match=f"'{name}' is not a supported classifier file: export the network to"):
        classifier_source(str(tmp_path / name))


@pytest.mark.parametrize("name", ["mobilenet_v2", "net.v2", "torchvision:vgg16", "torchvision:odd.pt2"])
def test_a_classifier_is_a_name_otherwise(name: str) -> None:
    assert classifier_source(name) == name


def test_a_background_is_a_colour_or_a_picture_file(tmp_path: Path) -> None:
    (tmp_path / "room.PNG").write_bytes(b"png")
    assert background_source("#ff8800") == "#ff8800"
    assert background_source(tmp_path / "room.PNG") == Upload("room.PNG", tmp_path / "room.PNG", kind=BackgroundInfo)
    with pytest.raises(SpecError, match="There is no background picture"):
        background_source("room2.png")


@pytest.mark.parametrize(
    ("option", "words"),
    [
        pytest.param({"tau": 1.5}, "`tau`: Input should be less than 1", id="out of range"),
        pytest.param({"epsilom": 0.1}, "Unknown option 'epsilom'; did you mean 'epsilon'", id="typing error"),
        pytest.param({"elevations": 2}, "random views are attacked: add `grid`", id="rows of no grid"),
        pytest.param({"ranges": {"colour": (0, 1)}}, "`ranges` colour: Extra inputs", id="no such range"),
        pytest.param({"ranges": {"roll": 3}}, "`ranges` roll: Input should be", id="no range"),
        pytest.param(
            {"label": [True]}, "`label` 0: should be a class by name or index; got true", id="label of no class"
        ),
        pytest.param({"target": False}, "`target`: should not be a truth value; got false", id="target of no class"),
        pytest.param({"epsilon": True}, "`epsilon`: should not be a truth value; got true", id="truth as a number"),
        pytest.param(
            {"ranges": {"intensity": [True, 2]}},
            "`ranges` intensity.*: should not be a truth value",
            id="truth as an end",
        ),
        pytest.param(
            {"elevation": [False, 9]}, "`elevation`.*: should not be a truth value; got f", id="truth as angle"
        ),
        pytest.param({"background": []}, "`background`: Value should have at least 1 item", id="no background"),
    ],
)
def test_a_wrong_option_is_named_before_any_server_is_asked(option: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecError, match=words):
        plan_attack("mug", **{"label": 0} | option)


def test_a_label_or_several_are_names_or_indices_of_any_library() -> None:
    for label in (5, 5.0, np.int64(5), [np.int64(5)], "5"):
        assert [int(each) for each in plan_attack("mug", label=label).request({}).goal.label] == [5]


def test_an_ensemble_and_judges_are_files_or_names_one_or_several(tmp_path: Path) -> None:
    file = tmp_path / "net.pt2"
    file.write_bytes(b"pt2")
    net = classifier_upload(file)
    planned = plan_attack("mug", label=0, ensemble=file, judges=["tiny", str(file)], background="black")
    assert planned.options == {
        "object": "mug",
        "label": 0,
        "ensemble": [net],
        "judges": ["tiny", net],
        "background": ["black"],
    }
    assert planned.uploads() == [net]
    request = planned.request({net: "4711"})
    assert (request.victim.ensemble, request.judges.networks) == (["4711"], ["tiny", "4711"])
    assert plan_attack("mug", label=0, judges="tiny").options["judges"] == ["tiny"]
