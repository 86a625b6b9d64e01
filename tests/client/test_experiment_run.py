"""Running an experiment: everything is submitted once, what comes out is kept, and it can be stopped at any time."""

import csv
import json
import shutil
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from io import StringIO
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from rich.console import Console

from trompe_client import ServerUnreachable
from trompe_client._errors import BadRequest
from trompe_client.experiments import Experiment, Outcome, Plan, plan_experiment, run, run_experiment
from trompe_client.experiments.about import ABOUT, note_how_it_was_made
from trompe_client.experiments.cli import experiment
from trompe_client.experiments.estimate import estimated_seconds
from trompe_client.experiments.plan import File, Row
from trompe_client.experiments.progress import experiment_display
from trompe_client.experiments.tables import compared, differences, failures, read_results
from trompe_shared.api import Accuracy, Job, JobRequest, JobState, Problem, Progress, Result, ViewPrediction
from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import PREDICTIONS, RESULTS, PredictionRow, ResultRow, RowId, read_table


def result_of(request: JobRequest) -> Result:
    """A result whose ``A_drop`` is ten times epsilon."""
    drop = min(1.0, 10 * request.epsilon)
    accuracy = Accuracy(
        views=2,
        a_before=1.0,
        a_after=1 - drop,
        a_drop=drop,
        a_drop_interval=(drop / 2, 1.0),
        a_before_interval=(0.5, 1.0),
        a_after_interval=(0.0, 1.0),
    )
    view = ViewPrediction(
        azimuth=0,
        elevation=0,
        distance=1,
        light_azimuth=0,
        light_elevation=0,
        before=1,
        before_confidence=0.9,
        before_true_confidence=0.9,
        after=2,
        after_confidence=0.8,
        after_true_confidence=0.1,
    )
    return Result(
        spec=request.spec(),
        object=request.object,
        label=1,
        label_name="mug",
        classifier="tiny",
        epsilon=request.epsilon,
        alpha=request.alpha,
        tau=request.tau,
        surrogate_model="calibrated",
        surrogate_reason="good",
        seed=request.seed,
        steps=request.steps,
        image_size=(128, 128),
        surrogate=accuracy,
        target=accuracy,
        held_out=accuracy,
        transfer_gap=0.0,
        texels_altered=0.5,
        mean_texel_change=0.01,
        max_view_change=0.1,
        fidelity={"correlation": 0.98, "slope": 1.0, "error": 0.001, "explained": 0.96},
        warnings=["one", "two"],
        seconds={"prepare": 1.0, "attack-000": 2.0, "attack-001": 3.0, "judge": 0.5},
        probe_renders=10,
        versions={},
        views=[view, view],
        held_out_views=[view],
    )


class FakeService:
    """Jobs that run when they are looked at; those of ``failing`` objects fail, ``refused`` ones are not taken, and
    the jobs ``waiting`` stay so."""

    def __init__(self) -> None:
        self.by_key: dict[str, Job] = {}
        self.requests: dict[str, JobRequest] = {}
        self.uploads: list[File] = []
        self.failing: set[str] = set()
        self.refused: set[str] = set()
        self.waiting: set[str] = set()
        self.goes_away_after: int | None = None
        self.looks = 0
        self.ids = count(1)

    def store(self, file: File) -> str:
        self.uploads.append(file)
        return f"stored-{len(self.uploads)}"

    def submit(self, request: JobRequest, key: str) -> Job:
        if request.object in self.refused:
            raise BadRequest(Problem(title="No such class", status=422))
        if key not in self.by_key:
            job = Job(id=f"job-{next(self.ids)}", state=JobState.queued, spec=request.spec(), created=datetime.now(UTC))
            self.by_key[key], self.requests[job.id] = job, request
        return self.by_key[key]

    def job(self, job: str) -> Job:
        self.looks += 1
        if self.goes_away_after is not None and self.looks > self.goes_away_after:
            raise ServerUnreachable("gone")
        found = next(each for each in self.by_key.values() if each.id == job)
        if job in self.waiting:
            return found
        bad = found.spec.object in self.failing
        state, error = (JobState.failed, "the renderer said no") if bad else (JobState.succeeded, None)
        return found.model_copy(
            update={"state": state, "error": error, "progress": Progress(phase="judge", fraction=1)}
        )

    def jobs(self, experiment: str) -> Iterator[Job]:
        return iter(())

    def result(self, job: str) -> Result:
        return result_of(self.requests[job])

    def artifact(self, job: str, name: str) -> bytes | None:
        return b"picture" if name == "contact_sheet.png" else None

    def classes(self, classifier: str) -> list[str] | None:
        return ["ball", "mug", "chair"]


