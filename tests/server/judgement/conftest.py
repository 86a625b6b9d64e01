"""Judgements of the shipped mug over a fake renderer."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.job_runs import Recorder
from trompe_server.job.protocol import OnProgress
from trompe_server.judgement.judge_files import judge_files
from trompe_server.judgement.manifest import Judged
from trompe_server.judgement.sources import LocalSources
from trompe_server.renderers import TargetRenderer
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import JudgementSpec
from trompe_shared.errors import RendererError
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects


@pytest.fixture
def fake_renderer(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    """The renderer of the name ``fake``; there is no other."""
    target = Recorder()

    @contextmanager
    def running(_sources: LocalSources, name: str) -> Iterator[TargetRenderer]:
        if name != "fake":
            raise RendererError(f"The renderer worker did not start. There is no engine {name!r}.")
        yield target

    monkeypatch.setattr(LocalSources, "running", running)
    return target


@pytest.fixture
def dark(tmp_path: Path) -> Path:
    """The mug, painted all black but for its handle's side of the texture."""
    mug = load_object(shipped_objects()["mug"].read())
    painted = {name: np.where(np.arange(512)[:, None, None] < 400, 0, image) for name, image in mug.textures.items()}
    file = tmp_path / "dark.zip"
    file.write_bytes(mug.with_textures({name: image.astype(np.uint8) for name, image in painted.items()}).to_zip())
    return file


Judge = Callable[..., Judged]


@pytest.fixture
def judge(fake_renderer: Recorder, tmp_path: Path) -> Judge:
    """Judges the mug against another file."""
    assert fake_renderer.asked == []

    def run(after: Path, *, on_progress: OnProgress = lambda _: None, **options: Any) -> Judged:
        kept = LocalArtifacts(tmp_path / "kept")
        return judge_files(spec_of(after, **options), LocalSources(tmp_path), kept=kept, on_progress=on_progress)

    return run


def spec_of(after: Path, **options: Any) -> JudgementSpec:
    asked: dict[str, Any] = {"label": "mug", "renderers": ["fake"], "views": 6, **options}
    return JudgementSpec.of("mug", str(after), **asked)
