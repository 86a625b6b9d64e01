"""A job's progress: a bar on a terminal or in a notebook, else lines on standard error."""

import html
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from trompe_shared.api import Event, JobState
from trompe_shared.api import Progress as JobProgress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress

Show = Callable[[Event], None]
Progress = bool | Show
"""Whether to show progress, or a function that gets each event."""
INTERVAL: Final = 20.0
"""Longest time without a line, seconds."""


@contextmanager
def shown(progress: Progress) -> Iterator[Show]:
    """A function that shows an event, valid within the block."""
    if callable(progress):
        yield progress
    elif not progress:
        yield lambda _event: None
    elif _in_notebook():
        yield _notebook()
    else:
        with _on_stderr() as show:
            yield show


def _in_notebook() -> bool:
    """Whether output goes to a notebook. Does not import IPython."""
    ipython: Any = sys.modules.get("IPython")
    return getattr(ipython and ipython.get_ipython(), "kernel", None) is not None


def _notebook() -> Show:
    """A bar in HTML, without widgets."""
    tools: Any = import_module("IPython.display")

    place = tools.display(tools.HTML(""), display_id=True)
    messages: list[str] = []

    def show(event: Event) -> None:
        messages.extend([event.message] if event.message else [])
        words = html.escape("  ".join(_words(event)))
        lines = "".join(f"<div>{html.escape(message)}</div>" for message in messages)
        place.update(tools.HTML(f'{lines}<progress max="1" value="{event.progress.fraction:.3f}"></progress> {words}'))

    return show


@contextmanager
def _on_stderr() -> Iterator[Show]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    if not console.is_terminal:
        lines = _Lines(console)
        with lines.repeated():
            yield lines.show
        return
    words = TextColumn("{task.fields[detail]}", markup=False)
    phase = TextColumn("{task.description}", markup=False)
    with Progress(phase, BarColumn(), TaskProgressColumn(), words, TimeElapsedColumn(), console=console) as bar:
        yield _bar(bar)


def _bar(bar: "RichProgress") -> Show:
    task = bar.add_task("queued", total=1.0, detail="")

    def show(event: Event) -> None:
        phase, *detail = _words(event)
        bar.update(task, completed=event.progress.fraction, description=phase, detail="  ".join(detail))
        if event.message:
            bar.console.print(event.message)

    return show


class _Lines:
    """A line for each phase and each message, and the latest progress again whenever ``INTERVAL`` is over.

    Each begins with the time since the first.
    """

    def __init__(self, console: "Console") -> None:
        self._console, self._lock = console, threading.Lock()
        self._began = self._printed = self._seen = time.monotonic()
        self._event: Event | None = None

    def show(self, event: Event) -> None:
        with self._lock:
            before, self._event, self._seen = self._event, event, time.monotonic()
            if event.message or before is None or _words(event)[0] != _words(before)[0]:
                self._print(event)

    @contextmanager
    def repeated(self) -> Iterator[None]:
        """Print the latest progress again within the block, also while the job says nothing."""
        over = threading.Event()
        thread = threading.Thread(target=self._repeat, args=(over,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def _repeat(self, over: threading.Event) -> None:
        while not over.wait(max(0.0, self._printed + INTERVAL - time.monotonic())):
            with self._lock:
                if time.monotonic() < self._printed + INTERVAL:
                    continue
                self._printed = time.monotonic()
                if self._event is not None:
                    self._print(self._event.model_copy(update={"message": None}))

    def _print(self, event: Event) -> None:
        self._printed = time.monotonic()
        words = _words(event, age=self._printed - self._seen)
        message = [event.message] if event.message and event.message != words[0] else []
        elapsed = f"{_clock(self._printed - self._began):>6}"
        self._console.print("  ".join([elapsed, f"{event.progress.fraction:4.0%}", *words, *message]))


def _words(event: Event, *, age: float = 0.0) -> list[str]:
    """``attack``, ``step 12/30``, ``loss 0.417``, ``fooled 85%``, ``0:20 to 1:05 left``: the known ones, phase first.

    age: seconds since the event.
    """
    if event.state.final:
        return [event.state.value]
    opening = event.state is JobState.running and event.progress.phase == JobState.queued
    return ["open" if opening else event.progress.phase, *_detail(event.progress, age)]


def _detail(progress: JobProgress, age: float) -> Iterator[str]:
    if progress.step is not None:
        yield f"step {progress.step}/{progress.steps}" if progress.steps else f"step {progress.step}"
    if progress.loss is not None:
        yield f"loss {progress.loss:.3g}"
    if progress.fooled is not None:
        yield f"fooled {progress.fooled:.0%}"
    if progress.eta_seconds is not None and progress.eta_seconds > age:
        most, least = (_clock(max(0.0, eta - age)) for eta in (progress.eta_seconds, progress.eta_least_seconds or 0.0))
        yield f"{least} to {most} left" if progress.eta_least_seconds is not None and least != most else f"{most} left"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02}"
