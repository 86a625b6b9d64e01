"""Files the user points at: what is sent for them."""

import io
import json
import zipfile
from typing import Any

import pytest

from trompe_client._plan import (
    CLASSIFIER_SUFFIXES,
    AttackOptions,
    AttackPlan,
    Upload,
    background_source,
    classifier_source,
    classifier_upload,
    object_source,
    plan_attack,
)
from trompe_shared.api import JobRequest
from trompe_shared.errors import ClassifierError, ObjectError, SpecError


def names(upload: Upload) -> list[str]:
    assert isinstance(upload.content, bytes)
    return zipfile.ZipFile(io.BytesIO(upload.content)).namelist()


def test_a_folder_is_zipped_flat_sorted_and_without_hidden_files(mug_folder):
    assert names(object_source(mug_folder)) == ["a.png", "mug.obj", "mug_mat_def.json"]


def test_the_same_folder_gives_the_same_bytes_whatever_its_dates(mug_folder):
    before = object_source(str(mug_folder)).content
    for file in mug_folder.iterdir():
        file.write_bytes(file.read_bytes())
    later = mug_folder.rename(mug_folder.with_name("elsewhere"))
    assert object_source(later).content == before


def test_an_obj_file_takes_its_materials_and_pictures_along_but_no_other_mesh(mug_folder):
    (mug_folder / "other.obj").write_text("o other")
    (mug_folder / "notes.txt").write_text("mine")
    assert names(object_source(mug_folder / "mug.obj")) == ["a.png", "mug.obj", "mug_mat_def.json"]


def test_a_zip_is_sent_as_it_is(mug_folder, tmp_path):
    archive = tmp_path / "cup.zip"
    archive.write_bytes(object_source(mug_folder).content)
    assert object_source(archive) == Upload("cup.zip", archive)


@pytest.mark.parametrize("ending", ["glb", "FBX", "ply", "stl"])
def test_a_model_in_one_file_is_sent_as_it_is(tmp_path, ending):
    model = tmp_path / f"cup.{ending}"
    model.write_bytes(b"any bytes: the server reads them")
    assert object_source(model) == object_source(str(model)) == Upload(model.name, model)


def test_a_gltf_file_takes_its_buffers_and_pictures_along(tmp_path):
    for name in ("cup.gltf", "cup.bin", "paint.png", "notes.txt"):
        (tmp_path / name).write_text("{}")
    assert names(object_source(tmp_path / "cup.gltf")) == ["cup.bin", "cup.gltf", "paint.png"]
    assert "cup.gltf" in names(object_source(tmp_path))


