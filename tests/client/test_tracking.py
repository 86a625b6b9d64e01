"""Jobs in an experiment tracker: the same run in a fake MLflow and, where it is installed, in the real one."""

import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import pytest

from tests.client.conftest import FakeServer, trompe
from trompe_client.tracking import MlflowRun
from trompe_shared.api import JobSpec, JobState, Progress

CALLS = ("get_experiment_by_name", "create_experiment", "create_run", "log_param", "log_metric", "log_artifacts")


@pytest.fixture
def mlflow(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """MLflow's client, which knows no experiment."""
    client = Mock(spec_set=[*CALLS, "set_terminated"])
    client.get_experiment_by_name.return_value = None
    monkeypatch.setitem(sys.modules, "mlflow", Mock(MlflowClient=lambda: client))
    return client


def attacked(server: FakeServer, out: Path, *words: str) -> Any:
    return trompe("attack", "mug", "--label", "mug", "--track", "mlflow", *words, "--server", server.url, "--out", out)


def test_an_attack_logs_parameters_curves_result_and_files(mlflow: Mock, server: FakeServer, tmp_path: Path) -> None:
    done = attacked(server, tmp_path / "out", "--epsilon", "0.1")
    assert done.exit_code == 0, done.output
    run = mlflow.create_run.return_value.info.run_id
    mlflow.create_experiment.assert_called_once_with("trompe")
    mlflow.set_terminated.assert_called_once_with(run, "FINISHED")
    assert mlflow.create_run.call_args.kwargs["run_name"].startswith("mug job-")
    assert call(run, "paint.epsilon", "0.1") in mlflow.log_param.call_args_list
    assert call(run, "target.a_before", 0.9) in mlflow.log_metric.call_args_list
    steps = [each.kwargs["step"] for each in mlflow.log_metric.call_args_list if each.args[1] == "loss"]
    assert steps
    assert steps == sorted(set(steps))
    mlflow.log_artifacts.assert_called_once_with(run, str(tmp_path / "out"))
    assert (tmp_path / "out" / "result.json").exists()


def test_a_failed_job_is_a_failed_run_of_a_known_experiment(mlflow: Mock, server: FakeServer, tmp_path: Path) -> None:
    mlflow.get_experiment_by_name.return_value = Mock(experiment_id="7")
    server.ending = JobState.failed
    assert attacked(server, tmp_path / "out").exit_code == 6
    mlflow.set_terminated.assert_called_once_with(mlflow.create_run.return_value.info.run_id, "FAILED")
    mlflow.log_artifacts.assert_not_called()
    mlflow.create_experiment.assert_not_called()
    assert mlflow.create_run.call_args.args == ("7",)


def test_without_mlflow_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, server: FakeServer, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)
    done = attacked(server, tmp_path / "out")
    assert "pip install 'trompe[mlflow]'" in done.stderr
    assert trompe("attack", "mug", "--label", "0", "--track", "mlflow", "--detach").exit_code == 2


@pytest.mark.thorough
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
