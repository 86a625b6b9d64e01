"""Jobs on the light and on vertices, over a fake target: whole, cut off, judged, and what they are refused."""

from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from memory_files import MemoryArtifacts
from numpy.typing import NDArray
from pydantic import ValidationError

from trompe_server.attack.beyond import load_light
from trompe_server.attack_job import open_pipeline
from trompe_server.classifiers import load_classifier
from trompe_server.formats import read_object
from trompe_server.library import Library
from trompe_server.meter import Meter
from trompe_server.pages.present import JobRow, command, job_row, present
from trompe_server.pipeline import VIEWS_AFTER, VIEWS_BEFORE, PhaseReport
from trompe_server.scene import open_scene
from trompe_server.target import FakeTarget, TargetRenderer
from trompe_shared.api import Job, JobSpec, JobState, Progress
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

CHAIR = load_object(shipped_objects()["chair"].read())
COMMON = {
    "object": "chair",
    "label": "chair",
    "pool": 0,
    "azimuths": 2,
    "elevations": 2,
    "held_out": 3,
}
LIGHT = JobSpec.model_validate({**COMMON, "attack_on": "light", "steps": 12, "views_per_step": 2})
VERTICES = JobSpec.model_validate({**COMMON, "attack_on": "vertices", "steps": 7, "vertex_budget": 0.03})
BOTH = pytest.mark.parametrize("spec", [LIGHT, VERTICES], ids=["light", "vertices"])
Image8 = NDArray[np.uint8]


class Noting:
    """A quick target; notes what it was asked for, and shows noise to the cameras in ``garbled``."""

    def __init__(self, garbled: Collection[Camera] = ()) -> None:
        self.inner, self.asked, self.garbled = FakeTarget(points=20_000), list[View](), garbled

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> Image8:
        self.asked += views
        images = self.inner.render(obj, views, size=size, on_frame=on_frame)
        for image, view in zip(images, views, strict=True):
            if view.camera in self.garbled:
                image[:] = np.random.default_rng(0).integers(0, 256, image.shape, np.uint8)
        return images

    def close(self) -> None:
        self.inner.close()


class Whole:
    """A job that was run to its end."""

    def __init__(self, spec: JobSpec, library: Library, *, new: bool = False, times: int = 1) -> None:
        self.files, self.progress = MemoryArtifacts(), list[Progress]()
        self.reports, self.asked = dict[str, PhaseReport](), dict[str, list[View]]()
        target = Noting()

        def opened(target: TargetRenderer = target) -> Any:
            return open_pipeline(spec, library=library, artifacts=self.files, target=target)

        job = opened()
        for phase in job.phases():
            for _ in range(times):
                target.asked.clear()
                job = opened() if new else job
                self.reports[phase] = job.run(phase, self.progress.append)
            self.asked[phase] = list(target.asked)
            if self.reports[phase].state is not None:
                break


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library(tmp_path_factory.mktemp("library"))


@pytest.fixture(scope="module")
def light(library: Library) -> Whole:
    return Whole(LIGHT, library)


@pytest.fixture(scope="module")
def vertices(library: Library) -> Whole:
    return Whole(VERTICES, library)


# Light


def test_a_job_on_the_light_looks_for_it_and_judges_it(light: Whole) -> None:
    assert list(light.reports) == ["prepare", "attack-000", "attack-001", "attack-002", "judge"]
    assert light.reports["judge"].state is JobState.succeeded
    assert set(light.reports["judge"].public) == {
        *("contact_sheet.png", "difference.png", "light_map.png", "predictions.png", "result.json", "saliency.png"),
        *("views_after.npz", "views_before.npz"),
    }
    fractions = [progress.fraction for progress in light.progress]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1)
    steps = [progress.step for progress in light.progress if progress.phase == "attack"]
    assert steps == list(range(1, 13))


def test_the_light_that_is_told_is_the_best_of_all_that_was_tried(light: Whole) -> None:
    found, told = load_light(light.files.read("state-1.npz")), light.files.result().light
    best = max(found.trials, key=lambda trial: trial.won)
    assert told is not None
    assert (told.azimuth, told.elevation, told.intensity, told.ambient) == (*vars(best.place).values(),)
    assert (told.fooled, told.tried_on) == (best.fooled, 2)


