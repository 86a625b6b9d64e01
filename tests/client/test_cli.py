"""The command line: what it prints, writes and exits with."""

import io
import json
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from datetime import timedelta
from functools import partial
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal
from unittest.mock import Mock

import click
import pytest
from click.testing import Result
from rich.console import Console

from tests.client.conftest import NOW, SPEC, FakeServer, stored_id, trompe, zipped
from trompe_client import BadRequest, Client, JobHandle
from trompe_client._report import jobs_table, result_report, spent
from trompe_client.cli import connection
from trompe_client.cli.attack import attack
from trompe_client.cli.options import flag_of
from trompe_server.pages.present import command
from trompe_shared.api import OPTIONS, PARTS, JobSpec, JobState, Option, SearchOptions, in_flags
from trompe_shared.api.jobs import CONDITIONS, option

Attack = Callable[..., Result]


@pytest.fixture
def attack_mug(server: FakeServer, tmp_path: Path) -> Attack:
    """Attacks the mug on the server with results in ``tmp_path / "out"``."""
    to = ("--server", server.url, "--out", tmp_path / "out")
    return lambda *words: trompe("attack", "mug", "--label", "mug", *words, *to)


def test_attack_prints_the_table_and_names_the_files_it_wrote(attack_mug: Attack, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = attack_mug("--judge", "tiny")
    assert done.exit_code == 0, done.output
    table = [[cell.strip() for cell in line.split("│")] for line in done.stdout.splitlines()]
    rows = {cells[1]: cells[2:6] for cells in table if len(cells) > 5}
    figures = ["0.90 [0.80, 0.95]", "0.30 [0.20, 0.43]", "0.67 [0.55, 0.78]"]
    assert rows == {
        "surrogate (own views)": ["60 (50 distinct)", *figures],
        "target (own views)": ["60 (50 distinct)", *figures],
        "target (held-out views)": ["17", *figures],
        "judge tiny (own views)": ["60 (50 distinct)", *figures],
        "held-out views, half size": ["17", *figures],
    }
    for words in (
        "42.1%",
        "0.0310 (7.9/255)",
        "0.2000 (51.0/255)",
        "25.0% of the target views (1.23% of the object's pixels); epsilon bounds texels",
        "Side by side, a viewer sees a difference for a trained eye on average (CIEDE2000 1.2)",
        "SSIM 0.987",
        "4,800 by each attacked classifier",
        "calibrated: error 0.4/255 is within tolerance",
        "0.01",
        "tau none,",
        "mug, class mug (3) or cup (1), attacked through",
        "jug 15, vase 13, pot 12, pan 11, beer mug 10 (neighbour), 9 in other classes",
        "warning: the [racket] is thin",
        "8.8: calibrate 1.2, attack 7.5",
        str(out / "report" / "index.html"),
        str(out / "mug-adversarial.zip"),
    ):
        assert words in done.stdout
    assert "goal reached" not in done.stdout
    assert json.loads((out / "result.json").read_text())["label_name"] == "mug"


EVERY_OPTION: dict[str, Any] = {
    "classifier": "net",
    "ensemble": ["torchvision:vgg16", "other"],
    "queries": 8,
    "judges": ["torchvision:vgg16", "net"],
    "epsilon": 0.1,
    "perceptual": True,
    "epsilon_view": 0.04,
    "tau": 0.2,
    "keep": 0.3,
    "materials": ["clay", "glaze"],
    "masks": {"a.png": stored_id(b"mask")},
    "label": [7, "lamp"],
    "target": 2,
    "top_k": 2,
    "loss": "cross_entropy",
    "steps": 9,
    "alpha": 0.02,
    "optimiser": "pgd",
    "image_pipeline": "transfer",
    "views_per_step": 3,
    "surrogate": "curve",
    "seed": 4,
    "centre": "origin",
    "distance": 2,
    "elevation": (-5, 30),
    "background": ["#112233", "black"],
    "pool": 50,
    "grid": True,
    "azimuths": 4,
    "elevations": 3,
    "conditions": "wide",
    "ranges": {"roll": (-10, 10), "ambient": (0.2, 0.6)},
    "held_out": 12,
    "renderers": ["three", "mitsuba 3.9 (spp 64)"],
    "judge_renderers": ["cycles"],
}
"""A value of each option, other than its default."""


def words_of(keyword: str, value: object) -> list[str]:
    """An option's words on the command line, by its declaration."""
    flag = OPTIONS[keyword].flag
    if isinstance(value, bool):
        return [flag]
    if keyword == "masks":
        return [flag, "a.png=mask.png"]
    if isinstance(value, dict):
        return [str(word) for name, ends in value.items() for word in (flag, name, *ends)]
    rows = value if isinstance(value, list) else [value]
    return [str(word) for row in rows for word in (flag, *(row if isinstance(row, tuple) else [row]))]


def test_every_option_has_a_value_here() -> None:
    assert EVERY_OPTION.keys() == OPTIONS.keys()


@pytest.mark.parametrize("keyword", EVERY_OPTION)
def test_every_option_is_a_flag_a_keyword_and_a_word_of_the_printed_command(
    server: FakeServer, client: Client, mask: str, keyword: str
) -> None:
    more = {"pool": {}, "azimuths": {"grid": True}, "elevations": {"grid": True}}.get(keyword, {})
    given = {"label": "mug", **more, keyword: EVERY_OPTION[keyword]}
    words = [word for name, value in given.items() for word in words_of(name, value)]
    done = trompe("attack", "mug", *words, "--server", server.url, "--detach")
    assert done.exit_code == 0, done.output
    spec = server.jobs["job-1"].attack
    assert spec == JobSpec.of("mug", **given)
    files = {"masks": {"a.png": mask}} if keyword == "masks" else {}
    assert client.attack("mug", **given | files).status.spec == spec
    printed = shlex.split(command(spec, object="mug", classifier=spec.victim.classifier))
    if keyword != "masks":  # their pictures are on the server
        assert trompe(*printed[1:-2], "--server", server.url, "--detach").exit_code == 0
        assert server.jobs["job-3"].spec == spec


def test_a_given_range_takes_the_place_of_that_of_the_conditions_even_if_it_is_the_usual_one(
    server: FakeServer,
) -> None:
    words = ["--conditions", "wide", "--range", "roll", "0", "0", "--range", "ambient", "0.1", "0.2"]
    assert trompe("attack", "mug", "--label", "mug", *words, "--server", server.url, "--detach").exit_code == 0
    spec = server.jobs["job-1"].attack
    given = {"roll": (0.0, 0.0), "ambient": (0.1, 0.2)}
    assert spec.views.ranges == CONDITIONS["wide"].model_copy(update=given)
    assert spec.changed()["ranges"] == given
    assert JobSpec.model_validate_json(spec.model_dump_json()) == spec
    assert command(spec, object="mug", classifier="tiny").count("--range") == 2


def test_an_option_is_added_by_its_field_alone() -> None:
    class Named(SearchOptions):
        rule: Literal["a", "b"] = option("a", "rule of the test", in_form=True)

    info = Named.model_fields["rule"]
    added = Option("search", "rule", info)
    flag = flag_of(added)
    assert isinstance(flag.type, click.Choice)
    assert (flag.opts, flag.type.choices, flag.section) == (["--rule"], ("a", "b"), "Search")
    assert flag.help == "Rule of the test; default: a."
    assert (added.keyword, added.default, added.in_form, added.repeated) == ("rule", "a", True, False)


@pytest.fixture
def mask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The picture that ``words_of`` names, in the working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mask.png").write_bytes(b"mask")
    return "mask.png"


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        pytest.param("", {}, id="defaults"),
        pytest.param("--ensemble net", {"ensemble": ["net"]}, id="for transfer"),
        pytest.param("--image-pipeline none", {"image_pipeline": "none"}, id="as rendered"),
        pytest.param("--target vase", {"target": "vase"}, id="target by name"),
    ],
)
def test_other_spellings_of_options(attack_mug: Attack, server: FakeServer, words: str, wanted: dict[str, Any]) -> None:
    assert attack_mug(*words.split()).exit_code == 0
    assert server.jobs["job-1"].spec == JobSpec.of("mug", label="mug", **wanted)


