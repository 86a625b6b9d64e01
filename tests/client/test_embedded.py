"""The service that a command starts for itself, played by small scripts."""

import os
import signal
import sys
from pathlib import Path

import pytest

from trompe_client import EmbeddedServerError, ServerUnreachable, Unauthorized
from trompe_client._embedded import embedded_server
from trompe_shared.api import Problem

NOTE_AND_WAIT = """
import os, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1]); folder.mkdir(exist_ok=True)
def stop(*_):
    pathlib.Path(sys.argv[2]).write_text("stopped"); sys.exit(0)
signal.signal(signal.SIGTERM, stop)
print("warming up"); print("trompe serving on http://127.0.0.1:4711"); time.sleep(60)
"""


def script(code: str) -> tuple[str, ...]:
    return (sys.executable, "-c", code)


def test_it_gives_the_address_it_is_told_and_stops_the_service_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TROMPE_DATA", str(tmp_path / "data"))
    note = tmp_path / "note"
    code = f"import sys; sys.argv.append({str(note)!r})\n{NOTE_AND_WAIT}"
    with embedded_server(command=script(code)) as url:
        assert url == "http://127.0.0.1:4711"
        assert (tmp_path / "data").is_dir()
    assert note.read_text() == "stopped"


def test_a_service_that_ends_at_its_start_is_an_error_with_its_last_words() -> None:
    with (
        pytest.raises(EmbeddedServerError, match=r"(?s)exit code 3.*no port for you"),
        embedded_server(command=script("import sys; print('no port for you', file=sys.stderr); sys.exit(3)")),
    ):
        pytest.fail("it came up")


def test_a_service_that_never_comes_up_is_given_up() -> None:
    with (
        pytest.raises(EmbeddedServerError, match="within 0 s"),
        embedded_server(command=script("import time; time.sleep(60)"), start_seconds=0.1),
    ):
        pytest.fail("it came up")


def test_a_service_that_dies_is_told_apart_from_a_server_elsewhere() -> None:
    code = "print('out of memory\\ntrompe serving on http://127.0.0.1:1')"
    with (
        pytest.raises(EmbeddedServerError, match=r"(?s)has ended.*out of memory"),
        embedded_server(command=script(f"{code}; import time; time.sleep(60)")),
    ):
        raise ServerUnreachable("nobody there")


def test_data_with_tokens_are_told_of_where_none_was_given() -> None:
    code = "print('trompe serving on http://127.0.0.1:1', flush=True); import time; time.sleep(60)"
    asked = Problem(title="Unauthorized", status=401, detail="This needs a token.")
    with (
        pytest.raises(Unauthorized, match=r"needs a token\. The embedded service .*\(TROMPE_DATA, .*TROMPE_TOKEN"),
        embedded_server(command=script(code)),
    ):
        raise Unauthorized(asked)


def test_a_terminated_command_takes_its_service_along(tmp_path: Path) -> None:
    note = tmp_path / "note"
    code = f"import sys; sys.argv.append({str(note)!r})\n{NOTE_AND_WAIT}"
    with pytest.raises(SystemExit, match="143"), embedded_server(command=script(code)):
        os.kill(os.getpid(), signal.SIGTERM)
    assert note.read_text() == "stopped"
