"""The commands: `trompe serve`, `worker`, `migrate` as far as they need no service to run, `token` and `judge`."""

import json
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from trompe_client.cli import main
from trompe_server.errors import ServiceError
from trompe_server.queue.store import JobStore
from trompe_server.service import commands
from trompe_server.service import serve as serving
from trompe_server.settings import Settings
from trompe_server.storage.tokens import Right, Tokens, hash_secret
from trompe_shared.api import Manifest
from trompe_shared.object3d import Object3D


def run(command: click.Command, *arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(main, [str(command.name), *arguments])
    return result.exit_code, result.output


@pytest.mark.parametrize(
    ("command", "arguments", "status", "words"),
    [
        pytest.param(
            commands.serve, ["--host", "0.0.0.0", "--port", "0"], 1, "trompe token create NAME", id="anybody could come"
        ),
        pytest.param(commands.serve, ["--renderers", "0"], 1, "--workers 0", id="workers without a renderer"),
        pytest.param(commands.serve, ["--executor", "dask"], 2, "executor: String should match", id="a wrong setting"),
        pytest.param(commands.worker, [], 2, "--renderers-dns", id="a worker that does not know the renderers"),
        pytest.param(
            commands.worker, ["--renderer", "127.0.0.1:1", "--workers", "0"], 1, "--workers 1", id="no processes"
        ),
        *(
            pytest.param(commands.worker, ["--renderer", wrong], 2, "is not HOST:PORT", id=f"address {wrong!r}")
            for wrong in ("8085", "host:", ":80x", "", "a..b:80", "http://host:8085", "::1")
        ),
        *(
            pytest.param(commands.migrate, ["--database", url], 1, "is not a supported database URL", id=url)
            for url in ("mysql://host/name", "nonsense", "sqlite://")
        ),
    ],
)
def test_what_cannot_work_is_refused_with_a_remedy(
    tmp_path: Path, command: click.Command, arguments: list[str], status: int, words: str
) -> None:
    found, said = run(command, "--data", str(tmp_path), *arguments)
    assert (found, words in said) == (status, True), said


def test_migrating_makes_the_database_once_and_again(tmp_path: Path) -> None:
    for _ in range(2):
        assert run(commands.migrate, "--data", str(tmp_path)) == (0, "the database is up to date\n")
    assert (tmp_path / "trompe.sqlite").exists()


def test_serve_says_what_is_wrong_with_the_data_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    status, words = run(commands.serve, "--port", "0", "--data", str(tmp_path / "file" / "data"))
    assert status == 1
    assert "cannot be written" in words
    assert "TROMPE_DATA" in words


def test_a_data_folder_without_the_database_must_be_writable_too(tmp_path: Path) -> None:
    elsewhere = ("--database", f"sqlite:///{tmp_path / 'jobs.sqlite'}", "--renderer", "127.0.0.1:1")
    for command in (commands.serve, commands.worker):
        status, words = run(command, "--data", "/proc", *elsewhere)
        assert (status, "The data folder /proc or the database cannot be written" in words) == (1, True), words


@pytest.mark.parametrize(
    ("variable", "value", "fault"),
    [
        ("TROMPE_WORKERS", "many", "workers: Input should be a valid integer, unable to parse"),
        ("TROMPE_NETWORKS", "tiny", "networks: 'tiny' is not a JSON list"),
        ("TROMPE_DEVICE", "gpu", r"device: String should match pattern '\^\(cpu\|cuda\(:\\d\+\)\?\)\$'"),
        ("TROMPE_MAX_UPLOAD", "-1", "max_upload: Input should be greater than 0"),
        ("TROMPE_SILENCE", "inf", "silence: Input should be less than or equal to 86400"),
        ("TROMPE_RENDERER_PATIENCE", "nan", "renderer_patience: Input should be greater than or equal to 0"),
    ],
)
def test_wrong_settings_are_named_with_their_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, value: str, fault: str
) -> None:
    monkeypatch.setenv(variable, value)
    status, words = run(commands.migrate, "--data", str(tmp_path))
    assert status == 2
    assert re.search(rf"{fault}[^()]* \({variable}\)", words)


