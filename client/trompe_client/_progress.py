"""A job's progress on standard error: a bar on a terminal, a line per phase elsewhere."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from trompe_shared.api import Event
from trompe_shared.api import Progress as JobProgress

__all__ = ["progress_display"]

Show = Callable[[Event], None]


@contextmanager
def progress_display(console: Console | None = None) -> Iterator[Show]:
    """A function to hand each event to, for as long as the block lasts."""
    console = console or Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    if not console.is_terminal:
        yield _lines(console)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[detail]}", markup=False),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        yield _bar(bar)


def _bar(bar: Progress) -> Show:
    task = bar.add_task("queued", total=1.0, detail="")

    def show(event: Event) -> None:
        progress = event.progress
        bar.update(task, completed=progress.fraction, description=_phase(event), detail=_detail(progress))
        if event.message:
            bar.console.print(event.message)

    return show


def _lines(console: Console) -> Show:
    seen: set[str] = set()

    def show(event: Event) -> None:
        phase = _phase(event)
        if phase not in seen or event.message:
            seen.add(phase)
            message = event.message if event.message != phase else None
            words = [f"{event.progress.fraction:4.0%}", phase, _detail(event.progress), message]
            console.print("  ".join(word for word in words if word))

    return show


def _phase(event: Event) -> str:
    return event.state.value if event.state.final else event.progress.phase


def _detail(progress: JobProgress) -> str:
    """E.g. ``step 12/30  loss 0.417  fooled 85%``, as far as known."""
    parts = []
    if progress.step is not None:
        parts.append(f"step {progress.step}/{progress.steps}" if progress.steps else f"step {progress.step}")
    if progress.loss is not None:
        parts.append(f"loss {progress.loss:.3g}")
    if progress.fooled is not None:
        parts.append(f"fooled {progress.fooled:.0%}")
    return "  ".join(parts)