def test_a_word_is_the_name_of_a_stored_object_even_where_a_folder_of_that_name_holds_no_mesh(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mug").mkdir()
    assert object_source("mug") == "mug"


@pytest.mark.parametrize("source", ["missing.zip", "missing/mug.obj"])
def test_a_path_that_leads_nowhere_is_an_error(source):
    with pytest.raises(ObjectError, match="There is no file"):
        object_source(source)


def test_a_file_that_is_no_zip_is_not_sent(tmp_path):
    (tmp_path / "mug.zip").write_text("<html>")
    with pytest.raises(ObjectError, match="not a zip archive"):
        object_source(tmp_path / "mug.zip")


def test_a_folder_without_mesh_is_an_error(tmp_path):
    with pytest.raises(ObjectError, match=r"holds no \.obj"):
        object_source(tmp_path)


def test_the_class_names_nearest_to_the_classifier_win(tmp_path):
    victim = tmp_path / "net.v2.pt2"
    victim.write_bytes(b"")
    assert classifier_upload(victim).form == {}
    for file, name in {"classes.json": "c", "imagenet_classes.json": "i", "net.v2.classes.json": "own"}.items():
        (tmp_path / file).write_text(json.dumps([name]))
        assert json.loads(classifier_upload(victim).form["classes"]) == [name]
    assert json.loads(classifier_upload(victim, classes=["given"]).form["classes"]) == ["given"]


@pytest.mark.parametrize("text", ['{"0": "mug"}', "[1, 2]", "mug"])
def test_class_names_that_are_no_list_of_strings_are_refused(tmp_path, text):
    (tmp_path / "net.onnx").write_bytes(b"")
    (tmp_path / "classes.json").write_text(text)
    with pytest.raises(ClassifierError, match="class names"):
        classifier_source(tmp_path / "net.onnx")


@pytest.mark.parametrize("ending", CLASSIFIER_SUFFIXES)
def test_a_classifier_is_a_file_by_its_ending(tmp_path, ending):
    file = tmp_path / f"net{ending.upper()}"
    with pytest.raises(ClassifierError, match="There is no classifier file"):
        classifier_source(file)
    file.write_bytes(b"net")
    assert classifier_source(str(file)) == Upload(file.name, file)


@pytest.mark.parametrize("name", ["mobilenet_v2", "torchvision:vgg16", "hub:owner/nets:small", "hub:owner/nets.pt"])
def test_a_classifier_is_a_name_otherwise(name):
    assert classifier_source(name) == name


def test_a_background_is_a_colour_or_a_picture_file(tmp_path):
    (tmp_path / "room.PNG").write_bytes(b"png")
    assert background_source("#ff8800") == "#ff8800"
    assert background_source(tmp_path / "room.PNG") == Upload("room.PNG", tmp_path / "room.PNG")
    with pytest.raises(SpecError, match="There is no background picture"):
        background_source("room2.png")


def test_the_options_are_those_of_a_job():
    assert AttackOptions.__annotations__.keys() == JobRequest.model_fields.keys() - {"object", "label"}


def plan(**options: Any) -> AttackPlan:
    nothing = {"ensemble": (), "judges": (), "background": "white", "masks": {}}
    return plan_attack("mug", **{"label": 0, "classifier": "tiny"} | nothing | options)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        pytest.param({"tau": 1.5}, "tau: Input should be less than 1", id="out of range"),
        pytest.param({"saliency_scope": "each_view"}, "there is no tau: give one", id="scope of no threshold"),
        pytest.param({"azimuths": 12}, "and 240 random views", id="columns of no grid"),
        pytest.param({"elevations": 2, "pool": 3}, "and 3 random views", id="rows of no grid"),
        pytest.param({"pool": 0, "held_out": 0, "ranges": {"roll": (0, 9)}}, "there are none", id="ranges of no views"),
        pytest.param({"optimiser": "auto", "alpha": 0.02}, "auto chooses its own", id="step of auto"),
        pytest.param({"optimiser": "fgsm", "steps": 1, "alpha": 0.02}, "fgsm chooses its own", id="step of fgsm"),
        pytest.param({"saliency_scope": "a_view", "tau": 0.1}, "saliency_scope: Input should be", id="no scope"),
        pytest.param({"ranges": {"colour": (0, 1)}}, "ranges.colour", id="no such range"),
        pytest.param({"ranges": {"roll": 3}}, "ranges.roll", id="no range"),
        pytest.param({"background": []}, "background: Value should have at least 1 item", id="no background"),
        pytest.param({"target_label": 1, "top_k": 5}, "choose one", id="two goals"),
        pytest.param({"masks": {"a.png": "missing.png"}}, "no mask picture 'missing.png'", id="mask"),
    ],
)
def test_a_wrong_option_is_named_before_any_server_is_asked(option, words):
    with pytest.raises(SpecError, match=words):
        plan(**option)


def test_an_ensemble_and_judges_are_files_or_names_one_or_several(tmp_path):
    (tmp_path / "net.pt").write_bytes(b"script")
    planned = plan(ensemble=tmp_path / "net.pt", judges=["tiny", str(tmp_path / "net.pt")], background="black")
    assert planned.ensemble == (Upload("net.pt", tmp_path / "net.pt"),)
    assert planned.judges == ("tiny", Upload("net.pt", tmp_path / "net.pt"))
    assert planned.backgrounds == ("black",)
    assert plan(judges="tiny").judges == ("tiny",)