def test_metrics_on_a_port_in_use_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setenv("TROMPE_METRICS_PORT", str(port))
        status, words = run(commands.worker, "--data", str(tmp_path), "--renderer", "127.0.0.1:1")
    assert (status, f"Cannot serve metrics on port {port}" in words) == (1, True), words


def test_an_option_goes_before_a_wrong_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROMPE_WORKERS", "many")
    assert commands.settings_of(None, workers=2).workers == 2


def test_the_data_folder_is_set_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROMPE_DATA", str(tmp_path))
    assert Settings().data == tmp_path
    monkeypatch.setenv("TROMPE_DATA", "~/trompe")
    assert Settings().data == Path.home() / "trompe"


def test_an_empty_variable_sets_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = Settings()
    for name in ("data", "workers", "device", "networks"):
        monkeypatch.setenv(f"TROMPE_{name.upper()}", "")
    assert Settings() == expected


def test_a_misspelt_variable_is_told_and_those_of_other_readers_are_not(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("SILENSE", "WORKER", "PORT", "BIND", "TOKEN", "RAY_NODES", "RENDERER_CPUS", "WORKER_MEMORY"):
        monkeypatch.setenv(f"TROMPE_{name}", "3")
    commands.settings_of(None)
    assert caplog.messages == [
        "the variable TROMPE_SILENSE sets nothing; did you mean TROMPE_SILENCE?",
        "the variable TROMPE_WORKER sets nothing; did you mean TROMPE_WORKERS?",
    ]


# Tokens


def token(data: Path, *words: str) -> tuple[int, str]:
    """Exit status and standard output of ``trompe token`` with these words."""
    result = CliRunner().invoke(main, ["token", *words, "--data", str(data)])
    return result.exit_code, result.stdout if result.exit_code == 0 else result.output


def tokens(data: Path) -> Tokens:
    return Tokens(JobStore(Settings(data=data).database_url).engine)


def test_a_token_is_made_in_a_folder_that_has_none_yet_and_its_secret_is_all_that_is_printed(tmp_path: Path) -> None:
    status, secret = token(tmp_path / "new", "create", "ci", "--right", "read")
    assert status == 0
    found = tokens(tmp_path / "new").by_hash()[hash_secret(secret.strip())]
    assert (found.name, found.right) == ("ci", Right.read)


def test_an_error_is_json_where_json_was_asked_for(tmp_path: Path) -> None:
    token(tmp_path, "create", "ann")
    status, told = token(tmp_path, "create", "ann", "--json")
    error = json.loads(told)["error"]
    assert (error["exit_code"], "'ann'" in error["message"]) == (status, True)


def test_tokens_are_listed_with_what_became_of_them(tmp_path: Path) -> None:
    assert token(tmp_path, "list") == (0, "")
    made = json.loads(token(tmp_path, "create", "ann", "--json")[1])
    assert made["right"] == "write"
    assert hash_secret(made["secret"]) in tokens(tmp_path).by_hash()
    token(tmp_path, "create", "bob")
    assert token(tmp_path, "revoke", "bob")[0] == 0
    ann, bob = json.loads(token(tmp_path, "list", "--json")[1])
    assert (ann["name"], ann["revoked"], ann["last_used"]) == ("ann", None, None)
    assert bob["revoked"] is not None
    words = token(tmp_path, "list")[1]
    assert "last used never" in words
    assert "revoked 20" in words
    assert made["secret"] not in words


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        (["create", "ann"], 1, "name 'ann' is in use"),
        (["create", "a b"], 2, "not a valid token name"),
        (["create", "eve", "--right", "admin"], 2, "is not one of"),
        (["revoke", "eve"], 1, "no token 'eve'"),
    ],
)
def test_the_impossible_is_refused_with_a_reason(tmp_path: Path, words: list[str], status: int, reason: str) -> None:
    token(tmp_path, "create", "ann")
    found, said = token(tmp_path, *words)
    assert (found, reason in said) == (status, True), said


