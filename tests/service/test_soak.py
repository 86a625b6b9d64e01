"""Long use of the service: jobs of all kinds, good and bad uploads, downloads, deletions; nothing grows.

TROMPE_SOAK_MINUTES (120) is the duration, TROMPE_SOAK_CSV the file of samples. ``--log-cli-level=INFO`` prints figures.
"""

import itertools
import logging
import os
import random
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.security.test_hostile_uploads import ARCHIVES, obj_files
from tests.served import wait_until
from tests.service.soak import LEAST_SAMPLES, Soaked, trend, trends, watching
from tests.small_models import large_png, zipped
from trompe_client import BadRequest, Client, JobCancelled
from trompe_client._job import JobHandle
from trompe_server.formats.gltf_write import write_glb
from trompe_shared.object3d import load_object
from trompe_shared.shipped import ShippedObject, shipped_objects

logger = logging.getLogger(__name__)

MINUTES = float(os.environ.get("TROMPE_SOAK_MINUTES", "120"))
PAUSE = 4.0
"""Seconds between two actions."""
GRID = {"grid": True, "azimuths": 3, "elevations": 2, "held_out": 4, "steps": 10}
POOL = {"pool": 12, "views_per_step": 6, "held_out": 4, "steps": 10}


def hostile_files() -> dict[str, bytes]:
    return {
        "bomb.zip": ARCHIVES["a zip bomb"][0](),
        "picture.zip": zipped(obj_files(t__png=large_png(20_000, 20_000))),
        "noise.glb": b"glTF" + random.Random(0).randbytes(100_000),
        "path.zip": ARCHIVES["a path out of the folder"][0](),
    }


class User:
    """A user of the service. ``counts`` counts actions, ``seen`` collects the attacked objects."""

    def __init__(self, client: Client, folder: Path) -> None:
        self._client, self._folder = client, folder
        self._objects = itertools.cycle(shipped_objects().values())
        self._seeds = itertools.count()
        self.counts: Counter[str] = Counter()
        self.seen: set[str] = set()
        self._hostile = itertools.cycle(sorted(self._saved(hostile_files())))

    def _saved(self, files: dict[str, bytes]) -> list[Path]:
        self._folder.mkdir(exist_ok=True)
        for name, data in files.items():
            (self._folder / name).write_bytes(data)
        return [self._folder / name for name in files]

    def actions(self) -> Iterator[Callable[[], None]]:
        return itertools.cycle(
            [
                lambda: self.attack("grid", GRID),
                self.upload_something_hostile,
                lambda: self.attack("pool", POOL),
                self.cancel_a_long_one,
                lambda: self.attack("tau", GRID | {"tau": 0.1}),
                self.attack_a_glb,
                lambda: self.attack("two backgrounds", POOL | {"background": ["white", "#335577"]}),
                self.delete_one,
            ]
        )

    def _next(self) -> ShippedObject:
        chosen = next(self._objects)
        self.seen.add(chosen.name)
        return chosen

    def _submit(self, source: str | Path, label: str, options: dict[str, Any]) -> JobHandle:
        return self._client.attack(source, label=label, classifier="tiny", seed=next(self._seeds), **options)

    def attack(self, kind: str, options: dict[str, Any]) -> None:
        """Attack the next shipped object and fetch everything."""
        chosen = self._next()
        self._fetch(self._submit(chosen.name, chosen.label, options).wait(600))
        self.counts[kind] += 1

    def attack_a_glb(self) -> None:
        chosen = self._next()
        (file,) = self._saved({f"{chosen.name}.glb": write_glb(load_object(chosen.read()))})
        self._fetch(self._submit(file, chosen.label, GRID).wait(600))
        self.counts["GLB"] += 1

    def _fetch(self, job: JobHandle) -> None:
        folder = self._folder / "fetched"
        assert any(file.name.endswith("-adversarial.zip") for file in job.download(folder))
        job.archive(folder / "all.zip")
        assert job.result().steps >= 1
        for path in ("/", "/jobs", f"/jobs/{job.id}", f"/jobs/{job.id}/preview.png", "/metrics", "/v1/objects"):
            httpx.get(self._client.server + path, headers={"Accept": "text/html"}).raise_for_status()
        shutil.rmtree(folder)

    def upload_something_hostile(self) -> None:
        with pytest.raises(BadRequest):
            self._client.upload_object(next(self._hostile))
        self.counts["refused"] += 1

    def cancel_a_long_one(self) -> None:
        chosen = self._next()
        job = self._submit(chosen.name, chosen.label, GRID | {"steps": 10_000})
        while not job.refresh().progress.step:
            assert not job.status.state.final
            time.sleep(0.2)
        job.cancel()
        with pytest.raises(JobCancelled):
            job.wait(60)
        self.counts["cancelled"] += 1

    def delete_one(self) -> None:
        self._submit("mug", "mug", GRID).wait(600).delete()
        self.counts["deleted"] += 1


