"""The command line: what it prints, writes and exits with."""

import json
import re
from contextlib import contextmanager
from importlib import metadata

import click
import pytest
from click.testing import CliRunner

from trompe_client import JobHandle, cli
from trompe_client._plan import object_source
from trompe_shared.api import JobSpec, JobState

SPEC = JobSpec(object="mug", label="mug")


def trompe(*words: object):
    return CliRunner().invoke(cli.main, [str(word) for word in words])


def test_attack_prints_the_table_and_names_the_files_it_wrote(server, tmp_path):
    out = tmp_path / "out"
    done = trompe("attack", "mug", "--label", "mug", "--judge", "tiny", "--server", server.url, "--out", out)
    assert done.exit_code == 0, done.output
    rows = {
        cells[1]: cells[2:6]
        for line in done.stdout.splitlines()
        if len(cells := [c.strip() for c in line.split("│")]) > 5
    }
    figures = ["0.90 [0.80, 0.95]", "0.30 [0.20, 0.43]", "0.67"]
    assert rows == {
        "surrogate (own views)": ["60", *figures],
        "target (own views)": ["60", *figures],
        "target (held-out views)": ["17", *figures],
        "judge tiny (own views)": ["60", *figures],
    }
    for words in (
        "42.1%",
        "0.0310 (7.9/255)",
        "0.2000 (51.0/255)",
        "calibrated: error 0.4/255 is within tolerance",
        "0.01",
        "warning: the [racket] is thin",
        "calibrate 1.2, attack 7.5",
        str(out / "report" / "index.html"),
        str(out / "mug_adversarial.zip"),
    ):
        assert words in done.stdout
    assert json.loads((out / "result.json").read_text())["label_name"] == "mug"


def test_every_option_reaches_the_job(server, tmp_path):
    options = "--epsilon .1 --alpha .02 --tau .2 --surrogate curve --steps 9 --seed 4 --distance 2 --elevation -5 30"
    words = [*options.split(), "--background", "#112233", "--classifier", "tiny", "--label", "7"]
    done = trompe("attack", "mug", *words, "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    assert server.jobs["job-1"].spec == JobSpec(
        object="mug",
        label=7,
        epsilon=0.1,
        alpha=0.02,
        tau=0.2,
        surrogate="curve",
        steps=9,
        seed=4,
        distance=2,
        elevation=(-5, 30),
        background="#112233",
    )


def test_an_object_comes_back_in_the_form_it_was_given(server, mug_folder, tmp_path):
    archive = tmp_path / "cup.zip"
    archive.write_bytes(object_source(mug_folder).data)
    for source in (mug_folder, archive, mug_folder / "mug.obj", mug_folder):
        done = trompe("attack", source, "--label", 0, "--server", server.url, "--out", tmp_path / "out")
        assert done.exit_code == 0, done.output
    made = {p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert made == {
        "cup_adversarial.zip",
        "mug_adversarial/a.png",
        "mug_adversarial/mug.obj",
        "report/index.html",
        "result.json",
    }
    assert (tmp_path / "out/mug_adversarial/a.png").read_bytes() == b"repainted"


def test_not_applicable_is_reported_with_its_reason_and_is_no_failure(server, tmp_path):
    server.ending = JobState.not_applicable
    done = trompe("attack", "mug", "--label", 0, "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 0
    assert "n.a.: no view was recognised before the attack" in done.stdout
    assert re.search(r"target \(own views\).*0\.00 \[0\.00, 0\.06\] │ +n\.a\. │ +n\.a\.", done.stdout)


def test_a_failed_job_exits_with_1_and_its_reason(server, tmp_path):
    server.ending = JobState.failed
    done = trompe("attack", "mug", "--label", 0, "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 1
    assert "trompe: Job job-1 failed: the renderer said no" in done.stderr
    assert "Traceback" not in done.output


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["--epsilon", "7"], id="out of range"),
        pytest.param(["--surrogate", "magic"], id="no such model"),
        pytest.param(["--elevation", "50", "0"], id="range upside down"),
        pytest.param(["--bogus"], id="no such option"),
    ],
)
def test_wrong_usage_exits_with_2(words, tmp_path):
    done = trompe("attack", "mug", "--label", 0, "--server", "http://127.0.0.1:9", "--out", tmp_path, *words)
    assert done.exit_code == 2
    assert "Usage:" in done.stderr


def test_without_a_server_the_remedy_is_named_in_one_paragraph():
    done = trompe("jobs", "--server", "http://127.0.0.1:9")
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1
    assert "trompe serve" in done.stderr


