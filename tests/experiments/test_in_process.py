"""Jobs in this process on the fake target: changed networks, the stability suite and adversarial variants; and the
suite's disturbed renderers."""

import csv
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from tests.experiments.test_run import Silent
from tests.fakes import FakeTarget
from trompe_experiments.in_process import Done, run_job
from trompe_experiments.run import run_experiment
from trompe_experiments.service import Service
from trompe_experiments.stability import cases, disturbed, disturbed_engine, service
from trompe_experiments.stability.cases import CASES, DISTURBANCES, MEASURED, UNFORESEEN, Case, stability_plan
from trompe_experiments.stability.disturbed_engine import Disturbance, DisturbedEngine, disturbed_renderer
from trompe_experiments.stability.service import DisturbedService
from trompe_experiments.table import ResultRow
from trompe_experiments.variants import ATTACK, export_variants
from trompe_renderer.check import EngineRender
from trompe_renderer.engines.pyrender import PyrenderEngine, PyrenderOptions
from trompe_server.classifiers import NetworkClassifier, WhiteBoxClassifier, load_classifier
from trompe_server.renderers import SailenvTarget
from trompe_shared.api import Job, JobRequest, JobSpec, JobState, Result
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, load_object

VIEWS = [View(Camera(0.3, azimuth, 20)) for azimuth in (0, 90)]
SIZE = (32, 32)
SMALL = {"epsilon": 0.1, "steps": 1, "pool": 2, "held_out": 2, "surrogate": "diffuse"}


def tiny() -> WhiteBoxClassifier:
    found = load_classifier("tiny")
    assert isinstance(found, WhiteBoxClassifier)
    return found


