"""The command line: what it prints, writes and exits with."""

import hashlib
import io
import json
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from importlib import metadata

import click
import pytest
from click.testing import CliRunner
from rich.console import Console

from trompe_client import JobHandle
from trompe_client._plan import object_source
from trompe_client._report import result_report
from trompe_client.cli import connection, main
from trompe_client.cli.attack import attack
from trompe_shared.api import JobRequest, JobSpec, JobState, LightFound, VerticesMoved, ViewRanges

SPEC = JobSpec(object="mug", label="mug")


def stored_id(data: bytes) -> str:
    """The fake server's id of an upload."""
    return hashlib.sha256(data).hexdigest()[:12]


def trompe(*words: object):
    return CliRunner().invoke(main, [str(word) for word in words])


def test_attack_prints_the_table_and_names_the_files_it_wrote(server, tmp_path):
    out = tmp_path / "out"
    done = trompe("attack", "mug", "--label", "mug", "--judge", "tiny", "--server", server.url, "--out", out)
    assert done.exit_code == 0, done.output
    rows = {
        cells[1]: cells[2:6]
        for line in done.stdout.splitlines()
        if len(cells := [c.strip() for c in line.split("│")]) > 5
    }
    figures = ["0.90 [0.80, 0.95]", "0.30 [0.20, 0.43]", "0.67 [0.55, 0.78]"]
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
        "25.0% of the target views (1.23% of the object's pixels)",
        "SSIM 0.987, colour difference (CIEDE2000) 1.23",
        "4,800 by each attacked classifier",
        "calibrated: error 0.4/255 is within tolerance",
        "0.01",
        "warning: the [racket] is thin",
        "calibrate 1.2, attack 7.5",
        str(out / "report" / "index.html"),
        str(out / "mug_adversarial.zip"),
    ):
        assert words in done.stdout
    assert "goal reached" not in done.stdout
    assert json.loads((out / "result.json").read_text())["label_name"] == "mug"


def test_every_option_reaches_the_job(server, tmp_path):
    mask, member = tmp_path / "mask.png", tmp_path / "member.torchscript"
    mask.write_bytes(b"mask")
    member.write_bytes(b"script")
    options = """--epsilon .1 --alpha .02 --tau .2 --saliency-scope each_view --surrogate curve --steps 9 --seed 4
        --distance 2 --elevation -5 30
        --background #112233 --background black --classifier tiny --label 7 --judge torchvision:vgg16 --judge net
        --keep .3 --material clay --material glaze --epsilon-view .04 --target 2 --loss dlr --optimiser adam
        --restarts 3 --queries 8 --pool 50 --range roll -10 10 --range ambient 0.2 0.6 --held-out 12 --diverse"""
    words = [*options.split(), "--ensemble", member, "--ensemble", "hub:owner/nets.pt", "--mask", f"a.png={mask}"]
    done = trompe("attack", "mug", *words, "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    assert server.jobs["job-1"].spec == JobSpec(
        object="mug",
        label=7,
        classifier="tiny",
        ensemble=[stored_id(b"script"), "hub:owner/nets.pt"],
        judges=["torchvision:vgg16", "net"],
        epsilon=0.1,
        alpha=0.02,
        tau=0.2,
        saliency_scope="each_view",
        keep=0.3,
        materials=["clay", "glaze"],
        masks={"a.png": stored_id(b"mask")},
        epsilon_view=0.04,
        target_label=2,
        loss="dlr",
        optimiser="adam",
        restarts=3,
        queries=8,
        surrogate="curve",
        steps=9,
        seed=4,
        distance=2,
        elevation=(-5, 30),
        background=["#112233", "black"],
        pool=50,
        ranges=ViewRanges(roll=(-10, 10), ambient=(0.2, 0.6)),
        held_out=12,
        diverse=True,
    )


