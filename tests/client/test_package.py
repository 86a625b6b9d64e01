"""The client stays thin, and its public names are as written."""

import re
import subprocess
import sys
from pathlib import Path

import trompe_client

HEAVY = {"torch", "numpy", "PIL", "trimesh", "fastapi", "dbos", "trompe_server", "trompe_renderer"}


def test_public_names_are_sorted_and_exist():
    assert trompe_client.__all__ == sorted(trompe_client.__all__)
    assert all(hasattr(trompe_client, name) for name in trompe_client.__all__)


def test_importing_client_and_command_line_loads_nothing_heavy():
    code = "import sys, trompe_client, trompe_client.cli as cli; cli.main(['--help'], standalone_mode=False); "
    code += "print(','.join({m.split('.')[0] for m in sys.modules}), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stderr.strip().split(","))
    assert "trompe_client" in loaded
    assert not loaded & HEAVY


def test_httpx_is_imported_in_one_module_only():
    folder = Path(trompe_client.__file__).parent
    users = [file.name for file in folder.glob("*.py") if re.search(r"^\s*(import|from) httpx", file.read_text(), re.M)]
    assert users == ["_client.py"]
