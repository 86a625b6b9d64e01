"""Jobs on the library itself: disturbed targets, changed networks, the stability suite and adversarial variants, over
the fake target."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from trompe_server.classifiers import NetworkClassifier, WhiteBoxClassifier, load_classifier
from trompe_server.experiments import disturbed, suite, variants
from trompe_server.experiments.disturbed import DisturbedTarget
from trompe_server.experiments.in_process import run_job
from trompe_server.experiments.stability import MEASURED, UNFORESEEN, run_suite
from trompe_server.experiments.suite import Case, Planned, plan_jobs, run_planned
from trompe_server.experiments.variants import export_variants
from trompe_server.scene import Scene
from trompe_server.surrogate import SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry
from trompe_server.target import FakeTarget
from trompe_shared.api import JobSpec
from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import RESULTS, ResultRow, RowId, read_table
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, load_object

VIEWS = [View(Camera(0.3, azimuth, 20)) for azimuth in (0, 90)]
SIZE = (32, 32)
SMALL = {"epsilon": 0.1, "steps": 1, "pool": 0, "azimuths": 2, "elevations": 1, "held_out": 2, "surrogate": "diffuse"}


def tiny() -> WhiteBoxClassifier:
    found = load_classifier("tiny")
    assert isinstance(found, WhiteBoxClassifier)
    return found


@pytest.fixture
def _no_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fake target wherever a renderer worker would be started."""

    @contextmanager
    def fake(**_: object) -> Iterator[FakeTarget]:
        yield FakeTarget()

    for module in (suite, variants):
        monkeypatch.setattr(module, "running_renderer", fake)


@pytest.mark.parametrize(
    "see",
    [
        disturbed.grain(4),
        disturbed.flicker(0.2),
        disturbed.brighter_when_dark(0.3),
        disturbed.bounce(0.3),
        disturbed.filmic,
        disturbed.jpeg(50),
        disturbed.resized_twice(0.5),
    ],
    ids=["grain", "flicker", "exposure", "bounce", "tone", "jpeg", "resize"],
)
def test_what_is_seen_otherwise_is_another_image_of_the_same_size(see: disturbed.See, mug: Object3D) -> None:
    plain = FakeTarget().render(mug, VIEWS, size=SIZE)
    seen = DisturbedTarget(FakeTarget(), see=see).render(mug, VIEWS, size=SIZE)
    assert seen.shape == plain.shape
    assert seen.dtype == np.uint8
    assert 0 < np.abs(seen.astype(int) - plain).mean() < 60


def test_what_is_aimed_otherwise_is_another_image(mug: Object3D) -> None:
    plain = FakeTarget().render(mug, VIEWS, size=SIZE)
    for aim in (disturbed.jittered(3.0, 0.05), disturbed.relit(90.0, intensity=0.5)):
        target = DisturbedTarget(FakeTarget(), aim=aim)
        assert (target.render(mug, VIEWS, size=SIZE) != plain).any()
    smaller = disturbed.smaller(FakeTarget(), 0.5).render(mug, VIEWS, size=SIZE)
    assert smaller.shape == plain.shape
    assert (smaller != plain).any()


def test_noise_is_another_in_every_frame_and_the_same_in_every_run(mug: Object3D) -> None:
    def frames() -> list[np.ndarray]:
        target = DisturbedTarget(FakeTarget(), see=disturbed.grain(8))
        return [target.render(mug, VIEWS[:1], size=SIZE) for _ in range(2)]

    (first, second), (again, _) = frames(), frames()
    assert (first != second).any()
    assert (first == again).all()


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


def test_a_network_attacked_in_another_precision_is_judged_as_it_is_and_one_of_another_size_takes_that_size() -> None:
    network = tiny()
    images = torch.rand(3, 3, *network.image_size, generator=torch.Generator().manual_seed(0))
    shown = (images.permute(0, 2, 3, 1) * 255).byte().numpy()
    half = disturbed.bfloat16_gradients(network)
    np.testing.assert_array_equal(half.predict(shown), network.predict(shown))
    assert (half.logits(images) != network.logits(images)).any()
    small = disturbed.at_size(network, 64)
    assert small.image_size == (64, 64)
    assert small.predict(shown).shape == (3, network.n_classes)
    assert (small.predict(shown) != network.predict(shown)).any()


def test_a_job_in_this_process_attacks_the_network_that_is_put_in(tmp_path: Path) -> None:
    spec = JobSpec.model_validate({"object": "mug", "label": "mug"} | SMALL)
    done = run_job(spec, FakeTarget(), tmp_path, change=disturbed.bfloat16)
    assert isinstance(done.scene.classifier, disturbed.ChangedClassifier)
    if done.painted is not None:
        assert load_object(done.painted).textures.keys() == done.scene.obj.textures.keys()
    assert done.result.target.views == 2


class Overflowing(torch.nn.Module):
    """A network whose logits of the last image of a batch are beyond all numbers, or none."""

    def __init__(self, inner: torch.nn.Module, odd: float) -> None:
        super().__init__()
        self.inner, self.odd = inner, odd

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        last = torch.arange(len(images))[:, None] == len(images) - 1
        return self.inner(images).masked_fill(last, self.odd)  # type: ignore[no-any-return]


