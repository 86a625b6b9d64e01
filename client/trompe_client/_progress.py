"""A job's progress: a bar on a terminal or in a notebook, a line per phase on standard error elsewhere."""

import html
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

from trompe_shared.api import Event
from trompe_shared.api import Progress as JobProgress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress

__all__ = ["Progress", "shown"]

Show = Callable[[Event], None]
Progress = bool | Show
"""Whether progress is shown, or a function of one's own that is handed each event."""


@contextmanager
def shown(progress: Progress) -> Iterator[Show]:
    """A function to hand each event to, for as long as the block lasts."""
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
    """Whether what is displayed goes to a notebook. IPython is asked only where it is in use."""
    ipython: Any = sys.modules.get("IPython")
    return getattr(ipython and ipython.get_ipython(), "kernel", None) is not None


def _notebook() -> Show:
    """A bar in HTML, which needs no widgets."""
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
        yield _lines(console)
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


def _lines(console: "Console") -> Show:
    seen: set[str] = set()

    def show(event: Event) -> None:
        phase, *detail = _words(event)
        if phase not in seen or event.message:
            seen.add(phase)
            message = [event.message] if event.message and event.message != phase else []
            console.print("  ".join([f"{event.progress.fraction:4.0%}", phase, *detail, *message]))

    return show


def _words(event: Event) -> list[str]:
    """E.g. ``attack``, ``step 12/30``, ``loss 0.417``, ``fooled 85%``, ``1:05 left``, as far as known; phase first."""
    return [event.state.value] if event.state.final else [event.progress.phase, *_detail(event.progress)]


def _detail(progress: JobProgress) -> Iterator[str]:
    if progress.step is not None:
        yield f"step {progress.step}/{progress.steps}" if progress.steps else f"step {progress.step}"
    if progress.loss is not None:
        yield f"loss {progress.loss:.3g}"
    if progress.fooled is not None:
        yield f"fooled {progress.fooled:.0%}"
    if progress.eta_seconds is not None:
        minutes, seconds = divmod(round(progress.eta_seconds), 60)
        yield f"{minutes}:{seconds:02} left"