def test_a_refusal_shows_the_request_id(server):
    assert "(request req-7)" in trompe("watch", "nope", "--server", server.url).stderr


def test_the_server_can_come_from_the_environment(server, monkeypatch):
    monkeypatch.setenv("TROMPE_SERVER", server.url)
    done = trompe("objects")
    assert "mug" in done.stdout
    assert "a.png 8x4" in done.stdout


def test_lists_show_what_the_server_has(server, client):
    for _ in range(3):
        client.submit(SPEC)
    client.job("job-2").cancel()
    assert "attack, judge" in trompe("classifiers", "--server", server.url).stdout
    every = trompe("jobs", "--server", server.url).stdout
    assert all(f"job-{k}" in every for k in (1, 2, 3))
    only = trompe("jobs", "--state", "cancelled", "--server", server.url).stdout
    assert "job-2" in only
    assert "job-1" not in only
    assert "job-1" not in trompe("jobs", "--limit", 2, "--server", server.url).stdout


def test_watch_report_and_cancel_take_up_a_job_by_its_id(server, client, tmp_path):
    client.submit(SPEC)
    seen = trompe("watch", "job-1", "--server", server.url)
    assert seen.exit_code == 0
    assert "trompe report job-1" in seen.stdout
    done = trompe("report", "job-1", "--out", tmp_path, "--server", server.url)
    assert "target (own views)" in done.stdout
    assert (tmp_path / "adversarial.zip").is_file()
    client.submit(SPEC)
    assert "job-2: cancelled" in trompe("cancel", "job-2", "--server", server.url).stdout
    assert server.jobs["job-2"].state is JobState.cancelled


@pytest.fixture
def ctrl_c(monkeypatch):
    def interrupted(self: JobHandle, *_args: object, **_options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(JobHandle, "wait", interrupted)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_leaves_the_job_on_a_server_running_and_says_how_to_come_back(server, tmp_path):
    done = trompe("attack", "mug", "--label", 0, "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 130
    assert f"trompe watch job-1 --server {server.url}" in done.stderr
    assert server.jobs["job-1"].state is JobState.queued


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_cancels_the_job_on_a_server_of_our_own(server, tmp_path, monkeypatch):
    @contextmanager
    def embedded():
        yield server.url

    monkeypatch.setattr(cli, "embedded_server", embedded)
    done = trompe("attack", "mug", "--label", 0, "--out", tmp_path)
    assert done.exit_code == 130
    assert server.jobs["job-1"].state is JobState.cancelled


class EntryPoints(list):
    """Entry points of the group as ``importlib.metadata`` gives them."""

    names = frozenset({"serve", "worker", "paint"})


@pytest.fixture
def commands(monkeypatch):
    """Installed commands: one that works, one that cannot be loaded, one that finds out when it is called."""

    class Lacking:
        def load(self) -> click.Command:
            raise ModuleNotFoundError("No module named 'uvicorn'", name="uvicorn")

    class Working:
        def load(self) -> click.Command:
            return click.Command("paint", callback=lambda: click.echo("painted"))

    class Late:
        def load(self) -> click.Command:
            return click.Command("worker", callback=Lacking().load)

    found = {"serve": Lacking(), "worker": Late(), "paint": Working()}

    def entry_points(*, group: str, name: str | None = None) -> EntryPoints:
        assert group == "trompe.commands"
        return EntryPoints(found.values() if name is None else [found[name]] if name in found else [])

    monkeypatch.setattr(metadata, "entry_points", entry_points)


@pytest.mark.usefixtures("commands")
def test_a_command_of_another_package_is_found_by_its_entry_point():
    assert trompe("paint").stdout == "painted\n"


@pytest.mark.usefixtures("commands")
@pytest.mark.parametrize(("command", "extra"), [("serve", "server"), ("worker", "server"), ("render", "renderer")])
def test_a_missing_extra_is_named_with_the_command_that_installs_it(command, extra):
    done = trompe(command)
    assert done.exit_code == 1
    assert f"`trompe {command}` needs the {extra} extra: pip install 'trompe[{extra}]'" in done.stderr


@pytest.mark.usefixtures("commands")
def test_help_lists_the_commands_of_other_packages_without_importing_them():
    done = trompe("--help")
    assert done.exit_code == 0
    assert {"attack", "serve", "render", "paint"} <= {line.split()[0] for line in done.stdout.splitlines() if line}


def test_an_unknown_command_is_wrong_usage():
    assert trompe("fly").exit_code == 2
