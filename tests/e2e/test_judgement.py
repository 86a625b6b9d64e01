"""Judgements by a real service: a worker that is killed in the middle, and the figures of the job that painted."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.served import Served, wait_until
from trompe_client import Client
from trompe_server.judgement.verify import verify
from trompe_shared.api import MANIFEST, Manifest

ATTACK: dict[str, Any] = {
    "epsilon": 0.15,
    "alpha": 0.04,
    "steps": 5,
    "pool": 12,
    "held_out": 60,
    "image_pipeline": "none",
}


def served(tmp_path: Path, *, patience: int) -> Served:
    """A service whose jobs wait so many seconds for a renderer."""
    environment = {"OMP_NUM_THREADS": "1", "TROMPE_RENDERER_PATIENCE": str(patience)}
    return Served(tmp_path / "data", environment=environment)


def agree(one: Any, other: Any) -> bool:
    """Whether the drop of each ``Accuracy`` is within the interval of the other."""
    lows, highs = zip(one.a_drop_interval, other.a_drop_interval, strict=True)
    drops = one.a_drop, other.a_drop
    return bool(max(lows) <= min(drops) <= max(drops) <= min(highs))


@pytest.mark.thorough
def test_a_job_is_judged_through_the_service_over_a_killed_worker(tmp_path: Path) -> None:
    with served(tmp_path, patience=120) as serve, Client(serve.url) as client:
        job = client.attack("mug", label="mug", **ATTACK).wait(timeout=240)
        painted = job.result().held_out
        job.download(tmp_path / "painted")

        by_job = client.judge("mug", f"job:{job.id}", label="mug", epsilon=0.15, views=60)
        same = by_job.wait(timeout=240).manifest()
        assert same.cell("pyrender", "tiny") == painted
        assert same.findings == []

        file = tmp_path / "painted" / "mug-adversarial.glb"
        cut = client.judge("mug", file, label="mug", epsilon=0.15, views=60, seed=7)
        wait_until(lambda: serve.state(cut.id).progress.fraction > 0.1)
        os.kill(serve.children()["worker"], signal.SIGKILL)
        cut.wait(timeout=240)
        assert cut.status.attempts == 2
        assert agree(cut.manifest().cell("pyrender", "tiny"), painted)
        cut.download(tmp_path / "judged")
    manifest = Manifest.model_validate_json((tmp_path / "judged" / MANIFEST).read_bytes())
    assert manifest.after.source == "after.glb"
    assert list(verify(manifest, tmp_path / "judged", generator=np.random.default_rng(0))) == []


@pytest.mark.thorough
def test_what_cannot_be_judged_is_said_and_a_running_judgement_is_cancelled(tmp_path: Path) -> None:
    with served(tmp_path, patience=5) as serve, Client(serve.url) as client:
        nothing = client.judge("mug", "ball", label="coffee cup", renderers=["none-such"], views=3)
        nothing.wait(timeout=120)
        assert nothing.state == "n.a."
        assert [found.kind for found in nothing.manifest().findings] == ["object", "network", "renderer"]
        long = client.judge("mug", "mug", label="mug", views=1000)
        wait_until(lambda: serve.state(long.id).progress.fraction > 0)
        long.cancel()
        wait_until(lambda: serve.state(long.id).state == "cancelled")
