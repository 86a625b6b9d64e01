"""The pages about SDK and command line are true: their code runs, their tables are the code's."""

import csv
import json
import re
import shlex
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

import trompe_client
from tests.client.conftest import FakeServer, zipped
from tests.documentation import DOCS, blocks, readers_environment
from trompe_client.cli import main
from trompe_client.cli.group import EXITS, OWN

QUICKSTART = {heading: code for language in ("python", "sh") for heading, code in blocks("quickstart.md", language)}


def run(command: list[str], folder: Path, server: str) -> str:
    """What a program prints that is run in ``folder`` as a reader would, with ``server`` in the environment."""
    environment = readers_environment(TROMPE_SERVER=server)
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=240
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_quickstart_starts_the_service_that_these_tests_start() -> None:
    assert [code for _, code in blocks("quickstart.md", "sh")][:2] == [
        "pip install 'trompe[server]'\n",
        "trompe serve\n",
    ]


def test_the_quickstart_in_python_runs(service: str, tmp_path: Path) -> None:
    said = run([sys.executable, "-W", "error", "-c", QUICKSTART["Python"]], tmp_path, service)
    assert re.fullmatch(r"recognised in \d+% of the views before, in \d+% after\n", said)
    assert (tmp_path / "out-python" / "mug-adversarial.zip").is_file()


@pytest.mark.thorough
def test_the_quickstart_on_the_command_line_runs(service: str, tmp_path: Path) -> None:
    said = run(["bash", "-euo", "pipefail", "-c", QUICKSTART["Command line"]], tmp_path, service)
    assert "target (own views)" in said
    assert (tmp_path / "out-cli" / "mug-adversarial.zip").is_file()


@pytest.mark.thorough
def test_the_quickstart_with_curl_runs(service: str, tmp_path: Path) -> None:
    said = run(["bash", "-euo", "pipefail", "-c", QUICKSTART["curl"]], tmp_path, service)
    assert "event: progress" in said
    assert (tmp_path / "out-curl" / "mug-adversarial.zip").read_bytes()[:2] == b"PK"
    assert '"texels_altered"' in (tmp_path / "out-curl" / "result.json").read_text()


@pytest.fixture
def readers_folder(server: FakeServer, mug_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the pages speak of; the fake server is where commands look for one."""
    (tmp_path / "mug.zip").write_bytes(zipped(mug_folder))
    (tmp_path / "net.pt2").write_bytes(b"network")
    (tmp_path / "room.png").write_bytes(b"picture")
    server.when_listed = server.finish_all
    server.page_size = 500
    monkeypatch.setenv("TROMPE_SERVER", server.url)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("readers_folder")
def test_the_page_on_the_sdk_runs_from_its_beginning_to_its_end(
    server: FakeServer, capsys: pytest.CaptureFixture[str]
) -> None:
    names: dict[str, object] = {}
    for heading, code in blocks("sdk.md", "python"):
        here = code.replace('"http://127.0.0.1:8000"', repr(server.url))
        exec(compile(here, f"sdk.md, {heading}", "exec"), names)
    assert "'no such object' is not stored" in capsys.readouterr().out


@pytest.mark.usefixtures("readers_folder")
def test_the_page_on_the_command_line_runs_from_its_beginning_to_its_end() -> None:
    lines = [line for _, code in blocks("cli.md", "sh") for line in code.splitlines()]
    for line in lines:
        program, *words = shlex.split(line)
        done = CliRunner().invoke(main, words)
        assert (program, done.exit_code) == ("trompe", 0), f"{line}\n{done.output}"
    named = {shlex.split(line)[1] for line in lines}
    assert named >= OWN.keys() - {"cancel"}


def test_the_page_lists_the_exit_codes_of_the_code() -> None:
    rows = re.findall(r"^\| (\d+) \| (.+) \|$", (DOCS / "cli.md").read_text(), re.M)
    assert {int(code): meaning for code, meaning in rows} == EXITS


def test_the_page_on_the_sdk_names_every_error() -> None:
    text = (DOCS / "sdk.md").read_text()
    public = {name: getattr(trompe_client, name) for name in trompe_client.__all__}
    errors = {name for name, one in public.items() if isinstance(one, type) and issubclass(one, Exception)}
    bases = {"APIError", "ClientError", "EmbeddedServerError", "JobError"}
    assert {name for name in errors if f"`{name}`" not in text} <= bases


def test_readme_and_start_page_give_the_figures_of_the_same_job() -> None:
    (row,) = csv.DictReader((DOCS / "bench" / "teapot.csv").read_text().splitlines())
    shares = [round(100 * float(row[f"held_out_a_{when}"])) for when in ("before", "after")]
    gallery = json.loads(files("trompe_server.pages").joinpath("gallery.json").read_text())
    assert [gallery["before"], gallery["after"]] == [f"{share}%" for share in shares]
    said = "recognises it in {} % of {} unseen views before, {} % after".format(
        shares[0], row["held_out_views"], shares[1]
    )
    assert said in (DOCS.parent / "README.md").read_text()


@pytest.mark.parametrize(
    "page", ["README.md", *(f"docs/{page.relative_to(DOCS)}" for page in sorted(DOCS.rglob("*.md")))]
)
def test_links_lead_somewhere(page: str) -> None:
    path = DOCS.parent / page
    links = re.findall(r"\]\(([^)#:]+)[^):]*\)", path.read_text())
    assert [link for link in links if not (path.parent / link).exists()] == []
