"""The file of an experiment: its options, its jobs, and messages about mistakes."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from trompe_client import _plan
from trompe_experiments.design import Experiment, load_experiment, shipped_experiments
from trompe_experiments.plan import Plan, plan_experiment
from trompe_experiments.table import KEY_VERSION, job_key
from trompe_shared.api import JobRequest, JobSpec
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.presets import PRESETS
from trompe_shared.shipped import shipped_objects

DEFAULTS: dict[str, Any] = {
    "classifier": "tiny",
    "ensemble": [],
    "judges": [],
    "image_pipeline": None,
    "epsilon": 0.05,
    "alpha": None,
    "tau": None,
    "keep": None,
    "materials": [],
    "masks": {},
    "epsilon_view": None,
    "label": ["mug"],
    "target": None,
    "top_k": 1,
    "loss": "margin",
    "optimiser": "nesterov",
    "queries": None,
    "surrogate": "auto",
    "steps": 90,
    "seed": 0,
    "distance": None,
    "elevation": None,
    "background": ["white"],
    "azimuths": None,
    "elevations": 10,
    "pool": 240,
    "grid": False,
    "views_per_step": None,
    "held_out": 60,
    "ranges": {
        "azimuth": [0, 360],
        "distance_factor": [0.9, 1.1],
        "roll": [0, 0],
        "light_azimuth": [-70, 70],
        "light_elevation": [35, 88],
        "intensity": [1.25, 1.25],
        "ambient": [0.5, 0.5],
        "light_colours": [[255, 255, 255], [255, 255, 255]],
    },
}
"""Defaults of ``KEY_VERSION``, without options added later under the same version."""

MINIMAL: dict[str, Any] = {"name": "small", "objects": {"mug": {}}}


def planned(**file: Any) -> Plan:
    return plan_experiment(Experiment.model_validate(MINIMAL | file))


def written(folder: Path, **file: Any) -> Path:
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(MINIMAL | file))
    return path


@pytest.fixture
def assets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder like that of the paper's objects: some of its objects and three classifiers."""
    folder = tmp_path / "assets"
    names = ("candle", "pot", "plunger", "table_living_room", "remote_controller", "toilet_paper")
    looks = {"distance": 0.5, "elevation_range": [-10, 40], "background": "black"}
    table = {name: looks | {"imagenet_class": 470 + number} for number, name in enumerate(names)}
    files = {"objects/objects.json": json.dumps(table)} | {f"objects/{name}/{name}.obj": f"o {name}" for name in names}
    white = ("mobilenet_v2.pt2", "mobilenet_edgetpu_075.pt2", "squeezenet1_1.pt2")
    for network in (*white, "mobilenet_v1.onnx", "mobilenet_v3_large_min.onnx"):
        files[f"classifiers/{network}"] = network
    files |= {f"backgrounds/{name}.png": name for name in ("room", "toilet")}
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    monkeypatch.setenv("TROMPE_ASSETS", str(folder))
    return folder


def test_a_minimal_file_is_one_job_with_the_label_of_the_experiment_and_shipped_is_one_of_each_object() -> None:
    assert [row.object for row in planned(objects="shipped").rows] == list(shipped_objects())
    (row,) = planned().rows
    assert row.object == row.request.object == "mug"
    assert row.request.goal.label == ["mug"]
    assert row.request.labels == {"experiment": "small"}
    assert row.request.priority == "sweep"
    assert row.key.startswith("small-")


@given(
    epsilons=st.lists(st.sampled_from([0.02, 0.05, 0.1, 0.5]), min_size=1, unique=True),
    taus=st.lists(st.sampled_from([None, 0.05, 0.2]), min_size=1, unique=True),
    cases=st.integers(0, 3),
    seeds=st.integers(1, 4),
)
@settings(max_examples=20)
def test_every_combination_is_one_job_with_a_key_of_its_own(
    epsilons: list[float], taus: list[float | None], cases: int, seeds: int
) -> None:
    plan = planned(
        objects={"mug": {}, "chair": {}},
        grid={"epsilon": epsilons, "tau": taus},
        cases={f"case {k}": {"steps": 10 + k} for k in range(cases)},
        seeds=seeds,
    )
    assert len(plan.rows) == 2 * len(epsilons) * len(taus) * max(cases, 1) * seeds
    assert len(plan.jobs()) == len(plan.rows)
    asked = {(row.object, *map(row.attack.options.get, ("epsilon", "tau", "steps", "seed"))) for row in plan.rows}
    assert len(asked) == len(plan.rows)


