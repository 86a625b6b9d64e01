"""What a job can be asked for beyond the paper's attack, over a fake target: each option reaches the result."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from numpy.typing import NDArray

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


def test_the_view_constraint_is_kept_in_the_surrogate_and_told_of_the_target(library: Library, tmp_path: Path) -> None:
    free, _ = attacked(library, tmp_path / "free")
    bound, _ = attacked(library, tmp_path / "bound", epsilon_view=0.02)
    assert free.max_view_change is not None
    assert bound.max_view_change is not None
    assert bound.max_view_change < free.max_view_change
    assert free.views_beyond_epsilon is not None


class Scores:
    """``tiny`` as one sees it through an .onnx file: scores, no gradients."""

    def __init__(self, inner: Any) -> None:
        self.inner: Any = inner
        self.name, self.classes = "net", inner.classes
        self.image_size, self.n_classes = inner.image_size, inner.n_classes

    def predict(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        scores: NDArray[np.float32] = self.inner.predict(images)
        return scores

    def scores(self, images: Float[torch.Tensor, "n 3 H W"]) -> Float[torch.Tensor, "n classes"]:
        with torch.no_grad():
            logits: torch.Tensor = self.inner.logits(images)
        return logits


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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_whole_job_runs_on_a_graphics_card(library: Library, tmp_path: Path) -> None:
    job = open_pipeline(SPEC, library=library, artifacts=LocalArtifacts(tmp_path), target=FakeTarget(), device="cuda")
    for phase in job.phases():
        job.run(phase, lambda _: None)
    assert (tmp_path / "result.json").exists()