class Silent:
    """Counts what it is told."""

    def __init__(self) -> None:
        self.began: dict[str, int] = {}
        self.ended: list[str] = []

    def begin(self, *, total: int, done: int) -> None:
        self.began = {"total": total, "done": done}

    def look(self, row: Row, job: Job) -> None:
        """Nothing to count."""

    def end(self, row: Row, finished: Any) -> None:
        self.ended.append(finished.state)


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
        "artifacts": ["contact_sheet.png", "missing.png"],
    }
    return plan_experiment(Experiment.model_validate(small | file))


def ran(plan: Plan, service: FakeService, folder: Path, **options: Any) -> tuple[Outcome, Silent]:
    show = Silent()
    return run_experiment(plan, service, folder, show=show, **options), show


def test_each_job_is_submitted_and_its_row_written(service: FakeService, tmp_path: Path) -> None:
    outcome, show = ran(plan_of(), service, tmp_path)
    assert show.began == {"total": 4, "done": 0}
    assert show.ended == ["succeeded"] * 4
    rows = read_table(tmp_path / RESULTS, ResultRow)
    assert rows == list(outcome.rows)
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
    assert not outcome.failed


def test_what_the_server_has_done_before_is_fetched_before_anything_is_waited_for(
    service: FakeService, tmp_path: Path
) -> None:
    ran(plan_of(grid={"epsilon": [0.05]}), service, tmp_path / "before")
    service.by_key = {key: service.job(job.id) for key, job in service.by_key.items()}
    service.goes_away_after = service.looks
    with pytest.raises(ServerUnreachable):
        ran(plan_of(), service, tmp_path / "now")
    rows = read_table(tmp_path / "now" / RESULTS, ResultRow)
    assert [(row.object, row.epsilon) for row in rows] == [("mug", 0.05), ("chair", 0.05)]


def test_a_job_is_fetched_when_it_is_done_however_many_submitted_before_it_still_wait(
    service: FakeService, tmp_path: Path
) -> None:
    plan = plan_of(objects={"mug": {}}, grid={"epsilon": [k / 100 for k in range(1, 3 * run.LOOK_AT + 1)]})
    service.waiting = {f"job-{number}" for number in range(1, len(plan.rows))}  # all but the last
    service.goes_away_after = 10 * len(plan.rows)
    with pytest.raises(ServerUnreachable):
        ran(plan, service, tmp_path)
    assert [row.epsilon for row in read_table(tmp_path / RESULTS, ResultRow)] == [plan.rows[-1].request.epsilon]


def test_rows_say_what_was_attacked_by_how_many_views_a_step_and_whether_images_were_diverse(
    service: FakeService, tmp_path: Path
) -> None:
    cases = {
        "plain": {},
        "diverse": {"diverse": True},
        "few": {"views_per_step": 7},
        "grid": {"pool": 0},
        "light": {"attack_on": "light"},
    }
    ran(plan_of(objects={"mug": {}}, grid={}, cases=cases), service, tmp_path)
    rows = read_table(tmp_path / RESULTS, ResultRow)
    assert [(row.case, row.attack_on, row.diverse, row.views_per_step) for row in rows] == [
        ("plain", "texture", False, 40),
        ("diverse", "texture", True, 40),
        ("few", "texture", False, 7),
        ("grid", "texture", False, 60),
        ("light", "light", False, 12),
    ]


def test_predictions_and_the_named_artifacts_are_kept(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path)
    key = next(iter(plan_of().jobs()))
    assert (tmp_path / "jobs" / key / "contact_sheet.png").read_bytes() == b"picture"
    assert not (tmp_path / "jobs" / key / "missing.png").exists()
    predictions = [row for row in read_table(tmp_path / PREDICTIONS, PredictionRow) if row.key == key]
    told = [(row.views, row.moment, row.name, row.true_class, row.count) for row in predictions]
    assert told == [
        ("target", "before", "mug", True, 2),
        ("target", "after", "chair", False, 2),
        ("held_out", "before", "mug", True, 1),
        ("held_out", "after", "chair", False, 1),
    ]


