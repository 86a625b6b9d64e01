"""Runner of an experiment: every job is submitted once, results are kept, and a stopped run continues."""

import csv
import json
import re
import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from datetime import UTC, datetime
from io import StringIO
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from rich.console import Console

from trompe_client import ServerUnreachable
from trompe_client._errors import APIError, BadRequest, ServerFault, TooMany, Unauthorized
from trompe_client._plan import Upload
from trompe_client.tracking import MlflowRun
from trompe_experiments import cli, progress, run
from trompe_experiments.about import ABOUT, estimated_seconds, write_about
from trompe_experiments.cli import experiment
from trompe_experiments.design import Experiment, shipped_experiments
from trompe_experiments.plan import Plan, Row, plan_experiment
from trompe_experiments.progress import Tracked, experiment_display
from trompe_experiments.run import run_experiment
from trompe_experiments.service import Service
from trompe_experiments.table import PREDICTIONS, RESULTS, PredictionRow, ResultRow, RowId, read_results, read_table
from trompe_experiments.terminal import change, compared, differences, failures
from trompe_server import renderers
from trompe_server.api.examples import RESULT as EXAMPLE
from trompe_shared.api import (
    Job,
    JobRequest,
    JobSpec,
    JobState,
    JudgementSpec,
    Problem,
    Progress,
    RendererResult,
    Result,
)
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import SpecError


def result_of(request: JobRequest) -> Result:
    """The API's example, with an ``A_drop`` of ten times epsilon."""
    drop = min(1.0, 10 * request.paint.epsilon)
    shares = {"views": 2, "a_before": 1.0, "a_after": 1 - drop, "a_drop": drop, "a_drop_interval": (drop / 2, 1.0)}
    accuracies = dict.fromkeys(("surrogate", "target", "held_out"), EXAMPLE["target"] | shares)
    paint, search = request.paint, request.search
    found = {
        "spec": request.spec(),
        "object": request.object,
        "epsilon": paint.epsilon,
        "alpha": request.alpha,
        "tau": paint.tau,
        "steps": search.steps,
        "views": 2 * EXAMPLE["views"],
        "warnings": ["one", "two"],
        "seconds": {"prepare": 1.0, "attack-000": 2.0, "attack-001": 3.0, "judge": 0.5},
    }
    return Result.model_validate(EXAMPLE | accuracies | found)


class FakeService(Service):
    """Runs a job when it is polled. Jobs on ``failing`` objects fail, those on ``refused`` ones are refused, jobs in
    ``waiting`` stay queued."""

    def __init__(self) -> None:
        self.by_key: dict[str, Job] = {}
        self.requests: dict[str, JobRequest] = {}
        self.uploads: list[Upload] = []
        self.failing: set[str] = set()
        self.refused: set[str] = set()
        self.waiting: set[str] = set()
        self.goes_away_after: int | None = None
        self.looks = 0
        self.ids = count(1)

    def store(self, upload: Upload) -> str:
        self.uploads.append(upload)
        return f"stored-{len(self.uploads)}"

    def submit(self, request: JobRequest, key: str) -> Job:
        if request.object in self.refused:
            raise BadRequest(Problem(title="No such class", status=422))
        if key not in self.by_key:
            name, now = f"job-{next(self.ids)}", datetime.now(UTC)
            job = Job(id=name, state=JobState.queued, spec=request.spec(), created=now, worker=None)
            self.by_key[key], self.requests[job.id] = job, request
        return self.by_key[key]

    def job(self, job: str) -> Job:
        self.looks += 1
        if self.goes_away_after is not None and self.looks > self.goes_away_after:
            raise ServerUnreachable("gone")
        found = next(each for each in self.by_key.values() if each.id == job)
        if job in self.waiting:
            return found
        bad = found.attack.object in self.failing
        state, error = (JobState.failed, "the renderer said no") if bad else (JobState.succeeded, None)
        return found.model_copy(
            update={
                "state": state,
                "error": error,
                "progress": Progress(phase="judge", fraction=1),
                "artifacts": [] if bad else ["contact_sheet.png", "result.json", "textures.png"],
            }
        )

    def jobs(self, experiment: str) -> Iterator[Job]:
        found = [self.job(job.id) for job in self.by_key.values()]
        return (job for job in reversed(found) if self.requests[job.id].labels["experiment"] == experiment)

    def result(self, job: str) -> Result:
        return result_of(self.requests[job])

    def artifact(self, job: str, name: str) -> bytes | None:
        return b"picture" if name.endswith(".png") else None

    def classes(self, classifier: str) -> list[str] | None:
        return ["ball", "chair", "mug"]


