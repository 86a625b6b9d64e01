"""A judgement as a job: one phase, which goes on with the images and logits among its artifacts."""

import time
from collections.abc import Mapping
from typing import Any, Final

from trompe_server.job.protocol import Artifacts, OnProgress, PhaseReport
from trompe_server.judgement.judge_files import judge_files
from trompe_server.judgement.manifest import Judged, manifest_of
from trompe_server.judgement.pictures import judgement_pictures
from trompe_server.judgement.sources import StoredSources
from trompe_server.pages.judgement import judgement_page
from trompe_shared.api import MANIFEST, MANIFEST_PAGE, JobState, JudgementSpec, Manifest, Progress

PHASE: Final = "judge"
UNSEEN: Final = "Nothing could be judged. The findings on the page say why."


class JudgementJob:
    """A ``PhasedJob``; its manifest, its page and the judged files are public. Arguments as for ``StoredSources``."""

    def __init__(self, spec: JudgementSpec, *, artifacts: Artifacts, **sources: Any) -> None:
        self._spec, self._artifacts = spec, artifacts
        self._sources = StoredSources(artifacts=artifacts, **sources)

    def phases(self) -> list[str]:
        return [PHASE]

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        began = time.perf_counter()
        judged = judge_files(self._spec, self._sources, kept=self._artifacts, on_progress=on_progress)
        manifest, files = written(judged, seconds=time.perf_counter() - began)
        for name, data in files.items():
            self._artifacts.write(name, data)
        sources = [file.source for file in (judged.before.file, judged.after.file)]
        public = (*files, *(name for name in sources if self._artifacts.exists(name)))
        figures = any(cell.accuracy for cell in manifest.cells)
        state, note = (JobState.succeeded, None) if figures else (JobState.not_applicable, UNSEEN)
        return PhaseReport(Progress(phase=phase, fraction=1.0), state, note, public)


def written(judged: Judged, *, seconds: float) -> tuple[Manifest, Mapping[str, bytes]]:
    """The manifest, and the files of a judgement by name: manifest and page. seconds: wall time of the judgement."""
    manifest = manifest_of(judged, seconds=seconds)
    page = judgement_page(manifest, judgement_pictures(judged))
    return manifest, {MANIFEST: manifest.model_dump_json(indent=1).encode(), MANIFEST_PAGE: page.encode()}
