"""What ``trompe judge`` does on this machine, without a service."""

import shutil
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Final

from trompe_shared.api import JudgementSpec, Manifest, Progress

KEPT: Final = ".judging"
"""Folder with the finished work of a judgement that was stopped."""


def judge_here(spec: JudgementSpec, out: Path, on_progress: Callable[[Progress], None]) -> Manifest:
    """Judge files, and write manifest and page to ``out``. After an interruption the same call goes on."""
    from trompe_server.judgement.judge_files import judge_files
    from trompe_server.judgement.sources import LocalSources
    from trompe_server.service.judgement_job import written
    from trompe_server.storage.folders import LocalArtifacts

    began, kept = time.monotonic(), LocalArtifacts(out / KEPT)
    judged = judge_files(spec, LocalSources(out), kept=kept, on_progress=on_progress)
    manifest, files = written(judged, seconds=time.monotonic() - began)
    for name, data in files.items():
        (out / name).write_bytes(data)
    shutil.rmtree(out / KEPT, ignore_errors=True)
    return manifest


def verify_here(manifest: Manifest, folder: Path, trusted: Collection[str]) -> Iterator[str]:
    """The faults of a manifest that lies in ``folder``, each in a sentence; random views are rendered again.

    trusted: renderers ``module:Class`` or HOST:PORT that may be asked.
    """
    import numpy as np

    from trompe_server.judgement.verify import verify

    return verify(manifest, folder, trusted=trusted, generator=np.random.default_rng())
