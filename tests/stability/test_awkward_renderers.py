"""Renderers that no affine model fits: a job either copes within tolerance, or says that its surrogate is not to be
trusted. Never silently wrong."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.library import Library
from trompe_server.surrogate.fidelity import MAX_ERROR, MIN_EXPLAINED
from trompe_server.target import SailenvTarget
from trompe_shared.api import JobSpec, Result
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

Image8 = NDArray[np.uint8]
Distort = Callable[[Image8, int], NDArray[np.float64]]

SPEC = JobSpec(
    object="mug",
    label="mug",
    classifier="tiny",
    steps=1,
    pool=0,
    azimuths=4,
    elevations=2,
    held_out=2,
    background="white",
)


class Distorted:
    """``inner`` seen through ``distort(image, frame)``; frames are counted over all requests."""

    def __init__(self, inner: SailenvTarget, distort: Distort) -> None:
        self.inner, self.distort, self.frames = inner, distort, 0

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> Image8:
        images = self.inner.render(obj, views, size=size, on_frame=on_frame)
        seen = np.stack([self.distort(image, self.frames + k) for k, image in enumerate(images)])
        self.frames += len(images)
        return np.clip(np.round(seen), 0, 255).astype(np.uint8)

    def close(self) -> None:
        pass


def noise(sigma: float) -> Distort:
    """Another grain in every frame."""
    return lambda image, frame: image + np.random.default_rng(frame).normal(0, sigma, image.shape)


def exposure(strength: float) -> Distort:
    """Tone mapping that depends on the whole picture: bright pictures are shown darker."""
    return lambda image, _: image * (1 - strength * (image.mean() / 255 - 0.5))


def bounce(strength: float) -> Distort:
    """Interreflection: every pixel of the object takes on some of the object's mean colour, squared."""

    def distort(image: Image8, _: int) -> NDArray[np.float64]:
        there = (image != 255).any(axis=2, keepdims=True)
        colour = (image * there).sum(axis=(0, 1)) / max(there.sum(), 1) / 255
        return image + there * strength * 255 * colour**2

    return distort


def pulse(strength: float) -> Distort:
    """A lamp that flickers."""
    return lambda image, frame: image * (1 - strength * (0.5 + 0.5 * np.sin(frame)))


def attacked(distort: Distort, target: SailenvTarget, folder: Path) -> Result:
    artifacts = LocalArtifacts(folder / "job")
    job = open_pipeline(
        SPEC, library=Library(folder / "library"), artifacts=artifacts, target=Distorted(target, distort)
    )
    for phase in job.phases():
        job.run(phase, lambda _: None)
    return Result.model_validate_json(artifacts.read("result.json"))


def warned(result: Result) -> bool:
    return any("surrogate is o" in warning for warning in result.warnings)


@pytest.mark.parametrize(
    "distort",
    [
        pytest.param(noise(4), id="grain"),
        pytest.param(exposure(0.3), id="exposure by the whole picture"),
        pytest.param(bounce(0.3), id="interreflection"),
        pytest.param(pulse(0.2), id="flickering light"),
    ],
)
def test_a_renderer_beyond_the_model_is_told(distort: Distort, target: SailenvTarget, tmp_path: Path) -> None:
    result = attacked(distort, target, tmp_path)
    assert warned(result)
    assert result.fidelity["error"] > MAX_ERROR or result.fidelity["explained"] < MIN_EXPLAINED


@pytest.mark.parametrize("distort", [noise(0.0), noise(0.7), bounce(0.02)], ids=["none", "faint grain", "faint bounce"])
def test_what_stays_within_tolerance_is_no_cause_for_alarm(
    distort: Distort, target: SailenvTarget, tmp_path: Path
) -> None:
    result = attacked(distort, target, tmp_path)
    assert not warned(result)
    assert result.fidelity["error"] <= MAX_ERROR
    assert result.fidelity["explained"] >= MIN_EXPLAINED