class Silent:
    """Counts calls, with the states and the cases of the jobs that end."""

    def __init__(self) -> None:
        self.began: dict[str, int] = {}
        self.ended: list[str] = []
        self.cases: list[str] = []

    def begin(self, *, total: int, done: int) -> None:
        self.began = {"total": total, "done": done}

    def look(self, row: Row, job: Job) -> None:
        """Nothing to count."""

    def end(self, row: Row, finished: Any) -> None:
        self.ended.append(finished.state)
        self.cases.append(row.place.case)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PAUSE", 0.0)


@pytest.fixture
def service() -> FakeService:
    return FakeService()


def plan_of(**file: Any) -> Plan:
    small: dict[str, Any] = {
        "name": "small",
        "objects": {"mug": {}, "chair": {}},
        "grid": {"epsilon": [0.02, 0.05]},
        "artifacts": ["contact_*.png", "missing.png"],
    }
    return plan_experiment(Experiment.model_validate(small | file))


def invoked(*words: object, status: int = 0) -> str:
    """Output of ``trompe experiment``."""
    told = CliRunner().invoke(experiment, [str(word) for word in words])
    assert told.exit_code == status, told.output
    return told.output


def ran(plan: Plan, service: FakeService, folder: Path, **options: Any) -> tuple[Sequence[ResultRow], Silent]:
    show = Silent()
    return run_experiment(plan, service, folder, show=show, **options), show


def test_each_job_is_submitted_and_its_row_written(service: FakeService, tmp_path: Path) -> None:
    ended, show = ran(plan_of(), service, tmp_path)
    assert show.began == {"total": 4, "done": 0}
    assert show.ended == ["succeeded"] * 4
    rows = read_table(tmp_path / RESULTS, ResultRow)
    assert rows == list(ended)
    assert [(row.object, row.epsilon, row.target_a_drop) for row in rows] == [
        ("mug", 0.02, 0.2),
        ("mug", 0.05, 0.5),
        ("chair", 0.02, 0.2),
        ("chair", 0.05, 0.5),
    ]
    first = rows[0]
    assert (first.attack_s, first.prepare_s, first.seconds) == (5.0, 1.0, 6.5)
    assert (first.warnings, first.image_size, first.configuration) == ("one | two", "128x128", "epsilon 0.02")
    assert (first.target_a_drop_low, first.target_a_drop_high) == (0.1, 1.0)
    assert not any(row.failed for row in rows)


def test_what_the_server_has_done_is_fetched_before_any_wait(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(grid={"epsilon": [0.05]}), service, tmp_path / "before")
    service.by_key = {key: service.job(job.id) for key, job in service.by_key.items()}
    service.goes_away_after = service.looks
    with pytest.raises(ServerUnreachable):
        ran(plan_of(), service, tmp_path / "now")
    rows = read_table(tmp_path / "now" / RESULTS, ResultRow)
    assert [(row.object, row.epsilon) for row in rows] == [("mug", 0.05), ("chair", 0.05)]


