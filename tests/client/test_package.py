"""The client stays thin, and its public names are as written."""

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import trompe_client
import trompe_renderer
import trompe_server
import trompe_shared

HEAVY = {"PIL", "fastapi", "filelock", "numpy", "pyrender", "sqlalchemy", "torch", "trimesh", "yaml"}
HEAVY |= {"trompe_renderer", "trompe_server"}
LATER = {"httpx", "rich", "click", "IPython"}
"""What an import of the SDK leaves for those who need it."""


def test_public_names_are_sorted_and_exist() -> None:
    assert trompe_client.__all__ == sorted(trompe_client.__all__)
    assert all(hasattr(trompe_client, name) for name in trompe_client.__all__)


def loaded(code: str) -> set[str]:
    """Top names of the modules that a fresh Python has loaded after ``code``."""
    code += "\nimport sys; print(','.join({m.split('.')[0] for m in sys.modules}), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stderr.strip().split(","))


COMMANDS = (["--help"], ["attack", "--help"], ["jobs", "--help"], ["completion", "bash"])
RUN_COMMANDS = [f"main({words}, standalone_mode=False)" for words in COMMANDS]
LOADS = [
    pytest.param("import trompe_client", HEAVY | LATER, id="the SDK"),
    pytest.param("\n".join(["from trompe_client.cli import main", *RUN_COMMANDS]), HEAVY, id="the command line"),
    pytest.param(
        "import trompe_client.cli.group as g; g.main.get_command(None, 'nothing')",
        HEAVY | {"httpx", "rich"},
        id="completion of a word",
    ),
    pytest.param(
        "import trompe_server.service.serve, trompe_server.service.dispatch, trompe_server.executor.attempts",
        {"ray"},
        id="a service on one machine",
    ),
]


@pytest.mark.parametrize(("code", "without"), LOADS)
def test_nothing_is_loaded_that_is_not_needed(code: str, without: set[str]) -> None:
    found = loaded(code)
    assert "trompe_shared" in found
    assert not found & without


def test_httpx_is_imported_in_one_module_only() -> None:
    folder = Path(trompe_client.__file__).parent
    files = {file.name: file.read_text() for file in folder.rglob("*.py")}
    users = [name for name, text in files.items() if re.search(r"^\s*(import|from) httpx", text, re.M)]
    assert users == ["_http.py"]


def test_an_installation_without_extras_brings_four_small_libraries_and_a_few_megabytes_of_ours() -> None:
    needs = [text for text in metadata.requires("trompe") or [] if "extra ==" not in text]
    assert {need.partition(">")[0] for need in needs} == {"click", "httpx", "pydantic", "rich"}
    packages = (trompe_client, trompe_renderer, trompe_server, trompe_shared)
    files = [file for one in packages for file in Path(*one.__path__).rglob("*") if file.suffix != ".pyc"]
    assert sum(file.stat().st_size for file in files if file.is_file()) < 8e6