def test_a_server_is_seen_by_other_machines_only_while_there_is_a_token_that_is_valid(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path)

    def refused(host: str) -> bool:
        try:
            serving._refuse_public(host, settings)
        except ServiceError:
            return True
        return False

    token(tmp_path, "list")
    assert [refused(host) for host in ("127.0.0.1", "::1", "localhost")] == [False] * 3
    assert [refused(host) for host in ("0.0.0.0", "::", "192.168.1.5", "example.org")] == [True] * 4
    token(tmp_path, "create", "ann", "--right", "read")
    assert not refused("0.0.0.0")
    token(tmp_path, "revoke", "ann")
    assert refused("0.0.0.0")


# Judgements, each by a process with a renderer of its own

TROMPE = [sys.executable, "-m", "trompe_client.cli", "judge"]


@pytest.fixture
def painted(tmp_path: Path, mug: Object3D) -> Path:
    """The mug, a little darker, as a zip."""
    file = tmp_path / "painted.zip"
    file.write_bytes(mug.with_textures({name: image // 8 * 7 for name, image in mug.textures.items()}).to_zip())
    return file


@pytest.mark.thorough
def test_a_judgement_is_interrupted_continued_and_verified(painted: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [*TROMPE, "mug", str(painted), "--label", "mug", "--views", "11", "--epsilon", "0.05", "--out", str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as stopped:
        assert stopped.stderr is not None
        first = stopped.stderr.readline()
        stopped.send_signal(signal.SIGINT)
        said = stopped.stderr.read()
    assert re.fullmatch(r" +\d:\d\d +0%  rendering in pyrender  \d+:\d\d left\n", first)
    assert f"Finished work is kept in {out}" in said
    assert stopped.returncode == 130

    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert re.search(r"tiny +│ pyrender", done.stdout)
    assert "exceeds the stated epsilon of 0.05" in done.stdout
    assert sorted(file.name for file in out.iterdir()) == ["judgement.html", "judgement.json"]
    assert Manifest.model_validate_json((out / "judgement.json").read_bytes()).after.source == "../painted.zip"

    verified = subprocess.run([*TROMPE, "--verify", str(out / "judgement.json")], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    assert "random views rendered again have the same classes" in verified.stdout
    in_json = CliRunner().invoke(main, ["judge", "--verify", str(out / "judgement.json"), "--json"])
    assert json.loads(in_json.output) == {"faults": []}


WRONG = [
    pytest.param(["mug"], 2, "Give two files, --label and --out", id="one file"),
    pytest.param(["mug", "mug", "--label", "mug"], 2, "Give two files, --label and --out", id="no folder"),
    pytest.param(["mug", "nowhere.glb", "--label", "mug", "--out", "out"], 2, "no file 'nowhere.glb'", id="no file"),
    pytest.param(["mug", "notes.txt", "--label", "mug", "--out", "out"], 2, "is not a zip archive", id="no model"),
    pytest.param(["mug", "mug", "--label", "mug", "--out", "o", "--suite", "s"], 2, "standard-1", id="no such suite"),
    pytest.param(["mug", "job:1", "--label", "mug", "--out", "o"], 2, "a job on a server: add --server", id="a job"),
    pytest.param(["--verify", "notes.txt"], 2, "notes.txt is not a manifest", id="no manifest"),
    pytest.param(["mug", "--verify", "notes.txt"], 2, "--verify takes a manifest alone", id="a manifest and a file"),
]


@pytest.mark.parametrize(("words", "code", "text"), WRONG)
def test_a_wrong_command_is_one_clear_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int, text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text(json.dumps({"a": 1}))
    done = CliRunner().invoke(main, ["judge", *words])
    assert (done.exit_code, text in done.output) == (code, True), done.output
