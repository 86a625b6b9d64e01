"""The main job over a fake target and the shipped classifier: phases, restarts, files, and what it says of failure."""

import dataclasses
import io
import json
import shutil
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from memory_files import MemoryArtifacts
from numpy.typing import NDArray
from PIL import Image

from trompe_server import attack_job
from trompe_server.array_files import unpack_arrays
from trompe_server.attack import Budget, Goal, attack, load_state, rescale_each_view, saliency, saliency_masks, start
from trompe_server.attack_job import AttackJob, open_pipeline
from trompe_server.errors import NotFoundError
from trompe_server.library import Library
from trompe_server.meter import Meter
from trompe_server.pipeline import VIEWS_BEFORE, DamagedFileError, PhaseReport
from trompe_server.scene import Scene, open_scene
from trompe_server.surrogate import Geometry, SamplingModel, diffuse_surrogate, prepare_geometry, textures_of
from trompe_server.target import BackdropTarget, FakeTarget, SailenvTarget, TargetRenderer
from trompe_shared.api import ClassifierInfo, JobSpec, JobState, Progress, SaliencyScope
from trompe_shared.errors import ClassifierError, LabelError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, encode_png, load_object
from trompe_shared.shipped import shipped_objects

CHAIR = shipped_objects()["chair"]
SPEC = JobSpec.model_validate(
    {
        "object": "chair",
        "label": "chair",
        "epsilon": 0.1,
        "alpha": 0.03,
        "surrogate": "calibrated",
        "steps": 6,
        "pool": 0,
        "azimuths": 2,
        "elevations": 2,
        "held_out": 3,
    }
)
QUICK = SPEC.model_copy(update={"surrogate": "diffuse", "steps": 2})
PICTURES = {
    "predictions.png",
    "saliency_object.png",
    "saliency_textures.png",
    "contact_sheet.png",
    "difference.png",
    "saliency.png",
    "textures.png",
}
MODELS = {"adversarial.zip", "adversarial.glb"}
IMAGES = {"views_before.npz", "views_after.npz"}
Image8 = NDArray[np.uint8]


