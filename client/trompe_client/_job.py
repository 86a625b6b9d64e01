"""A handle on one job: follow it, wait for it, fetch what it made."""

import os
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final, Self

from trompe_client import _core
from trompe_client._errors import ContractError, JobCancelled, JobFailed, ServerUnreachable, WaitTimeout
from trompe_shared.api import Event, Job, JobState, Result

if TYPE_CHECKING:
    from trompe_client._client import Client

__all__ = ["JobHandle"]

PATIENCE: Final = 60.0
"""How long a server may be gone (restarting) while a job is followed, seconds."""
SILENCE: Final = 30.0
"""How long an event stream may say nothing before it is opened anew, seconds."""
PAUSE: Final = 0.5
"""Time between two attempts, seconds."""


class JobHandle:
    """A job on a server. ``status`` is the job as last seen; ``refresh`` asks again."""

    def __init__(self, client: "Client", status: Job) -> None:
        self._client = client
        self.status = status

    def __repr__(self) -> str:
        return f"<JobHandle {self.id} {self.state.value}>"

    @property
    def id(self) -> str:
        """The job's id; ``client.job(id)`` gives the handle again."""
        return self.status.id

    @property
    def state(self) -> JobState:
        """The job's state as last seen."""
        return self.status.state

    def refresh(self) -> Job:
        """Ask the server for the job's status."""
        self.status = self._client.send(_core.job(self.id))
        return self.status

    def wait(self, timeout: float | None = None, *, progress: bool = False) -> Self:
        """Wait until the job is done and return this handle, so that ``job.wait().result()`` reads well.

        Args:
            timeout: seconds; None waits for ever.
            progress: show a progress bar on standard error.

        Raises ``JobFailed``, ``JobCancelled``, or ``WaitTimeout`` when the time is up (the job goes on); a job that
        ends as n.a. raises nothing. Raises ``ServerUnreachable`` when the server stays away for a minute.
        """
        if progress:
            from trompe_client._progress import progress_display  # rich is loaded only for those who look

            display: AbstractContextManager[Callable[[Event], None]] = progress_display()
        else:
            display = nullcontext(lambda _event: None)
        deadline = None if timeout is None else time.monotonic() + timeout
        with display as show, closing(self._follow(deadline)) as events:
            for event in events:
                show(event)
        while not self._refresh_patiently(deadline).state.final:
            time.sleep(PAUSE)
        self._raise_unless_done()
        return self

    def events(self) -> Iterator[Event]:
        """All events of the job from its first to its last, each as it happens; survives dropped connections."""
        return self._follow(None)

    def result(self) -> Result:
        """The figures of a finished job. Raises ``APIError`` when there are none (yet)."""
        return self._client.send(_core.result(self.id))

    def download(self, folder: str | Path) -> list[Path]:
        """Fetch all artifacts into ``folder``, which is made if need be; gives their paths.

        A file appears under its name when it is whole, and replaces one of that name.
        """
        return [self._fetch(name, Path(folder)) for name in self.refresh().artifacts]

    def cancel(self) -> Job:
        """Ask the server to stop the job; it does so at the end of the current chunk of work."""
        self.status = self._client.send(_core.cancel(self.id))
        return self.status

    def _fetch(self, name: str, folder: Path) -> Path:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ContractError(
                f"The server offers a file named {name!r}, which would lie outside {folder}; not fetched."
            )
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.part")
        partial.write_bytes(self._client.send(_core.artifact(self.id, name)))
        os.replace(partial, path)
        return path

    def _follow(self, deadline: float | None) -> Generator[Event, None, None]:
        """Events until the final one, over as many connections as it takes; each resumes after the last event seen."""
        last: int | None = None
        over = False
        while True:
            with suppress(ServerUnreachable), closing(self._stream(last, deadline)) as events:
                for event in events:
                    last = event.id
                    yield event
                    if event.state.final:
                        return
            if over:
                return
            over = self._refresh_patiently(deadline).state.final
            time.sleep(0 if over else PAUSE)

    def _stream(self, after: int | None, deadline: float | None) -> Generator[Event, None, None]:
        """Events of one connection."""
        silence = SILENCE if deadline is None else min(SILENCE, max(deadline - time.monotonic(), PAUSE))
        parser = _core.EventParser()
        with closing(self._client.stream(_core.events(self.id, after=after), timeout=silence)) as lines:
            for line in lines:
                self._check_time(deadline)
                event = parser.feed(line)
                if event is not None:
                    yield event

    def _refresh_patiently(self, deadline: float | None) -> Job:
        """``refresh``, for a server that may be just restarting."""
        give_up = time.monotonic() + PATIENCE
        while True:
            self._check_time(deadline)
            try:
                return self.refresh()
            except ServerUnreachable:
                if time.monotonic() > give_up:
                    raise
            time.sleep(PAUSE)

    def _check_time(self, deadline: float | None) -> None:
        if deadline is not None and time.monotonic() > deadline:
            raise WaitTimeout(f"Job {self.id} is still {self.state.value}; it goes on.", job=self.status)

    def _raise_unless_done(self) -> None:
        if self.state is JobState.failed:
            raise JobFailed(f"Job {self.id} failed: {self.status.error or 'no reason given'}", job=self.status)
        if self.state is JobState.cancelled:
            raise JobCancelled(f"Job {self.id} was cancelled.", job=self.status)