def test_help_lists_each_option_once_under_its_part_with_its_default() -> None:
    lines = trompe("attack", "--help").stdout.splitlines()
    sections = [part.title() for part in PARTS]
    assert [line[:-1] for line in lines if re.fullmatch(r"\S.*:", line)] == [*sections, "Server and results"]
    listed = re.findall(r"^  (?:-h, )?(--[a-z-]+)", "\n".join(lines), re.MULTILINE)
    declared = [parameter.opts[-1] for parameter in attack.params if isinstance(parameter, click.Option)]
    assert sorted(listed) == sorted([*declared, "--help"])
    text = " ".join(" ".join(lines).split())
    for each in OPTIONS.values():
        if isinstance(each.default, str | int | float) and not isinstance(each.default, bool):
            assert re.search(f"default: {each.default}[. ]", text), each


@pytest.mark.parametrize(
    ("words", "goal"),
    [
        pytest.param("--target 2", "83.3% of the target views: taken for class 2", id="index"),
        pytest.param("--target vase", "83.3% of the target views: taken for vase", id="name"),
        pytest.param("--top-k 5", "83.3% of the target views: the true class is not among the 5 best", id="top k"),
    ],
)
def test_a_goal_is_told_with_how_often_it_was_reached(attack_mug: Attack, words: str, goal: str) -> None:
    done = attack_mug(*words.split(), "--queries", 10, "--keep", 0.1, "--tau", ".2", "--ensemble", "net")
    assert goal in done.stdout
    assert "attacked through tiny and net: epsilon 0.05, alpha 0.01, tau 0.2, keep 0.1" in done.stdout
    assert "4,800 by each attacked classifier, 48,000 scores asked" in done.stdout


