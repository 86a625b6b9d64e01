"""Whole jobs in memory, over a fake target and the shipped classifier."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tests.fakes import FakeTarget
from trompe_server.job.protocol import PhaseReport, number_after
from trompe_server.job.setup import JobSetup, open_setup
from trompe_server.job.texture_attack import TextureAttack, open_job
from trompe_server.library import Library
from trompe_server.renderers import TargetRenderer
from trompe_server.storage.arrays import unpack_arrays
from trompe_shared.api import JobSpec, Progress, Result
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

_LARGE: Final = load_object(shipped_objects()["chair"].read())
CHAIR: Final = _LARGE.with_textures({name: image[::4, ::4] for name, image in _LARGE.textures.items()})
"""The shipped chair with textures of 128 x 128 texels: on its own of 512 x 512, most of a small job is texel work."""

SMALL_JOB: Final[dict[str, Any]] = {
    "object": "chair",
    "label": "chair",
    "epsilon": 0.1,
    "alpha": 0.03,
    "surrogate": "diffuse",
    "steps": 2,
    "held_out": 3,
}
GRID: Final[dict[str, Any]] = {"grid": True, "azimuths": 2, "elevations": 2}


def spec_of(**options: Any) -> JobSpec:
    """A small job with ``options``, on a grid of four views unless ``pool`` is given."""
    views = {} if "pool" in options else GRID
    return JobSpec.of(**SMALL_JOB | views | options)


class MemoryArtifacts:
    """``Artifacts`` in a dictionary."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}

    def read(self, name: str) -> bytes:
        if name not in self.files:
            raise FileNotFoundError(name)
        return self.files[name]

    def write(self, name: str, data: bytes) -> None:
        self.files[name] = data

    def exists(self, name: str) -> bool:
        return name in self.files

    def result(self) -> Result:
        return Result.model_validate_json(self.files["result.json"])

    def arrays(self, name: str) -> dict[str, NDArray[Any]]:
        return unpack_arrays(self.read(f"{name}.npz"))

    def painted(self) -> Object3D:
        return load_object(self.read(f"{self.result().object}-adversarial.zip"))

    def lasting(self) -> dict[str, bytes]:
        """All files but those that depend on the time: durations, and the preview, taken when it is time."""
        timed = ("seconds-", "preview.png")
        untimed = {name: data for name, data in self.files.items() if not name.startswith(timed)}
        result = json.loads(untimed.pop("result.json", b"{}"))
        result.pop("seconds", None)
        return untimed | {"result.json": json.dumps(result).encode()}


@dataclass
class Run:
    """A finished job: its files, the report of each phase, and the progress."""

    artifacts: MemoryArtifacts = field(default_factory=MemoryArtifacts)
    reports: dict[str, PhaseReport] = field(default_factory=dict)
    progress: list[Progress] = field(default_factory=list)

    @property
    def result(self) -> Result:
        return self.artifacts.result()

    def counts(self, kind: str = "") -> Counter[str]:
        """Work of all phases of a kind."""
        counts: Counter[str] = Counter()
        for phase, report in self.reports.items():
            counts.update(report.counts if phase.startswith(kind) else {})
        return counts


class SmallLibrary(Library):
    """A library with ``CHAIR`` in place of the shipped chair."""

    def object_bytes(self, reference: str) -> bytes:
        return CHAIR.to_zip() if reference == "chair" else super().object_bytes(reference)


class DarkTarget(FakeTarget):
    """A target with images half as bright on their left."""

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: tuple[int, int], **options: Any
    ) -> NDArray[np.uint8]:
        images = super().render(obj, views, size=size, **options)
        images[:, :, : size[1] // 2] //= 2
        return images


Asked = tuple[Object3D, tuple[View, ...]]


class Recorder(FakeTarget):
    """Records the views of each request, and shows noise on some views."""

    def __init__(self, noisy: Sequence[View] = ()) -> None:
        super().__init__()
        self.asked, self.noisy = list[Asked](), set(noisy)

    @property
    def images(self) -> int:
        return sum(len(views) for _, views in self.asked)

    def render(self, obj: Object3D, views: Sequence[View], **options: Any) -> NDArray[np.uint8]:
        self.asked.append((obj, tuple(views)))
        images = super().render(obj, views, **options)
        for image, view in zip(images, views, strict=True):
            if view in self.noisy:
                image[:] = np.random.default_rng(0).integers(0, 256, image.shape)
        return images


def setup_of(library: Library, **options: Any) -> JobSetup:
    return open_setup(spec_of(**options), library=library, target=FakeTarget())


def opened(
    spec: JobSpec, library: Library, artifacts: MemoryArtifacts, *, target: TargetRenderer | None = None, **options: Any
) -> TextureAttack:
    return open_job(spec, library=library, artifacts=artifacts, target=target or FakeTarget(), **options)


def run_job(
    spec: JobSpec,
    library: Library,
    *,
    new: bool = False,
    times: int = 1,
    known: bool = False,
    until: str = "judge",
    **options: Any,
) -> Run:
    """Run all phases, or those ``until`` one, or until the job ends.

    new: open the job anew for each phase. times: runs of each phase. known: keep the calibrations of earlier jobs.
    """
    if not known:
        library.calibrations.delete_all()
    run = Run()
    job = opened(spec, library, run.artifacts, **options)
    phases, number = job.phases(), 0
    while number < len(phases):
        phase = phases[number]
        for _ in range(times):
            job = opened(spec, library, run.artifacts, **options) if new else job
            run.reports[phase] = job.run(phase, run.progress.append)
        if run.reports[phase].state is not None or phase == until:
            break
        number = number_after(run.reports[phase], number, phases)
    return run
