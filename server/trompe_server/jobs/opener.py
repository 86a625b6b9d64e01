"""Puts together what a job needs to run in this process: its pipeline, its files, a way to the renderers."""

import importlib
from collections.abc import Sequence
from typing import Any

from trompe_server.artifacts import Folder, job_artifacts
from trompe_server.jobs.desk import Claim
from trompe_server.jobs.renderers import Address, RendererFleet, Renderers, wait_for_renderer
from trompe_server.jobs.runner import OpenedJob
from trompe_server.library import Library
from trompe_server.meter import Meter, MeteredPipeline, MeteredTarget
from trompe_server.settings import Settings
from trompe_server.target.protocol import TargetRenderer

__all__ = ["JobOpener", "load"]


class JobOpener:
    """Opens jobs whose files are in ``files`` and whose target is at ``renderers``. ``meter`` counts what they do."""

    def __init__(self, settings: Settings, files: Folder, renderers: Renderers) -> None:
        self._settings, self._files, self._renderers = settings, files, renderers
        self._library = Library(files.within("library"), cache=settings.data / "cache")
        self.meter = Meter()

    def open(self, claim: Claim) -> OpenedJob:
        """The job of ``claim``. Raises ``TrompeError`` for what the user can mend."""
        wait_for_renderer(self._renderers, seconds=self._settings.renderer_patience)
        target = MeteredTarget(RendererFleet(self._renderers, _target), self.meter)
        try:
            pipeline = load(self._settings.pipeline)(
                claim.job.spec,
                library=self._library,
                artifacts=job_artifacts(self._files, claim.job.id, attempt=claim.attempt),
                target=target,
                device=self._settings.device,
                meter=self.meter,
            )
        except BaseException:
            target.close()
            raise
        return OpenedJob(MeteredPipeline(pipeline, self.meter), target.close)

    def tidy(self, claim: Claim, kept: list[str]) -> None:
        """Remove what an ended job needs no more, such as its checkpoints: most of what it takes on the disk."""
        job_artifacts(self._files, claim.job.id).keep(kept)


def load(path: str) -> Any:
    """What ``module:name`` names. Imported late: it brings torch."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def _target(addresses: Sequence[Address]) -> TargetRenderer:
    from trompe_server.target import RendererPool, SailenvTarget

    return SailenvTarget(*addresses[0]) if len(addresses) == 1 else RendererPool(addresses)
