"""Renderers that no affine model fits: a job stays within tolerance, or warns that its surrogate is not reliable."""

from pathlib import Path

import pytest

from trompe_experiments.in_process import run_job
from trompe_experiments.stability.disturbed_engine import disturbed_renderer
from trompe_server.surrogate.fidelity import MAX_ERROR, MIN_EXPLAINED
from trompe_shared.api import JobSpec

SPEC = JobSpec.of("mug", label="mug", steps=1, grid=True, azimuths=4, elevations=2, held_out=2)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("disturbance", "reliable"),
    [
        pytest.param({}, True, id="none"),
        pytest.param({"grain": 0.7}, True, id="faint grain"),
        pytest.param({"bounce": 0.02}, True, id="faint interreflection"),
        pytest.param({"grain": 4}, False, id="grain"),
        pytest.param({"exposure": 0.3}, True, id="exposure by the whole picture"),
        pytest.param({"bounce": 0.3}, True, id="interreflection"),
        pytest.param({"flicker": 0.2}, False, id="flickering light"),
        pytest.param({"filmic": True}, True, id="tone curve"),
    ],
)
def test_a_job_warns_of_a_renderer_that_its_model_does_not_fit_and_of_no_other(
    disturbance: dict[str, float], reliable: bool, tmp_path: Path
) -> None:
    with disturbed_renderer(**disturbance) as target:
        result = run_job(SPEC, target, tmp_path).result
    assert any("surrogate is o" in warning for warning in result.warnings) != reliable
    assert (result.fidelity["error"] <= MAX_ERROR and result.fidelity["explained"] >= MIN_EXPLAINED) == reliable
