"""Jobs with several renderers, and with random ones."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.fakes import FakeTarget
from tests.job_runs import CHAIR, DarkTarget, Run, opened, run_job, setup_of, spec_of
from trompe_server.library import Library
from trompe_server.surrogate.calibration_file import calibration_key
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

Image8 = NDArray[np.uint8]
SHARP, DARK, COARSE = (EngineInfo(name, "1") for name in ("sharp", "dark", "coarse"))
TARGETS: dict[str, Any] = {
    "target": FakeTarget(engine=SHARP),
    "more_targets": [DarkTarget(engine=DARK)],
    "judge_targets": [FakeTarget(5_000, COARSE)],
}
SPEC: dict[str, Any] = {"surrogate": "calibrated", "steps": 6, "epsilon": 0.3, "alpha": 0.1, "held_out": 8}


@pytest.fixture(scope="module")
def run(library: Library) -> Run:
    return run_job(spec_of(**SPEC), library, **TARGETS)


def test_each_renderer_has_its_figures_and_images(run: Run) -> None:
    result = run.result
    told = [(each.renderer, each.attacked) for each in result.renderers]
    assert told == [(SHARP, True), (DARK, True), (COARSE, False)]
    for number, each in enumerate(result.renderers):
        images = [run.artifacts.arrays(f"views_{when}-{number}".removesuffix("-0")) for when in ("before", "after")]
        assert [arrays["own"].shape[0] for arrays in images] == [4, 4] == [len(each.views), each.target.views]
        assert (each.held_out or each.target).views == len(each.held_out_views) == 8
        attacked = (each.surrogate, each.transfer_gap, each.surrogate_model)
        assert (None not in attacked) if each.attacked else attacked == (None, None, None)
    shown = [run.artifacts.arrays(f"views_before{end}")["own"] for end in ("", "-1", "-2")]
    assert not (shown[0] == shown[1]).all()
    assert not (shown[0] == shown[2]).all()


def test_the_headline_is_of_the_attacked_renderer_with_the_smallest_drop(run: Run) -> None:
    result = run.result
    attacked = [each for each in result.renderers if each.attacked]
    worst = min(attacked, key=lambda each: (each.held_out or each.target).a_drop or 0)
    assert (result.renderer, result.held_out, result.views) == (worst.renderer, worst.held_out, worst.views)
    assert result.drawn_by is not None
    assert result.drawn_by.startswith(f"Figures and pictures are of {worst.renderer}, of 2 attacked renderers")
    assert result.probe_renders == run.counts("calibrate")["target_renders"]


@pytest.mark.thorough
def test_one_paint_works_in_both_where_a_paint_for_one_fails_in_the_other(run: Run, library: Library) -> None:
    """The paint for both has a larger loss in the worse renderer than the paint for the first alone."""
    alone = run_job(spec_of(**SPEC), library, target=TARGETS["target"], judge_targets=TARGETS["more_targets"])
    worse = (run.result.renderers[1], alone.result.renderers[1])
    kept = [np.mean([view.after_true_confidence for view in each.views]) for each in worse]
    assert kept[0] < kept[1]


@pytest.mark.thorough
@pytest.mark.usefixtures("pictures")
def test_a_job_resumed_at_each_phase_gives_the_same_bytes(run: Run, library: Library) -> None:
    again = run_job(spec_of(**SPEC), library, new=True, times=2, **TARGETS)
    assert again.artifacts.lasting().keys() == run.artifacts.lasting().keys()
    different = [name for name, data in run.artifacts.lasting().items() if again.artifacts.lasting()[name] != data]
    assert different == []


def test_a_view_counts_in_each_attacked_renderer(run: Run) -> None:
    """All views of both renderers fit one step."""
    assert run.result.evaluations is not None
    assert run.result.evaluations <= 6 * 2 * 4
    first = next(each for each in run.progress if each.step == 1)
    assert first.fooled is not None
    assert first.fooled * 8 == round(first.fooled * 8)


def test_no_attack_needs_one_renderer_that_recognises_the_object(library: Library) -> None:
    class Blank(FakeTarget):
        def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
            return np.zeros_like(super().render(obj, views, **options))

    blank = Blank(engine=DARK)
    both = run_job(spec_of(), library, more_targets=[blank])
    assert both.result.target.a_before > 0
    assert both.result.renderers[1].target.a_drop is None
    alone = run_job(spec_of(), library, target=blank, judge_targets=[FakeTarget()])
    assert alone.reports["prepare"].state == "n.a."
    assert [each.target.a_after for each in alone.result.renderers] == [None, None]


@pytest.mark.usefixtures("pictures")
def test_a_headline_that_recognises_nothing_in_its_own_views_has_pictures(library: Library) -> None:
    sampled = {"pool": 12, "held_out": 6}
    own = setup_of(library, **sampled).views

    class Unmoved(FakeTarget):
        """Shows nothing in the own views, and the same chair in all others."""

        def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
            images = super().render(CHAIR, views, **options)
            return images * np.array([view not in own for view in views], np.uint8)[:, None, None, None]

    run = run_job(spec_of(epsilon=0.5, alpha=0.1, steps=12, **sampled), library, more_targets=[Unmoved(engine=DARK)])
    assert (run.result.renderer, run.result.target.a_before) == (DARK, 0)
    assert run.result.held_out is not None
    assert run.result.held_out.a_drop == 0
    assert "contact_sheet.png" in run.artifacts.files


def test_the_same_images_by_another_engine_are_another_calibration(library: Library) -> None:
    setup = opened(spec_of(), library, Run().artifacts).setup
    clean = np.zeros((4, 8, 8, 3), np.uint8)
    keys = {
        calibration_key(setup.obj, setup.views, clean, engine=engine, wanted="auto", seed=0)
        for engine in (SHARP, DARK, EngineInfo("dark", "2"), EngineInfo("dark", "2", "gain 2"))
    }
    assert len(keys) == 4


@dataclass(frozen=True)
class NoisyTarget(FakeTarget):
    """Adds noise by the view's number of it, which it notes with the object shown."""

    engine: EngineInfo = EngineInfo("noisy", "1", deterministic=False)  # noqa: RUF009
    seen: list[tuple[bytes, int]] = field(default_factory=list)
    levels: int = 3

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        images = super().render(obj, views, **options)
        for image, view in zip(images, views, strict=True):
            np.minimum(image, 256 - self.levels, out=image)
            image += np.random.default_rng(view.noise).integers(0, self.levels, image.shape, dtype=np.uint8)
            self.seen.append((obj.to_zip(), view.noise))
        return images


