"""Renderers that no affine model fits: a job either copes within tolerance, or says that its surrogate is not to be
trusted. Never silently wrong."""

from pathlib import Path

import pytest

from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.experiments.disturbed import (
    DisturbedTarget,
    See,
    bounce,
    brighter_when_dark,
    filmic,
    flicker,
    grain,
)
from trompe_server.library import Library
from trompe_server.surrogate.fidelity import MAX_ERROR, MIN_EXPLAINED
from trompe_server.target import SailenvTarget
from trompe_shared.api import JobSpec, Result

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


def attacked(see: See, target: SailenvTarget, folder: Path) -> Result:
    artifacts = LocalArtifacts(folder / "job")
    job = open_pipeline(
        SPEC, library=Library(folder / "library"), artifacts=artifacts, target=DisturbedTarget(target, see=see)
    )
    for phase in job.phases():
        job.run(phase, lambda _: None)
    return Result.model_validate_json(artifacts.read("result.json"))


def warned(result: Result) -> bool:
    return any("surrogate is o" in warning for warning in result.warnings)


@pytest.mark.parametrize(
    "see",
    [
        pytest.param(grain(4), id="grain"),
        pytest.param(brighter_when_dark(0.3), id="exposure by the whole picture"),
        pytest.param(bounce(0.3), id="interreflection"),
        pytest.param(flicker(0.2), id="flickering light"),
        pytest.param(filmic, id="tone curve"),
    ],
)
def test_a_renderer_beyond_the_model_is_told(see: See, target: SailenvTarget, tmp_path: Path) -> None:
    result = attacked(see, target, tmp_path)
    assert warned(result)
    assert result.fidelity["error"] > MAX_ERROR or result.fidelity["explained"] < MIN_EXPLAINED


@pytest.mark.parametrize("see", [grain(0.0), grain(0.7), bounce(0.02)], ids=["none", "faint grain", "faint bounce"])
def test_what_stays_within_tolerance_is_no_cause_for_alarm(see: See, target: SailenvTarget, tmp_path: Path) -> None:
    result = attacked(see, target, tmp_path)
    assert not warned(result)
    assert result.fidelity["error"] <= MAX_ERROR
    assert result.fidelity["explained"] >= MIN_EXPLAINED
