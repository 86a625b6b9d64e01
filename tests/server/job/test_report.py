"""The report: the result's figures by view, its warnings, the views of its pictures, the names of its files."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn

from tests.fakes import FakeTarget
from tests.job_runs import CHAIR, DarkTarget, run_job, setup_of, spec_of
from trompe_server.classifiers import NetworkClassifier, load_classifier
from trompe_server.formats import read_object, repaint_file, write_glb
from trompe_server.image_pipelines import SUITE
from trompe_server.job import texture_attack
from trompe_server.job.files import Spent
from trompe_server.job.report import ReportData
from trompe_server.job.report.models import model_files
from trompe_server.job.report.pictures import short_names
from trompe_server.job.report.warnings import _stronger, _wider
from trompe_server.library import Library
from trompe_server.renderers import SailenvTarget
from trompe_server.storage.folders import checked
from trompe_shared.api import JobSpec
from trompe_shared.geometry import Camera, View
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

Image8 = NDArray[np.uint8]


def is_probe(obj: Object3D) -> bool:
    return obj.textures[next(iter(obj.textures))].shape == (4, 4, 3)


def where(camera: Camera) -> str:
    return f"(azimuth {camera.azimuth:.0f}, elevation {camera.elevation:.0f})"


class PatchyTarget(FakeTarget):
    """A target with darker probes of its second view."""

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        images = super().render(obj, views, **options)
        if is_probe(obj):
            images[1:2] //= 2
        return images


class StubbornTarget(FakeTarget):
    """A target that never shows a repaint to one camera, except for probes."""

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.camera = camera

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> Image8:
        images = super().render(obj, views, **options)
        if not is_probe(obj):
            clean = super().render(CHAIR, views, **options)
            for index, view in enumerate(views):
                images[index] = clean[index] if view.camera == self.camera else images[index]
        return images


def test_views_with_a_poor_surrogate_are_named(library: Library) -> None:
    warnings = run_job(spec_of(surrogate="curve", steps=1), library, target=PatchyTarget()).result.warnings
    (warning,) = [found for found in warnings if "off by more" in found]
    assert f"1 {where(setup_of(library).views[1].camera)}" in warning


def test_views_with_an_unpredicted_change_are_named(library: Library) -> None:
    first = setup_of(library).views[0].camera
    spec = spec_of(surrogate="calibrated", steps=6)
    warnings = run_job(spec, library, target=StubbornTarget(first)).result.warnings
    (warning,) = [found for found in warnings if "did not predict" in found]
    assert f"on views 0 {where(first)}: " in warning


def test_a_surrogate_without_probes_names_its_views_too(library: Library) -> None:
    warnings = run_job(spec_of(), library, target=DarkTarget()).result.warnings
    assert [found for found in warnings if "off by more than 3/255 on views" in found]


@pytest.mark.usefixtures("searched_sampling")
def test_each_attacked_view_has_the_fidelity_of_its_prediction(library: Library, target: SailenvTarget) -> None:
    spec = spec_of(surrogate="calibrated", steps=6)
    result = run_job(spec, library, target=target).result
    for view in result.views:
        assert view.fidelity is not None
        assert view.fidelity.correlation > 0.97
        assert 0.9 < view.fidelity.slope < 1.1
        assert view.fidelity.explained > 0.9
        assert view.fidelity.error < 1.5 / 255
        assert 0 < view.fidelity.change <= spec.paint.epsilon * 1.5
    assert not any(view.fidelity for view in result.held_out_views)
    assert not [found for found in result.warnings if "on views" in found]


@pytest.mark.parametrize(("name", "near"), [("{} lamp", True), ("{}", False)], ids=["all lamps", "as they are"])
def test_the_report_lists_what_the_object_became_and_both_drops(
    library: Library, monkeypatch: pytest.MonkeyPatch, name: str, near: bool
) -> None:
    tiny = load_classifier("tiny")
    assert isinstance(tiny, NetworkClassifier)
    names = tuple(name.format(each) for each in tiny.classes or ())
    named = replace(tiny, classes=names)
    monkeypatch.setattr("trompe_server.job.setup._stored_classifier", lambda *_, **__: named)
    spec = spec_of(object="lamp", label=4, epsilon=0.3, alpha=0.1, steps=3)
    result = run_job(spec, library, target=FakeTarget(60_000)).result
    fooled = {
        views: Counter(view.after for view in seen if view.before == 4 != view.after)
        for views, seen in (("own", result.views), ("held_out", result.held_out_views))
    }
    assert fooled["own"]
    assert fooled["held_out"]
    for views, counts in fooled.items():
        assert {each.label: getattr(each, views) for each in result.fooled_as if getattr(each, views)} == counts
    assert all((each.name, each.neighbour) == (names[each.label], near) for each in result.fooled_as)
    found = result.held_out
    assert found is not None
    assert found.a_drop is not None
    assert found.a_drop > 0
    unseen = fooled["held_out"].total()
    warnings = [each for each in result.warnings if "neighbour" in each]
    if near:
        assert found.a_drop_with_neighbours == 0
        assert found.a_drop_with_neighbours_interval is not None
        assert f"Of {unseen} fooled held-out views, {unseen} became a neighbour" in warnings[0]
        assert f"(chair lamp): A_drop is {found.a_drop:.2f}, or 0.00 if all neighbours count" in warnings[0]
    else:
        assert found.a_drop_with_neighbours == found.a_drop
        assert found.a_drop_with_neighbours_interval == found.a_drop_interval
        assert not warnings


def test_a_judge_sees_the_images_and_knows_the_label_by_name(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = load_classifier("tiny")
    assert isinstance(tiny, NetworkClassifier)
    turned = replace(tiny, name="turned", classes=(tiny.classes or ())[::-1], network=Turned(tiny.network))
    stored = {"turned": turned, "tiny": tiny}
    monkeypatch.setattr("trompe_server.job.setup._stored_classifier", lambda name, **_: stored[name])
    result = run_job(spec_of(judges=["turned"]), library).result
    (judge,) = result.judges
    assert (judge.classifier, judge.target, judge.held_out) == ("turned", result.target, result.held_out)
    assert result.target.a_before > 0


class Turned(nn.Module):
    """A network with its classes in the opposite order."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        logits: Tensor = self.network(images)
        return logits.flip(1)


