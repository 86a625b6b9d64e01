"""A job's progress on a terminal, in a notebook, and where there is neither."""

import io
import sys
from types import SimpleNamespace

import pytest
from rich.console import Console

from trompe_client import JobCancelled, _progress
from trompe_shared.api import Event, JobSpec, JobState, Progress

SPEC = JobSpec(object="mug", label="mug")


@pytest.fixture
def notebook(monkeypatch):
    """What a notebook displays: the contents of its one place, one after the other."""
    shown: list[str] = []
    place = SimpleNamespace(update=lambda html: shown.append(html))
    tools = SimpleNamespace(HTML=str, display=lambda _html, display_id: place)
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell, display=tools))
    monkeypatch.setitem(sys.modules, "IPython.display", tools)
    return shown


def test_a_notebook_shows_a_bar_and_what_the_job_said(client, notebook, capsys):
    client.submit(SPEC).wait(timeout=20, progress=True)
    assert '<progress max="1" value="0.500"></progress> attack  step 7/15  loss 0.25  fooled 50%' in notebook[2]
    assert notebook[-1].startswith("<div>chose the calibrated model</div>")
    assert 'value="1.000"></progress> succeeded' in notebook[-1]
    assert capsys.readouterr() == ("", "")


def test_a_notebook_takes_no_markup_from_a_server(notebook):
    with _progress.shown(True) as show:
        moment = {"id": 1, "time": "2025-01-02T00:00:00Z", "state": JobState.running}
        show(Event(**moment, progress=Progress(phase="<b>"), message="<script>"))
    assert "<b>" not in notebook[0]
    assert "<script>" not in notebook[0]


def test_ipython_on_a_terminal_is_no_notebook(client, monkeypatch, capsys):
    shell = SimpleNamespace()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    client.submit(SPEC).wait(timeout=20, progress=True)
    assert "attack  step 7/15" in capsys.readouterr().err


def test_a_terminal_shows_a_bar_with_the_time_that_is_left(monkeypatch):
    screen = io.StringIO()
    made = Console

    def console(**options):
        return made(**options | {"stderr": False}, file=screen, force_terminal=True, width=120)

    monkeypatch.setattr("rich.console.Console", console)
    moment = {"id": 1, "time": "2025-01-02T00:00:00Z", "state": JobState.running}
    with _progress.shown(True) as show:
        show(
            Event(**moment, progress=Progress(phase="attack", fraction=0.25, step=3, eta_seconds=65.2), message="[so]")
        )
    text = screen.getvalue()
    assert "25%" in text
    assert "step 3  1:05 left" in text
    assert "[so]" in text


def test_progress_can_be_a_function_of_ones_own(client, capsys):
    events: list[Event] = []
    client.submit(SPEC).wait(timeout=20, progress=events.append)
    assert [event.id for event in events] == [1, 2, 3, 4, 5]
    assert capsys.readouterr() == ("", "")


def test_the_bar_is_put_away_when_the_job_does_not_succeed(client, server):
    server.ending = JobState.cancelled
    with pytest.raises(JobCancelled):
        client.submit(SPEC).wait(timeout=20, progress=True)
