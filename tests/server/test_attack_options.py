"""What a job can be asked for beyond the paper's attack, over a fake target: each option reaches the result."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from scores_only import Scores

from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.classifiers import Classifier, load_classifier
from trompe_server.library import Library
from trompe_server.target import FakeTarget
from trompe_shared.api import ClassifierInfo, JobSpec, Result
from trompe_shared.errors import ClassifierError, SpecError
from trompe_shared.object3d import Object3D, encode_png, load_object
from trompe_shared.shipped import shipped_objects

CHAIR = load_object(shipped_objects()["chair"].read())
WOOD, CUSHION = "chair_wood_AlbedoTransparency.png", "chair_cushion_AlbedoTransparency.png"
SPEC = JobSpec.model_validate(
    {
        "object": "chair",
        "label": "chair",
        "epsilon": 0.1,
        "alpha": 0.03,
        "surrogate": "diffuse",
        "steps": 4,
        "pool": 0,
        "azimuths": 2,
        "elevations": 2,
        "held_out": 3,
    }
)


@pytest.fixture
def library(tmp_path: Path) -> Library:
    return Library(tmp_path / "library")


def attacked(library: Library, folder: Path, **options: Any) -> tuple[Result, Object3D]:
    """The result of a job with ``options``, and the repainted object."""
    shutil.rmtree(folder, ignore_errors=True)
    spec, artifacts = SPEC.model_copy(update=options), LocalArtifacts(folder)
    job = open_pipeline(spec, library=library, artifacts=artifacts, target=FakeTarget())
    for phase in job.phases():
        job.run(phase, lambda _: None)
    result = Result.model_validate_json(artifacts.read("result.json"))
    return result, load_object(artifacts.read("adversarial.zip"))


def changed(painted: Object3D) -> dict[str, NDArray[np.bool_]]:
    """Which texels of each texture differ."""
    return {name: (image != CHAIR.textures[name]).any(axis=2) for name, image in painted.textures.items()}


def test_only_the_share_of_texels_that_is_kept_moves(library: Library, tmp_path: Path) -> None:
    everything, _ = attacked(library, tmp_path / "all")
    few, _ = attacked(library, tmp_path / "few", keep=0.05)
    assert few.texels_altered is not None
    assert everything.texels_altered is not None
    assert 0 < few.texels_altered <= 0.05 + 1e-6 < everything.texels_altered


def test_only_the_named_material_moves(library: Library, tmp_path: Path) -> None:
    _, painted = attacked(library, tmp_path / "job", materials=["chair_cushion"])
    assert changed(painted)[CUSHION].any()
    assert not changed(painted)[WOOD].any()


def test_only_what_a_picture_shows_white_moves(library: Library, tmp_path: Path) -> None:
    picture = np.zeros(CHAIR.textures[WOOD].shape, np.uint8)
    picture[:, 256:] = 255
    mask = library.add_background(encode_png(picture), "mask.png").id
    _, painted = attacked(library, tmp_path / "job", masks={WOOD: mask})
    assert changed(painted)[WOOD][:, 256:].any()
    assert not changed(painted)[WOOD][:, :256].any()
    assert not changed(painted)[CUSHION].any()


def test_a_mask_of_another_size_is_refused_before_any_work(library: Library, tmp_path: Path) -> None:
    mask = library.add_background(encode_png(np.full((8, 8, 3), 255, np.uint8)), "mask.png").id
    with pytest.raises(SpecError, match=r"8 x 8 pixels, the texture 512 x 512"):
        attacked(library, tmp_path / "job", masks={WOOD: mask})
    assert not (tmp_path / "job").exists()


def test_masks_of_which_none_leaves_what_another_does_are_refused_before_any_work(
    library: Library, tmp_path: Path
) -> None:
    mask = library.add_background(encode_png(np.full(CHAIR.textures[WOOD].shape, 255, np.uint8)), "mask.png").id
    with pytest.raises(SpecError, match=r"leave none of the texels of \['chair_cushion'\]: paint white"):
        attacked(library, tmp_path / "job", masks={WOOD: mask}, materials=["chair_cushion"])
    assert not (tmp_path / "job").exists()
    _, painted = attacked(library, tmp_path / "job", masks={WOOD: mask}, materials=["chair_wood"], steps=1)
    assert changed(painted)[WOOD].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keep": 9e-7}, r"keep=9e-07 leaves none of the 524288 texels to move: keep 2e-06 or more"),
        ({"queries": 4}, "'tiny' gives gradients: leave them out"),
    ],
    ids=str,
)
def test_what_does_not_fit_the_object_or_the_classifier_is_refused_before_any_work(
    library: Library, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(SpecError, match=message):
        attacked(library, tmp_path / "job", **options)
    assert not (tmp_path / "job").exists()


def test_a_target_class_is_reached_or_the_result_says_how_often(library: Library, tmp_path: Path) -> None:
    towards, _ = attacked(library, tmp_path / "towards", target_label="table", epsilon=0.3, alpha=0.1, steps=8)
    away, _ = attacked(library, tmp_path / "away", epsilon=0.3, alpha=0.1, steps=8)
    index = CLASSES.index("table")
    assert towards.goal_reached == np.mean([view.after == index for view in towards.views])
    assert away.goal_reached == np.mean([view.after != away.label for view in away.views])


CLASSES = sorted({shipped.label for shipped in shipped_objects().values()})


@pytest.mark.parametrize(
    "options",
    [
        {"optimiser": "pgd", "restarts": 1},
        {"optimiser": "fgsm", "steps": 1},
        {"optimiser": "adam"},
        {"optimiser": "auto", "loss": "dlr"},
        {"loss": "cross_entropy", "top_k": 2},
        {"ensemble": ["tiny"]},
        {"ensemble": ["tiny"], "diverse": True},
        {"diverse": True, "restarts": 1},
    ],
    ids=str,
)
def test_every_kind_of_attack_stays_in_its_budget_and_says_what_it_was(
    library: Library, tmp_path: Path, options: dict[str, Any]
) -> None:
    result, painted = attacked(library, tmp_path / "job", **options)
    for name, image in painted.textures.items():
        assert np.abs(image.astype(int) - CHAIR.textures[name]).max() <= int(0.1 * 255)
    assert result.spec == SPEC.model_copy(update=options)
    assert result.evaluations is not None
    assert 0 < result.evaluations <= 4 * (SPEC.steps + 2)  # all views at each step, and at what is compared at the end
    assert any(mask.any() for mask in changed(painted).values())


@pytest.mark.parametrize(
    ("options", "diverse"),
    [
        ({}, False),
        ({"ensemble": ["net"]}, True),
        ({"ensemble": ["net"], "diverse": False}, False),
        ({"ensemble": ["net"], "queries": 4}, False),
        ({"ensemble": ["net"], "attack_on": "vertices"}, False),
    ],
    ids=str,
)
def test_an_ensemble_is_attacked_for_transfer_unless_that_is_impossible_or_unwanted(
    options: dict[str, Any], diverse: bool
) -> None:
    assert JobSpec(object="mug", label="mug", **options).diverse is diverse


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"optimiser": "fgsm"}, r"single step: make steps 1 \(one a run\) instead of 90, or choose another"),
        ({"optimiser": "fgsm", "steps": 3, "restarts": 1}, "make steps 2 .one a run. instead of 3"),
        ({"steps": 3, "restarts": 3}, "too few for 3 restarts.*make steps 4 or more"),
        ({"epsilon": 0.001}, r"0.001 is less than 1/255.*nothing could change; make it 0.004 or more"),
        ({"epsilon": 0.0039}, "0.0039 is less than 1/255"),
        ({"epsilon": 0.0}, "epsilon"),
        ({"epsilon": 1.1}, "epsilon"),
        ({"epsilon": float("nan")}, "epsilon"),
    ],
    ids=str,
)
def test_options_that_cannot_be_are_refused_before_there_is_a_job(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        JobSpec(object="mug", label="mug", **options)


@pytest.mark.parametrize(
    "options",
    [
        {"optimiser": "fgsm", "steps": 3, "restarts": 2},
        {"steps": 3, "restarts": 2},
        {"epsilon": 1 / 255},
        {"epsilon": 1},
    ],
    ids=str,
)
def test_options_that_just_can_be_are_accepted(options: dict[str, Any]) -> None:
    assert JobSpec.model_validate_json(JobSpec(object="mug", label="mug", **options).model_dump_json())


def test_the_view_constraint_is_kept_in_the_surrogate_and_told_of_the_target(library: Library, tmp_path: Path) -> None:
    free, _ = attacked(library, tmp_path / "free")
    bound, _ = attacked(library, tmp_path / "bound", epsilon_view=0.02)
    assert free.max_view_change is not None
    assert bound.max_view_change is not None
    assert bound.max_view_change < free.max_view_change
    assert free.views_beyond_epsilon is not None


@pytest.fixture
def opaque(library: Library, monkeypatch: pytest.MonkeyPatch) -> Classifier:
    net = Scores(load_classifier("tiny"))
    info = ClassifierInfo(
        id="net", name="net", white_box=False, image_size=net.image_size, n_classes=net.n_classes, classes=CLASSES
    )
    monkeypatch.setattr(library, "classifier", lambda _: info)
    monkeypatch.setattr(library, "classifier_path", lambda _: "net.onnx")
    monkeypatch.setattr("trompe_server.scene.load_classifier", lambda *_, **__: net)
    return net


@pytest.mark.usefixtures("opaque")
def test_a_classifier_that_only_gives_scores_is_attacked_and_its_answers_are_counted(
    library: Library, tmp_path: Path
) -> None:
    result, painted = attacked(library, tmp_path / "job", classifier="net", queries=6)
    assert result.queries is not None
    assert result.evaluations is not None
    assert result.evaluations <= result.queries <= 7 * result.evaluations
    assert any(mask.any() for mask in changed(painted).values())
    assert not (tmp_path / "job" / "saliency.png").exists()
    assert (tmp_path / "job" / "contact_sheet.png").exists()


@pytest.mark.usefixtures("opaque")
@pytest.mark.parametrize("options", [{"tau": 0.1}, {"keep": 0.1}], ids=str)
def test_saliency_of_a_classifier_that_only_gives_scores_is_refused(
    library: Library, tmp_path: Path, options: dict[str, Any]
) -> None:
    with pytest.raises(SpecError, match="need saliency, and 'net' gives no gradients"):
        attacked(library, tmp_path / "job", classifier="net", queries=6, **options)


@pytest.mark.usefixtures("opaque")
def test_random_places_are_refused_for_a_classifier_that_only_gives_scores(library: Library, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="diverse needs gradients, and 'net' gives none"):
        attacked(library, tmp_path / "job", classifier="net", queries=6, diverse=True)


def test_an_ensemble_needs_gradients(library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    net = Scores(load_classifier("tiny"))
    monkeypatch.setattr(
        "trompe_server.scene._stored_classifier",
        lambda name, **_: net if name == "net" else load_classifier("tiny"),
    )
    with pytest.raises(ClassifierError, match=r"\['net'\] give scores but no gradients"):
        attacked(library, tmp_path / "job", ensemble=["net"])


def test_a_device_that_is_not_there_is_told_before_any_work(library: Library, tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match="'cuda:7' cannot be used here"):
        open_pipeline(SPEC, library=library, artifacts=LocalArtifacts(tmp_path), target=FakeTarget(), device="cuda:7")