def test_views_that_are_all_the_same_count_once(library: Library) -> None:
    fixed = {"azimuth": (20, 20), "distance_factor": (1, 1), "light_azimuth": (0, 0), "light_elevation": (60, 60)}
    result = run_job(spec_of(elevation=(20, 20), ranges=fixed, held_out=6, judges=["tiny"]), library).result
    judged = [result.held_out, result.judges[0].held_out, *(each.held_out for each in result.image_pipelines)]
    assert [(each.views, each.distinct) for each in judged if each] == [(6, 1), (6, 1), *[(3, 1)] * len(SUITE)]


def test_an_attack_of_little_effect_says_so_with_a_remedy(library: Library) -> None:
    result = run_job(spec_of(epsilon=1 / 255, alpha=1 / 255, steps=1), library).result
    assert result.target.a_drop == 0
    assert [warning for warning in result.warnings if "A_drop 0.00" in warning and "a larger `epsilon`" in warning]


@pytest.mark.parametrize(
    ("options", "why", "remedy"),
    [
        pytest.param({"loss": "cross_entropy"}, "gradient is zero on every view", "Try `loss: margin`", id="loss"),
        pytest.param({}, "gradient is zero on every view", "Export it without its softmax", id="saturated"),
        pytest.param({"tau": 0.05}, "through the pixels", "Try a smaller `tau` or `keep` in its place", id="tau"),
        pytest.param({"tau": 0.05, "keep": 0.5}, "through the pixels", "Try a smaller `tau`.", id="tau and keep"),
        pytest.param(
            {"alpha": 0.0009}, "less than half an 8-bit level", "Try a larger `alpha` or more `steps`", id="alpha"
        ),
    ],
)
def test_an_attack_that_altered_nothing_says_why_and_advises_what_was_not_done(
    options: dict[str, Any], why: str, remedy: str, library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(texture_attack, "attack", lambda state, *_, steps, **__: replace(state, step=steps))
    warnings = run_job(spec_of(**options), library).result.warnings
    (unaltered,) = [warning for warning in warnings if "No texel was altered" in warning]
    assert why in unaltered
    assert remedy in unaltered


def data_of(*, steps_taken: int = 90, **options: Any) -> ReportData:
    """What advice is made from: the options of a job, and the number of its steps."""
    spec = JobSpec.of("mug", label="mug", **options)
    taken: Any = SimpleNamespace(spec=spec, spent=Spent(steps_taken, None, None))
    return taken  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        pytest.param({"grid": True}, "Attack random views instead: leave out `grid`.", id="grid"),
        pytest.param(
            {"grid": True, "azimuths": 3, "elevations": 4},
            "Attack random views instead: leave out `grid`, `azimuths` and `elevations`.",
            id="shape of the grid",
        ),
        pytest.param({}, "Try `pool: 480` and more `steps`.", id="all steps"),
        pytest.param({"steps_taken": 30}, "Try `pool: 480`.", id="early end"),
        pytest.param({"pool": 60}, "Try `pool: 240` and more `steps`.", id="few views"),
        pytest.param({"pool": 1500}, "Try `pool: 2000` and more `steps`.", id="at most"),
        pytest.param({"pool": 2000, "steps_taken": 30}, "", id="nothing left"),
    ],
)
def test_more_views_are_advised_by_options_that_fit_the_job(options: dict[str, Any], advice: str) -> None:
    assert _wider(data_of(**options)) == advice
    asked = {name: value for name, value in options.items() if name != "steps_taken"}
    kept = {name: value for name, value in asked.items() if f"`{name}`" not in advice}
    more = {match[1]: int(match[2]) for match in re.finditer(r"`(\w+): (\d+)`", advice)}
    JobSpec.of("mug", label="mug", **kept | more)  # is not refused


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        pytest.param({}, "Try a larger `epsilon` or more `steps`.", id="defaults"),
        pytest.param({"steps_taken": 30}, "Try a larger `epsilon`.", id="early end"),
        pytest.param({"epsilon": 1, "alpha": 0.1, "tau": 0}, "Try more `steps`.", id="at their limits"),
        pytest.param({"alpha": 0.0005}, "Try a larger `alpha` or more `steps`.", id="steps too small"),
        pytest.param({"tau": 0.2}, "Try a larger `epsilon`, more `steps` or a smaller `tau`.", id="tau"),
        pytest.param(
            {"loss": "cross_entropy", "keep": 0.1, "materials": ["clay"], "steps_taken": 3},
            "Try a larger `epsilon`, `loss: margin`, a larger `keep` or more `materials`.",
            id="what limits it",
        ),
    ],
)
def test_a_stronger_attack_is_advised_by_the_options_that_limited_it(options: dict[str, Any], advice: str) -> None:
    assert _stronger(data_of(**options)) == advice