def key(**file: Any) -> str:
    return planned(**file).rows[0].key


def test_keys_are_the_same_at_every_run_and_others_for_other_options_not_for_defaults_spelled_out() -> None:
    assert key(base={"steps": 7}) == key(base={"steps": 7}) != key(base={"steps": 8})
    assert key(name="other").startswith("other-")
    assert key(base={"epsilon": 0.05, "steps": 90, "background": "white"}) == key()


class LaterRequest(JobRequest):
    """A job request of a version with one more option."""

    gloss: float = 0.5

    def spec(self) -> JobSpec:
        return LaterRequest.model_validate(self.model_dump(exclude={"labels", "priority"}))


def test_keys_stay_when_a_version_adds_an_option_until_somebody_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {
        "base": {"steps": 7, "ranges": {"roll": [-5, 5]}},
        "grid": {"epsilon": [0.02, 0.1], "image_pipeline": ["none"]},
    }
    before = [row.key for row in planned(**asked).rows]
    monkeypatch.setattr(_plan, "JobRequest", LaterRequest)
    assert [row.key for row in planned(**asked).rows] == before
    glossy = [job_key("small", LaterRequest.of("mug", label="mug", gloss=gloss)) for gloss in (0.5, 0.6)]
    assert glossy[0] == job_key("small", JobRequest.of("mug", label="mug")) != glossy[1]


def test_keys_are_those_of_the_version_before_unless_what_they_stand_for_was_said_to_have_changed() -> None:
    """A changed default makes the same file another job: raise ``KEY_VERSION``, and write the new defaults here."""
    defaults = json.loads(json.dumps(JobSpec.of("mug", label="mug").options(), default=lambda part: part.model_dump()))
    assert (KEY_VERSION, {name: defaults[name] for name in DEFAULTS}) == (3, DEFAULTS)


def test_several_grids_are_series_and_what_they_share_is_one_job() -> None:
    plan = planned(grid=[{"steps": [10, 30]}, {"pool": [60, 240]}], base={"steps": 30, "pool": 240})
    assert [row.place.series for row in plan.rows] == ["steps", "steps", "pool", "pool"]
    assert [row.place.configuration for row in plan.rows] == ["steps 10", "steps 30", "pool 60", "pool 240"]
    assert plan.rows[1].key == plan.rows[3].key
    assert len(plan.jobs()) == 3


def test_later_fields_win_base_object_grid_case() -> None:
    plan = planned(
        base={"steps": 1, "pool": 1, "held_out": 1, "background": "black"},
        objects={"mug": {"steps": 2, "pool": 2, "held_out": 2}},
        grid={"pool": [3], "held_out": [3]},
        cases={"last": {"held_out": 4}},
    )
    request = plan.rows[0].request
    assert (request.search.steps, request.views.pool, request.views.held_out) == (2, 3, 4)
    assert request.views.background == ["black"]


def test_a_case_may_have_seeds_of_its_own() -> None:
    plan = planned(cases={"often": {"seeds": 5}, "else": {}}, seeds=2)
    assert [(row.place.case, row.request.search.seed) for row in plan.rows] == [
        *(("often", seed) for seed in range(5)),
        ("else", 0),
        ("else", 1),
    ]


def test_fractions_are_numbers_and_small_budgets_take_small_steps() -> None:
    plan = planned(grid={"epsilon": ["1/255", "4/255"]})
    assert [row.request.paint.epsilon for row in plan.rows] == [1 / 255, 4 / 255]
    assert plan.rows[0].request.alpha == pytest.approx(1 / 255 / 5)


def test_a_preset_stands_for_its_options_and_what_is_given_beside_it_wins() -> None:
    plan = planned(base={"preset": "fast", "steps": 3}, grid={"preset": ["best"], "held_out": [5]})
    assert plan.rows[0].request.views.pool == PRESETS["best"].options["pool"]
    assert plan.rows[0].request.views.held_out == 5
    (plain,) = planned(base={"preset": "fast", "steps": 3}).rows
    assert (plain.request.search.steps, plain.request.views.pool) == (3, PRESETS["fast"].options["pool"])