def test_own_and_held_out_views_are_judged_with_their_own_cameras_under_the_found_light(
    light: Whole, library: Library
) -> None:
    told, scene = light.files.result().light, open_scene(LIGHT, library=library, target=FakeTarget())
    assert told is not None
    judged = light.asked["judge"]
    assert [view.camera for view in judged] == [view.camera for view in (*scene.views, *scene.held_out)]
    assert {(view.light.azimuth, view.light.elevation) for view in judged} == {(told.azimuth, told.elevation)}
    images = light.files.images(VIEWS_AFTER)
    result = light.files.result()
    for name, accuracy in (("own", result.target), ("held_out", result.held_out)):
        said = scene.classifier.predict(images[name]).argmax(axis=1)
        assert accuracy is not None
        assert accuracy.a_after == (said == scene.label).mean()


def test_no_view_that_is_judged_is_looked_at_by_the_search_for_a_light(light: Whole, library: Library) -> None:
    scene = open_scene(LIGHT, library=library, target=FakeTarget())
    judged = {view.camera for view in (*scene.views, *scene.held_out)}
    looked = {view.camera for phase, views in light.asked.items() if phase.startswith("attack") for view in views}
    assert len(looked) == 2
    assert not looked & judged


def test_what_the_target_shows_in_judged_views_cannot_influence_the_light(light: Whole, library: Library) -> None:
    scene = open_scene(LIGHT, library=library, target=FakeTarget())
    target = Noting({view.camera for view in (*scene.views, *scene.held_out)})
    files = MemoryArtifacts()
    job = open_pipeline(LIGHT, library=library, artifacts=files, target=target)
    for phase in job.phases():
        if phase.startswith("attack"):
            job.run(phase, lambda _: None)
    assert files.read("state-1.npz") == light.files.read("state-1.npz")


def test_the_object_stays_as_it_is_and_nothing_is_said_of_texels(light: Whole) -> None:
    result = light.files.result()
    assert not [name for name in light.files.files if name.startswith("adversarial")]
    assert (result.epsilon, result.alpha, result.tau, result.vertices) == (0, 0, None, None)
    assert (result.texels_altered, result.mean_texel_change, result.texture_variation) == (None, None, None)
    assert (result.pixels_beyond_epsilon, result.surrogate, result.transfer_gap) == (None, None, None)
    assert (result.steps, result.evaluations, result.probe_renders) == (12, 24, 24)
    assert not [warning for warning in result.warnings if "texel" in warning]


def test_strength_and_ambient_light_are_searched_where_they_are_asked_for(library: Library) -> None:
    sun = {"azimuth": (10, 20), "elevation": (30, 40), "intensity": (0.2, 0.4), "ambient": (0.0, 0.1)}
    spec = JobSpec.model_validate(LIGHT.model_dump() | {"sun": sun, "steps": 3})
    found = Whole(spec, library).files.result().light
    assert found is not None
    for name, (low, high) in sun.items():
        assert low <= getattr(found, name) <= high


# Vertices


def test_a_job_on_vertices_moves_them_and_judges_that(vertices: Whole) -> None:
    assert list(vertices.reports) == ["prepare", "calibrate", "attack-000", "attack-001", "judge"]
    assert vertices.reports["judge"].state is JobState.succeeded
    assert set(vertices.reports["judge"].public) == {
        *("adversarial.glb", "adversarial.zip", "contact_sheet.png", "difference.png", "predictions.png"),
        *("result.json", "saliency.png", "views_after.npz", "views_before.npz"),
    }
    steps = [progress.step for progress in vertices.progress if progress.phase == "attack"]
    assert steps == list(range(1, 8))


def corners(obj: Object3D) -> NDArray[np.float64]:
    """(faces, 3, 3), metres."""
    return np.concatenate([part.vertices[part.faces] for part in obj.parts]).astype(np.float64)


def test_no_vertex_moves_further_than_its_budget_and_the_largest_move_is_told(vertices: Whole) -> None:
    moved, told = load_object(vertices.files.read("adversarial.zip")), vertices.files.result().vertices
    apart = np.linalg.norm(corners(moved) - corners(CHAIR), axis=2)
    assert told is not None
    assert 0 < apart.max() <= 0.03 * CHAIR.radius
    assert told.largest == pytest.approx(apart.max())
    assert told.mean == pytest.approx(apart.mean())
    assert told.largest_share == pytest.approx(apart.max() / CHAIR.radius)