def test_each_disturbance_of_the_suite_changes_the_pictures_in_the_same_way_in_every_run(
    mug: Object3D, target: SailenvTarget, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = target.render(mug, VIEWS, size=SIZE)
    engine = PyrenderEngine(PyrenderOptions())
    monkeypatch.setattr(disturbed_engine, "PyrenderEngine", lambda _: engine)

    def seen(options: Mapping[str, Any]) -> NDArray[np.uint8]:
        return EngineRender(DisturbedEngine(Disturbance(**options)))(mug, VIEWS, size=SIZE)

    assert np.abs(seen({}).astype(int) - plain).max() <= 1  # the wire rounds cameras
    for words, case in DISTURBANCES.items():
        picture = seen(case.renderer)
        assert picture.shape == plain.shape, words
        assert 0.05 < np.abs(picture.astype(int) - plain).mean() < 60, words
        assert (picture == seen(case.renderer)).all(), words


def test_a_disturbed_worker_says_so_and_every_picture_has_its_own_noise(mug: Object3D, target: SailenvTarget) -> None:
    with disturbed_renderer(grain=8) as noisy:
        assert noisy.engine.settings == "grain=8.0"
        first, second = (noisy.render(mug, VIEWS[:1], size=SIZE) for _ in range(2))
    for other in (second, target.render(mug, VIEWS[:1], size=SIZE)):
        assert 2 < np.abs(first.astype(int) - other).mean() < 12


def test_changed_networks_say_nearly_the_same_and_mask_or_keep_gradients() -> None:
    network = tiny()
    images = torch.rand(3, 3, *network.image_size, generator=torch.Generator().manual_seed(0))
    shown = (images.permute(0, 2, 3, 1) * 255).byte().numpy()
    plain = network.predict(shown)
    assert np.abs(disturbed.bfloat16(network).predict(shown) - plain).max() < 0.3
    np.testing.assert_allclose(disturbed.saturated(network, 5.0).predict(shown), 5 * plain, rtol=1e-4, atol=1e-4)

    def gradient(changed: disturbed.ChangedClassifier) -> float:
        given = images.clone().requires_grad_()
        (found,) = torch.autograd.grad(changed.logits(given).sum(), given)
        return float(found.abs().sum())

    assert gradient(disturbed.saturated(network, 5.0)) > 0
    assert gradient(disturbed.quantised(network, 8)) == 0


def test_a_job_in_this_process_attacks_the_network_that_is_put_in(tmp_path: Path) -> None:
    spec = JobSpec.of("mug", label="mug", **SMALL)
    done = run_job(spec, FakeTarget(), tmp_path, change=disturbed.bfloat16)
    assert isinstance(done.setup.classifier, disturbed.ChangedClassifier)
    if done.painted is not None:
        assert load_object(done.painted).textures.keys() == done.setup.obj.textures.keys()
    assert done.result.target.views == 2


class Overflowing(torch.nn.Module):
    """A network whose logits of the last image of a batch are beyond all numbers, or none."""

    def __init__(self, inner: torch.nn.Module, odd: float) -> None:
        super().__init__()
        self.inner, self.odd = inner, odd

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        last = torch.arange(len(images))[:, None] == len(images) - 1
        return self.inner(images).masked_fill(last, self.odd)  # type: ignore[no-any-return]


def attacked_by(odd: float, folder: Path) -> Result:
    def overflowing(classifier: WhiteBoxClassifier) -> WhiteBoxClassifier:
        assert isinstance(classifier, NetworkClassifier)
        return replace(classifier, network=Overflowing(classifier.network, odd))

    return run_job(JobSpec.of("chair", label="chair", **SMALL), FakeTarget(), folder, change=overflowing).result


def test_a_network_that_says_what_is_no_number_has_no_result(tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match="gives NaN for 1 of 2 images"):
        attacked_by(float("nan"), tmp_path)


@pytest.mark.parametrize("odd", [float("inf"), -float("inf")])
def test_a_result_can_be_read_where_the_network_says_what_is_beyond_all_numbers(tmp_path: Path, odd: float) -> None:
    result = attacked_by(odd, tmp_path)
    assert [view.before_confidence for view in result.views[-1:]] == pytest.approx([1 / 8])
    assert result.target.a_before == 0.5
    assert 0 <= result.views[0].before_confidence <= 1


def test_cases_of_the_suite_have_names_of_their_own_and_a_reference() -> None:
    assert next(iter(MEASURED)) == "as it should be"
    assert len(CASES) == len(MEASURED) + len(UNFORESEEN) == 36
    assert not any("|" in name for name in CASES)


def test_words_of_no_case_are_refused_with_the_cases() -> None:
    with pytest.raises(SpecError, match=r"contains 'nonsense'; cases: as it should be; field of view"):
        stability_plan(objects=["mug"], seeds=1, only="nonsense")


def suite(folder: Path, only: str) -> tuple[tuple[ResultRow, ...], Silent]:
    show = Silent()
    plan = stability_plan(objects=["mug"], seeds=1, only=only, options=SMALL)
    return run_experiment(plan, DisturbedService(FakeTarget()), folder, show=show), show


def test_the_suite_runs_what_is_missing_in_order_of_its_cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "disturbed_renderer", lambda **_: nullcontext(FakeTarget()))
    rows, show = suite(tmp_path, "JPEG, quality 75")
    assert [row.case for row in rows] == ["JPEG, quality 75", "unforeseen: JPEG, quality 75"] == show.cases
    assert rows[0].experiment == "stability_targets"
    assert rows[0].key != rows[1].key
    again, show = suite(tmp_path, "JPEG, quality 75")
    assert ([row.key for row in again], show.ended) == ([row.key for row in rows], [])


def test_an_unforeseen_disturbance_changes_the_judgement_of_the_undisturbed_jobs_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "disturbed_renderer", lambda **_: nullcontext(FakeTarget(points=40_000)))
    rows, _ = suite(tmp_path, "quality 30")
    plain, _ = suite(tmp_path / "plain", "as it should be")
    measured, unforeseen = rows
    assert unforeseen.surrogate_a_drop == plain[0].surrogate_a_drop
    assert unforeseen.steps_taken == plain[0].steps_taken
    assert measured.target_a_before is not None
    assert (unforeseen.surrogate_a_drop, plain[0].target_a_drop) == (0, 1)
    assert (unforeseen.target_a_drop, unforeseen.transfer_gap) == (0, 0)
    for name in ("margin_error", "max_view_change", "ssim", "delta_e", "pipeline_drops"):
        assert getattr(plain[0], name)
        assert not getattr(unforeseen, name), name