def test_a_job_is_fetched_when_it_is_done_however_many_before_it_wait(service: FakeService, tmp_path: Path) -> None:
    plan = plan_of(objects={"mug": {}}, grid={"epsilon": [k / 100 for k in range(1, 3 * run.POLLED + 1)]})
    service.waiting = {f"job-{number}" for number in range(1, len(plan.rows))}  # all but the last
    service.goes_away_after = 10 * len(plan.rows)
    with pytest.raises(ServerUnreachable):
        ran(plan, service, tmp_path)
    assert [row.epsilon for row in read_table(tmp_path / RESULTS, ResultRow)] == [plan.rows[-1].request.paint.epsilon]


def test_rows_hold_the_resolved_views_per_step_and_image_pipeline(service: FakeService, tmp_path: Path) -> None:
    cases = {"plain": {}, "many": {"ensemble": ["tiny"]}, "few": {"views_per_step": 7}, "grid": {"grid": True}}
    ran(plan_of(objects={"mug": {}}, grid={}, cases=cases), service, tmp_path)
    rows = read_table(tmp_path / RESULTS, ResultRow)
    assert [(row.case, row.image_pipeline, row.views_per_step, row.alpha) for row in rows] == [
        ("plain", "robust", 40, 0.01),
        ("many", "transfer", 40, 0.01),
        ("few", "robust", 7, 0.01),
        ("grid", "none", 60, 0.01),
    ]


def test_predictions_and_the_named_artifacts_are_kept(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path)
    key = next(iter(plan_of().jobs()))
    assert (tmp_path / "jobs" / key / "contact_sheet.png").read_bytes() == b"picture"
    assert {file.name for file in (tmp_path / "jobs" / key).glob("*.png")} == {"contact_sheet.png"}
    predictions = [row for row in read_table(tmp_path / PREDICTIONS, PredictionRow) if row.key == key]
    told = [(row.views, row.moment, row.name, row.true_class, row.count) for row in predictions]
    assert told == [
        ("target", "before", "mug", True, 2),
        ("target", "after", "chair", False, 2),
        ("held_out", "before", "mug", True, 1),
        ("held_out", "after", "chair", False, 1),
    ]


def test_another_run_submits_only_what_is_new_or_kept_by_another_version(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path)
    before = (tmp_path / RESULTS).read_bytes()
    other = FakeService()
    _, show = ran(plan_of(), other, tmp_path)
    assert show.began == {"total": 4, "done": 4}
    assert not other.by_key
    assert (tmp_path / RESULTS).read_bytes() == before
    _, show = ran(plan_of(grid={"epsilon": [0.02, 0.05, 0.1]}), service, tmp_path)
    assert show.began == {"total": 6, "done": 4}
    assert len(service.by_key) == 6
    key = next(iter(plan_of().jobs()))
    (tmp_path / "jobs" / key / "job.json").write_text(json.dumps({"other": "version"}))
    assert ran(plan_of(), service, tmp_path)[1].began == {"total": 4, "done": 3}


def test_a_run_that_was_cut_off_goes_on_where_it_was(service: FakeService, tmp_path: Path) -> None:
    service.goes_away_after = 2
    with pytest.raises(ServerUnreachable):
        ran(plan_of(), service, tmp_path)
    assert len(read_table(tmp_path / RESULTS, ResultRow)) == 2
    service.goes_away_after = None
    rows, show = ran(plan_of(), service, tmp_path)
    assert show.began == {"total": 4, "done": 2}
    assert len(service.by_key) == len(rows) == 4


def test_a_second_run_in_a_folder_where_one_is_at_work_is_refused(service: FakeService, tmp_path: Path) -> None:
    refused = []

    class Impatient(Silent):
        def end(self, row: Row, finished: Any) -> None:
            with pytest.raises(SpecError) as caught:
                ran(plan_of(), FakeService(), tmp_path)
            refused.append(str(caught.value))

    assert len(run_experiment(plan_of(), service, tmp_path, show=Impatient())) == len(refused) == 4
    assert f"Another run uses {str(tmp_path)!r}: wait for its end, or choose another --out" in refused[0]
    ran(plan_of(), service, tmp_path)


