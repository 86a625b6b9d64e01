"""The pages about SDK and command line are true: their code runs, their tables are the code's."""

import csv
import json
import re
import shlex
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

import trompe_client
from tests.client.conftest import FakeServer, zipped
from tests.documentation import DOCS, blocks
from trompe_client.cli import main
from trompe_client.cli.group import EXITS, OWN


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
    before, after = (round(100 * float(row[f"held_out_a_{when}"])) for when in ("before", "after"))
    gallery = json.loads(files("trompe_server.pages").joinpath("gallery.json").read_text())
    assert (gallery["before"], gallery["after"]) == (f"{before}%", f"{after}%")
    said = f"recognises it in {before} % of {row['held_out_views']} unseen views before, {after} % after"
    assert said in (DOCS.parent / "README.md").read_text()


@pytest.mark.parametrize(
    "page", ["README.md", *(f"docs/{page.relative_to(DOCS)}" for page in sorted(DOCS.rglob("*.md")))]
)
def test_links_lead_somewhere(page: str) -> None:
    path = DOCS.parent / page
    links = re.findall(r"\]\(([^)#:]+)[^):]*\)", path.read_text())
    assert [link for link in links if not (path.parent / link).exists()] == []