def test_a_second_run_submits_nothing_and_writes_the_same(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path)
    before = (tmp_path / RESULTS).read_bytes()
    other = FakeService()
    _, show = ran(plan_of(), other, tmp_path)
    assert show.began == {"total": 4, "done": 4}
    assert not other.by_key
    assert (tmp_path / RESULTS).read_bytes() == before


def test_a_run_that_was_cut_off_goes_on_where_it_was(service: FakeService, tmp_path: Path) -> None:
    service.goes_away_after = 2
    with pytest.raises(ServerUnreachable):
        ran(plan_of(), service, tmp_path)
    assert len(read_table(tmp_path / RESULTS, ResultRow)) == 2
    service.goes_away_after = None
    outcome, show = ran(plan_of(), service, tmp_path)
    assert show.began == {"total": 4, "done": 2}
    assert len(service.by_key) == 4
    assert len(outcome.rows) == 4


def test_a_second_run_in_a_folder_where_one_is_at_work_is_refused(service: FakeService, tmp_path: Path) -> None:
    refused = []

    class Impatient(Silent):
        def end(self, row: Row, finished: Any) -> None:
            with pytest.raises(SpecError) as caught:
                ran(plan_of(), FakeService(), tmp_path)
            refused.append(str(caught.value))

    outcome = run_experiment(plan_of(), service, tmp_path, show=Impatient())
    assert len(outcome.rows) == len(refused) == 4
    assert f"at work in {str(tmp_path)!r}: wait until it has ended, or choose another --out" in refused[0]
    ran(plan_of(), service, tmp_path)


def test_a_wider_grid_runs_only_what_is_new(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path)
    _, show = ran(plan_of(grid={"epsilon": [0.02, 0.05, 0.1]}), service, tmp_path)
    assert show.began == {"total": 6, "done": 4}
    assert len(service.by_key) == 6


def test_failures_stay_and_are_listed_until_they_are_to_be_tried_again(service: FakeService, tmp_path: Path) -> None:
    service.failing = {"chair"}
    outcome, _ = ran(plan_of(), service, tmp_path)
    assert [(row.object, row.state, row.error) for row in outcome.failed] == [
        ("chair", "failed", "the renderer said no")
    ] * 2
    assert failures(outcome.failed)[0] == "chair  epsilon 0.02  seed 0: failed: the renderer said no"
    service.failing = set()
    again, show = ran(plan_of(), service, tmp_path)
    assert (show.began["done"], len(again.failed)) == (4, 2)
    mended, show = ran(plan_of(), service, tmp_path, retry_failed=True)
    assert (show.began["done"], len(mended.failed)) == (2, 0)
    assert sum("-after-job-" in key for key in service.by_key) == 2


def test_a_row_that_the_server_refuses_does_not_stop_the_others(service: FakeService, tmp_path: Path) -> None:
    service.refused = {"mug"}
    outcome, _ = ran(plan_of(), service, tmp_path)
    assert [row.state for row in outcome.rows] == ["refused", "refused", "succeeded", "succeeded"]
    assert "No such class" in outcome.failed[0].error


def test_a_file_is_uploaded_once_for_all_jobs(service: FakeService, tmp_path: Path) -> None:
    (tmp_path / "net.onnx").write_bytes(b"network")
    plan = plan_of(base={"classifier": str(tmp_path / "net.onnx"), "queries": 4})
    ran(plan, service, tmp_path / "out")
    assert [file.kind for file in service.uploads] == ["classifier"]
    assert {request.classifier for request in service.requests.values()} == {"stored-1"}


def test_a_shared_job_fills_the_rows_of_all_its_series(service: FakeService, tmp_path: Path) -> None:
    plan = plan_of(grid=[{"steps": [10, 30]}, {"pool": [240]}], base={"steps": 30, "pool": 240})
    outcome, show = ran(plan, service, tmp_path)
    assert (show.began["total"], len(outcome.rows)) == (4, 6)
    assert {row.series for row in outcome.rows} == {"steps", "pool"}


def row_of(**columns: Any) -> ResultRow:
    spec = JobRequest(object="mug", label="mug").spec()
    return ResultRow.of_spec(RowId(experiment="x", key="k"), spec, state="succeeded", **columns)