def test_assets_give_objects_their_distance_elevations_class_and_background(assets: Path) -> None:
    plan = planned(objects={"assets": "$TROMPE_ASSETS", "only": ["pot"]})
    (row,) = plan.rows
    views = row.request.views
    assert (row.request.goal.label, views.distance, views.background) == ([471], 0.5, ["black"])
    assert (views.elevation, row.object, row.request.object) == ((-10, 40), "pot", "pot.zip")
    assert key(objects={"assets": "$TROMPE_ASSETS", "only": ["pot"]}) == row.key


def test_a_relative_folder_of_assets_is_below_the_working_folder(assets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(assets.parent)
    monkeypatch.setenv("TROMPE_ASSETS", assets.name)
    assert len(plan_experiment(load_experiment("baselines_real")).rows) == 15


def test_files_are_named_by_their_bytes_and_then_by_what_the_server_called_them(assets: Path, tmp_path: Path) -> None:
    classifier = "$TROMPE_ASSETS/classifiers/mobilenet_v2.pt2"
    (tmp_path / "room.png").write_bytes(b"picture")
    path = written(tmp_path, base={"classifier": classifier, "judges": ["tiny"], "background": ["white", "room.png"]})
    (row,) = plan_experiment(load_experiment(path)).rows
    assert (row.request.victim.classifier, row.request.views.background) == ("mobilenet_v2.pt2", ["white", "room.png"])
    ids = {"mobilenet_v2.pt2": "id-1", "room.png": "id-2"}
    stored = row.attack.request({each: ids[each.filename] for each in row.attack.uploads()})
    assert (stored.victim.classifier, stored.judges.networks) == ("id-1", ["tiny"])
    assert stored.views.background == ["white", "id-2"]
    assert stored.labels == {"experiment": "small"}


def test_configurations_name_files_without_folder_and_suffix_and_other_networks_in_full(assets: Path) -> None:
    networks = ["timm:resnet50.a1_in1k", "hf:someone/net.onnx", "$TROMPE_ASSETS/classifiers/mobilenet_v2.pt2"]
    plan = planned(grid={"classifier": networks})
    named = [f"classifier {name}" for name in (*networks[:2], "mobilenet_v2")]
    assert [row.place.configuration for row in plan.rows] == named


@pytest.mark.parametrize("name", shipped_experiments())
def test_what_comes_with_trompe_can_be_planned(name: str, assets: Path) -> None:
    experiment = load_experiment(name)
    assert experiment.name == name
    assert experiment.description
    assert plan_experiment(experiment).rows


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        pytest.param(
            {"base": {"epsilonn": 1}}, r"base: unknown option 'epsilonn'; did you mean 'epsilon'\?", id="field"
        ),
        pytest.param({"base": {"seed": 1}}, "list seeds under `seeds`", id="own place"),
        pytest.param({"grid": {"tau": 0.2}}, "'tau' must be a list of values; got 0.2", id="no list"),
        pytest.param({"grid": {"step": [1]}}, "did you mean 'steps'", id="field of a grid"),
        pytest.param({"cases": {"dark": {"rangs": {}}}}, "cases.dark: unknown option 'rangs'", id="field of a case"),
        pytest.param({"cases": {"dark": {"seeds": "x"}}}, "'seeds' must be a list", id="seeds of a case"),
        pytest.param({"objects": {"mug": {"distanc": 1}}}, "did you mean 'distance'", id="field of an object"),
        pytest.param({"base": {"preset": "quickest"}}, "presets: fast, balanced, best", id="preset"),
        pytest.param({"base": {"preset": ["fast"]}}, "presets: fast, balanced, best", id="presets"),
        pytest.param({"grid": {"preset": ["slow"]}}, "unknown preset 'slow'", id="preset in a grid"),
        pytest.param({"base": {"epsilon": "1/0"}}, "base: '1/0' divides by zero", id="fraction"),
        pytest.param({"judgement": {"veiws": 60}}, "judgement: unknown .* did you mean 'views'", id="judgement"),
        pytest.param({"judgement": {"epsilon": 0.1}}, "'epsilon' .* the experiment sets it", id="set for a judgement"),
        pytest.param({"judgement": {"views": 0}}, "views: .* greater than or equal to 1", id="value of a judgement"),
        pytest.param({"judgement": {"suite": "standard-1"}}, "leave out `suite`", id="suite of a judgement"),
        pytest.param({"judgement": {"renderers": ["three", "cycles"]}}, "one of `renderers`", id="renderers"),
        pytest.param({"objects": ["mug"]}, "objects: expected shipped, .* a table of objects", id="list of objects"),
        pytest.param({"seeds": 20261127}, r"number of seeds, at most 1000; .* write \[20261127\]", id="one seed"),
        pytest.param({"seeds": [0, 1, 0]}, "gives a seed twice", id="a seed twice"),
        pytest.param({"grid": {"epsilon": [0.1, 0.1]}}, "'epsilon' gives a value twice", id="a value twice"),
        pytest.param({"grd": {}}, "unknown key 'grd'; keys: name,", id="part"),
        pytest.param({"name": "no spaces"}, "name", id="name"),
    ],
)
def test_mistakes_are_told_with_what_there_is(mistake: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=words):
        load_experiment(written(tmp_path, **mistake))