def test_what_is_not_said_is_left_to_the_job(server, tmp_path):
    assert trompe("attack", "mug", "--label", "mug", "--server", server.url, "--out", tmp_path).exit_code == 0
    assert server.jobs["job-1"].spec == SPEC


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        pytest.param("--grid", {"pool": 0}, id="grid"),
        pytest.param("--ensemble hub:a/b.pt", {"ensemble": ["hub:a/b.pt"], "diverse": True}, id="for transfer"),
        pytest.param("--ensemble hub:a/b.pt --no-diverse", {"ensemble": ["hub:a/b.pt"], "diverse": False}, id="not so"),
        pytest.param("--pool 0 --azimuths 4", {"pool": 0, "azimuths": 4}, id="no pool"),
        pytest.param("--grid --azimuths 4 --elevations 3", {"pool": 0, "azimuths": 4, "elevations": 3}, id="its size"),
        pytest.param("--target vase", {"target_label": "vase"}, id="target by name"),
        pytest.param("--top-k 5", {"top_k": 5}, id="top k"),
    ],
)
def test_short_words_for_common_wishes(server, tmp_path, words, wanted):
    done = trompe("attack", "mug", "--label", "mug", *words.split(), "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    assert server.jobs["job-1"].spec == JobSpec(**SPEC.model_dump() | wanted)


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        pytest.param("light", {"sun": {"azimuth": (0, 360)}}, id="light"),
        pytest.param("light", {"sun": {"azimuth": (-90, 90), "intensity": (0.5, 2)}}, id="how strong"),
        pytest.param("vertices", {"vertex_budget": 0.01}, id="vertices"),
    ],
)
def test_light_and_vertices_are_attacked_where_they_are_asked_for(server, tmp_path, words, wanted):
    sun = [word for name, ends in wanted.get("sun", {}).items() for word in ("--sun", name, *ends)]
    budget = ["--vertex-budget", wanted["vertex_budget"]] if "vertex_budget" in wanted else []
    more = ["--attack-on", words, *sun, *budget, "--server", server.url, "--out", tmp_path]
    done = trompe("attack", "mug", "--label", "mug", *more)
    assert done.exit_code == 0, done.output
    assert server.jobs["job-1"].spec == JobSpec.model_validate(
        SPEC.model_dump() | {"attack_on": words, "label": "mug"} | wanted
    )
    assert f": {words}, 90 steps" in done.stdout
    assert "texel" not in done.stdout


def test_options_of_texels_are_wrong_usage_where_the_light_is_attacked(tmp_path):
    done = trompe("attack", "mug", "--label", "mug", "--attack-on", "light", "--tau", 0.1, "--out", tmp_path)
    assert done.exit_code == 2
    assert "attack_on is 'light', and tau belong to another kind of attack" in " ".join(done.stderr.split())