def test_a_report_of_100_columns_keeps_every_number_whole(client: Client) -> None:
    spec = JobSpec.of("mug", label=0, judges=["mobilenet_v3_large"], top_k=5)
    console = Console(width=100, file=(printed := io.StringIO()))
    console.print(result_report(client.submit(spec).wait(timeout=20).result()))
    lines = printed.getvalue().splitlines()
    assert max(map(len, lines)) <= 100
    rows = [line for line in lines if "0.90 [0.80, 0.95] │ 0.30 [0.20, 0.43] │ 0.67 [0.55, 0.78]" in line]
    assert len(rows) == 5


def test_a_narrow_terminal_shows_which_row_is_which(client: Client) -> None:
    console = Console(width=60, file=(printed := io.StringIO()))
    job = client.submit(JobSpec.of("mug", label=0))
    console.print(jobs_table([job.status]), crop=False)
    console.print(result_report(job.wait(timeout=20).result()), crop=False)
    assert job.id in printed.getvalue()
    assert "target" in printed.getvalue()


def test_files_of_others_stay_and_an_older_result_is_named(
    server: FakeServer, mug_folder: Path, tmp_path: Path
) -> None:
    theirs = tmp_path / "out/mug-adversarial/notes.txt"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("mine")
    (tmp_path / "out/result.json").write_text("{}")
    (tmp_path / "out/bottle-adversarial.glb").write_text("older")
    attack = "attack", mug_folder, "--label", 0, "--server", server.url, "--out", tmp_path / "out"
    assert "files of an earlier result, too: bottle-adversarial.glb" in trompe(*attack).stderr
    assert theirs.read_text() == "mine"
    assert "earlier" not in trompe(*attack).stderr


