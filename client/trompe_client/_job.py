"""Handles on one job: follow it, wait for it, show and download its results."""

from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from trompe_client import _core
from trompe_client._following import Followed, follow, wait
from trompe_client._operations import send
from trompe_client._port import blocking, finish, iterate
from trompe_client._progress import Progress, shown
from trompe_client._transfer import fetch, fetch_all
from trompe_shared.api import Event, Job, Manifest, Result

if TYPE_CHECKING:
    from trompe_client._client import AsyncClient, Client


HEIGHT: Final = 900
"""Pixels in a notebook."""


@dataclass(frozen=True)
class ResultPage:
    """One HTML page with everything inside. A notebook shows it; ``html`` is its text, to be written to a file."""

    html: str

    def _repr_html_(self) -> str:
        """The page in a frame that can reach neither the notebook nor a network."""
        style = f"width: 100%; height: {HEIGHT}px; border: 0"
        return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{escape(self.html)}"></iframe>'


class AsyncJobHandle(Followed):
    """``JobHandle`` for asyncio: the same methods to await; iterate ``events`` by ``async for``."""

    client: "AsyncClient"

    async def refresh(self) -> Job:
        """Update ``status`` from the server."""
        self.status = await send(self._port, _core.job(self.id))
        return self.status

    async def result(self) -> Result:
        """The result of an ended attack. Raises ``Conflict`` before that."""
        return await send(self._port, _core.result(self.id))

    async def manifest(self) -> Manifest:
        """The manifest of an ended judgement. Raises ``Conflict`` before that, ``NotFound`` for an attack."""
        return await send(self._port, _core.manifest(self.id))

    async def download(self, folder: str | Path) -> list[Path]:
        """Download all artifacts into ``folder``, created if missing. Returns their paths.

        A file appears under its name once it is complete and its checksum is right, and replaces an older one. Existing
        files are not downloaded again, and interrupted downloads continue.
        """
        self.status, paths = await fetch_all(self._port, self.id, Path(folder))
        return paths

    async def show(self) -> ResultPage:
        """The result as one page: a notebook shows it, and ``.html`` opens from a file without a network.

        Raises ``NotFound`` before there is a result.
        """
        return ResultPage(await send(self._port, _core.page(self.id)))

    async def archive(self, path: str | Path) -> Path:
        """Download all artifacts as one zip file."""
        return await fetch(self._port, _core.archive(self.id), Path(path))

    async def cancel(self) -> Job:
        """Cancel the job. A running one stops at the end of its current chunk of work."""
        self.status = await send(self._port, _core.cancel(self.id))
        return self.status

    async def delete(self) -> None:
        """Delete the job and its files. Raises ``Conflict`` for a job that has not ended."""
        await send(self._port, _core.delete(self.id))

    async def wait(self, timeout: float | None = None, *, progress: Progress = False) -> Self:
        """As ``JobHandle.wait``."""
        with shown(progress) as show:
            await wait(self._port, self, timeout=timeout, show=show)
        return self

    def events(self) -> AsyncIterator[Event]:
        """As ``JobHandle.events``."""
        return follow(self._port, self)

    async def retry(self) -> "AsyncJobHandle":
        """As ``JobHandle.retry``."""
        return AsyncJobHandle(self.client, await send(self._port, _core.retry(self.id, key=_core.new_key())))


class JobHandle(Followed):
    """A job on a server. ``status`` is the job as last seen; ``refresh`` updates it."""

    client: "Client"
    refresh = blocking(AsyncJobHandle.refresh)
    result = blocking(AsyncJobHandle.result)
    manifest = blocking(AsyncJobHandle.manifest)
    download = blocking(AsyncJobHandle.download)
    show = blocking(AsyncJobHandle.show)
    archive = blocking(AsyncJobHandle.archive)
    cancel = blocking(AsyncJobHandle.cancel)
    delete = blocking(AsyncJobHandle.delete)

    def wait(self, timeout: float | None = None, *, progress: Progress = False) -> Self:
        """Wait for the end of the job. Returns this handle: ``job.wait().result()``.

        Args:
            timeout: seconds; None waits for ever.
            progress: whether to show a bar on the terminal or in the notebook; or a function that gets each event.

        Raises ``JobFailed``, ``JobCancelled``, ``WaitTimeout`` (the job continues), or ``ServerUnreachable`` after a
        minute without the server. A job that ends as n.a. raises nothing.
        """
        with shown(progress) as show:
            finish(wait(self._port, self, timeout=timeout, show=show))
        return self

    def events(self) -> Iterator[Event]:
        """All events of the job, as they happen; survives dropped connections."""
        return iterate(follow(self._port, self))

    def retry(self) -> "JobHandle":
        """Submit the same job again. Returns the new one. Raises ``Conflict`` for a job that has not ended."""
        return JobHandle(self.client, finish(send(self._port, _core.retry(self.id, key=_core.new_key()))))
