"""Jobs in an experiment tracker: the same run in a fake MLflow and, where it is installed, in the real one."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.client.conftest import FakeServer, trompe
from trompe_client.tracking import MlflowRun
from trompe_shared.api import JobSpec, JobState, Progress


class FakeMlflow(ModuleType):
    """MLflow's client over lists."""

    def __init__(self) -> None:
        super().__init__("mlflow")
        self.params, self.files, self.status = dict[str, str](), list[str](), ""
        self.points: list[tuple[str, float, int | None]] = []
        self.MlflowClient = lambda: self

    def get_experiment_by_name(self, name: str) -> Any:
        return None

    def create_experiment(self, name: str) -> str:
        self.experiment = name
        return "1"

    def create_run(self, experiment: str, run_name: str) -> Any:
        self.run_name = run_name
        return SimpleNamespace(info=SimpleNamespace(run_id="r"))

    def log_param(self, run: str, key: str, value: str) -> None:
        self.params[key] = value

    def log_metric(self, run: str, key: str, value: float, step: int | None = None) -> None:
        self.points.append((key, value, step))

    def log_artifacts(self, run: str, folder: str) -> None:
        self.files = sorted(file.name for file in Path(folder).iterdir())

    def set_terminated(self, run: str, status: str) -> None:
        self.status = status


@pytest.fixture
def mlflow(monkeypatch: pytest.MonkeyPatch) -> FakeMlflow:
    fake = FakeMlflow()
    monkeypatch.setitem(sys.modules, "mlflow", fake)
    return fake


def attacked(server: FakeServer, out: Path, *words: str) -> Any:
    return trompe("attack", "mug", "--label", "mug", "--track", "mlflow", *words, "--server", server.url, "--out", out)


def test_an_attack_logs_parameters_curves_result_and_files(
    mlflow: FakeMlflow, server: FakeServer, tmp_path: Path
) -> None:
    done = attacked(server, tmp_path / "out", "--epsilon", "0.1")
    assert done.exit_code == 0, done.output
    assert (mlflow.experiment, mlflow.status) == ("trompe", "FINISHED")
    assert mlflow.run_name.startswith("mug job-")
    assert mlflow.params["paint.epsilon"] == "0.1"
    figures = {key: value for key, value, step in mlflow.points if step is None}
    assert figures["target.a_before"] == 0.9
    steps = [step or 0 for key, _, step in mlflow.points if key == "loss"]
    assert steps
    assert steps == sorted(set(steps))
    assert "result.json" in mlflow.files


def test_a_failed_job_is_a_failed_run(mlflow: FakeMlflow, server: FakeServer, tmp_path: Path) -> None:
    server.ending = JobState.failed
    assert attacked(server, tmp_path / "out").exit_code == 6
    assert (mlflow.status, mlflow.files) == ("FAILED", [])


def test_without_mlflow_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, server: FakeServer, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)
    done = attacked(server, tmp_path / "out")
    assert "pip install 'trompe[mlflow]'" in done.stderr
    assert trompe("attack", "mug", "--label", "0", "--track", "mlflow", "--detach").exit_code == 2


@pytest.mark.filterwarnings("ignore")
def test_the_real_mlflow_keeps_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.chdir(tmp_path)
    mlflow.set_tracking_uri(f"sqlite:///{tmp_path}/mlflow.db")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_text("{}")
    run, _ = (MlflowRun("mug", JobSpec.of("mug", label="mug", epsilon=0.1)) for _ in range(2))
    for step in (0, 0, 1):
        run.progress(Progress(step=step, loss=1.0 - step, fooled=0.5))
    run.end(None, tmp_path / "out")
    client = mlflow.MlflowClient()
    kept = client.get_run(run._id)
    assert kept.data.params["paint.epsilon"] == "0.1"
    assert [point.value for point in client.get_metric_history(run._id, "loss")] == [1.0, 0.0]
    assert [file.path for file in client.list_artifacts(run._id)] == ["result.json"]
    assert kept.info.status == "FAILED"