def test_a_case_may_have_its_own_renderer_and_network_and_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(FakeTarget):
        def render(self, *_: object, **__: object) -> np.ndarray:
            raise ObjectError("broken")

    own = Case(renderer={"grain": 1}, classifier=disturbed.bfloat16)
    broken = Case(renderer={"grain": 2})
    rendered = {1: FakeTarget(), 2: Broken()}
    monkeypatch.setattr(service, "disturbed_renderer", lambda *, grain: nullcontext(rendered[grain]))
    monkeypatch.setattr(cases, "CASES", {"own renderer": own, "broken renderer": broken})
    monkeypatch.setattr(service, "CASES", cases.CASES)
    good, bad = suite(tmp_path, "renderer")[0]
    assert (good.state, bad.state, bad.error) == ("succeeded", "failed", "broken")


class InProcess(Service):
    """Runs each job on the fake target when it is submitted."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.done: dict[str, Done] = {}

    def submit(self, request: JobRequest, key: str) -> Job:
        self.done[key] = run_job(request.spec(), FakeTarget(), self.folder / key)
        return Job(id=key, state=JobState.succeeded, spec=request.spec(), created=datetime.now(UTC), worker=None)

    def result(self, job: str) -> Result:
        return self.done[job].result

    def artifact(self, job: str, name: str) -> bytes | None:
        return self.done[job].painted

    def classes(self, classifier: str) -> list[str] | None:
        return None


def test_variants_are_zips_and_labelled_pictures_from_views_that_train_and_test_do_not_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(ATTACK):
        monkeypatch.delitem(ATTACK, name)
    for name, value in SMALL.items():
        monkeypatch.setitem(ATTACK, name, value)
    out, service = tmp_path / "out", InProcess(tmp_path / "jobs")
    asked = {"names": ["ball", "ball"], "per_object": 1, "views": 5, "size": SIZE, "epsilon": 0.1}
    attacked = export_variants(out, service, FakeTarget(), show=Silent(), **asked)  # type: ignore[arg-type]
    made = list((out / "objects").glob("*.zip"))
    rows = list(csv.DictReader((out / "labels.csv").read_text().splitlines()))
    assert [row.object for row in attacked] == ["ball"]
    assert {row["label"] for row in rows} == {"ball"}
    assert sum(row["split"] == "test" for row in rows) == (1 + len(made))
    assert len(rows) == 5 * (1 + len(made))
    seen = {split: {row["azimuth"] for row in rows if row["split"] == split} for split in ("train", "test")}
    assert not seen["train"] & seen["test"]
    for row in rows:
        assert row["file"].startswith(f"{row['split']}/ball/")
        with Image.open(out / row["file"]) as picture:
            assert picture.size == SIZE
    for file in made:
        painted = load_object(service.artifact(attacked[0].key, "") or b"")
        assert load_object(file.read_bytes()).textures.keys() == painted.textures.keys()
    (tmp_path / "kept.png").write_bytes(b"")
    with (out / "labels.csv").open("a") as table:
        table.write("../kept.png,train,ball,ball,ball-9\n")
    (out / "objects" / "ball-9.zip").write_bytes(b"")
    export_variants(out, service, FakeTarget(), show=Silent(), **asked | {"views": 3})  # type: ignore[arg-type]
    rows = list(csv.DictReader((out / "labels.csv").read_text().splitlines()))
    listed = [row["file"] for row in rows]
    assert sorted(listed) == sorted(path.relative_to(out).as_posix() for path in out.glob("t*/*/*.png"))
    assert {path.stem for path in out.glob("objects/*.zip")} == {row["variant"] for row in rows} - {"clean"}
    assert (tmp_path / "kept.png").exists()


def test_unknown_objects_have_no_variants(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="No shipped object sofa; objects: ball"):
        export_variants(tmp_path, InProcess(tmp_path), FakeTarget(), names=["sofa"], show=Silent())