@pytest.mark.thorough
@pytest.mark.usefixtures("measured_tone")
def test_held_out_views_have_noise_that_the_attack_has_not_seen(library: Library) -> None:
    target, spec = NoisyTarget(), spec_of(surrogate="calibrated", steps=2)
    run = run_job(spec, library, target=target)
    setup = opened(spec, library, run.artifacts, target=target).setup
    painted, clean = run.artifacts.painted().to_zip(), setup.obj.to_zip()
    own, held_out = setup.renderers[0].noise
    assert own != held_out
    looks = [own] * 4 + [held_out] * 3 + [own + 1] * 4  # the last ones measure the noise
    assert [noise for shown, noise in target.seen if shown == clean] == looks
    judged = [noise for shown, noise in target.seen if shown == painted]
    assert judged[-7:] == [own] * 4 + [held_out] * 3
    assert {noise for shown, noise in target.seen if shown not in (clean, painted)} == {0, own}  # charts have none
    assert any("noisy 1 is not deterministic" in warning for warning in run.result.warnings)
    assert run.result.drawn_by == "Figures and pictures are of noisy 1."
    again = run_job(spec, library, target=NoisyTarget(), new=True, times=2)
    assert again.artifacts.lasting() == run.artifacts.lasting()
    other = opened(spec_of(seed=1), library, run.artifacts, target=target).setup.renderers[0].noise
    assert not {own, held_out} & {*other}


def test_pictures_before_and_after_have_the_same_noise(library: Library) -> None:
    run = run_job(spec_of(epsilon=0.004, alpha=0.004, steps=1, loss="cross_entropy"), library, target=NoisyTarget())
    assert run.result.max_view_change is not None
    assert run.result.max_view_change <= 2 / 255
    for views in ("own", "held_out"):
        before, after = (run.artifacts.arrays(f"views_{when}")[views].astype(int) for when in ("before", "after"))
        assert abs(after - before).max() <= 2


@pytest.mark.thorough
@pytest.mark.parametrize(("levels", "advised"), [(3, False), (12, True)])
def test_more_samples_are_advised_where_noise_is_strong(library: Library, levels: int, advised: bool) -> None:
    run = run_job(spec_of(surrogate="calibrated", steps=1), library, target=NoisyTarget(levels=levels))
    assert any("take more samples" in warning for warning in run.result.warnings) == advised


def test_an_engine_that_is_deterministic_numbers_no_noise(library: Library) -> None:
    setup = opened(spec_of(seed=3), library, Run().artifacts).setup
    assert setup.renderers[0].noise == (0, 0)
    assert setup.renderers[0].shown(setup.views, held_out=True) == list(setup.views)