@pytest.mark.parametrize("odd", [float("nan"), float("inf"), -float("inf")])
def test_a_result_can_be_read_where_the_network_says_what_is_no_number(tmp_path: Path, odd: float) -> None:
    def overflowing(classifier: WhiteBoxClassifier) -> WhiteBoxClassifier:
        assert isinstance(classifier, NetworkClassifier)
        return replace(classifier, network=Overflowing(classifier.network, odd))

    spec = JobSpec.model_validate({"object": "chair", "label": "chair"} | SMALL)
    result = run_job(spec, FakeTarget(), tmp_path, change=overflowing).result
    assert [view.before_confidence for view in result.views[-1:]] == pytest.approx([1 / 8])
    assert result.target.a_before == 0.5
    assert 0 <= result.views[0].before_confidence <= 1


def test_cases_of_the_suite_have_names_of_their_own_and_a_reference() -> None:
    assert next(iter(MEASURED)) == "as it should be"
    assert not any("|" in name for name in (*MEASURED, *UNFORESEEN))


@pytest.mark.usefixtures("_no_renderer")
def test_the_suite_runs_what_is_missing_and_keeps_the_order_of_its_cases(tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []

    def run(only: str) -> list[ResultRow]:
        told.clear()
        return run_suite(
            tmp_path,
            objects=["mug"],
            seeds=[0],
            options=SMALL,
            only=only,
            on_row=lambda row, done, total: told.append((row.case, done, total)),
        )

    rows = run("JPEG, quality 75")
    assert [row.case for row in rows] == ["JPEG, quality 75", "unforeseen: JPEG, quality 75"]
    assert [done for _, done, _ in told] == [1, 2]
    kept = read_table(tmp_path / RESULTS, ResultRow)
    assert [row.key for row in kept] == [row.key for row in rows]
    assert rows[0].experiment == "stability_targets"
    assert rows[0].threads is not None
    assert run("JPEG, quality 75") == kept
    assert told == []


def planned(configuration: str, case: Case, *, same: str = "") -> list[Planned]:
    place = RowId(experiment="some", key="", series="a series", configuration=configuration)
    return plan_jobs(place, case, SMALL, objects=["mug"], seeds=[0], same=same)


@pytest.mark.usefixtures("_no_renderer")
def test_places_that_ask_the_same_share_a_job_and_rows_that_are_not_wanted_now_are_kept(tmp_path: Path) -> None:
    plan = [
        *planned("threads 1", Case(threads=1)),
        *planned("threads 2", Case(threads=2), same="standard"),
        *planned("size 128", Case(threads=2), same="standard"),
    ]
    told: list[str] = []

    def run(word: str) -> list[ResultRow]:
        return run_planned(
            tmp_path,
            plan,
            wanted=lambda each: word in each.place.configuration,
            on_row=lambda row, done, total: told.append(f"{row.configuration}: {done}/{total}"),
        )

    assert [(row.configuration, row.threads) for row in run("size")] == [("threads 2", 2), ("size 128", 2)]
    assert told == ["size 128: 1/1"]
    assert [(row.configuration, row.threads) for row in run("threads")] == [
        ("threads 1", 1),
        ("threads 2", 2),
        ("size 128", 2),
    ]
    assert told[1:] == ["threads 1: 2/2"]
    assert [row.configuration for row in read_table(tmp_path / RESULTS, ResultRow)] == [
        each.place.configuration for each in plan
    ]


@pytest.mark.usefixtures("_no_renderer")
def test_a_job_searches_in_the_surrogate_that_is_put_in_and_is_judged_in_the_target(tmp_path: Path) -> None:
    made: list[Surrogate] = []

    def own(scene: Scene) -> Surrogate:
        geometry = prepare_geometry(scene.obj, scene.views, size=scene.size, sampling=SamplingModel())
        made.append(diffuse_surrogate(geometry, scene.views))
        return made[-1]

    (row,) = run_planned(tmp_path, planned("other", Case(surrogate=own)))
    assert len(made) == 1
    assert row.state == "succeeded"
    assert row.target_a_drop is not None


@pytest.mark.usefixtures("_no_renderer")
def test_variants_are_zips_and_labelled_pictures_from_views_that_train_and_test_do_not_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(variants, "ATTACK", SMALL)
    made = export_variants(tmp_path, names=["ball"], per_object=1, views=5, size=SIZE)
    rows = list(csv.DictReader((tmp_path / "labels.csv").read_text().splitlines()))
    assert {row["label"] for row in rows} == {"ball"}
    assert sum(row["split"] == "test" for row in rows) == (1 + len(made))
    assert len(rows) == 5 * (1 + len(made))
    seen = {split: {row["azimuth"] for row in rows if row["split"] == split} for split in ("train", "test")}
    assert not seen["train"] & seen["test"]
    for row in rows:
        assert row["file"].startswith(f"{row['split']}/ball/")
        with Image.open(tmp_path / row["file"]) as picture:
            assert picture.size == SIZE
    for variant in made:
        painted = load_object((tmp_path / "objects" / f"{variant.name}.zip").read_bytes())
        assert painted.textures.keys() == variant.obj.textures.keys()


def test_unknown_objects_have_no_variants(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="No shipped object is called sofa; there are ball"):
        export_variants(tmp_path, names=["sofa"])
