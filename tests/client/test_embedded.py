"""The service that a command starts for itself, played by small scripts."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.served import wait_until
from trompe_client import Client, EmbeddedServerError, ServerUnreachable, Unauthorized
from trompe_client._embedded import embedded_server
from trompe_shared.api import Problem

NOTE_AND_WAIT = """
import os, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[2]); folder.mkdir(exist_ok=True)
def stop(*_):
    pathlib.Path(sys.argv[1]).write_text("stopped"); sys.exit(0)
signal.signal(signal.SIGTERM, stop)
print("warming up"); print("trompe serving on http://127.0.0.1:4711"); time.sleep(60)
"""


def script(code: str, *words: object) -> tuple[str, ...]:
    return (sys.executable, "-c", code, *map(str, words))


def test_it_gives_the_address_it_is_told_and_stops_the_service_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TROMPE_DATA", str(tmp_path / "data"))
    note = tmp_path / "note"
    with embedded_server(command=script(NOTE_AND_WAIT, note)) as url:
        assert url == "http://127.0.0.1:4711"
        assert (tmp_path / "data").is_dir()
    assert note.read_text() == "stopped"


WARM = "import time; print('warming up'); print('trompe serving on http://127.0.0.1:1'); time.sleep(60)"
SLEEP = "import time; time.sleep(60)"
SERVE = f"print('trompe serving on http://127.0.0.1:1'); {SLEEP}"
REFUSED = Unauthorized(Problem(title="Unauthorized", status=401, detail="This needs a token."))
NO_TOKEN = r"needs a token\. The embedded service .*\(TROMPE_DATA, .*TROMPE_TOKEN"


@pytest.mark.parametrize(
    ("code", "seconds", "raised", "error", "words"),
    [
        pytest.param(
            "import sys; print('no port for you', file=sys.stderr); sys.exit(3)",
            *(180, None, EmbeddedServerError, r"(?s)exit code 3.*no port for you"),
            id="ends at its start",
        ),
        pytest.param(SLEEP, 0.1, None, EmbeddedServerError, "within 0 s", id="never comes up"),
        pytest.param(
            f"print('out of memory'); {SERVE}",
            *(180, ServerUnreachable("nobody there"), EmbeddedServerError, r"(?s)does not answer.*out of memory"),
            id="is silent, unlike a server elsewhere",
        ),
        pytest.param(SERVE, 180, REFUSED, Unauthorized, NO_TOKEN, id="has data with tokens"),
    ],
)
def test_what_goes_wrong_with_the_service_is_told(
    code: str, seconds: float, raised: Exception | None, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words), embedded_server(command=script(code), start_seconds=seconds):
        raise raised or AssertionError("it came up")


def test_the_end_of_the_service_ends_the_command_whatever_it_waits_for(tmp_path: Path) -> None:
    note = tmp_path / "note"
    service = script(f"import os; open({str(note)!r}, 'w').write(str(os.getpid()))\n{WARM}")
    began = time.monotonic()
    ended = pytest.raises(EmbeddedServerError, match=r"(?s)has ended \(by SIGKILL\).*warming up")
    with ended, embedded_server(command=service):
        _kill_and_wait(int(note.read_text()))
    assert time.monotonic() - began < 60


def _kill_and_wait(process: int) -> None:
    os.kill(process, signal.SIGKILL)
    time.sleep(60)


def test_a_terminated_command_takes_its_service_along(tmp_path: Path) -> None:
    note = tmp_path / "note"
    with pytest.raises(SystemExit, match="143"), embedded_server(command=script(NOTE_AND_WAIT, note)):
        os.kill(os.getpid(), signal.SIGTERM)
    assert note.read_text() == "stopped"


def test_a_killed_command_takes_its_service_along(tmp_path: Path) -> None:
    code = f"import {embedded_server.__module__} as e\nwith e.embedded_server() as url: print(url, flush=True); {SLEEP}"
    own = {
        "TROMPE_DATA": str(tmp_path / "data"),
        "TMPDIR": str(tmp_path),
        "TROMPE_WORKERS": "0",
        "TROMPE_RENDERERS": "0",
    }
    command = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=os.environ | own)
    assert command.stdout is not None
    url = command.stdout.readline().strip()
    with Client(url) as client:
        assert client.objects()
        command.kill()
        command.communicate()
        wait_until(lambda: not _answers(client))


def _answers(client: Client) -> bool:
    try:
        return bool(client.objects())
    except ServerUnreachable:
        return False