def test_the_texture_stays_as_it_is(vertices: Whole) -> None:
    moved, result = load_object(vertices.files.read("adversarial.zip")), vertices.files.result()
    changed = [name for name in CHAIR.files if moved.files[name] != CHAIR.files[name]]
    assert [name.rpartition(".")[2] for name in changed] == ["obj"]
    assert (result.epsilon, result.alpha, result.texels_altered, result.mean_texel_change) == (0, 0, None, None)
    assert not [warning for warning in result.warnings if "texel" in warning]


def test_the_glb_holds_the_moved_vertices_too(vertices: Whole) -> None:
    saved, held = (
        load_object(vertices.files.read("adversarial.zip")),
        read_object(vertices.files.read("adversarial.glb"), name="moved.glb").obj,
    )
    assert np.allclose(np.sort(corners(held).reshape(-1)), np.sort(corners(saved).reshape(-1)), atol=1e-6)


def test_what_is_judged_is_the_object_that_is_saved(vertices: Whole, library: Library) -> None:
    scene = open_scene(VERTICES, library=library, target=FakeTarget())
    saved = load_object(vertices.files.read("adversarial.zip"))
    shown = FakeTarget(points=20_000).render(saved, scene.views, size=scene.size)
    assert (vertices.files.images(VIEWS_AFTER)["own"] == shown).all()
    assert (vertices.files.images(VIEWS_BEFORE)["own"] != shown).any()


def test_the_model_of_moving_vertices_is_judged_beside_the_target(vertices: Whole) -> None:
    result = vertices.files.result()
    assert result.surrogate is not None
    assert result.surrogate.a_before == result.target.a_before
    assert (result.surrogate_model, result.steps, result.evaluations) == ("relief", 7, 28)
    assert result.probe_renders == len(vertices.asked["calibrate"])


# Both


@BOTH
def test_a_job_that_is_cut_off_between_chunks_or_repeats_one_ends_with_the_same_bytes(
    spec: JobSpec, library: Library, request: pytest.FixtureRequest
) -> None:
    whole: Whole = request.getfixturevalue(spec.attack_on)
    again = Whole(spec, library, new=True, times=2)
    assert again.files.lasting() == whole.files.lasting()


@BOTH
def test_all_images_that_the_search_showed_the_classifier_are_counted(spec: JobSpec, library: Library) -> None:
    meter, files, shown = Meter(), MemoryArtifacts(), 0.0
    job = open_pipeline(spec, library=library, artifacts=files, target=Noting(), meter=meter)
    for name in job.phases():
        meter.take()
        job.run(name, lambda _: None)
        shown += meter.take()["classifier_images"] if name.startswith("attack") else 0
    assert files.result().evaluations == shown


@BOTH
def test_an_object_that_is_never_recognised_is_not_applicable(spec: JobSpec, library: Library) -> None:
    ended = Whole(spec.model_copy(update={"label": "ball"}), library)
    assert ended.reports["prepare"].state is JobState.not_applicable
    result = ended.files.result()
    assert (result.target.a_after, result.light, result.vertices) == (None, None, None)


def row_of(whole: Whole, spec: JobSpec) -> JobRow:
    job = Job(
        id="1",
        state=JobState.succeeded,
        spec=spec,
        worker=None,
        created=datetime(2026, 1, 1, tzinfo=UTC),
        artifacts=list(whole.reports["judge"].public),
    )
    return job_row(job, object="chair", classifier="tiny", label="chair")


def test_the_page_of_a_light_shows_the_sky_and_says_where_the_light_went(light: Whole) -> None:
    row, result = row_of(light, LIGHT), light.files.result()
    shown = present(result, row, names=str)
    assert (row.change, row.epsilon) == ("the light", "light")
    assert [picture["url"].rpartition("/")[2] for picture in shown.pictures] == ["light_map.png", "predictions.png"]
    names = [measure["name"] for measure in shown.measures]
    assert "Light that was found" in names
    assert not [name for name in names if "exel" in name]
    assert result.light is not None
    assert f"after the attack from {result.light.azimuth:.0f}° around" in shown.viewer[0]["views"][0]["where"]


def test_the_page_of_vertices_says_how_far_they_moved(vertices: Whole) -> None:
    row, result = row_of(vertices, VERTICES), vertices.files.result()
    (tile,) = [each for each in present(result, row, names=str).measures if each["name"] == "Largest move of a vertex"]
    assert row.change == "vertices within 3.0% of the radius"
    assert tile["value"].endswith("3.0% of the radius")


