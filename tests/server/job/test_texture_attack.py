"""Whole jobs over a fake target: phases, resumption, files, counts and calibrations."""

import io
import threading
import time
from collections.abc import Sequence
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from tests.fakes import FakeTarget
from tests.job_runs import CHAIR, DarkTarget, MemoryArtifacts, Recorder, Run, opened, run_job, setup_of, spec_of
from trompe_server.attack import Budget, Goal, attack, load_state, saliency_masks, start
from trompe_server.classifiers import NetworkClassifier, load_classifier
from trompe_server.job import setup, texture_attack
from trompe_server.job.protocol import DamagedFileError
from trompe_server.job.texture_attack import CHUNK
from trompe_server.library import Library
from trompe_server.renderers import TargetRenderer
from trompe_server.surrogate import Geometry, SamplingModel, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.api import JobState, Progress
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

WHOLE: dict[str, Any] = {"surrogate": "calibrated", "steps": 6}
"""A job that calibrates, and attacks in two phases."""

PICTURES = {
    *("contact_sheet.png", "difference.png", "predictions.png", "textures.png", "thumbnail.png"),
    *("saliency.png", "saliency_object.png", "saliency_textures.png"),
}
MODELS = {"chair-adversarial.zip", "chair-adversarial.glb"}
IMAGES = {"views_before.npz", "views_after.npz"}
Image8 = NDArray[np.uint8]


@pytest.fixture(scope="module")
def timed(library: Library) -> tuple[Run, float]:
    """A finished job and the seconds that it took."""
    began = time.perf_counter()
    run = run_job(spec_of(**WHOLE), library)
    return run, time.perf_counter() - began


@pytest.fixture(scope="module")
def finished(timed: tuple[Run, float]) -> Run:
    return timed[0]


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
    assert fractions[-1] < finished.reports["judge"].progress.fraction == 1
    steps = [(progress.step, progress.steps) for progress in finished.progress if progress.phase == "attack"]
    assert steps == [(step, 6) for step in range(1, 7)]


def test_the_time_left_is_told_from_the_second_step_on_as_a_range_that_falls(finished: Run) -> None:
    left = [(each.eta_least_seconds, each.eta_seconds) for each in finished.progress if each.phase == "attack"]
    assert left[0] == (None, None)
    ranges = [(least, most) for least, most in left if least is not None and most is not None]
    assert len(ranges) == len(left) - 1
    assert all(0 < least <= most for least, most in ranges)
    judging = [each.eta_seconds for each in finished.progress if each.phase == "judge" and each.eta_seconds]
    assert judging == sorted(judging, reverse=True)
    assert all(each.eta_seconds is None for each in finished.progress if each.phase in {"prepare", "calibrate"})
    assert finished.reports["judge"].progress.eta_seconds is None


@pytest.mark.parametrize("new", [False, True], ids=["one process", "a process for each phase"])
def test_the_seconds_of_a_result_sum_to_those_of_the_job(library: Library, timed: tuple[Run, float], new: bool) -> None:
    run, took = timed
    if new:
        began = time.perf_counter()
        run = run_job(spec_of(steps=6), library, new=True)
        took = time.perf_counter() - began
    assert list(run.result.seconds) == ["open", "prepare", "calibrate", "attack", "judge", "report"]
    assert all(seconds > 0 for seconds in run.result.seconds.values())
    assert 0.8 * took < sum(run.result.seconds.values()) < took + 0.1


def test_the_result_holds_options_and_figures(finished: Run) -> None:
    result = finished.result
    named = (result.object, result.label_name, result.classifier, result.image_size)
    assert named == ("chair", "chair", "tiny", (128, 128))
    assert (result.epsilon, result.alpha, result.tau, result.steps, result.seed) == (0.1, 0.03, None, 6, 0)
    assert result.spec == spec_of(**WHOLE)
    assert result.target.a_before > 0
    assert result.held_out is not None
    assert (result.target.views, result.held_out.views) == (4, 3)
    assert (len(result.views), len(result.held_out_views)) == (4, 3)
    assert result.surrogate is not None
    assert result.surrogate.a_before == result.target.a_before
    assert result.surrogate_model == "calibrated"
    assert result.probe_renders > 0
    assert set(result.fidelity) == {"error", "correlation", "slope", "explained"}
    assert all(view.after is not None for view in result.views + result.held_out_views)


def test_the_figures_of_the_change_are_those_of_the_files(finished: Run) -> None:
    result, new = finished.result, finished.artifacts.painted()
    change = np.concatenate([np.abs(new.textures[n].astype(int) - t).reshape(-1, 3) for n, t in CHAIR.textures.items()])
    altered = change.any(axis=1)
    assert change.max() == 25  # floor(0.1 * 255)
    assert result.texels_altered == pytest.approx(altered.mean())
    assert result.mean_texel_change == pytest.approx(change[altered].mean() / 255)
    clean, painted = (finished.artifacts.arrays(name) for name in ("views_before", "views_after"))
    seen = max(np.abs(clean[k].astype(int) - painted[k]).max() for k in ("own", "held_out"))
    assert result.max_view_change == pytest.approx(seen / 255)