class DarkTarget(FakeTarget):
    """A target whose images are half as bright on their left."""

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> Image8:
        images = super().render(obj, views, size=size, on_frame=on_frame)
        images[:, :, : size[1] // 2] //= 2
        return images


@dataclasses.dataclass
class Run:
    """A job that was run through: its files, what each phase reported, and the progress it told."""

    artifacts: MemoryArtifacts
    reports: dict[str, PhaseReport]
    progress: list[Progress]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library(tmp_path_factory.mktemp("library"))


def run(
    spec: JobSpec,
    library: Library,
    *,
    target: TargetRenderer | None = None,
    new: bool = False,
    times: int = 1,
    calibrations: bool = False,
) -> Run:
    """Run all phases until the job ends; ``new`` opens the job anew for each, ``times`` runs each so often.

    Nothing that earlier jobs found out about the target is known, unless with ``calibrations``.
    """
    if not calibrations:
        shutil.rmtree(library.calibrations.folder, ignore_errors=True)
    artifacts, reports, progress = MemoryArtifacts(), {}, list[Progress]()

    def opened() -> AttackJob:
        return open_pipeline(spec, library=library, artifacts=artifacts, target=target or FakeTarget())

    job = opened()
    for phase in job.phases():
        for _ in range(times):
            job = opened() if new else job
            reports[phase] = job.run(phase, progress.append)
        if reports[phase].state is not None:
            break
    return Run(artifacts, reports, progress)


@pytest.fixture(scope="module")
def finished(library: Library) -> Run:
    return run(SPEC, library)


def test_a_job_goes_through_its_phases_and_succeeds(finished: Run) -> None:
    assert list(finished.reports) == ["prepare", "calibrate", "attack-000", "attack-001", "judge"]
    states = [report.state for report in finished.reports.values()]
    assert states == [None, None, None, None, JobState.succeeded]
    assert set(finished.reports["judge"].public) == PICTURES | MODELS | {"result.json", *IMAGES}
    assert set(finished.reports["judge"].public) <= set(finished.artifacts.files)


def test_progress_grows_from_nothing_to_all(finished: Run) -> None:
    fractions = [progress.fraction for progress in finished.progress]
    assert fractions == sorted(fractions)
    assert 0 < fractions[0] < 0.1
    assert fractions[-1] == pytest.approx(1)
    steps = [(progress.step, progress.steps) for progress in finished.progress if progress.phase == "attack"]
    assert steps == [(step, 6) for step in range(1, 7)]


def test_the_result_says_what_was_asked_and_what_came_out(finished: Run) -> None:
    result = finished.artifacts.result()
    assert (result.object, result.label_name, result.classifier, result.image_size) == (
        "chair",
        "chair",
        "tiny",
        (128, 128),
    )
    assert (result.epsilon, result.alpha, result.tau, result.steps, result.seed) == (0.1, 0.03, None, 6, 0)
    assert result.target.a_before > 0
    assert result.held_out is not None
    assert (result.target.views, result.held_out.views) == (4, 3)
    assert (len(result.views), len(result.held_out_views)) == (4, 3)
    assert result.surrogate is not None
    assert result.surrogate.a_before == result.target.a_before
    assert result.surrogate_model == "calibrated"
    assert result.probe_renders > 0
    assert {"prepare", "calibrate", "attack"} <= set(result.seconds)
    assert set(result.fidelity) == {"error", "correlation", "slope", "explained"}
    assert all(view.after is not None for view in result.views + result.held_out_views)


def test_the_figures_of_the_change_are_those_of_the_files(finished: Run) -> None:
    result, before = finished.artifacts.result(), load_object(CHAIR.read())
    after = load_object(finished.artifacts.read("adversarial.zip"))
    change = np.concatenate(
        [np.abs(after.textures[n].astype(int) - t).reshape(-1, 3) for n, t in before.textures.items()]
    )
    altered = change.any(axis=1)
    assert change.max() == 25  # floor(0.1 * 255)
    assert result.texels_altered == pytest.approx(altered.mean())
    assert result.mean_texel_change == pytest.approx(change[altered].mean() / 255)
    clean, painted = (unpack_arrays(finished.artifacts.read(f"{name}.npz")) for name in ("views_before", "views_after"))
    seen = max(np.abs(clean[k].astype(int) - painted[k]).max() for k in ("own", "held_out"))
    assert result.max_view_change == pytest.approx(seen / 255)


def test_the_repainted_object_differs_in_its_albedo_files_alone(finished: Run) -> None:
    before, after = load_object(CHAIR.read()), load_object(finished.artifacts.read("adversarial.zip"))
    assert list(after.files) == list(before.files)
    assert {name for name in before.files if after.files[name] != before.files[name]} == set(before.textures)


def test_what_is_judged_is_the_texture_that_is_saved(finished: Run, library: Library) -> None:
    scene = open_scene(SPEC, library=library, target=FakeTarget())
    saved = load_object(finished.artifacts.read("adversarial.zip"))
    images = FakeTarget().render(saved, scene.views, size=scene.size)
    assert (unpack_arrays(finished.artifacts.read("views_after.npz"))["own"] == images).all()
    verdicts = scene.classifier.predict(images).argmax(axis=1)
    assert [view.after for view in finished.artifacts.result().views] == verdicts.tolist()
    assert finished.artifacts.result().target.a_after == (verdicts == scene.label).mean()


def test_the_pictures_can_be_seen(finished: Run) -> None:
    for name in PICTURES:
        with Image.open(io.BytesIO(finished.artifacts.read(name))) as picture:
            assert min(picture.size) > 100
            assert len(picture.convert("RGB").getcolors(2**24) or []) > 10


def test_each_phase_may_run_in_another_process_and_twice(finished: Run, library: Library) -> None:
    again = run(SPEC, library, new=True, times=2)
    assert again.artifacts.lasting() == finished.artifacts.lasting()


def test_an_attack_that_has_won_all_views_safely_takes_no_further_steps(
    library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trompe_server.attack.search.SAFE_ENOUGH", 1.1)
    easy = QUICK.model_copy(update={"epsilon": 0.5, "alpha": 0.1, "steps": 30})
    once, anew = run(easy, library), run(easy, library, new=True)
    result = once.artifacts.result()
    assert result.spec.steps == 30
    assert 2 < result.steps < 30
    assert result.target.a_after == 0
    taken = [progress.step for progress in once.progress if progress.step is not None]
    assert taken == list(range(1, result.steps + 1))
    assert anew.artifacts.lasting() == once.artifacts.lasting()


@pytest.mark.parametrize("options", [{"diverse": True}, {"keep": 0.03}], ids=str)
def test_options_of_the_search_change_the_texture_and_survive_restarts(
    finished: Run, library: Library, options: dict[str, Any]
) -> None:
    spec = SPEC.model_copy(update=options)
    once, anew = run(spec, library), run(spec, library, new=True)
    assert anew.artifacts.lasting() == once.artifacts.lasting()
    assert once.reports["judge"].state is JobState.succeeded
    result, plain = once.artifacts.result(), finished.artifacts.result()
    assert result.steps == plain.steps == 6
    assert once.artifacts.files["adversarial.zip"] != finished.artifacts.files["adversarial.zip"]
    assert result.texels_altered is not None
    assert result.texels_altered <= options.get("keep", 1.0) + 1e-6
    assert once.artifacts.files["saliency.npz"] == finished.artifacts.files["saliency.npz"]


def test_few_texels_are_chosen_once_and_again_where_their_file_is_damaged(library: Library) -> None:
    spec, artifacts = SPEC.model_copy(update={"keep": 0.03}), MemoryArtifacts()

    def phase(name: str) -> None:
        open_pipeline(spec, library=library, artifacts=artifacts, target=FakeTarget()).run(name, told.append)

    told = list[Progress]()
    phase("prepare")
    phase("calibrate")
    told.clear()
    phase("attack-000")
    assert [progress.step for progress in told] == [None] * 8 + [1, 2, 3, 4, 5]
    chosen = artifacts.files["few_texels.npz"]
    artifacts.files["few_texels.npz"] = chosen[:-40]
    with pytest.raises(DamagedFileError, match="few_texels"):
        phase("attack-001")
    phase("attack-000")
    assert artifacts.files["few_texels.npz"] == chosen


def test_a_meter_sees_networks_behind_wrappers(library: Library) -> None:
    meter = Meter()
    spec = QUICK.model_copy(update={"diverse": True})
    job = open_pipeline(spec, library=library, artifacts=MemoryArtifacts(), target=FakeTarget(), meter=meter)
    for name in job.phases()[:-1]:
        meter.take()
        job.run(name, lambda _: None)
    taken = meter.take()
    assert taken["classifier_images"] == 2 * 4
    assert taken["classifier_seconds"] > 0


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"tau": 0.05},
        {"keep": 0.1},
        {"tau": 0.05, "keep": 0.1},
        {"diverse": True},
        {"restarts": 2, "optimiser": "pgd"},
        {"restarts": 1, "optimiser": "auto"},
        {"optimiser": "auto", "diverse": True},
        {"pool": 12, "background": ["white", "black"], "keep": 0.1},
    ],
    ids=str,
)
def test_all_images_that_the_search_showed_the_classifier_are_counted(
    library: Library, options: dict[str, Any]
) -> None:
    meter, artifacts, shown = Meter(), MemoryArtifacts(), 0.0
    spec = QUICK.model_copy(update={"steps": 6} | options)
    job = open_pipeline(spec, library=library, artifacts=artifacts, target=FakeTarget(), meter=meter)
    for name in job.phases():
        meter.take()
        job.run(name, lambda _: None)
        shown += meter.take()["classifier_images"] if name.startswith("attack") else 0
    saliency = spec.n_views if spec.tau is not None else 0  # was made beforehand, for the report as well
    assert artifacts.result().evaluations == shown + saliency


