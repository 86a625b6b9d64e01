"""A process that may fail: whatever it does, the call ends in time, with an answer or with a word why not."""

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.served import wait_until
from trompe_server.system.sandbox import run_limited
from trompe_shared.errors import ClassifierError, ObjectError

Run = Callable[..., Mapping[str, Any]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs lines of Python as a module in the sandbox."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def start(lines: str, *arguments: str, memory: int = 2**30, seconds: float = 120.0) -> Mapping[str, Any]:
        (tmp_path / "hostile_module.py").write_text(f"import os, sys, time\n{lines}\n")
        return run_limited("hostile_module", arguments, memory=memory, seconds=seconds, failure=ObjectError)

    return start


def failure(run: Run, lines: str, **limits: Any) -> str:
    with pytest.raises(ObjectError) as raised:
        run(lines, **limits)
    return str(raised.value)


def test_the_answer_is_the_last_line(run: Run) -> None:
    assert run("print('chatter'); print('{\"sum\": %d}' % sum(map(int, sys.argv[1:])))", "1", "2") == {"sum": 3}


def test_a_refusal_is_raised_with_its_words_as_the_error_that_the_caller_names(run: Run, tmp_path: Path) -> None:
    lines = 'print(\'{"error": "the chair has no legs"}\'); sys.exit(1)'
    assert failure(run, lines) == "the chair has no legs"
    with pytest.raises(ClassifierError, match="no legs"):
        run_limited("hostile_module", [], memory=2**30, seconds=120, failure=ClassifierError)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        pytest.param("x = bytearray(2**31)", "1024 MiB of memory", id="memory"),
        pytest.param("os.abort()", "memory", id="abort, as C++ does without memory"),
        pytest.param("import ctypes; ctypes.string_at(0)", "SIGSEGV", id="a crash"),
        pytest.param("os.kill(os.getpid(), 9)", "was killed, probably for want of memory", id="killed by the kernel"),
        pytest.param("sys.exit(3)", "exit code 3", id="an exit code"),
        pytest.param("raise RuntimeError('boo')", "exit code 1", id="an exception"),
        pytest.param("pass", "without an answer", id="silence"),
        pytest.param("print('[' * 100000)", "without an answer", id="an answer that is none"),
        pytest.param("print('[1]')", "without an answer", id="an answer that is a list"),
        pytest.param("open(__file__ + '.large', 'wb').truncate(2**31)", "exit code 1", id="a large file"),
    ],
)
def test_what_ended_it_is_said(run: Run, lines: str, words: str) -> None:
    assert words in failure(run, lines)


def test_it_ends_when_its_time_is_over_and_takes_its_children_with_it(run: Run, tmp_path: Path) -> None:
    note = tmp_path / "pid"
    note.touch()
    child = f"import subprocess; p = subprocess.Popen(['sleep', '600']); open({str(note)!r}, 'w').write(str(p.pid))"
    for seconds in (3, 60):  # in three seconds a busy machine may not come as far as to the child
        start = time.monotonic()
        assert f"more than {seconds} s" in failure(run, f"{child}\ntime.sleep(600)", seconds=seconds)
        assert time.monotonic() - start < seconds + 60
        if note.read_text():
            break
    pid = int(note.read_text())
    wait_until(lambda: state_of(pid) in {"", "Z"}, story=lambda: "the child lives on")


def state_of(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return ""


def test_it_ends_when_it_has_computed_for_as_long(run: Run) -> None:
    assert "more than 1 s" in failure(run, "while True: pass", seconds=1)


def test_what_it_prints_has_an_end(run: Run) -> None:
    assert "exit code" in failure(run, "os.lseek(1, 2**29 - 1, os.SEEK_SET); os.write(1, b'x'); os.write(1, b'x')")


def test_it_sees_no_secrets(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROMPE_TOKEN", "hunter2")
    seen = run("import json; print(json.dumps(dict(os.environ)))")
    assert "hunter2" not in seen.values()
    assert seen["PATH"] == os.environ["PATH"]