@pytest.mark.slow
@pytest.mark.timeout(60 * MINUTES + 1800)
def test_in_hours_of_mixed_use_memory_handles_threads_and_disk_stay_flat(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "httpx")
    duration = 60 * MINUTES
    kept = max(20.0, min(300.0, duration / 12))
    file = Path(os.environ.get("TROMPE_SOAK_CSV", tmp_path / "soak.csv"))
    with Soaked(tmp_path, kept=kept) as service, Client(service.url) as client:
        user, before = User(client, tmp_path / "user"), service.processes()
        begun, warm = time.monotonic(), duration / 4
        with watching(service, file, every=min(30.0, duration / 180)) as rows:
            for action in user.actions():
                known = len(user.seen)
                action()
                time.sleep(PAUSE)
                passed = time.monotonic() - begun
                if len(user.seen) > known:
                    warm = max(warm, passed)
                if passed > duration:
                    break
        wait_until(lambda: not service.passing(), seconds=2 * kept + 60, story=lambda: "retention leaves files behind")
        assert list(client.jobs()) == []
        assert service.processes() == before, f"a process was started again\n{service.log.read_text()[-4000:]}"
    found = trends(rows, warm=warm)
    story = "\n".join([str(dict(user.counts)), *map(str, found)])
    logger.info("%.0f minutes\n%s", MINUTES, story)
    assert "Traceback" not in service.log.read_text()
    assert all(each.flat for each in found), story


TIMES = np.arange(0, 6000, 30.0)


def noise(scale: float) -> np.ndarray[Any, Any]:
    """Noise with an eighth of outliers."""
    random = np.random.default_rng(0)
    return scale * (random.uniform(-0.1, 0.1, len(TIMES)) + 3 * (random.uniform(size=len(TIMES)) < 0.125))


@pytest.mark.parametrize(
    ("name", "values", "flat"),
    [
        pytest.param("worker MiB", 600 + noise(100), True, id="memory that goes up and down"),
        pytest.param("worker MiB", 600 + noise(100) + TIMES / 60, False, id="memory that grows by a MiB a minute"),
        pytest.param("worker handles", 30 + noise(5), True, id="handles of what is open just now"),
        pytest.param("worker handles", 30 + noise(5) + TIMES // 600, False, id="a handle left behind in ten minutes"),
        pytest.param("lasting files", 900 - TIMES / 10, True, id="files that become fewer"),
    ],
)
def test_what_grows_is_told_from_what_varies(name: str, values: Any, flat: bool) -> None:
    assert trend(name, TIMES, values).flat is flat


def test_a_soak_that_is_too_short_is_not_believed() -> None:
    rows = [{"seconds": 30.0 * number, "API MiB": 100.0} for number in range(LEAST_SAMPLES)]
    assert [each.flat for each in trends(rows, warm=0)] == [True]
    with pytest.raises(AssertionError, match="too few"):
        trends(rows, warm=60)