class Counting(FakeTarget):
    """Counts the images it is asked for."""

    def __init__(self) -> None:
        super().__init__()
        object.__setattr__(self, "images", 0)

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        object.__setattr__(self, "images", self.images + len(views))
        return super().render(obj, views, **options)


def test_a_second_job_on_the_same_object_and_views_spends_no_probe(library: Library) -> None:
    targets = [Counting(), Counting()]
    spec = SPEC.model_copy(update={"steps": 1})
    first = run(spec, library, target=targets[0])
    second = run(
        spec.model_copy(update={"epsilon": 0.05, "alpha": 0.01}), library, target=targets[1], calibrations=True
    )
    assert first.artifacts.result().probe_renders == targets[0].images - targets[1].images > 0
    assert second.artifacts.result().probe_renders == 0
    assert "earlier job" in second.artifacts.result().surrogate_reason
    assert second.artifacts.result().fidelity == first.artifacts.result().fidelity


def test_the_views_are_rasterised_while_the_renderer_is_busy_with_probes(
    library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A renderer that shows no more than the trial views before all views are rasterised."""
    done, prepared = threading.Event(), list[tuple[View, ...]]()

    def prepare(obj: Object3D, views: Sequence[View], **options: Any) -> Geometry:
        geometry = prepare_geometry(obj, views, **options)
        if len(views) > 4:
            prepared.append(tuple(views))
            done.set()
        return geometry

    class Patient(FakeTarget):
        def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
            if obj.textures[next(iter(obj.textures))].shape == (4, 4, 3) and len(views) > 4:
                assert done.wait(60)
            return super().render(obj, views, **options)

    for module in ("attack_job", "surrogate.calibration"):
        monkeypatch.setattr(f"trompe_server.{module}.prepare_geometry", prepare)
    spec = SPEC.model_copy(update={"azimuths": 5, "elevations": 2, "steps": 1})
    job = open_pipeline(spec, library=library, artifacts=MemoryArtifacts(), target=Patient())
    shutil.rmtree(library.calibrations.folder, ignore_errors=True)
    for phase in ("prepare", "calibrate", "attack-000"):
        job.run(phase, lambda _: None)
    assert prepared == [job.scene.views]


def test_a_calibration_serves_only_the_renderer_it_was_made_with(library: Library) -> None:
    spec = SPEC.model_copy(update={"steps": 1})
    run(spec, library)
    assert run(spec, library, target=DarkTarget(), calibrations=True).artifacts.result().probe_renders > 0


def test_a_damaged_calibration_is_made_anew(library: Library) -> None:
    spec = SPEC.model_copy(update={"steps": 1})
    whole = run(spec, library)
    (stored,) = library.calibrations.folder.iterdir()
    stored.write_bytes(stored.read_bytes()[:-100])
    again = run(spec, library, calibrations=True)
    assert again.artifacts.lasting() == whole.artifacts.lasting()
    assert len(list(library.calibrations.folder.iterdir())) == 1


def test_a_pool_of_random_views_takes_the_place_of_the_grid(library: Library) -> None:
    pool = run(SPEC.model_copy(update={"pool": 50, "steps": 2, "surrogate": "diffuse"}), library)
    result = pool.artifacts.result()
    assert result.target.views == len(result.views) == 50
    assert len({view.azimuth for view in result.views}) == 50
    assert len({view.light_azimuth for view in result.views}) == 50
    assert not {view.azimuth for view in result.views} & {view.azimuth for view in result.held_out_views}


def test_the_seed_changes_the_held_out_views_and_only_them_of_the_images(finished: Run, library: Library) -> None:
    job = open_pipeline(
        SPEC.model_copy(update={"seed": 1}), library=library, artifacts=MemoryArtifacts(), target=FakeTarget()
    )
    job.run("prepare", lambda _: None)
    clean, other = (unpack_arrays(files.read("views_before.npz")) for files in (finished.artifacts, job.artifacts))
    assert (clean["own"] == other["own"]).all()
    assert (clean["held_out"] != other["held_out"]).any()


def test_an_object_that_is_never_recognised_is_not_applicable(library: Library) -> None:
    ended = run(QUICK.model_copy(update={"label": "ball"}), library)
    report = ended.reports["prepare"]
    assert (list(ended.reports), report.state) == (["prepare"], JobState.not_applicable)
    assert report.note is not None
    for word in ("n.a.", "'ball'", "none of the 4", "--label", "--background"):
        assert word in report.note
    assert set(report.public) == {"result.json", "saliency.png", "views_before.npz"}
    result = ended.artifacts.result()
    assert (result.target.a_before, result.target.a_after, result.target.a_drop) == (0, None, None)
    assert (result.surrogate, result.texels_altered, result.transfer_gap) == (None, None, None)
    assert report.note in result.warnings


def test_a_job_without_held_out_views_or_with_one_view_works_too(library: Library) -> None:
    ended = run(QUICK.model_copy(update={"held_out": 0, "azimuths": 1, "elevations": 1}), library)
    result = ended.artifacts.result()
    assert ended.reports["judge"].state is JobState.succeeded
    assert (result.held_out, result.held_out_views, result.target.views) == (None, [], 1)


def test_the_higher_the_threshold_the_fewer_texels_are_altered(library: Library) -> None:
    altered = [
        run(QUICK.model_copy(update={"tau": tau}), library).artifacts.result().texels_altered
        for tau in (None, 0.05, 0.2)
    ]
    shares = [share for share in altered if share is not None]
    assert len(set(shares)) == 3
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] > 0


@pytest.mark.parametrize("scope", get_args(SaliencyScope))
def test_the_threshold_stops_the_gradient_of_the_pixels_below_it(library: Library, scope: SaliencyScope) -> None:
    spec = QUICK.model_copy(update={"tau": 0.2, "saliency_scope": scope})
    artifacts, scene = run(spec, library).artifacts, open_scene(spec, library=library, target=FakeTarget())
    maps = torch.from_numpy(unpack_arrays(artifacts.read("saliency.npz"))["maps"].astype(np.float32))
    geometry = prepare_geometry(scene.obj, scene.views, size=scene.size, sampling=SamplingModel())
    textures, masks = textures_of(scene.obj), saliency_masks(maps, 0.2)
    expected = attack(
        start(textures),
        textures,
        diffuse_surrogate(geometry, scene.views),
        scene.classifier,
        goal=Goal(scene.label),
        budget=Budget(spec.epsilon, spec.alpha),
        optimiser=spec.optimiser,
        steps=2,
        masks=masks,
    )
    done = load_state(artifacts.read("state-1.npz"))
    assert done.step == 2
    for name, delta in expected.deltas.items():
        assert torch.equal(done.deltas[name], delta)


class DimTarget(FakeTarget):
    """A target whose first view is nearly black, so that hardly a pixel of it matters."""

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        images = super().render(obj, views, **options)
        images[0] //= 32
        return images


def test_each_view_alone_gives_pixels_of_a_view_that_all_views_together_leave_out(library: Library) -> None:
    together, alone = (
        run(QUICK.model_copy(update={"tau": 0.5, "saliency_scope": scope}), library, target=DimTarget()).artifacts.files
        for scope in get_args(SaliencyScope)
    )
    over_all, each = (unpack_arrays(files["saliency.npz"])["maps"] for files in (together, alone))
    assert each.max((1, 2)).tolist() == [1.0] * len(each)
    assert over_all.max() == 1
    assert over_all[0].max() < 0.5
    scene = open_scene(QUICK, library=library, target=FakeTarget())
    own = unpack_arrays(alone[f"{VIEWS_BEFORE}.npz"])["own"]
    rescaled = rescale_each_view(saliency(own, scene.members, goal=scene.goal))
    np.testing.assert_array_equal(each, rescaled.half())  # rounded once, after it was rescaled
    shares = [json.loads(files["result.json"])["texels_altered"] for files in (together, alone)]
    assert 0 < shares[0] < shares[1]
    for name in ("saliency.png", "saliency_textures.png", "saliency_object.png"):
        assert together[name] != alone[name]


def saliency_of(target: TargetRenderer, library: Library) -> NDArray[np.float16]:
    artifacts = MemoryArtifacts()
    open_pipeline(QUICK, library=library, artifacts=artifacts, target=target).run("prepare", lambda _: None)
    return unpack_arrays(artifacts.read("saliency.npz"))["maps"]


def test_saliency_is_that_of_the_targets_images(library: Library) -> None:
    bright, dark = saliency_of(FakeTarget(), library), saliency_of(DarkTarget(), library)
    assert bright.shape == (4, 128, 128)
    assert (bright.min(), bright.max()) == (0, 1)
    assert (bright != dark).mean() > 0.1


def test_judges_say_what_they_think_of_the_same_images(library: Library) -> None:
    result = run(QUICK.model_copy(update={"judges": ["tiny"]}), library).artifacts.result()
    (judge,) = result.judges
    assert (judge.classifier, judge.target, judge.held_out) == ("tiny", result.target, result.held_out)


# The scene


def scene_of(library: Library, **changes: object) -> Scene:
    return open_scene(SPEC.model_copy(update=changes), library=library, target=FakeTarget())


def test_a_shipped_object_is_looked_at_as_it_was_made_for(library: Library) -> None:
    scene = scene_of(library)
    assert (scene.object_name, scene.label, scene.size) == ("chair", 3, (128, 128))
    assert (len(scene.views), len(scene.held_out)) == (4, 3)
    assert {view.camera.distance for view in scene.views} == {CHAIR.distance}
    assert {view.camera.elevation for view in scene.views} == set(CHAIR.elevation)
    assert {view.background for view in scene.views} == {(255, 255, 255)}


def test_distance_and_elevation_can_be_asked_for(library: Library) -> None:
    scene = scene_of(library, distance=2.5, elevation=(0.0, 0.0))
    assert {(view.camera.distance, view.camera.elevation) for view in scene.views} == {(2.5, 0)}


def test_an_uploaded_object_is_framed_by_its_size(tmp_path: Path, mug: Object3D) -> None:
    library = Library(tmp_path)
    library.add_object(io.BytesIO(mug.to_zip()), "cup.zip")
    scene = scene_of(library, object="cup", label="mug")
    assert {round(view.camera.distance / mug.radius, 3) for view in scene.views} == {2.1}
    assert {view.camera.elevation for view in scene.views} == {0, 50}


@pytest.mark.parametrize(
    ("background", "colour"), [("black", (0, 0, 0)), ("#0a64ff", (10, 100, 255)), ("#000000", (0, 0, 0))]
)
def test_a_background_can_be_a_colour(library: Library, background: str, colour: tuple[int, int, int]) -> None:
    scene = scene_of(library, background=[background])
    assert {view.background for view in (*scene.views, *scene.held_out)} == {colour}
    assert isinstance(scene.target, FakeTarget)


@pytest.mark.parametrize("background", ["#xyzxyz", "#12 34 ", "#123", "red", ""])
def test_a_background_that_is_nothing_known_is_refused(library: Library, background: str) -> None:
    with pytest.raises(NotFoundError, match="background"):
        scene_of(library, background=[background])


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        pytest.param({"object": "sofa"}, NotFoundError, "sofa.*chair", id="object"),
        pytest.param({"classifier": "resnet"}, NotFoundError, "resnet.*tiny", id="classifier"),
        pytest.param({"judges": ["resnet"]}, NotFoundError, "resnet", id="judge"),
        pytest.param({"label": "chairs"}, LabelError, "did you mean 'chair'", id="label"),
        pytest.param({"label": 8}, LabelError, r"0\.\.7", id="index"),
    ],
)
def test_what_is_unknown_is_named_with_what_is_known(
    library: Library, changes: dict[str, object], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        scene_of(library, **changes)


def test_a_classifier_without_gradients_cannot_be_attacked(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    class Opaque:
        """Gives scores only, as an .onnx file does."""

        name, image_size, n_classes, classes = "net", (8, 8), 2, None

        def predict(self, images: Image8) -> NDArray[np.float32]:
            return np.zeros((len(images), 2), np.float32)

    info = ClassifierInfo(id="net", name="net", white_box=False, image_size=(8, 8), n_classes=2, classes=None)
    monkeypatch.setattr(library, "classifier", lambda _: info)
    monkeypatch.setattr(library, "classifier_path", lambda _: "net.onnx")
    monkeypatch.setattr("trompe_server.scene.load_classifier", lambda *_, **__: Opaque())
    with pytest.raises(ClassifierError, match=r"'net'.*no gradients.*\.onnx.*\.pt2.*judge.*--queries"):
        scene_of(library, classifier="net", label=0)


# A photograph behind the object


@pytest.fixture
def photo() -> Image8:
    """(90, 60, 3), in large squares of random colours."""
    image = np.random.default_rng(0).integers(0, 256, (90, 60, 3), dtype=np.uint8)
    return np.kron(image[::15, ::15], np.ones((15, 15, 1), np.uint8))


def test_an_uploaded_photograph_stands_behind_the_object(tmp_path: Path, photo: Image8) -> None:
    library = Library(tmp_path)
    info = library.add_background(encode_png(photo), "wall.png")
    scene = scene_of(library, background=[info.id])
    image = scene.target.render(scene.obj, scene.views[:1], size=scene.size)[0]
    assert isinstance(scene.target, BackdropTarget)
    black = dataclasses.replace(scene.views[0], background=(0, 0, 0))
    plain = FakeTarget().render(scene.obj, [black], size=scene.size)[0]
    there = (plain != 0).any(axis=-1)
    assert (image[there] == plain[there]).all()
    assert len(np.unique(image[~there], axis=0)) > 50


def test_a_photograph_is_what_compositing_by_hand_gives(mug: Object3D, photo: Image8) -> None:
    views, size = [View(Camera(0.157, 30, 20), backdrop="photo"), View(Camera(0.3, 90, 0), backdrop="photo")], (40, 60)
    frames: list[None] = []
    images = BackdropTarget(FakeTarget(), {"photo": photo}).render(
        mug, views, size=size, on_frame=lambda: frames.append(None)
    )
    cropped = Image.fromarray(photo[25:65]).resize((60, 40), Image.Resampling.LANCZOS)
    for image, view in zip(images, views, strict=True):
        black, white = (
            FakeTarget().render(mug, [dataclasses.replace(view, background=colour)], size=size)[0]
            for colour in ((0, 0, 0), (255, 255, 255))
        )
        free = (black == 0).all(axis=-1) & (white == 255).all(axis=-1)
        expected = np.where(free[..., None], np.asarray(cropped), black)
        assert np.abs(image.astype(int) - expected).max() <= 1
        assert 0.1 < free.mean() < 0.97
    assert len(frames) == len(views)


def test_a_plain_photograph_is_the_same_as_a_uniform_background_at_soft_edges_too(
    mug: Object3D, target: SailenvTarget
) -> None:
    view, size = View(Camera(0.157, 30, 20), background=(120, 60, 200)), (64, 64)
    picture = np.full((5, 5, 3), view.background, np.uint8)
    pictured = [dataclasses.replace(view, backdrop="plain"), view]
    composed = BackdropTarget(target, {"plain": picture}).render(mug, pictured, size=size)
    assert np.abs(composed[0].astype(int) - composed[1]).max() <= 2
    assert (composed[1] == target.render(mug, [view], size=size)).all()


class PatchyTarget(FakeTarget):
    """A target whose probes of one view are darker than what it shows else."""

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        images = super().render(obj, views, **options)
        if obj.textures[next(iter(obj.textures))].shape == (4, 4, 3):
            images[1:2] //= 2
        return images


def test_views_on_which_the_surrogate_is_far_off_are_named(library: Library) -> None:
    spec = SPEC.model_copy(update={"steps": 1})
    warnings = run(spec, library, target=PatchyTarget()).artifacts.result().warnings
    (warning,) = [found for found in warnings if "off by more" in found]
    view = open_scene(spec, library=library, target=FakeTarget()).views[1].camera
    assert f"1 (azimuth {view.azimuth:.0f}, elevation {view.elevation:.0f})" in warning


class StubbornTarget(FakeTarget):
    """A target that shows no repaint to a camera, but probes."""

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.camera, self.clean = camera, load_object(CHAIR.read())

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        images = super().render(obj, views, **options)
        if obj.textures[next(iter(obj.textures))].shape != (4, 4, 3):
            clean = super().render(self.clean, views, **options)
            for index, view in enumerate(views):
                images[index] = clean[index] if view.camera == self.camera else images[index]
        return images


def test_views_on_which_the_attack_changed_something_else_than_predicted_are_named(library: Library) -> None:
    first = open_scene(SPEC, library=library, target=FakeTarget()).views[0].camera
    result = run(SPEC, library, target=StubbornTarget(first)).artifacts.result()
    (warning,) = [found for found in result.warnings if "not as the surrogate predicted" in found]
    assert f"on views 0 (azimuth {first.azimuth:.0f}, elevation {first.elevation:.0f}): " in warning


def test_what_the_surrogate_predicted_of_each_attacked_view_is_told(library: Library, target: SailenvTarget) -> None:
    result = run(SPEC, library, target=target).artifacts.result()
    for view in result.views:
        assert view.fidelity is not None
        assert view.fidelity.correlation > 0.97
        assert 0.9 < view.fidelity.slope < 1.1
        assert view.fidelity.explained > 0.9
        assert view.fidelity.error < 1.5 / 255
        assert 0 < view.fidelity.change <= SPEC.epsilon * 1.5
    assert not any(view.fidelity for view in result.held_out_views)
    assert not [found for found in result.warnings if "on views" in found]


def test_a_surrogate_that_asked_for_no_probes_names_its_views_too(library: Library) -> None:
    warnings = run(QUICK, library, target=DarkTarget()).artifacts.result().warnings
    assert [found for found in warnings if "off by more than 3/255 on views" in found]


def test_an_attack_that_came_to_little_says_so_and_what_to_try(library: Library) -> None:
    spec = SPEC.model_copy(update={"epsilon": 1 / 255, "alpha": 1 / 255, "steps": 1})
    result = run(spec, library).artifacts.result()
    assert result.target.a_drop == 0
    assert [
        warning for warning in result.warnings if "came to little: A_drop 0.00" in warning and "--epsilon" in warning
    ]


@pytest.mark.parametrize(("tau", "why"), [(None, "gradient is zero on every view"), (0.05, "through the pixels")])
def test_an_attack_that_altered_nothing_says_so_and_why(
    tau: float | None, why: str, library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attack_job, "attack", lambda state, *_, steps, **__: dataclasses.replace(state, step=steps))
    done = run(QUICK.model_copy(update={"tau": tau}), library)
    warnings = json.loads(done.artifacts.read("result.json"))["warnings"]
    (unaltered,) = [warning for warning in warnings if "No texel was altered" in warning]
    assert why in unaltered


def test_views_draw_their_backgrounds_from_several(tmp_path: Path, photo: Image8) -> None:
    library = Library(tmp_path)
    picture = library.add_background(encode_png(photo), "wall.png").id
    scene = scene_of(library, background=["black", "#ff0000", picture], held_out=30)
    for views in (scene.views, scene.held_out):
        seen = {view.backdrop or view.background for view in views}
        assert seen <= {(0, 0, 0), (255, 0, 0), picture}
    assert len({view.backdrop or view.background for view in scene.held_out}) == 3
    assert scene.backdrops[picture].shape == (*scene.size, 3)
    again = scene_of(library, background=["black", "#ff0000", picture], held_out=30)
    assert again.views == scene.views


def test_the_attack_knows_what_its_views_stand_in_front_of(tmp_path: Path, photo: Image8) -> None:
    library = Library(tmp_path)
    picture = library.add_background(encode_png(photo), "wall.png").id
    scene = scene_of(library, background=["black", "#ff0000", picture], pool=30)
    assert scene.backgrounds is not None
    for view, number in zip(scene.views, scene.backgrounds.own, strict=True):
        expected = scene.backdrops[picture] if view.backdrop else np.array(view.background, np.uint8)
        assert (scene.backgrounds.pictures[number].numpy() == expected).all()
    assert scene_of(library, background=["black"], pool=30).backgrounds is None


class Liar(FakeTarget):
    """A target that shows noise wherever the result could be seen: held-out views, and all from the attack's start."""

    def __init__(self, own: Sequence[View]) -> None:
        self.own, self.judging = set(own), False

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        images = super().render(obj, views, **options)
        noise = np.random.default_rng(0)
        for image, view in zip(images, views, strict=True):
            if self.judging or view not in self.own:
                image[:] = noise.integers(0, 256, image.shape)
        return images


@pytest.mark.parametrize(
    "options",
    [{}, {"tau": 0.05}, {"keep": 0.2}, {"diverse": True}, {"restarts": 1, "optimiser": "auto"}, {"pool": 12}],
    ids=str,
)
def test_what_the_result_is_judged_on_cannot_influence_the_texture(library: Library, options: dict[str, Any]) -> None:
    spec = SPEC.model_copy(update=options)
    honest = run(spec, library).artifacts
    shutil.rmtree(library.calibrations.folder, ignore_errors=True)
    target, artifacts = Liar(open_scene(spec, library=library, target=FakeTarget()).views), MemoryArtifacts()
    job = open_pipeline(spec, library=library, artifacts=artifacts, target=target)
    for phase in job.phases():
        target.judging = phase not in {"prepare", "calibrate"}
        job.run(phase, lambda _: None)
    assert artifacts.files["adversarial.zip"] == honest.files["adversarial.zip"]
    assert artifacts.result().target.a_after != honest.result().target.a_after or honest.result().target.a_after == 0
    assert artifacts.result().held_out != honest.result().held_out