def test_failures_stay_and_are_listed_until_they_are_to_be_tried_again(service: FakeService, tmp_path: Path) -> None:
    service.failing = {"chair"}
    rows, _ = ran(plan_of(), service, tmp_path)
    assert failures(rows) == [f"chair  epsilon {e}  seed 0: failed: the renderer said no" for e in (0.02, 0.05)]
    service.failing = set()
    again, show = ran(plan_of(), service, tmp_path)
    assert (show.began["done"], len(failures(again))) == (4, 2)
    mended, show = ran(plan_of(), service, tmp_path, retry_failed=True)
    assert (show.began["done"], len(failures(mended))) == (2, 0)
    assert sum("-after-job-" in key for key in service.by_key) == 2


def test_a_row_that_the_server_refuses_does_not_stop_the_others(service: FakeService, tmp_path: Path) -> None:
    service.refused = {"mug"}
    rows, _ = ran(plan_of(base={"classifier": "timm:resnet50.a1_in1k"}), service, tmp_path)
    assert rows[0].classifier == "timm:resnet50.a1_in1k"
    assert [row.state for row in rows] == ["refused", "refused", "succeeded", "succeeded"]
    assert "No such class" in rows[0].error


@pytest.mark.parametrize(("fault", "status"), [(Unauthorized, 401), (TooMany, 429), (ServerFault, 503)])
def test_a_fault_of_the_server_stops_the_run_and_leaves_no_row(
    fault: type[APIError], status: int, service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "submit", Mock(side_effect=fault(Problem(title="Not now", status=status))))
    with pytest.raises(fault):
        ran(plan_of(), service, tmp_path)
    assert read_table(tmp_path / RESULTS, ResultRow) == []


