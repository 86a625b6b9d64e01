"""Judgements of the results of an experiment: what is judged, with which options, and that rows are kept."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.experiments.test_run import FakeService, Silent
from trompe_experiments.baselines import baselines_markdown
from trompe_experiments.design import OF_JOBS, Experiment, load_experiment
from trompe_experiments.figures import read_data
from trompe_experiments.judged import JUDGEMENTS, NOISE, NOTHING, JudgedRow, judge_all, noised
from trompe_experiments.plan import Plan, plan_experiment
from trompe_experiments.run import run_experiment
from trompe_experiments.table import read_table
from trompe_server.api.examples import MANIFEST as EXAMPLE
from trompe_shared.api import Job, JudgementRequest, Manifest
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects

FILE: dict[str, Any] = {
    "name": "small",
    "objects": {"mug": {"elevation": [5, 15]}, "ball": {}},
    "base": {"epsilon": 0.05},
    "cases": {"weak": {"steps": 5}, "strong": {"steps": 50}},
    "judgement": {"views": 4, "seed": 1},
    "artifacts": ["*-adversarial.zip"],
}


class JudgingService(FakeService):
    """Keeps the requests of judgements and their keys; the painted objects are the shipped ones."""

    def __init__(self) -> None:
        super().__init__()
        self.judged: list[JudgementRequest] = []
        self.keys: list[str] = []

    def job(self, job: str) -> Job:
        found = super().job(job)
        return found.model_copy(update={"artifacts": [*found.artifacts, f"{found.attack.object}-adversarial.zip"]})

    def artifact(self, job: str, name: str) -> bytes | None:
        return shipped_objects()[name.partition("-")[0]].read() if name.endswith(".zip") else b"picture"

    def judge(self, request: JudgementRequest, *, key: str) -> Manifest:
        self.judged.append(request)
        self.keys.append(key)
        return Manifest.model_validate(EXAMPLE)


def planned(**changes: object) -> Plan:
    return plan_experiment(Experiment.model_validate(FILE | changes))


@pytest.fixture
def plan() -> Plan:
    return planned()


def judged(
    plan: Plan, service: JudgingService, folder: Path, show: Callable[[str], None] = lambda _: None
) -> list[JudgedRow]:
    rows = run_experiment(plan, service, folder, show=Silent())
    return judge_all(plan, service, folder, seconds={row.key: row.seconds for row in rows}, show=show)


@pytest.mark.parametrize("artifacts", [[], ["*-adversarial.zip"]])
def test_each_object_is_judged_as_it_is_with_noise_and_painted(artifacts: list[str], tmp_path: Path) -> None:
    service = JudgingService()
    rows = judged(planned(artifacts=artifacts), service, tmp_path)
    cases = [NOTHING, NOISE, "weak", "strong"]
    assert [(row.object, row.case) for row in rows] == [(name, case) for name in ("mug", "ball") for case in cases]
    assert [row.seconds for row in rows[:4]] == [None, None, 6.5, 6.5]
    assert {row.a_drop for row in rows} == {EXAMPLE["cells"][0]["accuracy"]["a_drop"]}
    assert service.judged[0].after == "mug"
    assert {(one.before, one.epsilon, one.views, one.seed, one.elevation) for one in service.judged} == {
        ("mug", 0.05, 4, 1, (5, 15)),
        ("ball", 0.05, 4, 1, None),
    }
    assert [list(one.label) for one in service.judged] == [["mug"]] * 4 + [["ball"]] * 4
    assert service.judged[0].model_fields_set == {*OF_JOBS, "views", "seed"}


def test_rows_are_kept_and_made_into_a_table_and_a_chart(plan: Plan, tmp_path: Path) -> None:
    first = judged(plan, JudgingService(), tmp_path)
    again = JudgingService()
    assert judged(plan, again, tmp_path) == read_table(tmp_path / JUDGEMENTS, JudgedRow)
    assert again.judged == []
    table = baselines_markdown(first).splitlines()
    assert table[0] == "| method | A_drop | at half size | JPEG 30 | CIEDE2000 | seconds |"
    assert len(table) == 2 + 4
    assert [path.suffix for path in read_data(tmp_path).draw("baselines")] == [".svg", ".png"]


def test_where_only_the_tables_were_kept_judgements_stay_and_what_is_missing_is_told(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, again, told = judged(plan, JudgingService(), tmp_path), JudgingService(), list[str]()
    shutil.rmtree(tmp_path / "jobs")
    monkeypatch.setattr(JudgingService, "artifact", lambda *_: None)
    wider = planned(cases={**FILE["cases"], "other": {"steps": 7}})
    rows = judged(wider, again, tmp_path, told.append)
    assert [row.key for row in rows] == [row.key for row in first]
    assert told == [f"no painting of {name}, other in {str(tmp_path)!r}" for name in ("mug", "ball")]
    assert again.judged == []


def test_changed_options_of_the_judgement_judge_everything_again_under_other_keys(plan: Plan, tmp_path: Path) -> None:
    first, again = JudgingService(), JudgingService()
    judged(plan, first, tmp_path)
    rows = judged(planned(judgement={"views": 4, "seed": 2}), again, tmp_path)
    assert [one.seed for one in again.judged] == [2] * 8
    assert [row.key for row in rows] == again.keys
    assert not {*first.keys} & {*again.keys}


def test_without_cases_each_configuration_of_the_grid_is_a_method(tmp_path: Path) -> None:
    rows = judged(planned(cases={}, grid={"epsilon": [0.02, 0.05]}), JudgingService(), tmp_path)
    methods = [line.split(" | ")[0] for line in baselines_markdown(rows).splitlines()[2:]]
    assert methods == ["| no change", "| noise", "| epsilon 0.02", "| epsilon 0.05"]


def test_a_judgement_without_figures_says_why_and_the_others_go_on(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finding = {"kind": "network", "text": "No figures of 'tiny'."}
    empty = Manifest.model_validate(EXAMPLE | {"cells": [], "findings": [*EXAMPLE["findings"], finding]})
    others = [Manifest.model_validate(EXAMPLE)] * 7
    monkeypatch.setattr(JudgingService, "judge", Mock(side_effect=[empty, *others]))
    told = list[str]()
    rows = judged(plan, JudgingService(), tmp_path, told.append)
    assert told[1] == f"mug, {NOTHING}: No figures of 'tiny'."
    assert [row.configuration for row in rows if row.object == "mug"] == ["noise", "weak", "strong"]
    assert len(rows) == 7


@given(epsilon=st.floats(0.004, 1), seed=st.integers(0, 9))
@settings(deadline=None, max_examples=10)
def test_noise_keeps_within_the_budget_and_depends_on_its_seed(epsilon: float, seed: int) -> None:
    obj = load_object(shipped_objects()["ball"].read())
    noisy = noised(obj, epsilon, seed=seed)
    for name, image in obj.textures.items():
        change = np.abs(noisy.textures[name].astype(int) - image)
        assert 0 < change.max() <= epsilon * 255 + 1e-9
        assert (noised(obj, epsilon, seed=seed).textures[name] == noisy.textures[name]).all()
        assert (noised(obj, epsilon, seed=seed + 1).textures[name] != noisy.textures[name]).any()


def test_the_shipped_baselines_are_judged_alike() -> None:
    experiment = load_experiment("baselines")
    assert experiment.judgement == {"views": 60, "seed": 1}
    specs = {row.place.case: row.request for row in plan_experiment(experiment).rows}
    assert list(specs) == ["paper", "eot", "fast", "balanced", "best"]
    assert {spec.search.seed for spec in specs.values()} == {0}
    assert {spec.paint.epsilon for spec in specs.values()} == {0.05}
    assert (specs["paper"].views.count, specs["paper"].image_pipeline) == (60, "none")
