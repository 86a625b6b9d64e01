"""Handles on one job: follow it, wait for it, fetch what it made."""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Self

from trompe_client import _core
from trompe_client._following import Followed, follow, wait
from trompe_client._operations import send
from trompe_client._port import finish, iterate
from trompe_client._progress import Progress, shown
from trompe_client._transfer import fetch, fetch_all
from trompe_shared.api import Event, Job, Result

if TYPE_CHECKING:
    from trompe_client._async_client import AsyncClient
    from trompe_client._client import Client

__all__ = ["AsyncJobHandle", "JobHandle"]


class JobHandle(Followed):
    """A job on a server. ``status`` is the job as last seen; ``refresh`` asks again."""

    def __init__(self, client: "Client", status: Job) -> None:
        super().__init__(status)
        self._client = client
        self._port = client.port

    @property
    def server(self) -> str:
        """The server's address."""
        return self._client.server

    def refresh(self) -> Job:
        """Ask the server for the job's status."""
        self.status = finish(send(self._port, _core.job(self.id)))
        return self.status

    def wait(self, timeout: float | None = None, *, progress: Progress = False) -> Self:
        """Wait until the job is done and return this handle, so that ``job.wait().result()`` reads well.

        Args:
            timeout: seconds; None waits for ever.
            progress: show a bar, on the terminal or in the notebook; or a function of yours, to hand each event to.

        Raises ``JobFailed``, ``JobCancelled``, or ``WaitTimeout`` when the time is up (the job goes on); a job that
        ends as n.a. raises nothing. Raises ``ServerUnreachable`` when the server stays away for a minute.
        """
        with shown(progress) as show:
            finish(wait(self._port, self, timeout=timeout, show=show))
        return self

    def events(self) -> Iterator[Event]:
        """All events of the job from its first to its last, each as it happens; survives dropped connections."""
        return iterate(follow(self._port, self))

    def result(self) -> Result:
        """The figures of a finished job. Raises ``APIError`` when there are none (yet)."""
        return finish(send(self._port, _core.result(self.id)))

    def download(self, folder: str | Path) -> list[Path]:
        """Fetch all artifacts into ``folder``, which is made if need be; gives their paths.

        A file appears under its name when it is whole and its checksum is right, and replaces one of that name. What an
        earlier download brought is not fetched again, and one that was cut off goes on where it was.
        """
        self.status, paths = finish(fetch_all(self._port, self.id, Path(folder)))
        return paths

    def archive(self, path: str | Path) -> Path:
        """Fetch all artifacts as one zip file."""
        return finish(fetch(self._port, _core.archive(self.id), Path(path)))

    def cancel(self) -> Job:
        """Ask the server to stop the job; it does so at the end of the current chunk of work."""
        self.status = finish(send(self._port, _core.cancel(self.id)))
        return self.status

    def retry(self) -> "JobHandle":
        """Submit the same job anew; gives the new one. Raises ``Conflict`` for a job that has not ended."""
        return JobHandle(self._client, finish(send(self._port, _core.retry(self.id, key=_core.new_key()))))

    def delete(self) -> None:
        """Delete the job and its files. Raises ``Conflict`` for a job that has not ended."""
        finish(send(self._port, _core.delete(self.id)))


class AsyncJobHandle(Followed):
    """``JobHandle`` for asyncio: the same methods, to be awaited; ``events`` is iterated by ``async for``."""

    def __init__(self, client: "AsyncClient", status: Job) -> None:
        super().__init__(status)
        self._client = client
        self._port = client.port

    @property
    def server(self) -> str:
        """As ``JobHandle.server``."""
        return self._client.server

    async def refresh(self) -> Job:
        """As ``JobHandle.refresh``."""
        self.status = await send(self._port, _core.job(self.id))
        return self.status

    async def wait(self, timeout: float | None = None, *, progress: Progress = False) -> Self:
        """As ``JobHandle.wait``."""
        with shown(progress) as show:
            await wait(self._port, self, timeout=timeout, show=show)
        return self

    def events(self) -> AsyncIterator[Event]:
        """As ``JobHandle.events``."""
        return follow(self._port, self)

    async def result(self) -> Result:
        """As ``JobHandle.result``."""
        return await send(self._port, _core.result(self.id))

    async def download(self, folder: str | Path) -> list[Path]:
        """As ``JobHandle.download``."""
        self.status, paths = await fetch_all(self._port, self.id, Path(folder))
        return paths

    async def archive(self, path: str | Path) -> Path:
        """As ``JobHandle.archive``."""
        return await fetch(self._port, _core.archive(self.id), Path(path))

    async def cancel(self) -> Job:
        """As ``JobHandle.cancel``."""
        self.status = await send(self._port, _core.cancel(self.id))
        return self.status

    async def retry(self) -> "AsyncJobHandle":
        """As ``JobHandle.retry``."""
        return AsyncJobHandle(self._client, await send(self._port, _core.retry(self.id, key=_core.new_key())))

    async def delete(self) -> None:
        """As ``JobHandle.delete``."""
        await send(self._port, _core.delete(self.id))
