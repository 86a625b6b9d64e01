"""The command line for programs: JSON, exit codes, completion."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import click
import pytest
from click.testing import CliRunner

from tests.client.conftest import FakeServer, trompe
from trompe_client import Client
from trompe_client.cli import main
from trompe_client.cli.group import EXITS, EXTENSIONS, OWN
from trompe_shared.api import Job, JobRequest, JobState, Priority
from trompe_shared.api import Result as JobResult

REQUEST = JobRequest.of("mug", label="mug", labels={"campaign": "cups"})


Ask = Callable[..., Any]


@pytest.fixture
def ask(server: FakeServer) -> Ask:
    """Run a command with --json on the server; gives the document on its standard output."""
    server.when_listed = server.finish_all

    def run(*words: object) -> Any:
        done = trompe(*words, "--server", server.url, "--json")
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)

    return run


def test_an_attack_answers_with_job_result_and_files(ask: Ask, tmp_path: Path) -> None:
    said = ask("attack", "mug", "--label", "mug", "--out", tmp_path)
    assert Job.model_validate(said["job"]).state is JobState.succeeded
    assert JobResult.model_validate(said["result"]).label == 3
    assert said["files"][0] == str(tmp_path / "mug-adversarial.zip")


def test_a_detached_attack_answers_with_the_job_at_once(ask: Ask, server: FakeServer) -> None:
    said = ask("attack", "mug", "--label", 0, "--detach", "--tag", "a=b", "--priority", "sweep", "--needs", "gpu=0.5")
    job = Job.model_validate(said)
    assert (job.state, job.labels, job.priority, job.needs.gpu) == (JobState.queued, {"a": "b"}, "sweep", 0.5)
    assert not [path for _, path, _ in server.requests if path.endswith("/events")]


def test_the_same_key_gives_the_same_job(ask: Ask) -> None:
    words = ["attack", "mug", "--label", 0, "--detach", "--key", "k"]
    assert ask(*words)["id"] == ask(*words)["id"]


def test_lists_are_those_of_the_api(ask: Ask, client: Client) -> None:
    ids = [client.submit(REQUEST).id for _ in range(3)]
    assert [Job.model_validate(one).id for one in ask("jobs")] == ids[::-1]
    assert [one["id"] for one in ask("jobs", "list", "--tag", "campaign=cups", "--limit", 2)] == ids[:0:-1]
    assert ask("jobs", "--tag", "campaign=mugs") == []
    assert ask("jobs", "--object", "mug", "--classifier", "tiny", "--state", "failed") == []
    assert [one["name"] for one in ask("objects")] == ["mug"]
    assert [one["name"] for one in ask("classifiers")] == ["tiny"]
    assert ask("backgrounds") == []
    assert [one["host"] for one in ask("workers")] == ["here"]
    silent = {"engine": None, "version": None, "settings": None}
    assert ask("renderers") == [{"address": "127.0.0.1:8085", "alive": True} | silent]


def test_jobs_are_shown_cancelled_retried_downloaded_and_deleted(ask: Ask, client: Client, tmp_path: Path) -> None:
    first, second = client.submit(REQUEST).id, client.submit(REQUEST).id
    assert Job.model_validate(ask("jobs", "show", first)).spec == REQUEST.spec()
    assert [one["state"] for one in ask("jobs", "cancel", first, second)] == ["cancelled"] * 2
    (anew,) = ask("jobs", "retry", first)
    assert (anew["id"], anew["labels"]) == ("job-3", {"campaign": "cups"})
    assert ask("jobs", "delete", first, second) == {"deleted": [first, second]}
    client.job("job-3").wait(timeout=20)
    files = ask("jobs", "download", "job-3", "--out", tmp_path)["files"]
    assert files[0] == str(tmp_path / "mug-adversarial.zip")
    assert ask("jobs", "download", "job-3", "--out", tmp_path, "--zip") == {"files": [str(tmp_path / "job-3.zip")]}
    assert JobResult.model_validate(ask("report", "job-3")["result"]).object == "mug"


def test_watching_says_one_event_a_line(server: FakeServer, client: Client) -> None:
    client.submit(REQUEST)
    done = trompe("watch", "job-1", "--server", server.url, "--json")
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert [event["id"] for event in events] == [1, 2, 3, 4, 5]
    assert events[-1]["state"] == "succeeded"


def test_what_is_added_comes_back_with_its_id(ask: Ask, mug_folder: Path, tmp_path: Path) -> None:
    picture, net = tmp_path / "room.png", tmp_path / "net.pt2"
    picture.write_bytes(b"png")
    net.write_bytes(b"pt2")
    assert ask("objects", "add", mug_folder, "--name", "cup")["name"] == "cup"
    assert ask("classifiers", "add", net, "--name", "n")["name"] == "n"
    assert ask("backgrounds", "add", picture)["id"] == ask("backgrounds")[0]["id"]


FAILURES = [
    pytest.param({}, ["jobs", "show", "nope"], 5, "not-found", id="not there"),
    pytest.param({}, ["report", "job-1"], 5, "conflict", id="not possible now"),
    pytest.param({"token": "t"}, ["objects"], 4, "unauthorized", id="no token"),
    pytest.param({"refusals": [(403, {})]}, ["objects"], 4, "forbidden", id="no right"),
    pytest.param({"refusals": [(429, {"Retry-After": "999"})]}, ["objects"], 4, "too-many", id="too many"),
    pytest.param({"refusals": [(422, {})]}, ["objects"], 2, "bad-request", id="wrong"),
    pytest.param({"refusals": [(500, {})]}, ["objects"], 1, "server-fault", id="its own fault"),
    pytest.param({"ending": JobState.failed}, ["watch", "job-1"], 6, "job-failed", id="failed"),
    pytest.param({"ending": JobState.cancelled}, ["watch", "job-1"], 7, "job-cancelled", id="cancelled"),
    pytest.param({"stalls": True}, ["watch", "job-1", "--timeout", "0.1"], 8, "wait-timeout", id="too long"),
]


@pytest.mark.parametrize(("script", "words", "exit_code", "code"), FAILURES)
def test_a_script_can_tell_what_went_wrong(
    server: FakeServer, client: Client, script: dict[str, Any], words: list[str], exit_code: int, code: str
) -> None:
    for name, value in script.items():
        setattr(server, name, value)
    server.add_job(REQUEST)
    done = trompe(*words, "--server", server.url, "--json")
    error = json.loads(done.stderr.splitlines()[-1])["error"]
    assert (done.exit_code, error["exit_code"], error["code"]) == (exit_code, exit_code, code)
    assert error["message"]
    assert error.get("request_id") or error.get("job_id")
    in_words = trompe(*words, "--server", server.url)
    assert in_words.exit_code in {exit_code, 0}


def test_nobody_there_is_3_and_the_remedy_is_named_in_one_paragraph() -> None:
    done, in_words = (trompe("jobs", "--server", "http://127.0.0.1:9", *more) for more in (["--json"], []))
    assert in_words.exit_code == done.exit_code == json.loads(done.stderr)["error"]["exit_code"] == 3
    assert in_words.stderr.count("\n") == 1
    assert "trompe serve" in in_words.stderr


def test_help_lists_the_exit_codes() -> None:
    text = trompe("--help").stdout
    assert [int(code) for code in re.findall(r"^  (\d+) ", text, re.MULTILINE)] == list(EXITS)


def test_the_token_can_be_an_option_or_come_from_the_environment(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.token = "trompe_secret"
    assert trompe("objects", "--server", server.url, "--token", "trompe_secret").exit_code == 0
    assert trompe("objects", "--server", server.url).exit_code == 4
    monkeypatch.setenv("TROMPE_TOKEN", "trompe_secret")
    assert trompe("objects", "--server", server.url).exit_code == 0


@pytest.mark.parametrize(
    ("shell", "word"), [("bash", "complete -o"), ("zsh", "#compdef trompe"), ("fish", "complete ")]
)
def test_completion_prints_the_script_of_a_shell(shell: str, word: str) -> None:
    script = trompe("completion", shell).stdout
    assert word in script
    assert "_TROMPE_COMPLETE" in script


def completed(*words: str) -> set[str]:
    """What a shell offers after these words, the last of which is not finished."""
    environment = {"_TROMPE_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(["trompe", *words])}
    done = CliRunner().invoke(main, env=environment | {"COMP_CWORD": str(len(words))}, prog_name="trompe")
    return {line.split(",", 1)[1] for line in done.output.splitlines()}


def test_commands_options_and_choices_are_completed() -> None:
    assert completed("jo") == {"jobs"}
    assert completed("") == OWN.keys() | EXTENSIONS.keys()
    assert "--priority" in completed("attack", "mug", "--pri")
    assert completed("attack", "mug", "--priority", "") == {"interactive", "normal", "sweep"} == set(get_args(Priority))
    assert {"list", "show", "cancel", "retry", "delete", "download"} == completed("jobs", "")
    assert completed("jobs", "list", "--st") == completed("jobs", "--st") == {"--state"}


def test_own_commands_all_take_json(server: FakeServer) -> None:
    for name in OWN.keys() - {"completion"}:
        command = main.get_command(click.Context(main), name)
        each = getattr(command, "commands", {name: command})
        assert [key for key, one in each.items() if "json" not in {p.name for p in one.params}] == []