def test_the_command_line_of_a_job_asks_for_the_same() -> None:
    sun = {"azimuth": (-90, 90), "intensity": (0.5, 2)}
    spec = JobSpec.model_validate(LIGHT.model_dump() | {"sun": sun})
    words = command(spec, object="chair", classifier="tiny")
    assert "--attack-on light" in words
    assert "--sun azimuth -90 90 --sun intensity 0.5 2" in words
    assert "--vertex-budget 0.03" in command(VERTICES, object="chair", classifier="tiny")
    spec = JobSpec.model_validate({**COMMON, "tau": 0.2, "saliency_scope": "each_view"})
    assert "--tau 0.2 --saliency-scope each_view" in command(spec, object="chair", classifier="tiny")


class Blind:
    """``tiny`` as one sees it through an .onnx file: scores, no gradients."""

    def __init__(self) -> None:
        self.inner: Any = load_classifier("tiny")
        self.name, self.classes, self.n_classes = "net", self.inner.classes, self.inner.n_classes
        self.image_size = self.inner.image_size

    def predict(self, images: Image8) -> NDArray[np.float32]:
        scores: NDArray[np.float32] = self.inner.predict(images)
        return scores

    def scores(self, images: Float[torch.Tensor, "n 3 H W"]) -> Float[torch.Tensor, "n classes"]:
        logits: torch.Tensor = self.inner.scores(images)
        return logits


def test_a_light_is_found_by_scores_alone_which_are_counted(
    library: Library, light: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trompe_server.scene.load_classifier", lambda *_, **__: Blind())
    blind = Whole(LIGHT, library).files
    assert blind.read("state-1.npz") == light.files.read("state-1.npz")
    assert (blind.result().queries, blind.result().light) == (24, light.files.result().light)


def test_vertices_are_not_moved_without_gradients(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trompe_server.scene.load_classifier", lambda *_, **__: Blind())
    with pytest.raises(SpecError, match="along gradients, and 'net' gives none"):
        Whole(VERTICES, library)


# What is refused


@pytest.mark.parametrize("kind", ["light", "vertices"])
@pytest.mark.parametrize(
    "option",
    [
        *({"epsilon": 0.1}, {"alpha": 0.001}, {"tau": 0.1}, {"keep": 0.5}, {"materials": ["wood"]}),
        *({"masks": {"a.png": "b"}}, {"epsilon_view": 0.1}, {"loss": "dlr"}, {"optimiser": "pgd"}, {"restarts": 1}),
        *({"queries": 2}, {"surrogate": "curve"}, {"diverse": True}, {"saliency_scope": "each_view"}),
    ],
    ids=lambda option: next(iter(option)),
)
def test_options_of_texels_are_refused_where_texels_stay(kind: str, option: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=f"attack_on is '{kind}', and {next(iter(option))} belong"):
        JobSpec.model_validate({**COMMON, "attack_on": kind, **option})


@pytest.mark.parametrize(
    ("kind", "option"),
    [
        ("texture", {"sun": {"azimuth": (0, 90)}}),
        ("vertices", {"sun": {"intensity": (1, 2)}}),
        ("texture", {"vertex_budget": 0.1}),
        ("light", {"vertex_budget": 0.1}),
    ],
    ids=str,
)
def test_options_of_one_kind_of_attack_are_refused_for_another(kind: str, option: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="belong to another kind of attack"):
        JobSpec.model_validate({**COMMON, "attack_on": kind, **option})


@pytest.mark.parametrize("sun", [{"azimuth": (9, 0)}, {"elevation": (0, 91)}, {"ambient": (0.5, 1.5)}], ids=str)
def test_a_sun_that_cannot_be_is_refused(sun: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="low end first"):
        JobSpec.model_validate({**COMMON, "attack_on": "light", "sun": sun})


@pytest.mark.parametrize("budget", [0, 0.6])
def test_a_vertex_budget_that_cannot_be_is_refused(budget: float) -> None:
    with pytest.raises(ValidationError, match="vertex_budget"):
        JobSpec.model_validate({**COMMON, "attack_on": "vertices", "vertex_budget": budget})


@BOTH
def test_a_spec_is_the_same_after_it_was_stored(spec: JobSpec) -> None:
    assert JobSpec.model_validate_json(spec.model_dump_json()) == spec


def test_an_old_spec_attacks_the_texture() -> None:
    assert JobSpec.model_validate(COMMON | {"epsilon": 0.02}).attack_on == "texture"
