"""``trompe judge`` as a user runs it: a process with a renderer of its own."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from trompe_client.cli import main
from trompe_shared.api import Manifest
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects

TROMPE = [sys.executable, "-m", "trompe_client.cli", "judge"]


@pytest.fixture
def painted(tmp_path: Path) -> Path:
    """The mug, a little darker, as a zip."""
    mug = load_object(shipped_objects()["mug"].read())
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


WRONG = [
    pytest.param(["mug"], 2, "Give two files, --label and --out", id="one file"),
    pytest.param(["mug", "mug", "--label", "mug"], 2, "Give two files, --label and --out", id="no folder"),
    pytest.param(["mug", "nowhere.glb", "--label", "mug", "--out", "out"], 2, "no file 'nowhere.glb'", id="no file"),
    pytest.param(["mug", "notes.txt", "--label", "mug", "--out", "out"], 2, "is not a zip archive", id="no model"),
    pytest.param(["mug", "mug", "--label", "mug", "--out", "o", "--suite", "s"], 2, "standard-1", id="no such suite"),
    pytest.param(
        ["mug", "mug", "--label", "mug", "--out", "o", "--suite", "standard-1", "--views", "9"],
        2,
        "the suite standard-1 fixes views and seed",
        id="another number of views",
    ),
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