def test_two_experiments_are_compared_on_what_they_share() -> None:
    old = [row_of(target_a_drop=drop, seed=k) for k, drop in enumerate((0.4, 0.6))] + [row_of(object="chair")]
    new = [row_of(target_a_drop=0.8), row_of(object="lamp", target_a_drop=1.0)]
    (found,) = differences(old, new)
    assert found.object == "mug"
    assert found.change("target_a_drop") == pytest.approx(0.3)
    assert found.change("held_out_a_drop") is None


def test_experiments_that_share_nothing_are_not_compared(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(objects={"mug": {}}), service, tmp_path / "a")
    ran(plan_of(objects={"chair": {}}), service, tmp_path / "b")
    with pytest.raises(SpecError, match="share no setting"):
        compared(tmp_path / "a", tmp_path / "b")
    assert compared(tmp_path / "a", tmp_path / "a")


def test_the_commands_show_and_compare_folders(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path / "a")
    shown = CliRunner().invoke(experiment, ["show", str(tmp_path / "a")])
    assert shown.exit_code == 0, shown.output
    assert "0.50 [0.25, 1.00]" in shown.output
    both = CliRunner().invoke(experiment, ["compare", str(tmp_path / "a"), str(tmp_path / "a" / RESULTS)])
    assert both.exit_code == 0, both.output
    assert "0 of 4 larger by 0.1 or more, 0 smaller; on average +0.000" in both.output


def test_a_table_without_the_columns_of_later_versions_is_shown_and_compared(
    service: FakeService, tmp_path: Path
) -> None:
    ran(plan_of(), service, tmp_path / "new")
    (tmp_path / "old").mkdir()
    with (
        (tmp_path / "new" / RESULTS).open(newline="") as new,
        (tmp_path / "old" / RESULTS).open("w", newline="") as old,
    ):
        rows = csv.DictReader(new)
        columns = [name for name in rows.fieldnames or [] if name not in {"diverse", "attack_on", "views_per_step"}]
        writer = csv.DictWriter(old, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    first = read_results(tmp_path / "old")[0]
    assert (first.target_a_drop, first.diverse, first.attack_on, first.views_per_step) == (0.2, None, "", None)
    shown = CliRunner().invoke(experiment, ["show", str(tmp_path / "old")])
    assert "0.50 [0.25, 1.00]" in shown.output
    both = CliRunner().invoke(experiment, ["compare", str(tmp_path / "old"), str(tmp_path / "new")])
    assert "0 of 4 larger by 0.1 or more, 0 smaller; on average +0.000" in both.output


def test_a_dry_run_says_how_many_jobs_there_are_and_asks_nobody() -> None:
    told = CliRunner().invoke(experiment, ["run", "quick", "--dry-run", "--server", "http://127.0.0.1:1"])
    assert told.exit_code == 0, told.output
    assert told.output.startswith("quick: 32 jobs, about ")


def test_the_shipped_files_are_listed() -> None:
    told = CliRunner().invoke(experiment, ["list"])
    assert [line.split()[0] for line in told.output.splitlines()] == [
        "paper",
        "quick",
        "speed_accuracy",
        "speed_accuracy_real",
        "stability",
    ]


def test_a_table_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / RESULTS).write_text("a,b\n1,2\n")
    with pytest.raises(SpecError, match="is not a table of this kind and version"):
        read_results(tmp_path)
    with pytest.raises(SpecError, match="There is no table"):
        read_results(tmp_path / "nowhere.csv")


def test_what_was_kept_by_another_version_is_asked_for_again(service: FakeService, tmp_path: Path) -> None:
    ran(plan_of(), service, tmp_path)
    key = next(iter(plan_of().jobs()))
    (tmp_path / "jobs" / key / "job.json").write_text(json.dumps({"other": "version"}))
    _, show = ran(plan_of(), service, tmp_path)
    assert show.began == {"total": 4, "done": 3}


def test_where_only_the_tables_were_kept_their_rows_stay_and_count_as_done(
    service: FakeService, tmp_path: Path
) -> None:
    """As in a checkout of published results: the same command must not wipe them out."""
    service.failing = {"chair"}
    ran(plan_of(), service, tmp_path)
    shutil.rmtree(tmp_path / "jobs")
    tables = {name: (tmp_path / name).read_bytes() for name in (RESULTS, PREDICTIONS)}
    outcome, show = ran(plan_of(), service, tmp_path)
    assert show.began == {"total": 4, "done": 4}
    assert {name: (tmp_path / name).read_bytes() for name in tables} == tables
    assert len(outcome.failed) == 2

    service.failing = set()
    wider, show = ran(plan_of(grid={"epsilon": [0.02, 0.05, 0.1]}), service, tmp_path, retry_failed=True)
    assert show.began == {"total": 6, "done": 2}
    assert [row.state for row in wider.rows] == ["succeeded"] * 6
    assert len({each.key for each in read_table(tmp_path / PREDICTIONS, PredictionRow)}) == 6


