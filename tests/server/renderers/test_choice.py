"""Which of the engines that answer draw a job."""

from typing import Any

import pytest

from trompe_server.renderers.choice import JOB_ENGINES, JobEngines
from trompe_shared.api import JobSpec
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, SpecError

OURS, SHARP = EngineInfo("pyrender", "0.1.45"), EngineInfo("pyrender", "0.1.45", "msaa 1")
THREE, MITSUBA = EngineInfo("three", "0.187"), EngineInfo("mitsuba", "3.9", "spp 64", deterministic=False)
THERE = [OURS, THREE, MITSUBA]


def spec(**options: Any) -> JobSpec:
    return JobSpec.of("mug", label="mug", **options)


@pytest.mark.parametrize(
    ("options", "attacked", "judging"),
    [
        pytest.param({}, (OURS,), (), id="the first one"),
        pytest.param({"renderers": "three"}, (THREE,), (), id="one by name"),
        pytest.param({"renderers": ["mitsuba", "pyrender"]}, (MITSUBA, OURS), (), id="several in their order"),
        pytest.param({"renderers": ["mitsuba 3.9 (spp 64)"] * 2}, (MITSUBA,), (), id="in full"),
        pytest.param({"judge_renderers": ["three", "mitsuba"]}, (OURS,), (THREE, MITSUBA), id="judges"),
    ],
)
def test_names_choose_among_those_that_answer(
    options: dict[str, Any], attacked: tuple[EngineInfo, ...], judging: tuple[EngineInfo, ...]
) -> None:
    found = JobEngines.of(spec(**options), THERE)
    assert (found.attacked, found.judging) == (attacked, judging)
    assert JOB_ENGINES.validate_json(JOB_ENGINES.dump_json(found)) == found


@pytest.mark.parametrize(
    ("options", "there", "words"),
    [
        pytest.param({"renderers": "cycles"}, THERE, "cycles.*mitsuba 3.9.*pyrender 0.1.45; three 0.187", id="unknown"),
        pytest.param({"judge_renderers": "x:Y"}, THERE, "judge_renderers: x:Y", id="never a class"),
        pytest.param({"renderers": "pyrender"}, [OURS, SHARP], r"in full: pyrender 0.1.45; .*\(msaa 1\)", id="two"),
        pytest.param({"renderers": "three", "judge_renderers": "three"}, THERE, "is attacked.*mitsuba", id="both"),
    ],
)
def test_other_names_are_refused_with_the_choices(options: dict[str, Any], there: list[EngineInfo], words: str) -> None:
    with pytest.raises((RendererError, SpecError), match=words):
        JobEngines.of(spec(**options), there)


def test_one_of_two_with_the_same_name_is_named_in_full() -> None:
    assert JobEngines.of(spec(renderers=str(SHARP)), [OURS, SHARP]).attacked == (SHARP,)
    assert JobEngines.of(spec(renderers=str(OURS)), [SHARP, OURS]).attacked == (OURS,)