def test_pictures_tell_classes_apart() -> None:
    classes = ("crane, bird", "crane", "t\u00e9apot", "\u676f\u5b50", "\u6905\u5b50")
    assert short_names(classes) == ["crane (0)", "crane (1)", "teapot", "?? (3)", "?? (4)"]


@pytest.mark.usefixtures("pictures")
def test_a_contact_sheet_shows_and_counts_recognised_views(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = Mock(return_value=Image.new("RGB", (8, 8)))
    monkeypatch.setattr("trompe_server.pictures.contact_sheet.contact_sheet", drawn)
    result = run_job(spec_of(pool=40, elevation=(-89, 89), held_out=0), library).result
    drawn.assert_called_once()
    (views,), words = drawn.call_args
    _, _, before, after = zip(*views, strict=True)
    recognised = [view for view in result.views if view.before == result.label]
    assert 0 < len(recognised) < 40
    assert len(before) == min(12, len(recognised))
    assert all(verdict.correct for verdict in before)
    fooled = sum(view.after != result.label for view in recognised)
    assert f"in {len(recognised)} of 40 views; {fooled} of these are fooled." in words["facts"]
    order = [verdict.confidence * (1 if verdict.correct else -1) for verdict in after]
    assert order == sorted(order, reverse=True)


@pytest.mark.parametrize(
    ("original", "endings"),
    [
        pytest.param(None, [".zip", ".glb"], id="sailenv"),
        pytest.param("glb", [".zip", ".glb"], id="glb"),
        pytest.param("zip", [".zip", ".glb", ".sailenv.zip"], id="zip of another format"),
    ],
)
def test_the_repainted_object_has_one_name_in_all_its_formats(original: str | None, endings: list[str]) -> None:
    chair = load_object(shipped_objects()["chair"].read())
    obj_zip = pack_zip({name: data for name, data in chair.files.items() if not name.endswith("_mat_def.json")})
    upload = {"glb": write_glb(chair), "zip": obj_zip, None: chair.to_zip()}[original]
    obj = read_object(upload, name=f"chair.{original or 'zip'}").obj
    white = obj.with_textures({name: np.full_like(image, 255) for name, image in obj.textures.items()})
    files, refused = model_files(white, "my chair: no. 2", (upload, f"chair.{original}") if original else None)
    assert refused == []
    assert sorted(files) == sorted(f"my_chair_no._2-adversarial{ending}" for ending in endings)
    own = files[f"my_chair_no._2-adversarial.{original or 'zip'}"]
    assert own == repaint_file(upload, white, name=f"chair.{original or 'zip'}").data


@pytest.mark.parametrize(
    ("name", "plain"), [("..", "object"), ("-rf", "rf"), ("caffè latte", "caff_latte"), ("x" * 300, "x" * 100)]
)
def test_the_name_of_a_file_is_safe(name: str, plain: str) -> None:
    chair = load_object(shipped_objects()["chair"].read())
    names = {checked(file) for file in model_files(chair, name, None)[0]}
    assert names == {f"{plain}-adversarial.zip", f"{plain}-adversarial.glb"}
