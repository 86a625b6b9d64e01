"""The file of an experiment: what it may say, what its jobs are, and what is said of mistakes."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from trompe_client.experiments import Experiment, Plan, load_experiment, plan, plan_experiment, shipped_experiments
from trompe_shared.api import JobRequest, JobSpec
from trompe_shared.errors import ClassifierError, ObjectError, SpecError
from trompe_shared.experiment_table import KEY_VERSION, job_key
from trompe_shared.presets import PRESETS
from trompe_shared.shipped import shipped_objects

DEFAULTS: dict[str, Any] = {
    "classifier": "tiny",
    "ensemble": [],
    "judges": [],
    "diverse": False,
    "attack_on": "texture",
    "sun": {"azimuth": [-180, 180], "elevation": [15, 88], "intensity": None, "ambient": None},
    "vertex_budget": 0.02,
    "epsilon": 0.05,
    "alpha": 0.01,
    "tau": None,
    "keep": None,
    "materials": [],
    "masks": {},
    "epsilon_view": None,
    "target_label": None,
    "top_k": 1,
    "loss": "margin",
    "optimiser": "nesterov",
    "restarts": 0,
    "queries": None,
    "surrogate": "auto",
    "steps": 90,
    "seed": 0,
    "distance": None,
    "elevation": None,
    "background": ["white"],
    "azimuths": 6,
    "elevations": 10,
    "pool": 240,
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
"""What jobs of ``KEY_VERSION`` do where a file is silent; options that came later without a new version are missing."""

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
    table = {}
    for number, name in enumerate(("candle", "pot", "plunger", "table_living_room")):
        (folder / "objects" / name).mkdir(parents=True)
        (folder / "objects" / name / f"{name}.obj").write_text(f"o {name}")
        row = {"imagenet_class": 470 + number, "distance": 0.5, "elevation_range": [-10, 40], "background": "black"}
        table[name] = row
    (folder / "objects" / "objects.json").write_text(json.dumps(table))
    (folder / "classifiers").mkdir()
    for name in ("mobilenet_v2", "mobilenet_edgetpu_075", "squeezenet1_1"):
        (folder / "classifiers" / f"{name}.pt2").write_bytes(name.encode())
    monkeypatch.setenv("TROMPE_ASSETS", str(folder))
    return folder


def test_a_minimal_file_is_one_job_with_the_label_of_the_experiment() -> None:
    (row,) = planned().rows
    assert row.object == row.request.object == "mug"
    assert row.request.label == "mug"
    assert row.request.labels == {"experiment": "small"}
    assert row.request.priority == "sweep"
    assert row.key.startswith("small-")


@given(
    epsilons=st.lists(st.sampled_from([0.02, 0.05, 0.1, 0.5]), min_size=1, unique=True),
    taus=st.lists(st.sampled_from([None, 0.05, 0.2]), min_size=1, unique=True),
    cases=st.integers(0, 3),
    seeds=st.integers(1, 4),
)
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
    asked = {(r.object, r.request.epsilon, r.request.tau, r.request.steps, r.request.seed) for r in plan.rows}
    assert len(asked) == len(plan.rows)


def test_keys_are_the_same_at_every_run_and_others_for_other_options() -> None:
    first, second = planned(base={"steps": 7}), planned(base={"steps": 7})
    assert [row.key for row in first.rows] == [row.key for row in second.rows]
    assert planned(base={"steps": 8}).rows[0].key != first.rows[0].key
    assert planned(name="other").rows[0].key.startswith("other-")


class LaterRequest(JobRequest):
    """A job request of a version that has one option more."""

    gloss: float = 0.5

    def spec(self) -> JobSpec:
        return LaterRequest.model_validate(self.model_dump(exclude={"labels", "priority"}))


def test_keys_stay_when_a_later_version_adds_an_option_until_somebody_asks_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = {"base": {"steps": 7, "ranges": {"roll": [-5, 5]}}, "grid": {"epsilon": [0.02, 0.1], "diverse": [True]}}
    before = [row.key for row in planned(**asked).rows]
    monkeypatch.setattr(plan, "JobRequest", LaterRequest)
    assert [row.key for row in planned(**asked).rows] == before
    glossy = [job_key("small", LaterRequest(object="mug", label="mug", gloss=gloss)) for gloss in (0.5, 0.6)]
    assert glossy[0] == job_key("small", JobRequest(object="mug", label="mug")) != glossy[1]


def test_keys_do_not_depend_on_whether_a_default_is_spelled_out() -> None:
    assert planned(base={"epsilon": 0.05, "alpha": 0.01, "background": "white"}).rows[0].key == planned().rows[0].key


def test_keys_are_those_of_the_version_before_unless_what_they_stand_for_was_said_to_have_changed() -> None:
    """A default that changes makes the same file another job: raise ``KEY_VERSION``, and write the new ones here."""

    def known(then: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
        return {name: known(old, now[name]) if isinstance(old, dict) else now[name] for name, old in then.items()}

    defaults = JobSpec(object="mug", label="mug").model_dump(mode="json")
    assert (KEY_VERSION, known(DEFAULTS, defaults)) == (1, DEFAULTS)


def test_several_grids_are_series_and_what_they_share_is_one_job() -> None:
    plan = planned(grid=[{"steps": [10, 30]}, {"pool": [0, 240]}], base={"steps": 30, "pool": 240})
    assert [row.place.series for row in plan.rows] == ["steps", "steps", "pool", "pool"]
    assert [row.place.configuration for row in plan.rows] == ["steps 10", "steps 30", "pool 0", "pool 240"]
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
    assert (request.steps, request.pool, request.held_out, request.background) == (2, 3, 4, ["black"])


def test_a_case_may_have_seeds_of_its_own() -> None:
    plan = planned(cases={"often": {"seeds": 5}, "else": {}}, seeds=2)
    assert [(row.place.case, row.request.seed) for row in plan.rows] == [
        *(("often", seed) for seed in range(5)),
        ("else", 0),
        ("else", 1),
    ]


def test_fractions_are_numbers_and_small_budgets_take_small_steps() -> None:
    plan = planned(grid={"epsilon": ["1/255", "4/255"]})
    assert [row.request.epsilon for row in plan.rows] == [1 / 255, 4 / 255]
    assert plan.rows[0].request.alpha == pytest.approx(1 / 255 / 5)


def test_a_preset_stands_for_its_options_and_what_is_given_beside_it_wins() -> None:
    plan = planned(base={"preset": "fast", "steps": 3}, grid={"preset": ["best"], "held_out": [5]})
    assert plan.rows[0].request.pool == PRESETS["best"].options["pool"]
    assert plan.rows[0].request.held_out == 5
    (plain,) = planned(base={"preset": "fast", "steps": 3}).rows
    assert (plain.request.steps, plain.request.pool) == (3, PRESETS["fast"].options["pool"])


def test_shipped_stands_for_all_shipped_objects() -> None:
    plan = planned(objects="shipped")
    assert [row.object for row in plan.rows] == list(shipped_objects())


def test_assets_give_objects_their_distance_elevations_class_and_background(assets: Path) -> None:
    plan = planned(objects={"assets": "$TROMPE_ASSETS", "only": ["pot"]})
    (row,) = plan.rows
    assert (row.request.label, row.request.distance, row.request.background) == (471, 0.5, ["black"])
    assert row.request.elevation == (-10, 40)
    assert row.object == "pot"
    assert row.uploads[row.request.object].upload.filename == "pot.zip"
    assert planned(objects={"assets": "$TROMPE_ASSETS", "only": ["pot"]}).rows[0].key == row.key


def test_files_are_named_by_their_bytes_and_then_by_what_the_server_called_them(assets: Path, tmp_path: Path) -> None:
    classifier = "$TROMPE_ASSETS/classifiers/mobilenet_v2.pt2"
    (tmp_path / "room.png").write_bytes(b"picture")
    path = written(tmp_path, base={"classifier": classifier, "judges": ["tiny"], "background": ["white", "room.png"]})
    (row,) = plan_experiment(load_experiment(path)).rows
    kinds = {file.kind: name for name, file in row.uploads.items()}
    assert row.request.classifier == kinds["classifier"]
    stored = row.stored({kinds["classifier"]: "id-1", kinds["background"]: "id-2"})
    assert (stored.classifier, stored.judges, stored.background) == ("id-1", ["tiny"], ["white", "id-2"])
    assert stored.labels == {"experiment": "small"}


@pytest.mark.parametrize("name", ["paper", "quick", "speed_accuracy", "speed_accuracy_real", "stability"])
def test_what_comes_with_trompe_can_be_planned(name: str, assets: Path) -> None:
    assert name in shipped_experiments()
    experiment = load_experiment(name)
    assert experiment.name == name
    assert experiment.description
    assert plan_experiment(experiment).rows


MISTAKES = [
    pytest.param(
        {"base": {"epsilonn": 1}}, r"base: there is no field 'epsilonn'; did you mean 'epsilon'\?", id="field"
    ),
    pytest.param({"base": {"seed": 1}}, "list the seeds under `seeds`", id="own place"),
    pytest.param({"grid": {"tau": 0.2}}, "'tau' must be a list of the values to try, got 0.2", id="no list"),
    pytest.param({"grid": {"step": [1]}}, "did you mean 'steps'", id="field of a grid"),
    pytest.param({"cases": {"dark": {"rangs": {}}}}, "cases.dark: there is no field 'rangs'", id="field of a case"),
    pytest.param({"cases": {"dark": {"seeds": "x"}}}, "'seeds' must be a list", id="seeds of a case"),
    pytest.param({"objects": {"mug": {"distanc": 1}}}, "did you mean 'distance'", id="field of an object"),
    pytest.param({"base": {"preset": "quickest"}}, "there are fast, balanced, best", id="preset"),
    pytest.param({"grd": {}}, "there is no 'grd'; there are name,", id="part"),
    pytest.param({"name": "no spaces"}, "name", id="name"),
]


@pytest.mark.parametrize(("mistake", "words"), MISTAKES)
def test_mistakes_are_told_with_what_there_is(mistake: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=words):
        load_experiment(written(tmp_path, **mistake))


def test_a_job_that_contradicts_itself_is_told_before_anything_is_asked() -> None:
    with pytest.raises(SpecError, match=r"The job mug, alpha 0\.5, cannot be: .*alpha \(0\.5\)"):
        planned(grid={"alpha": [0.5]})
    with pytest.raises(SpecError, match="no preset 'slow'"):
        planned(grid={"preset": ["slow"]})


def test_what_is_not_there_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SpecError, match="one of paper, quick, speed_accuracy, speed_accuracy_real, stability"):
        load_experiment("nothing")
    (tmp_path / "bad.yaml").write_text("name: [")
    with pytest.raises(SpecError, match="is not YAML"):
        load_experiment(tmp_path / "bad.yaml")
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(SpecError, match="must be a table"):
        load_experiment(tmp_path / "list.yaml")
    with pytest.raises(ClassifierError, match="There is no classifier file"):
        planned(base={"classifier": "nowhere.pt2"})
    monkeypatch.delenv("TROMPE_ASSETS", raising=False)
    with pytest.raises(SpecError, match="needs the environment variable TROMPE_ASSETS"):
        planned(objects={"assets": "$TROMPE_ASSETS"})


def test_unknown_objects_of_the_assets_are_told(assets: Path) -> None:
    with pytest.raises(ObjectError, match="has no mug; there are candle, pot, plunger, table_living_room"):
        planned(objects={"assets": "$TROMPE_ASSETS", "only": ["mug"]})
    (assets / "objects" / "objects.json").unlink()
    with pytest.raises(ObjectError, match=r"must hold an objects\.json"):
        planned(objects={"assets": "$TROMPE_ASSETS"})
