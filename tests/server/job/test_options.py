"""Options of a job beyond the paper's attack, over a fake target: each one reaches the result."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from tests.fakes import Scores
from tests.job_runs import CHAIR, MemoryArtifacts, run_job, spec_of
from trompe_server.classifiers import load_classifier
from trompe_server.image_pipelines import SUITE
from trompe_server.library import Library
from trompe_shared.api import JobSpec, Result
from trompe_shared.object3d import encode_png
from trompe_shared.shipped import shipped_objects

WOOD, CUSHION = "chair_wood_AlbedoTransparency.png", "chair_cushion_AlbedoTransparency.png"
CLASSES = sorted({shipped.label for shipped in shipped_objects().values()})


def attacked(library: Library, **options: Any) -> tuple[Result, dict[str, NDArray[np.bool_]]]:
    """The result of a job with ``options``, and the changed texels of each texture."""
    run = run_job(spec_of(**{"steps": 4} | options), library)
    return run.result, changed(run.artifacts)


def changed(artifacts: MemoryArtifacts) -> dict[str, NDArray[np.bool_]]:
    return {name: (image != CHAIR.textures[name]).any(axis=2) for name, image in artifacts.painted().textures.items()}


def test_only_the_named_material_moves(library: Library) -> None:
    _, texels = attacked(library, materials=["chair_cushion"])
    assert texels[CUSHION].any()
    assert not texels[WOOD].any()


@pytest.mark.parametrize("materials", [[], ["chair_wood"]], ids=str)
def test_only_texels_under_white_of_a_mask_move(library: Library, materials: list[str]) -> None:
    picture = np.zeros(CHAIR.textures[WOOD].shape, np.uint8)
    picture[:, 64:] = 255
    mask = library.add_background(encode_png(picture), "mask.png").id
    _, texels = attacked(library, masks={WOOD: mask}, materials=materials, steps=1)
    assert texels[WOOD][:, 64:].any()
    assert not texels[WOOD][:, :64].any()
    assert not texels[CUSHION].any()


def test_every_second_held_out_image_is_also_judged_through_each_pipeline_of_the_suite(library: Library) -> None:
    run, classifier = run_job(spec_of(steps=3, held_out=7), library), load_classifier("tiny")
    assert [each.pipeline for each in run.result.image_pipelines] == list(SUITE)
    for judged in run.result.image_pipelines:
        for name, share in (("before", judged.held_out.a_before), ("after", judged.held_out.a_after)):
            images = SUITE[judged.pipeline].shown(run.artifacts.arrays(f"views_{name}")["held_out"][::2])
            assert share == np.mean(classifier.predict(images).argmax(1) == run.result.label)
    assert run_job(spec_of(steps=1, held_out=0), library).result.image_pipelines == []


@pytest.mark.parametrize("target", ["table", None])
def test_the_result_says_how_often_the_goal_is_reached(library: Library, target: str | None) -> None:
    result, _ = attacked(library, target=target, epsilon=0.3, alpha=0.1, steps=8)
    reached = [view.after == CLASSES.index(target) if target else view.after != result.label for view in result.views]
    assert result.goal_reached == np.mean(reached)


@pytest.mark.parametrize(
    "options", [{}, {"top_k": 2}, {"target": "ball"}, {"loss": "cross_entropy", "tau": 0.05}], ids=str
)
@pytest.mark.usefixtures("pictures")
def test_each_of_several_labels_counts_as_the_object(library: Library, options: dict[str, Any]) -> None:
    run = run_job(spec_of(label=["table", "chair"], steps=4, epsilon=0.3, alpha=0.1, **options), library)
    result = run.result
    assert (result.label, result.label_name) == (CLASSES.index("table"), "table")
    assert (result.labels, result.label_names) == ([result.label, CLASSES.index("chair")], ["table", "chair"])
    for found, views in ((result.target, result.views), (result.held_out, result.held_out_views)):
        assert found is not None
        assert found.a_before == np.mean([view.before in result.labels for view in views]) > 0
        assert found.a_after == np.mean([view.after in result.labels for view in views])
        assert all((view.before in result.labels) <= (view.before_true_confidence > 0.125) for view in views)
    assert not {each.label for each in result.fooled_as} & set(result.labels)
    assert "predictions.png" in run.artifacts.files


@pytest.mark.parametrize(
    "options",
    [
        {"optimiser": "pgd"},
        {"loss": "cross_entropy", "top_k": 2},
        {"ensemble": ["tiny"]},
        {"ensemble": ["tiny"], "image_pipeline": "none"},
        {"image_pipeline": "robust"},
    ],
    ids=str,
)
def test_every_attack_stays_in_its_budget_and_says_what_it_was(library: Library, options: dict[str, Any]) -> None:
    run = run_job(spec_of(steps=4, **options), library)
    for name, image in run.artifacts.painted().textures.items():
        assert np.abs(image.astype(int) - CHAIR.textures[name]).max() <= int(0.1 * 255)
    assert run.result.spec == spec_of(steps=4, **options)
    assert 0 < (run.result.evaluations or 0) <= 4 * 4  # all views at each step
    assert any(mask.any() for mask in changed(run.artifacts).values())


def test_the_view_constraint_holds_in_the_surrogate_and_is_measured_in_the_target(library: Library) -> None:
    (plain, _), (bound, _) = attacked(library), attacked(library, epsilon_view=0.02)
    assert plain.max_view_change is not None
    assert bound.max_view_change is not None
    assert bound.max_view_change < plain.max_view_change
    assert plain.pixels_beyond_epsilon is not None
    assert bound.pixels_beyond_epsilon is not None
    assert (
        bound.pixels_beyond_epsilon > plain.pixels_beyond_epsilon
    )  # a smaller change, but of a bound of 0.02, not 0.1


@pytest.mark.usefixtures("pictures")
def test_scores_of_a_classifier_without_gradient_are_counted(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trompe_server.job.setup._stored_classifier", lambda *_, **__: Scores(load_classifier("tiny")))
    run = run_job(spec_of(queries=6, steps=4), library)
    evaluations = run.result.evaluations or 0
    assert 0 < evaluations <= (run.result.queries or 0) <= 7 * evaluations
    assert any(mask.any() for mask in changed(run.artifacts).values())
    assert "saliency.png" not in run.artifacts.files
    assert "contact_sheet.png" in run.artifacts.files
    note = run_job(spec_of(queries=6, label="ball"), library).reports["prepare"].note
    assert note is not None
    assert note.endswith("`background`, and that the .onnx file normalises its images.")


# Rules of the options alone


@pytest.mark.parametrize(
    ("options", "pipeline"),
    [
        ({}, "robust"),
        ({"image_pipeline": "none"}, "none"),
        ({"grid": True}, "none"),
        ({"queries": 4}, "none"),
        ({"ensemble": ["net"], "queries": 4}, "none"),
        ({"ensemble": ["net"]}, "transfer"),
        ({"ensemble": ["net"], "grid": True}, "none"),
        ({"ensemble": ["net"], "image_pipeline": "none"}, "none"),
        ({"grid": True, "image_pipeline": "robust"}, "robust"),
    ],
    ids=str,
)
def test_paint_is_made_for_changed_images_but_on_the_grid_or_by_scores(options: dict[str, Any], pipeline: str) -> None:
    assert JobSpec.of("mug", label="mug", **options).image_pipeline == pipeline


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epsilon": 0.001}, r"0.001 is less than 1/255.*nothing could change; use 0.004 or more"),
        ({"epsilon": 0.0039}, "0.0039 is less than 1/255"),
        ({"epsilon": 0.0}, "epsilon"),
        ({"epsilon": 1.1}, "epsilon"),
        ({"epsilon": float("nan")}, "epsilon"),
        ({"alpha": 0.06}, "make it smaller"),
        ({"elevation": (50, 0)}, "low end first"),
        ({"label": []}, "at least 1"),
        ({"grid": True, "held_out": 0, "ranges": {"roll": (-5, 5)}}, "ask for `held_out`"),
    ],
    ids=str,
)
def test_contradictory_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        JobSpec.of("mug", **{"label": "mug"} | options)


@pytest.mark.parametrize("label", ["mug", 5, ["mug"], ("mug", 5)], ids=str)
def test_a_label_is_a_list_however_it_was_given(label: Any) -> None:
    spec = JobSpec.of("mug", label=label)
    assert spec.goal.label == (list(label) if isinstance(label, list | tuple) else [label])
    assert JobSpec.model_validate_json(spec.model_dump_json()) == spec


@pytest.mark.parametrize("options", [{"epsilon": 1 / 255}, {"epsilon": 1}, {"alpha": 0.05}], ids=str)
def test_options_at_their_limits_are_accepted(options: dict[str, Any]) -> None:
    assert JobSpec.model_validate_json(JobSpec.of("mug", label="mug", **options).model_dump_json())