def test_a_scope_without_a_threshold_is_wrong_usage(tmp_path):
    done = trompe("attack", "mug", "--label", "mug", "--saliency-scope", "each_view", "--out", tmp_path)
    assert done.exit_code == 2
    assert "saliency_scope says how saliency is rescaled for tau, and there is no tau" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("words", "told"),
    [
        pytest.param("", "tau none,", id="none"),
        pytest.param("--tau .2", "tau 0.2,", id="all views"),
        pytest.param("--tau .2 --saliency-scope each_view", "tau 0.2 in each view,", id="each view"),
    ],
)
def test_the_headline_says_the_threshold_and_what_it_is_of(server, tmp_path, words, told):
    done = trompe("attack", "mug", "--label", "mug", *words.split(), "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    assert told in done.stdout


def test_a_report_says_which_light_was_found_and_how_far_vertices_moved(client):
    result = client.submit(SPEC).wait(timeout=20).result()
    light = LightFound(azimuth=143.2, elevation=44, intensity=None, ambient=0.2, fooled=0.5, tried_on=12)
    moved = VerticesMoved(largest=0.00202, largest_share=0.02, mean=0.00106)
    console = Console(width=120, file=io.StringIO(), record=True)
    console.print(result_report(result.model_copy(update={"light": light, "vertices": moved})))
    text = console.export_text()
    assert "azimuth 143, elevation 44, ambient 0.2; fooled 50.0% of 12 views that judge nothing" in text
    assert "at most 2.02 mm (2.0% of the radius), 1.06 mm on average" in text


def test_the_command_line_knows_every_option_of_a_job_and_says_its_default():
    names = {parameter.name for parameter in attack.params}
    assert names - {"grid", "server", "token", "key", "detach", "out", "json"} == JobRequest.model_fields.keys()
    text = " ".join(trompe("attack", "--help").stdout.split())
    options = "epsilon saliency_scope top_k loss optimiser restarts surrogate steps seed pool"
    for option in options.split():
        words = f"--{option.replace('_', '-')} [^-]*Default: {JobSpec.model_fields[option].default}[. ]"
        assert re.search(words, text), option


def test_help_lists_each_option_once_under_a_heading():
    lines = trompe("attack", "--help").stdout.splitlines()
    assert {line for line in lines if re.fullmatch(r"\S.*:", line)} == {
        "Object and classifiers:",
        "What may change:",
        "What the classifier should say:",
        "How it is looked for:",
        "Views:",
        "Server and results:",
    }
    listed = re.findall(r"^  (?:-h, )?(--[a-z-]+)", "\n".join(lines), re.MULTILINE)
    declared = [parameter.opts[-1] for parameter in attack.params if isinstance(parameter, click.Option)]
    assert listed == [*declared, "--help"]


@pytest.mark.parametrize(
    ("words", "goal"),
    [
        pytest.param("--target 2", "83.3% of the target views: taken for class 2", id="index"),
        pytest.param("--target vase", "83.3% of the target views: taken for vase", id="name"),
        pytest.param("--top-k 5", "83.3% of the target views: the true class is not among the 5 best", id="top k"),
    ],
)
def test_a_goal_of_its_own_is_told_with_how_often_it_was_reached(server, tmp_path, words, goal):
    more = ["--queries", 10, "--keep", 0.1, "--ensemble", "net"]
    done = trompe("attack", "mug", "--label", 0, *words.split(), *more, "--server", server.url, "--out", tmp_path)
    assert goal in done.stdout
    assert "attacked through tiny and net: epsilon 0.05, alpha 0.01, tau none, keep 0.1" in done.stdout
    assert "4,800 by each attacked classifier, 48,000 scores asked" in done.stdout


def test_a_report_of_100_columns_keeps_every_number_whole(client):
    spec = JobSpec(object="mug", label=0, judges=["mobilenet_v3_large"], top_k=5)
    console = Console(width=100, file=io.StringIO())
    console.print(result_report(client.submit(spec).wait(timeout=20).result()))
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 100
    rows = [line for line in lines if "0.90 [0.80, 0.95] │ 0.30 [0.20, 0.43] │ 0.67 [0.55, 0.78]" in line]
    assert len(rows) == 4


def test_an_object_comes_back_in_the_form_it_was_given(server, mug_folder, tmp_path):
    archive = tmp_path / "cup.zip"
    archive.write_bytes(object_source(mug_folder).content)
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


def test_a_failed_job_exits_with_6_and_its_reason(server, tmp_path):
    server.ending = JobState.failed
    done = trompe("attack", "mug", "--label", 0, "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 6
    assert "trompe: Job job-1 failed: the renderer said no" in done.stderr
    assert "Traceback" not in done.output


@pytest.mark.parametrize(
    ("words", "why"),
    [
        pytest.param(["--epsilon", "7"], "epsilon: Input should be less than or equal to 1", id="out of range"),
        pytest.param(["--surrogate", "magic"], "'magic' is not one of 'auto', 'diffuse'", id="no such model"),
        pytest.param(["--elevation", "50", "0"], "not right: elevation must be a range within", id="range upside down"),
        pytest.param(["--bogus"], "No such option '--bogus'", id="no such option"),
        pytest.param(["--mask", "mask.png"], "should be a texture and a picture of its size", id="mask of no texture"),
        pytest.param(["--mask", "a.png=missing.png"], "no mask picture 'missing.png'", id="mask without a file"),
        pytest.param(["--range", "elevation", "0", "9"], "'elevation' is not one of 'azimuth'", id="no such range"),
        pytest.param(["--grid", "--pool", "9"], "choose one", id="grid and pool"),
        pytest.param(["--pool", "9", "--azimuths", "4"], "or --grid", id="size of no grid"),
        pytest.param(["--target", "vase", "--top-k", "5"], "top_k is about leaving the best classes", id="two goals"),
        pytest.param(["--queries", "7"], "make it even", id="odd queries"),
        pytest.param(["--optimiser", "fgsm"], "make steps 1 (one a run)", id="many steps of a single one"),
        pytest.param(["--restarts", "9", "--steps", "9"], "make steps 10 or more", id="more runs than steps"),
        pytest.param(["--epsilon", "0.001"], "make it 0.004 or more", id="less than a level"),
    ],
)
def test_wrong_usage_exits_with_2_and_why_before_any_server_is_asked(words, why, tmp_path):
    done = trompe("attack", "mug", "--label", 0, "--server", "http://127.0.0.1:9", "--out", tmp_path, *words)
    assert done.exit_code == 2
    assert "Usage:" in done.stderr
    assert why in done.stderr
    assert "Value error" not in done.stderr


def test_without_a_server_the_remedy_is_named_in_one_paragraph():
    done = trompe("jobs", "--server", "http://127.0.0.1:9")
    assert done.exit_code == 3
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
    server.classifiers.append(server.classifiers[0].model_copy(update={"name": "blind", "white_box": False}))
    uses = trompe("classifiers", "--server", server.url).stdout
    assert re.search(r"tiny .*│ attack, judge ", uses)
    assert re.search(r"blind .*│ judge, attack by scores ", uses)
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


def test_ctrl_c_in_a_terminal_ends_the_command_and_not_the_job(server, client):
    server.stalls = True
    job = client.submit(SPEC)
    command = [sys.executable, "-m", "trompe_client.cli", "watch", job.id, "--server", server.url]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not server.resumed_after:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, words = process.communicate(timeout=60)
    assert process.returncode == 130
    assert f"Job {job.id} goes on. Come back by: trompe watch {job.id} --server {server.url}" in words
    assert "Traceback" not in words
    assert client.job(job.id).state is JobState.queued


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_cancels_the_job_on_a_server_of_our_own(server, tmp_path, monkeypatch):
    @contextmanager
    def embedded():
        yield server.url

    monkeypatch.setattr(connection, "embedded_server", embedded)
    done = trompe("attack", "mug", "--label", 0, "--out", tmp_path)
    assert done.exit_code == 130
    assert server.jobs["job-1"].state is JobState.cancelled


def test_a_token_that_is_given_opens_the_service_of_the_command_too(server, monkeypatch):
    @contextmanager
    def embedded():
        yield server.url

    server.token = "trompe_secret"
    monkeypatch.setattr(connection, "embedded_server", embedded)
    with connection.service(None, "trompe_secret") as client:
        assert client.objects()


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