def test_the_saved_texture_is_judged(finished: Run, library: Library) -> None:
    setup = setup_of(library, **WHOLE)
    images = FakeTarget().render(finished.artifacts.painted(), setup.views, size=setup.size)
    assert (finished.artifacts.arrays("views_after")["own"] == images).all()
    classes = setup.classifier.predict(images).argmax(axis=1)
    assert [view.after for view in finished.result.views] == classes.tolist()
    assert finished.result.target.a_after == np.isin(classes, setup.labels).mean()


def test_the_pictures_show_something(finished: Run) -> None:
    for name in PICTURES:
        with Image.open(io.BytesIO(finished.artifacts.read(name))) as picture:
            assert min(picture.size) > 100
            assert len(picture.convert("RGB").getcolors(2**24) or []) > 10


@pytest.mark.usefixtures("pictures")
def test_each_phase_can_run_in_another_process_and_twice(finished: Run, library: Library) -> None:
    again = run_job(spec_of(**WHOLE), library, new=True, times=2)
    assert again.artifacts.lasting() == finished.artifacts.lasting()


def test_an_attack_with_all_views_safely_won_takes_no_further_steps_and_goes_on_with_the_judgement(
    library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trompe_server.attack.search.SAFE_ENOUGH", 1.1)
    easy = spec_of(epsilon=0.5, alpha=0.1, steps=90)
    once, anew = run_job(easy, library), run_job(easy, library, new=True)
    *_, last, judge = once.reports
    assert (judge, once.reports[last].then) == ("judge", "judge")
    assert len(once.reports) < len(opened(easy, library, once.artifacts).phases())
    result = once.result
    assert result.spec.search.steps == 90
    assert 2 < result.steps < 90
    assert once.counts()["attack_steps"] == result.steps
    assert result.target.a_after == 0
    taken = [progress.step for progress in once.progress if progress.step is not None]
    assert taken == list(range(1, result.steps + 1))
    assert anew.artifacts.lasting() == once.artifacts.lasting()
    end = once.artifacts.files["state-end.npz"]
    once.artifacts.files["state-end.npz"] = end[:-40]
    for phase in ("judge", "attack-017"):
        with pytest.raises(DamagedFileError):
            opened(easy, library, once.artifacts).run(phase, lambda _: None)
    opened(easy, library, once.artifacts).run(last, lambda _: None)
    assert once.artifacts.files["state-end.npz"] == end


@pytest.fixture(scope="module")
def six_steps(library: Library) -> Run:
    return run_job(spec_of(steps=6), library)


@pytest.mark.parametrize("options", [{"image_pipeline": "transfer"}, {"keep": 0.03}], ids=str)
def test_options_of_the_search_change_the_texture_and_survive_interruption(
    library: Library, six_steps: Run, options: dict[str, Any]
) -> None:
    spec = spec_of(steps=6, **options)
    once, anew = run_job(spec, library), run_job(spec, library, new=True)
    assert anew.artifacts.lasting() == once.artifacts.lasting()
    assert once.reports["judge"].state is JobState.succeeded
    assert once.result.steps == 6
    assert once.artifacts.files["chair-adversarial.zip"] != six_steps.artifacts.files["chair-adversarial.zip"]
    moved, all_moved = (each.result.texels_altered or 0.0 for each in (once, six_steps))
    assert 0 < moved <= options.get("keep", 1.0) + 1e-6
    assert "keep" not in options or all_moved > 0.03
    assert once.artifacts.files["saliency.npz"] == six_steps.artifacts.files["saliency.npz"]


def test_few_texels_are_chosen_once_and_again_if_their_file_is_damaged(library: Library) -> None:
    spec, artifacts, seen = spec_of(keep=0.03, steps=6), MemoryArtifacts(), list[Progress]()

    def phase(name: str) -> None:
        seen.clear()
        opened(spec, library, artifacts).run(name, seen.append)

    for name in ("prepare", "calibrate", "attack-000"):
        phase(name)
    assert [progress.step for progress in seen] == [None] * 8 + [1, 2, 3, 4, 5]
    chosen = artifacts.files["few_texels.npz"]
    artifacts.files["few_texels.npz"] = chosen[:-40]
    with pytest.raises(DamagedFileError, match="few_texels"):
        phase("attack-001")
    phase("attack-000")
    assert artifacts.files["few_texels.npz"] == chosen


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"tau": 0.05, "keep": 0.1},
        {"image_pipeline": "transfer"},
        {"ensemble": ["tiny"]},
        {"pool": 12, "background": ["white", "black"], "keep": 0.1},
    ],
    ids=str,
)
def test_shown_images_are_counted(library: Library, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    shown, during = {"attack": 0}, [""]
    logits = NetworkClassifier.logits

    def counted(self: NetworkClassifier, images: torch.Tensor) -> torch.Tensor:
        shown[during[0]] = shown.get(during[0], 0) + len(images)
        return logits(self, images)

    monkeypatch.setattr(NetworkClassifier, "logits", counted)
    spec, run = spec_of(**{"steps": 6} | options), Run()
    job = opened(spec, library, run.artifacts)
    for name in job.phases():
        during[0] = name.partition("-")[0]
        run.reports[name] = job.run(name, lambda _: None)
    saliency = spec.views.count if spec.paint.tau is not None else 0  # computed earlier, for the report as well
    members = 1 + len(spec.victim.ensemble)
    assert run.result.evaluations == shown["attack"] / members + saliency
    assert run.result.evaluations == run.counts("attack")["classifier_images"]
    assert run.counts()["classifier_images"] == run.counts("attack")["classifier_images"]


@pytest.mark.usefixtures("measured_tone")
def test_a_second_job_on_the_same_object_and_views_renders_no_probe(library: Library) -> None:
    one, other = Recorder(), Recorder()
    spec = {"surrogate": "calibrated", "steps": 1}
    first = run_job(spec_of(**spec), library, target=one)
    second = run_job(spec_of(**spec, epsilon=0.05, alpha=0.01), library, target=other, known=True)
    assert first.result.probe_renders == one.images - other.images > 0
    assert first.counts()["target_renders"] == one.images
    assert second.result.probe_renders == 0
    assert "earlier job" in second.result.surrogate_reason
    assert second.result.fidelity == first.result.fidelity


def test_views_are_rasterised_while_a_renderer_draws_probes(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    """The renderer waits for the rasterisation of all views after the trial views."""
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

    for module in ("job.calibrations", "surrogate.calibration"):
        monkeypatch.setattr(f"trompe_server.{module}.prepare_geometry", prepare)
    library.calibrations.delete_all()
    spec = spec_of(surrogate="calibrated", azimuths=5, steps=1)
    job = opened(spec, library, MemoryArtifacts(), target=Patient())
    for phase in ("prepare", "calibrate", "attack-000"):
        job.run(phase, lambda _: None)
    assert prepared == [job.setup.views]


@pytest.mark.thorough
@pytest.mark.usefixtures("measured_tone")
def test_calibrations_serve_their_renderer_until_damaged(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = spec_of(surrogate="calibrated")
    whole = run_job(spec, library, until="calibrate")
    count = len(library.calibrations.names())
    for stored in library.calibrations.names():
        library.calibrations.write(stored, library.calibrations.read(stored)[:-100])
    again = run_job(spec, library, known=True, until="calibrate")
    assert again.artifacts.lasting() == whole.artifacts.lasting()
    assert len(library.calibrations.names()) == count

    def refuse(*_: Any, **__: Any) -> Any:
        raise RuntimeError("probes the target")

    monkeypatch.setattr("trompe_server.job.calibrations.calibrate", refuse)
    run_job(spec, library, known=True, until="calibrate")
    with pytest.raises(RuntimeError, match="probes the target"):
        run_job(spec, library, target=DarkTarget(), known=True, until="calibrate")


@pytest.mark.usefixtures("measured_tone")
def test_a_tone_curve_is_that_of_the_renderer_and_not_of_another_one_of_its_name(library: Library) -> None:
    spec = spec_of(surrogate="calibrated")
    alone = run_job(spec, library, target=DarkTarget(), until="calibrate")
    run_job(spec, library, until="calibrate")
    after_another = run_job(spec, library, target=DarkTarget(), known=True, until="calibrate")
    assert after_another.artifacts.lasting() == alone.artifacts.lasting()


def test_a_pool_of_random_views_takes_the_place_of_the_grid(library: Library) -> None:
    result = run_job(spec_of(pool=12), library).result
    assert result.target.views == len(result.views) == 12
    assert len({view.azimuth for view in result.views}) == 12
    assert len({view.light_azimuth for view in result.views}) == 12
    assert not {view.azimuth for view in result.views} & {view.azimuth for view in result.held_out_views}


def prepared(library: Library, target: TargetRenderer | None = None, **options: Any) -> MemoryArtifacts:
    """The files after the first phase."""
    artifacts = MemoryArtifacts()
    opened(spec_of(**options), library, artifacts, target=target).run("prepare", lambda _: None)
    return artifacts


def test_the_seed_changes_only_the_held_out_images(finished: Run, library: Library) -> None:
    clean, other = (files.arrays("views_before") for files in (finished.artifacts, prepared(library, seed=1)))
    assert (clean["own"] == other["own"]).all()
    assert (clean["held_out"] != other["held_out"]).any()


def test_saliency_is_that_of_the_targets_images(library: Library) -> None:
    bright, dark = (prepared(library, target).arrays("saliency")["maps"] for target in (FakeTarget(), DarkTarget()))
    assert bright.shape == (4, 128, 128)
    assert (bright.min(), bright.max()) == (0, 1)
    assert (bright != dark).mean() > 0.1


@pytest.mark.parametrize(("share", "expected"), [(1e-9, 1), (1e9, 3)])
def test_previews_are_limited(share: float, expected: int, library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture_attack, "PREVIEWING", share)
    artifacts = MemoryArtifacts()
    write = Mock(side_effect=artifacts.write)
    monkeypatch.setattr(artifacts, "write", write)
    job = opened(spec_of(steps=2 * CHUNK + 1, loss="cross_entropy"), library, artifacts)
    for phase in job.phases():
        job.run(phase, lambda _: None)
    assert sum(call.args[0] == "preview.png" for call in write.call_args_list) == expected


def test_a_classifier_is_loaded_once_for_several_jobs(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    setup._loaded.cache_clear()
    load = Mock(side_effect=load_classifier)
    monkeypatch.setattr(setup, "load_classifier", load)
    for steps in (1, 2):
        run_job(spec_of(steps=steps, held_out=0), library)
    assert [call.args for call in load.call_args_list] == [("tiny",)]


@pytest.mark.usefixtures("pictures")
def test_an_object_never_recognised_is_not_applicable(library: Library) -> None:
    ended = run_job(spec_of(label="ball"), library)
    report, result = ended.reports["prepare"], ended.result
    assert (list(ended.reports), report.state) == (["prepare"], JobState.not_applicable)
    assert report.note is not None
    for word in ("'tiny' recognises 'ball' in none of the 4", "`label`", "`background`"):
        assert word in report.note
    assert set(report.public) == {"result.json", "saliency.png", "views_before.npz"}
    assert (result.target.a_before, result.target.a_after, result.target.a_drop) == (0, None, None)
    assert (result.surrogate, result.texels_altered, result.transfer_gap) == (None, None, None)
    assert report.note in result.warnings


@pytest.mark.usefixtures("pictures")
def test_a_job_with_one_view_and_no_held_out_ones_works_too(library: Library) -> None:
    ended = run_job(spec_of(held_out=0, azimuths=1, elevations=1), library)
    assert ended.reports["judge"].state is JobState.succeeded
    assert (ended.result.held_out, ended.result.held_out_views, ended.result.target.views) == (None, [], 1)


def test_the_threshold_stops_the_gradient_of_less_salient_pixels(library: Library) -> None:
    spec = spec_of(tau=0.2)
    artifacts, setup = run_job(spec, library, until="attack-000").artifacts, setup_of(library, tau=0.2)
    maps = torch.from_numpy(artifacts.arrays("saliency")["maps"].astype(np.float32))
    geometry = prepare_geometry(setup.obj, setup.views, size=setup.size, sampling=SamplingModel())
    textures = textures_of(setup.obj)
    expected = attack(
        *(start(textures), textures, diffuse_surrogate(geometry, setup.views), setup.members),
        goal=Goal(setup.labels),
        budget=Budget(spec.paint.epsilon, spec.alpha),
        optimiser=spec.search.optimiser,
        steps=2,
        masks=saliency_masks(maps, 0.2),
    )
    done = load_state(artifacts.read("state-end.npz"))
    assert done.step == 2
    for name, delta in expected.deltas.items():
        assert torch.equal(done.deltas[name], delta)


@pytest.mark.parametrize(
    "options",
    [
        WHOLE,
        {"tau": 0.05},
        *(
            pytest.param(options, marks=pytest.mark.thorough)
            for options in ({"keep": 0.2}, {"image_pipeline": "transfer"}, {"optimiser": "pgd"}, {"pool": 12})
        ),
    ],
    ids=str,
)
def test_judged_images_cannot_influence_the_texture(finished: Run, library: Library, options: dict[str, Any]) -> None:
    spec = spec_of(**options)
    honest = (finished if options == WHOLE else run_job(spec, library)).artifacts
    library.calibrations.delete_all()
    setup, artifacts = setup_of(library, **options), MemoryArtifacts()
    target = Recorder(setup.held_out)
    job = opened(spec, library, artifacts, target=target)
    for phase in job.phases():
        target.noisy |= set() if phase in {"prepare", "calibrate"} else {*setup.views}
        job.run(phase, lambda _: None)
    assert artifacts.files["chair-adversarial.zip"] == honest.files["chair-adversarial.zip"]
    assert artifacts.result().target.a_after != honest.result().target.a_after or honest.result().target.a_after == 0
    assert artifacts.result().held_out != honest.result().held_out