def test_objects_keep_their_own_names_whatever_their_files_are_called(service: FakeService, tmp_path: Path) -> None:
    for name in ("chair", "table"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.obj").write_text(f"o {name}")
    files = {name: {"file": str(tmp_path / name / "model.obj"), "label": 0} for name in ("chair", "table")}
    rows, _ = ran(plan_of(objects=files, grid={}), service, tmp_path / "out")
    assert [row.object for row in rows] == ["chair", "table"]


def test_a_file_is_uploaded_once_for_all_jobs(service: FakeService, tmp_path: Path) -> None:
    (tmp_path / "net.onnx").write_bytes(b"network")
    plan = plan_of(base={"classifier": str(tmp_path / "net.onnx"), "queries": 4})
    ran(plan, service, tmp_path / "out")
    assert [each.filename for each in service.uploads] == ["net.onnx"]
    assert {request.victim.classifier for request in service.requests.values()} == {"stored-1"}


def test_a_shared_job_fills_the_rows_of_all_its_series(service: FakeService, tmp_path: Path) -> None:
    plan = plan_of(grid=[{"steps": [10, 30]}, {"pool": [240]}], base={"steps": 30, "pool": 240})
    rows, show = ran(plan, service, tmp_path)
    assert (show.began["total"], len(rows)) == (4, 6)
    assert {row.series for row in rows} == {"steps", "pool"}


def row_of(**columns: Any) -> ResultRow:
    spec = JobRequest.of("mug", label="mug").spec()
    return ResultRow.of_spec(RowId(experiment="x", key="k"), spec, state="succeeded", **columns)


@pytest.mark.parametrize(("target", "cell"), [(0, "0"), (None, ""), ("ball", "ball")])
def test_rows_hold_the_class_to_be_taken_for(target: int | str | None, cell: str) -> None:
    spec = JobRequest.of("mug", label="mug", target=target).spec()
    assert ResultRow.of_spec(RowId(experiment="x", key="k"), spec, state="succeeded").target == cell


def test_rows_hold_the_drop_in_each_of_several_renderers() -> None:
    result = result_of(JobRequest.of("mug", label="mug", epsilon=0.05))
    seen = RendererResult(
        **{name: getattr(result, name) for name in ("surrogate", "target", "held_out", "transfer_gap")},
        renderer=EngineInfo("three", "0.180"),
        attacked=False,
        views=[],
        held_out_views=[],
    )
    other = seen.model_copy(update={"renderer": EngineInfo("pyrender", "0.1"), "held_out": None})
    result = result.model_copy(update={"renderers": [seen, other]})
    row = ResultRow.of_result(RowId(experiment="x", key="k"), result, state="succeeded")
    assert row.renderer_drops == "three 0.500 | pyrender 0.500"


def test_two_experiments_are_compared_on_what_they_share() -> None:
    old = [row_of(target_a_drop=drop, seed=k) for k, drop in enumerate((0.4, 0.6))] + [row_of(object="chair")]
    new = [row_of(target_a_drop=0.8), row_of(object="lamp", target_a_drop=1.0)]
    (found,) = differences(old, new)
    assert {row.object for rows in found for row in rows} == {"mug"}
    assert change(found, "target_a_drop") == pytest.approx(0.3)
    assert change(found, "held_out_a_drop") is None


def test_experiments_that_share_nothing_are_not_compared(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(objects={"mug": {}}), service, tmp_path / "a")
    ran(plan_of(objects={"chair": {}}), service, tmp_path / "b")
    with pytest.raises(SpecError, match="share no setting"):
        compared(tmp_path / "a", tmp_path / "b")
    assert compared(tmp_path / "a", tmp_path / "a")


def test_folders_are_shown_and_compared_without_columns_of_later_versions(service: FakeService, tmp_path: Path) -> None:
    new, old = tmp_path / "new", tmp_path / "old"
    ran(plan_of(), service, new)
    old.mkdir()
    with (new / RESULTS).open(newline="") as table, (old / RESULTS).open("w", newline="", encoding="utf-8-sig") as copy:
        rows = csv.DictReader(table)
        columns = [name for name in rows.fieldnames or [] if name not in {"image_pipeline", "target", "views_per_step"}]
        writer = csv.DictWriter(copy, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    first = read_results(old)[0]
    assert (first.target_a_drop, first.image_pipeline, first.target, first.views_per_step) == (0.2, "", "", None)
    for folder, other in ((new, new / RESULTS), (old, new)):
        assert "0.50 [0.25, 1.00]" in invoked("show", folder)
        told = invoked("compare", folder, other)
        assert "0 of 4 larger by 0.1 or more, 0 smaller; on average +0.000" in told


def test_a_dry_run_says_how_many_jobs_there_are_and_asks_nobody() -> None:
    told = invoked("run", "quick", "--dry-run", "--server", "http://127.0.0.1:1")
    assert told.startswith("quick: 32 jobs, about ")


def test_the_shipped_files_are_listed() -> None:
    assert [line.split()[0] for line in invoked("list").splitlines()] == list(shipped_experiments())


def test_a_table_of_another_kind_is_refused(tmp_path: Path) -> None:
    for text, words in (
        ("a,b\n1,2\n", "row 1, does not fit this version: experiment: Field required; .* and 3 more"),
        ("experiment,key,state,object,steps\nq,k,succeeded,mug,30\nq,k,succeeded,mug,3O\n", "row 2, .*: steps: .*int"),
    ):
        (tmp_path / RESULTS).write_text(text)
        with pytest.raises(SpecError, match=words):
            read_results(tmp_path)
    with pytest.raises(SpecError, match="No table"):
        read_results(tmp_path / "nowhere.csv")


def test_where_only_tables_were_kept_their_rows_stay_and_count_as_done(service: FakeService, tmp_path: Path) -> None:
    """As in a checkout of published results: the same command must not wipe them out."""
    service.failing = {"chair"}
    ran(plan_of(), service, tmp_path)
    shutil.rmtree(tmp_path / "jobs")
    tables = {name: (tmp_path / name).read_bytes() for name in (RESULTS, PREDICTIONS)}
    rows, show = ran(plan_of(), service, tmp_path)
    assert show.began == {"total": 4, "done": 4}
    assert {name: (tmp_path / name).read_bytes() for name in tables} == tables
    assert len(failures(rows)) == 2

    service.failing = set()
    wider, show = ran(plan_of(grid={"epsilon": [0.02, 0.05, 0.1]}), service, tmp_path, retry_failed=True)
    assert show.began == {"total": 6, "done": 2}
    assert [row.state for row in wider] == ["succeeded"] * 6
    assert len({each.key for each in read_table(tmp_path / PREDICTIONS, PredictionRow)}) == 6


def test_rows_that_are_all_that_is_left_of_a_job_are_never_overwritten(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path)
    narrower = plan_of(grid={"epsilon": [0.02]})
    assert len(ran(narrower, service, tmp_path)[0]) == 2
    ran(plan_of(), service, tmp_path)
    shutil.rmtree(tmp_path / "jobs")
    table = (tmp_path / RESULTS).read_bytes()
    with pytest.raises(SpecError, match=r"rows of 2 jobs .* mug, epsilon 0.05, .* choose another --out"):
        ran(narrower, service, tmp_path)
    with pytest.raises(SpecError, match=r"has the results of 'small': choose another --out for 'other'"):
        ran(plan_of(name="other"), service, tmp_path)
    assert (tmp_path / RESULTS).read_bytes() == table


def test_each_job_is_a_run_of_a_tracker(service: FakeService, tmp_path: Path) -> None:
    runs: dict[str, list[object]] = {}

    class Logged(MlflowRun):
        def __init__(self, name: str, spec: JobSpec) -> None:
            self.said = runs[name] = [spec.paint.epsilon]

        def progress(self, progress: Progress) -> None:
            """A point of the curves."""

        def end(self, result: Result | None, folder: Path | None = None) -> None:
            self.said.append(result and result.target.a_drop)

    service.failing = {"chair"}
    show = Silent()
    run_experiment(plan_of(), service, tmp_path, show=Tracked(show, Logged))
    assert runs == {
        "small  mug  epsilon 0.02": [0.02, 0.2],
        "small  mug  epsilon 0.05": [0.05, 0.5],
        "small  chair  epsilon 0.02": [0.02, None],
        "small  chair  epsilon 0.05": [0.05, None],
    }
    assert len(show.ended) == 4


def test_jobs_are_found_on_a_server(service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service.failing = {"chair"}
    ran(plan_of(), service, tmp_path)
    spec, attacks = JudgementSpec.of("mug", "mug", label="mug"), service.jobs
    judgement = Job(id="j", state=JobState.succeeded, spec=spec, created=datetime.now(UTC), worker=None)
    monkeypatch.setattr(service, "jobs", lambda name: [judgement, *attacks(name)])
    monkeypatch.setattr(cli, "Service", lambda client: service)
    shown = invoked("show", "small")
    assert "mean of the 2 of 4 rows with figures: target A_drop 0.35" in shown
    assert re.search(r"chair .* failed .* n\.a\.", shown)
    assert "chair  epsilon 0.05  seed 0: failed: the renderer said no" in shown
    assert "no job of an experiment 'other'" in invoked("show", "other", status=1)


def test_jobs_on_a_server_are_told_apart_by_what_differs_and_stored_files_have_their_names(
    service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = "0" * 64
    monkeypatch.setattr(service, "store", lambda upload: stored)
    (tmp_path / "net.onnx").write_bytes(b"network")
    grid = {"classifier": [str(tmp_path / "net.onnx")], "elevation": [[0, 10], [0, 20]]}
    ran(plan_of(objects={"mug": {}, "chair": {}}, grid=grid, seeds=2), service, tmp_path)
    service.failing, attacks = {"chair"}, service.jobs
    named = [job.model_copy(update={"names": {stored: "net"}}) for job in attacks("small")]
    monkeypatch.setattr(service, "jobs", lambda name: named)
    rows = cli._on_server(service, "small")
    settings = ["epsilon 0.05, elevation 0 + 10", "epsilon 0.05, elevation 0 + 20"]
    assert [row.configuration for row in rows] == 2 * [each for each in settings for _ in range(2)]
    assert [row.classifier for row in rows if row.failed] == ["net"] * 4


def displayed(plan: Plan, service: FakeService, folder: Path, **options: Any) -> str:
    written = StringIO()
    with experiment_display(Console(file=written, width=200, **options)) as show:
        run_experiment(plan, service, folder, show=show)
    return written.getvalue()


def test_a_log_shows_a_line_for_each_finished_job_and_a_terminal_a_bar(service: FakeService, tmp_path: Path) -> None:
    service.failing = {"chair"}
    lines = displayed(plan_of(), service, tmp_path / "log").splitlines()
    assert lines[0] == "4 jobs, 0 already done"
    assert lines[1].startswith("1/4  mug  epsilon 0.02  seed 0  A_drop 0.20, held-out 0.20  about ")
    assert lines[4].startswith("4/4  chair  epsilon 0.05  seed 0  failed: the renderer said no")
    assert "4/4" in displayed(plan_of(), service, tmp_path / "terminal", force_terminal=True)


def test_jobs_that_the_server_did_long_ago_promise_nothing_on_the_time_that_is_left(
    service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran(plan_of(grid={"epsilon": [0.05]}), service, tmp_path / "before")
    service.by_key = {key: service.job(job.id) for key, job in service.by_key.items()}
    now = count(step=20)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(now)))
    told = displayed(plan_of(grid={"epsilon": [0.02, 0.03, 0.05]}), service, tmp_path / "now")
    ends = [line.partition("seed 0  ")[2].partition("  ")[2] for line in told.splitlines()[1:]]
    assert ends == ["", "", "about 60 s left", "about 40 s left", "about 20 s left", ""]


def test_how_an_experiment_was_made_is_noted_and_its_runs_add_up(tmp_path: Path) -> None:
    source = tmp_path / "mine.yaml"
    source.write_text("name: mine\n")
    (tmp_path / ABOUT).write_text('{"seconds": 9')
    for _ in range(2):
        write_about(tmp_path, "trompe experiment run mine.yaml", seconds=30.0, source=source)
    note = json.loads((tmp_path / ABOUT).read_text())
    assert (note["command"], note["seconds"], note["took"]) == ("trompe experiment run mine.yaml", 60.0, "60 s")
    assert (tmp_path / "experiment.yaml").read_text() == "name: mine\n"


def test_the_stability_suite_notes_its_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "run_experiment", lambda *_args, **_options: ())
    monkeypatch.setattr(renderers, "local_renderer", nullcontext)
    asked = ["--object", "mug", "--seeds", "1", "--only", "quality 75"]
    invoked("stability", "--out", tmp_path, *asked)
    command = json.loads((tmp_path / ABOUT).read_text())["command"]
    assert shlex.split(command) == ["trompe", "experiment", "stability", "--out", str(tmp_path), *asked]


def test_more_views_steps_and_networks_take_longer() -> None:
    def job(**options: Any) -> JobRequest:
        return JobRequest.of("mug", label="mug", **options)

    base = estimated_seconds([job()])
    for more in ({"steps": 1000}, {"pool": 480}, {"held_out": 300}, {"ensemble": ["tiny"]}, {"surrogate": "curve"}):
        assert estimated_seconds([job(**more)]) > base
    assert estimated_seconds([job(), job()]) == pytest.approx(2 * base)
