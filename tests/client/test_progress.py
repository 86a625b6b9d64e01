"""A job's progress on a terminal, in a notebook, and where there is neither."""

import io
import re
import sys
import time
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from tests.client.conftest import NOW, SPEC
from trompe_client import Client, _progress
from trompe_shared.api import Event, JobState, Progress

RUNNING: dict[str, Any] = {"id": 1, "time": NOW, "state": JobState.running}


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a notebook displays: the contents of its one place, one after the other."""
    shown: list[str] = []
    place = SimpleNamespace(update=lambda html: shown.append(html))
    tools = SimpleNamespace(HTML=str, display=lambda _html, display_id: place)
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell, display=tools))
    monkeypatch.setitem(sys.modules, "IPython.display", tools)
    return shown


def test_a_notebook_shows_a_bar_and_what_the_job_said(
    client: Client, notebook: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    client.submit(SPEC).wait(timeout=20, progress=True)
    assert '<progress max="1" value="0.500"></progress> attack  step 7/15  loss 0.25  fooled 50%' in notebook[2]
    assert notebook[-1].startswith("<div>chose the calibrated model</div>")
    assert 'value="1.000"></progress> succeeded' in notebook[-1]
    assert capsys.readouterr() == ("", "")


def test_a_notebook_takes_no_markup_from_a_server(notebook: list[str]) -> None:
    with _progress.shown(True) as show:
        show(Event(**RUNNING, progress=Progress(phase="<b>"), message="<script>"))
    assert "<b>" not in notebook[0]
    assert "<script>" not in notebook[0]


def test_ipython_on_a_terminal_is_no_notebook(
    client: Client, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = SimpleNamespace()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    client.submit(SPEC).wait(timeout=20, progress=True)
    assert "attack  step 7/15" in capsys.readouterr().err


def test_a_terminal_shows_a_bar_with_the_time_that_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    console = partial(Console, file=screen, force_terminal=True, width=120)
    monkeypatch.setattr("rich.console.Console", lambda **options: console(**options | {"stderr": False}))
    progress = Progress(phase="attack", fraction=0.25, step=3, eta_seconds=65.2)
    with _progress.shown(True) as show:
        show(Event(**RUNNING, progress=progress, message="[so]"))
    text = screen.getvalue()
    assert "25%" in text
    assert "step 3  1:05 left" in text
    assert "[so]" in text


def lines(printed: str) -> list[str]:
    """Lines without the time at their beginning."""
    found = [re.fullmatch(r" *\d+:\d\d  ( *\d+%  .*)", line) for line in printed.splitlines()]
    return [match[1].strip() if match else "no time" for match in found]


def test_a_pipe_gets_a_line_for_each_phase_and_message(client: Client, capsys: pytest.CaptureFixture[str]) -> None:
    client.submit(SPEC).wait(timeout=20, progress=True)
    assert lines(capsys.readouterr().err) == [
        "0%  queued",
        "20%  calibrate  chose the calibrated model",
        "50%  attack  step 7/15  loss 0.25  fooled 50%",
        "100%  succeeded",
    ]


def test_a_pipe_gets_the_latest_progress_again_while_the_job_is_silent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(_progress, "INTERVAL", 0.1)
    attack: dict[str, Any] = {"phase": "attack", "fraction": 0.5, "steps": 90}
    attack |= {"eta_seconds": 1000, "eta_least_seconds": 200}
    printed, deadline = "", time.monotonic() + 60
    with _progress.shown(True) as show:
        time.sleep(0.2)  # nothing is known
        show(Event(**RUNNING, progress=Progress(**attack, step=1), message="started"))
        show(Event(**RUNNING, progress=Progress(**attack, step=2)))
        while printed.count("step 2/90") < 3 and time.monotonic() < deadline:
            time.sleep(0.05)
            printed += capsys.readouterr().err
    said, *again = lines(printed)
    left = r"[23]:\d\d to 1[56]:\d\d left"
    assert re.fullmatch(rf"50%  attack  step 1/90  {left}  started", said)
    assert sum("step 2/90" in line for line in again) >= 3
    assert all(re.fullmatch(rf"50%  attack  step [12]/90  {left}", line) for line in again)


@pytest.mark.parametrize(
    ("known", "age", "words"),
    [
        ({"eta_seconds": 65.2, "eta_least_seconds": 65.2}, 0, ["1:05 left"]),
        ({"eta_seconds": 65.2}, 0, ["1:05 left"]),
        ({"eta_seconds": 65.2, "eta_least_seconds": 12.0}, 0, ["0:12 to 1:05 left"]),
        ({"eta_seconds": 65.2, "eta_least_seconds": 12.0}, 20, ["0:00 to 0:45 left"]),
        ({"eta_seconds": 65.2, "eta_least_seconds": 12.0}, 70, []),
    ],
)
def test_the_time_left_is_a_range_that_ages(known: dict[str, Any], age: float, words: list[str]) -> None:
    event = Event(**RUNNING, progress=Progress(phase="attack", **known))
    assert _progress._words(event, age=age) == ["attack", *words]


def test_progress_can_be_a_function_of_ones_own(client: Client, capsys: pytest.CaptureFixture[str]) -> None:
    events: list[Event] = []
    client.submit(SPEC).wait(timeout=20, progress=events.append)
    assert [event.id for event in events] == [1, 2, 3, 4, 5]
    assert capsys.readouterr() == ("", "")
