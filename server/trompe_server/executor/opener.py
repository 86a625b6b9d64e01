"""Opens a job in this process: its phases, its files and its connection to the renderers."""

import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from typing import Any, Final, TypeVar

from trompe_server.job.protocol import PhasedJob
from trompe_server.library import Library
from trompe_server.queue.claims import Claim
from trompe_server.renderers.choice import JOB_ENGINES, JobEngines, listed, named
from trompe_server.renderers.discovery import DiscoveredRenderers, RendererAddresses, engines_at
from trompe_server.renderers.protocol import TargetRenderer
from trompe_server.settings import Settings
from trompe_server.storage.folders import Folder, JobArtifacts, job_artifacts
from trompe_shared.api import JobSpec, JudgementSpec
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, RendererLostError

ENGINES: Final = "engines.json"
"""File with the engines of a job's renderers: later attempts use the same ones."""

JUDGEMENTS: Final = "trompe_server.service.judgement_job:JudgementJob"
"""Opens a judgement."""

T = TypeVar("T")


class JobOpener:
    """Opens jobs with their files in ``files`` and their targets at ``renderers``."""

    def __init__(self, settings: Settings, files: Folder, renderers: RendererAddresses) -> None:
        self._settings, self._files, self._renderers = settings, files, renderers
        self._library = Library(files.within("library"), cache=settings.data / "cache", networks=settings.networks)

    @contextmanager
    def open(self, claim: Claim) -> Iterator[PhasedJob]:
        """The job of ``claim``, opened for the block. Raises ``TrompeError`` for errors the user can fix."""
        artifacts = job_artifacts(self._files, claim.job.id, attempt=claim.attempt)
        if isinstance(claim.job.spec, JudgementSpec):
            yield self._judgement(claim.job.spec, artifacts)
            return
        engines = self._engines(claim.job.spec, artifacts)
        attacked = len(engines.attacked)
        with ExitStack() as opened:
            targets = [
                opened.enter_context(closing(DiscoveredRenderers(self._renderers, engine))) for engine in engines.all
            ]
            yield load(self._settings.pipeline)(
                claim.job.spec,
                library=self._library,
                artifacts=artifacts,
                target=targets[0],
                more_targets=targets[1:attacked],
                judge_targets=targets[attacked:],
                device=self._settings.device,
            )

    def _judgement(self, spec: JudgementSpec, artifacts: JobArtifacts) -> PhasedJob:
        there = self._patiently(self._there)
        job: PhasedJob = load(JUDGEMENTS)(
            spec,
            artifacts=artifacts,
            library=self._library,
            renderer=there[0].named(there),
            opened=self._opened,
            device=self._settings.device,
        )
        return job

    @contextmanager
    def _opened(self, name: str) -> Iterator[TargetRenderer]:
        """The renderers with the engine ``name`` for the block. Raises ``RendererError``."""
        engine = self._patiently(lambda *, late: named(name, "renderers", self._there(late=late)))
        with closing(DiscoveredRenderers(self._renderers, engine)) as target:
            yield target

    def _engines(self, spec: JobSpec, artifacts: JobArtifacts) -> JobEngines:
        """The engines of the job's renderers, recorded at its first opening, once they answer."""
        known = JOB_ENGINES.validate_json(artifacts.read(ENGINES)) if artifacts.exists(ENGINES) else None
        engines = self._patiently(partial(self._engines_now, spec, known))
        if known is None:
            artifacts.write(ENGINES, JOB_ENGINES.dump_json(engines))
        return engines

    def _patiently(self, look: Callable[..., T]) -> T:
        """What ``look`` finds, repeated while it raises ``RendererError``, at last with ``late``."""
        deadline = time.monotonic() + self._settings.renderer_patience
        while True:
            late = time.monotonic() > deadline
            try:
                return look(late=late)
            except RendererError:
                if late:
                    raise
            time.sleep(0.3)

    def _there(self, *, late: bool) -> list[EngineInfo]:
        """The engines that answer now. The first renderer is the default: unless ``late``, wait for it."""
        found = engines_at(self._renderers.addresses())
        there = list(dict.fromkeys(engine for engine in found.values() if engine))
        if not there:
            where = ", ".join(f"{host}:{port}" for host, port in (*self._renderers.listed, *self._renderers.dns))
            raise RendererError(
                f"No renderer answers at {where}. Start one with: trompe render --host HOST --port PORT; "
                "`trompe doctor` tells whether this machine can render."
            )
        if next(iter(found.values())) is None and not late:
            raise RendererError("The first renderer does not answer yet.")
        return there

    def _engines_now(self, spec: JobSpec, known: JobEngines | None, *, late: bool) -> JobEngines:
        """The engines of a job by those that answer now. Those of its first opening may not be the first ones."""
        there = self._there(late=late or known is not None)
        if known is None:
            return JobEngines.of(spec, there)
        if missing := set(known.all) - set(there):
            raise RendererLostError(
                f"The job began with {listed(missing)}, and no renderer with it answers. There are: {listed(there)}."
            )
        return known

    def tidy(self, claim: Claim, kept: list[str]) -> None:
        """Delete all files of an ended job except ``kept``; its checkpoints take most of its space."""
        job_artifacts(self._files, claim.job.id).keep(kept)


def load(path: str) -> Any:
    """Import ``module:name``. Late, because it imports torch."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