def test_a_job_that_contradicts_itself_is_told_before_anything_is_asked() -> None:
    with pytest.raises(SpecError, match=r"Job mug, alpha 0\.5: .*`alpha` \(0\.5\)"):
        planned(grid={"alpha": [0.5]})


UNFIT: dict[str, tuple[dict[str, Any], str]] = {
    "networks": ({"grid": {"classifier": ["tiny", "net.onnx"]}}, "judgement of mug needs one `classifier`"),
    "name": ({"objects": {"stored": {"label": 0}}}, "needs the file of stored for its noise: give it as `file`"),
    "background": ({"base": {"background": "room.png"}}, "judgement of mug: .*'room.png' is not a colour"),
}


@pytest.mark.parametrize(("mistake", "words"), UNFIT.values(), ids=UNFIT)
def test_what_can_never_be_judged_is_told_before_any_job(mistake: dict[str, Any], words: str, tmp_path: Path) -> None:
    for file in ("net.onnx", "room.png"):
        (tmp_path / file).write_bytes(b"file")
    assert planned(**mistake, folder=tmp_path).rows
    with pytest.raises(SpecError, match=words):
        planned(**mistake, folder=tmp_path, judgement={"views": 4})


def test_a_judgement_may_be_of_several_budgets_and_of_one_network_by_object() -> None:
    objects = {"mug": {"classifier": "tiny"}, "ball": {"classifier": "timm:resnet50.a1_in1k"}}
    assert planned(objects=objects, grid={"epsilon": [0.02, 0.05]}, judgement={}).rows


def test_what_is_not_there_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped = "one of baselines, baselines_real, engines, few_texels, paper, path_tracers, perceptual, quick"
    with pytest.raises(SpecError, match=shipped):
        load_experiment("nothing")
    (tmp_path / "bad.yaml").write_text("name: [")
    with pytest.raises(SpecError, match="is not YAML"):
        load_experiment(tmp_path / "bad.yaml")
    (tmp_path / "twice.yaml").write_text("name: a\nobjects: {mug: {}}\ngrid: {tau: [0.1]}\ngrid: {tau: [0.2]}\n")
    with pytest.raises(SpecError, match=r"'grid' is given twice\s.*line 4"):
        load_experiment(tmp_path / "twice.yaml")
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(SpecError, match="must be a table"):
        load_experiment(tmp_path / "list.yaml")
    with pytest.raises(ClassifierError, match="There is no classifier file"):
        planned(base={"classifier": "nowhere.pt2"})
    monkeypatch.delenv("TROMPE_ASSETS", raising=False)
    with pytest.raises(SpecError, match="'stored' needs a `label`, as it is none of the shipped objects"):
        planned(objects={"stored": None})
    with pytest.raises(SpecError, match="needs the environment variable TROMPE_ASSETS"):
        planned(objects={"assets": "$TROMPE_ASSETS"})


def test_unknown_objects_of_the_assets_are_told(assets: Path) -> None:
    with pytest.raises(ObjectError, match=r"No mug in .*; objects: candle, pot, plunger, table_living_room, "):
        planned(objects={"assets": "$TROMPE_ASSETS", "only": ["mug"]})
    (assets / "objects" / "objects.json").unlink()
    with pytest.raises(ObjectError, match=r"must hold an objects\.json"):
        planned(objects={"assets": "$TROMPE_ASSETS"})