def test_results_that_cannot_be_unpacked_stay_packed(server: FakeServer, mug_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mug-adversarial").write_text("a file")
    done = trompe("attack", mug_folder, "--label", 0, "--server", server.url, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    assert "mug-adversarial.zip stays packed" in done.stderr
    assert (tmp_path / "mug-adversarial.zip").is_file()


def test_an_object_comes_back_in_the_form_it_was_given(server: FakeServer, mug_folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "cup.zip"
    archive.write_bytes(zipped(mug_folder))
    for source in (mug_folder, archive, mug_folder / "mug.obj", mug_folder):
        done = trompe("attack", source, "--label", 0, "--server", server.url, "--out", tmp_path / "out")
        assert done.exit_code == 0, done.output
    made = {p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert made == {
        "cup-adversarial.zip",
        "mug-adversarial/a.png",
        "mug-adversarial/maps/b.png",
        "mug-adversarial/mug.obj",
        "report/index.html",
        "result.json",
    }
    assert (tmp_path / "out/mug-adversarial/a.png").read_bytes() == b"repainted"


def test_not_applicable_is_reported_with_its_reason_and_is_no_failure(attack_mug: Attack, server: FakeServer) -> None:
    server.ending = JobState.not_applicable
    done = attack_mug()
    assert done.exit_code == 0
    assert "n.a.: no view was recognised before the attack" in done.stdout
    assert re.search(r"target \(own views\).*0\.00 \[0\.00, 0\.06\] │ +n\.a\. │ +n\.a\.", done.stdout)


def test_a_failed_job_exits_with_6_and_its_reason(attack_mug: Attack, server: FakeServer) -> None:
    server.ending = JobState.failed
    done = attack_mug()
    assert done.exit_code == 6
    assert "trompe: Job job-1 failed: the renderer said no" in done.stderr
    assert "Traceback" not in done.output


@pytest.mark.parametrize(
    ("words", "why"),
    [
        pytest.param(["--epsilon", "7"], "--epsilon: Input should be less than or equal to 1", id="out of range"),
        pytest.param(["--queries", "0"], "--queries: Input should be greater", id="not the keyword"),
        pytest.param(["--surrogate", "magic"], "'magic' is not one of 'auto', 'diffuse'", id="no such model"),
        pytest.param(
            ["--elevation", "50", "0"], "Invalid options: --elevation: must be a range within", id="range upside down"
        ),
        pytest.param(["--out", ""], "give a folder, or . for the current one", id="a folder without a name"),
        pytest.param(["--bogus"], "No such option '--bogus'", id="no such option"),
        pytest.param(["--mask", "mask.png"], "should be a texture and a picture of its size", id="mask of no texture"),
        pytest.param(["--mask", "a.png=missing.png"], "no mask picture 'missing.png'", id="mask without a file"),
        pytest.param(["--range", "elevation", "0", "9"], "'elevation' is not one of 'azimuth'", id="no such range"),
        pytest.param(
            ["--grid", "--pool", "9"], "--grid attacks the paper's grid, --pool 9 random views", id="two sets of views"
        ),
        pytest.param(["--pool", "9", "--azimuths", "4"], "add --grid, or leave", id="size of no grid"),
        pytest.param(["--target", "vase", "--top-k", "5"], "--top-k leaves the best classes", id="two goals"),
        pytest.param(["--queries", "7"], "use an even number", id="odd queries"),
        pytest.param(["--epsilon", "0.001"], "use 0.004 or more", id="less than a level"),
        pytest.param(["--detach"], "leave out --out", id="results to two places"),
        pytest.param(["--tag", "campaign"], "should be a name and a value", id="a tag without a value"),
        pytest.param(["--tag", "two words=1"], "labels", id="a tag that is none"),
        pytest.param(["--priority", "highest"], "'highest' is not one of", id="no such priority"),
    ],
)
def test_wrong_usage_exits_with_2_and_why_before_a_server_is_asked(words: list[str], why: str, tmp_path: Path) -> None:
    done = trompe("attack", "mug", "--label", 0, "--server", "http://127.0.0.1:9", "--out", tmp_path, *words)
    assert done.exit_code == 2
    assert "Usage:" in done.stderr
    assert why in done.stderr
    assert "Value error" not in done.stderr


@pytest.mark.parametrize("words", [["--detach"], []], ids=["on a server that ends at once", "results to nowhere"])
def test_results_need_a_place(words: list[str]) -> None:
    assert trompe("attack", "mug", "--label", 0, *words).exit_code == 2


def test_a_refusal_names_options_as_its_reader_gave_them_and_has_no_title(server: FakeServer, client: Client) -> None:
    server.detail = "'tiny' has no class 'mag'; name another network by `classifier`, or ask for `queries: 10`."
    server.refusals = [(422, {})] * 2
    with pytest.raises(BadRequest) as refusal:
        client.attack("mug", label="mag")
    assert str(refusal.value) == server.detail
    done = trompe("attack", "mug", "--label", "mag", "--server", server.url, "--detach")
    said = "'tiny' has no class 'mag'; name another network by --classifier, or ask for --queries 10."
    assert done.stderr == f"trompe: {said} (request req-7)\n"


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("a larger `epsilon`, `loss: margin`", "a larger --epsilon, --loss margin"),
        ("`judges`, `materials`, `top_k: 3`", "--judge, --material, --top-k 3"),
        ("run `trompe serve`; `colour: red`, epsilon", "run `trompe serve`; `colour: red`, epsilon"),
    ],
)
def test_keywords_in_backquotes_become_flags(text: str, printed: str) -> None:
    assert in_flags(text) == printed


def test_a_result_and_a_job_name_flags_too(attack_mug: Attack, server: FakeServer, client: Client) -> None:
    server.note, server.ending = "none was recognised: check `distance`", JobState.not_applicable
    server.warnings = ["leave out `grid`"]
    done = attack_mug()
    assert "n.a.: none was recognised: check --distance\n" in done.stdout
    assert "warning: leave out --grid\n" in done.stdout
    shown = trompe("jobs", "show", "job-1", "--server", server.url).stdout
    assert "note      none was recognised: check --distance" in shown
    assert client.job("job-1").status.note == server.note


def test_lists_show_what_the_server_has(server: FakeServer, client: Client) -> None:
    for _ in range(3):
        client.submit(SPEC)
    client.job("job-2").cancel()
    server.classifiers.append(server.classifiers[0].model_copy(update={"name": "blind", "white_box": False}))
    assert re.search("mug .*a.png 8x4", trompe("objects", "--server", server.url).stdout)
    uses = trompe("classifiers", "--server", server.url).stdout
    assert re.search(r"tiny .*│ attack, judge ", uses)
    assert re.search(r"blind .*│ judge, attack by scores ", uses)
    every = trompe("jobs", "--server", server.url).stdout
    assert all(f"job-{k}" in every for k in (1, 2, 3))
    only = trompe("jobs", "--state", "cancelled", "--server", server.url).stdout
    assert "job-2" in only
    assert "job-1" not in only
    assert "job-1" not in trompe("jobs", "--limit", 2, "--server", server.url).stdout


def test_jobs_on_uploads_are_listed_by_their_names(server: FakeServer, client: Client, mug_folder: Path) -> None:
    barrel = client.upload_object(mug_folder, name="a barrel with a name longer than an id")
    (mug_folder / "net.pt2").write_bytes(b"net")
    client.attack(barrel.id, label=0, classifier=mug_folder / "net.pt2", judges=["net"])
    (line,) = [line for line in trompe("jobs", "--server", server.url).stdout.splitlines() if "job-1" in line]
    assert [cell.strip() for cell in line.split("│")][3:6] == [barrel.name, "0", "net"]
    shown = trompe("jobs", "show", "job-1", "--server", server.url).stdout
    assert re.search(rf"^object +{barrel.name} *$", shown, re.MULTILINE)
    assert re.search(r"^classifier +net *$", shown, re.MULTILINE)
    assert f"{barrel.name}={barrel.id} net=" in shown


@pytest.mark.parametrize(
    ("wall", "start_up", "parts"),
    [
        pytest.param(None, 0.0, {"queue": 2, "open": 3, "attack": 9}, id="job of another command"),
        pytest.param(20.0, 4.5, {"start-up": 4.5, "queue": 2, "open": 3, "attack": 9, "download": 1.5}, id="own job"),
        pytest.param(13.0, 0.1, {"queue": 2, "open": 3, "attack": 9}, id="job that ended before the command"),
    ],
)
def test_all_time_from_start_to_the_files_on_disk_is_accounted_for(
    client: Client, wall: float | None, start_up: float, parts: dict[str, float]
) -> None:
    handle = client.submit(SPEC).wait(timeout=20)
    times = {name: NOW + timedelta(seconds=at) for name, at in {"started": 2, "finished": 14}.items()}
    seconds = {"open": 1.0, "attack": 9.0}  # and 2 s before it was opened
    result = handle.result().model_copy(update={"seconds": seconds})
    told = spent(result, handle.status.model_copy(update=times), start_up=start_up, wall=wall)
    assert told == parts
    assert list(told) == list(parts)
    if "download" in parts:
        assert sum(told.values()) == wall
    printed = io.StringIO()
    Console(width=120, file=printed).print(result_report(result, seconds=told))
    assert re.search(rf"seconds +{sum(parts.values()):.1f}: .*attack 9\.0", printed.getvalue())


def test_watch_report_and_cancel_take_up_a_job_by_its_id(server: FakeServer, client: Client, tmp_path: Path) -> None:
    client.submit(SPEC)
    seen = trompe("watch", "job-1", "--server", server.url)
    assert seen.exit_code == 0
    assert "trompe report job-1" in seen.stdout
    done = trompe("report", "job-1", "--out", tmp_path, "--server", server.url)
    assert "target (own views)" in done.stdout
    assert (tmp_path / "mug-adversarial.zip").is_file()
    client.submit(SPEC)
    assert "job-2: cancelled" in trompe("cancel", "job-2", "--server", server.url).stdout
    assert server.jobs["job-2"].state is JobState.cancelled


@pytest.mark.parametrize(
    "words", [["watch", "job-1"], ["attack", "mug", "--label", "mug", "--out", "out"]], ids=["watch", "attack"]
)
def test_ctrl_c_in_a_terminal_ends_the_command_and_not_the_job(
    server: FakeServer, client: Client, tmp_path: Path, words: list[str]
) -> None:
    server.stalls = True
    client.submit(SPEC)
    command, pipe = [sys.executable, "-m", "trompe_client.cli", *words, "--server", server.url], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, cwd=tmp_path) as process:
        while not server.resumed_after:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    job = [*server.jobs][-1]
    assert f"Job {job} continues. Follow it: trompe watch {job} --server {server.url}" in said
    assert "Traceback" not in said
    assert server.jobs[job].state is JobState.queued


@pytest.fixture
def our_own(server: FakeServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fake server in place of the one that a command starts for itself."""
    monkeypatch.setattr(connection, "embedded_server", lambda: nullcontext(server.url))


@pytest.mark.usefixtures("our_own")
def test_ctrl_c_cancels_the_job_on_a_server_of_our_own(
    server: FakeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JobHandle, "wait", Mock(side_effect=KeyboardInterrupt))
    assert trompe("attack", "mug", "--label", 0, "--out", tmp_path).exit_code == 130
    assert server.jobs["job-1"].state is JobState.cancelled


@pytest.mark.usefixtures("our_own")
def test_a_token_that_is_given_opens_the_service_of_the_command_too(server: FakeServer) -> None:
    server.token = "trompe_secret"
    with connection.service(None, "trompe_secret") as client:
        assert client.objects()


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed commands: one that works, one that cannot be loaded, one that finds out when it is called."""

    def lacking() -> click.Command:
        raise ModuleNotFoundError("No module named 'uvicorn'", name="uvicorn")

    made = {"worker": lacking, "paint": lambda: click.echo("painted")}
    loads = {"serve": lacking}
    loads |= {name: partial(click.Command, name, callback=callback) for name, callback in made.items()}

    def entry_points(*, group: str, name: str | None = None) -> metadata.EntryPoints:
        assert group == "trompe.commands"
        chosen: Any = [SimpleNamespace(name=each, load=load) for each, load in loads.items() if name in {None, each}]
        return metadata.EntryPoints(chosen)

    monkeypatch.setattr(metadata, "entry_points", entry_points)


@pytest.mark.usefixtures("commands")
def test_a_command_of_another_package_is_found_by_its_entry_point() -> None:
    assert trompe("paint").stdout == "painted\n"
    listed = trompe("--help")  # imports none of them
    assert listed.exit_code == 0
    assert {"attack", "serve", "render", "paint"} <= {line.split()[0] for line in listed.stdout.splitlines() if line}


@pytest.mark.usefixtures("commands")
@pytest.mark.parametrize(("command", "extra"), [("serve", "server"), ("worker", "server"), ("render", "renderer")])
def test_a_missing_extra_is_named_with_the_command_that_installs_it(command: str, extra: str) -> None:
    done = trompe(command)
    assert done.exit_code == 1
    assert f"`trompe {command}` needs the {extra} extra: pip install 'trompe[{extra}]'" in done.stderr


def test_an_unknown_command_is_wrong_usage() -> None:
    assert trompe("fly").exit_code == 2