def test_rows_of_other_jobs_that_nothing_else_is_left_of_are_never_overwritten(
    service: FakeService, tmp_path: Path
) -> None:
    ran(plan_of(), service, tmp_path)
    narrower = plan_of(grid={"epsilon": [0.02]})
    assert len(ran(narrower, service, tmp_path)[0].rows) == 2
    ran(plan_of(), service, tmp_path)
    shutil.rmtree(tmp_path / "jobs")
    table = (tmp_path / RESULTS).read_bytes()
    with pytest.raises(SpecError, match=r"rows of 2 jobs .* mug, epsilon 0.05, .* choose another --out"):
        ran(narrower, service, tmp_path)
    assert (tmp_path / RESULTS).read_bytes() == table


def test_the_jobs_of_an_experiment_are_found_on_a_server(server: Any) -> None:
    spec = JobRequest(object="mug", label="mug", labels={"experiment": "small"})
    server.add_job(spec)
    unknown = CliRunner().invoke(experiment, ["show", "other", "--server", server.url])
    assert unknown.exit_code == 1
    assert "has no job of an experiment 'other'" in unknown.output


def test_a_log_shows_a_line_for_each_job_that_is_done(service: FakeService, tmp_path: Path) -> None:
    service.failing = {"chair"}
    written = StringIO()
    with experiment_display(Console(file=written, width=200)) as show:
        run_experiment(plan_of(), service, tmp_path, show=show)
    lines = written.getvalue().splitlines()
    assert lines[0] == "4 jobs, 0 of them done before"
    assert lines[1].startswith("1/4  mug  epsilon 0.02  seed 0  A_drop 0.20, held-out 0.20  about ")
    assert lines[4].startswith("4/4  chair  epsilon 0.05  seed 0  failed: the renderer said no")


def test_jobs_that_the_server_did_long_ago_promise_nothing_on_the_time_that_is_left(
    service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran(plan_of(grid={"epsilon": [0.05]}), service, tmp_path / "before")
    service.by_key = {key: service.job(job.id) for key, job in service.by_key.items()}
    now = count(step=20)
    monkeypatch.setattr(time, "monotonic", lambda: next(now))
    written = StringIO()
    with experiment_display(Console(file=written, width=200)) as show:
        run_experiment(plan_of(grid={"epsilon": [0.02, 0.03, 0.05]}), service, tmp_path / "now", show=show)
    ends = [line.partition("seed 0  ")[2].partition("  ")[2] for line in written.getvalue().splitlines()[1:]]
    assert ends == ["", "", "about 60 s left", "about 40 s left", "about 20 s left", ""]


def test_a_terminal_shows_one_bar_over_all_jobs(service: FakeService, tmp_path: Path) -> None:
    written = StringIO()
    with experiment_display(Console(file=written, width=200, force_terminal=True)) as show:
        run_experiment(plan_of(), service, tmp_path, show=show)
    assert "4/4" in written.getvalue()


def test_how_an_experiment_was_made_is_noted_and_its_runs_add_up(tmp_path: Path) -> None:
    source = tmp_path / "mine.yaml"
    source.write_text("name: mine\n")
    for _ in range(2):
        note_how_it_was_made(tmp_path, "trompe experiment run mine.yaml", seconds=30.0, source=source)
    note = json.loads((tmp_path / ABOUT).read_text())
    assert (note["command"], note["seconds"], note["took"]) == ("trompe experiment run mine.yaml", 60.0, "60 s")
    assert (tmp_path / "experiment.yaml").read_text() == "name: mine\n"


def test_more_views_steps_and_networks_take_longer() -> None:
    plain = JobRequest(object="mug", label="mug")
    base = estimated_seconds([plain])
    for more in ({"steps": 1000}, {"pool": 480}, {"held_out": 300}, {"ensemble": ["tiny"]}, {"surrogate": "curve"}):
        assert estimated_seconds([plain.model_copy(update=more)]) > base
    assert estimated_seconds([plain, plain]) == pytest.approx(2 * base)
