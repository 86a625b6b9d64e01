"""A growing pool: which views an attack adds, and that it survives interruption."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.fakes import FakeTarget
from tests.job_runs import Asked, MemoryArtifacts, Recorder, Run, opened, run_job, setup_of, spec_of
from trompe_server.job.protocol import DamagedFileError
from trompe_server.judging.metrics import recognised
from trompe_server.library import Library

pytestmark = pytest.mark.usefixtures("few_first_views")

HARD: dict[str, Any] = {"pool": 16, "steps": 15, "epsilon": 0.1, "alpha": 0.02, "surrogate": "calibrated"}


Watched = tuple[Run, dict[str, list[Asked]]]
"""A finished job that adds views, and what each of its phases asked of the renderer."""


@pytest.fixture(scope="module")
def few_first_views() -> Iterator[None]:
    """Four first views, and four at each look, which is after every chunk of steps. Reports without pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trompe_server.job.setup.FEWEST", 4)
        patch.setattr("trompe_server.job.pool.LOOKS", (5, 10))
        patch.setattr("trompe_server.job.report.picture_files", lambda _: {})
        yield


@pytest.fixture(scope="module")
def hard(library: Library, few_first_views: None) -> Watched:
    library.calibrations.delete_all()
    target, run, asked = Recorder(), Run(), dict[str, list[Asked]]()
    job = opened(spec_of(**HARD), library, run.artifacts, target=target)
    for phase in job.phases():
        before = len(target.asked)
        run.reports[phase] = job.run(phase, run.progress.append)
        asked[phase] = target.asked[before:]
    return run, asked


def test_an_attack_that_loses_views_adds_those_it_has_not_safely_won(library: Library, hard: Watched) -> None:
    artifacts, setup = hard[0].artifacts, setup_of(library, **HARD)
    assert (len(setup.views), len(setup.further)) == (4, 12)
    clean = FakeTarget().render(setup.obj, setup.views, size=setup.size)
    known = recognised(setup.classifier.predict(clean), setup.labels)
    count = round(4 / max(float(known.mean()), 0.25))
    seen = 0
    for phase, asked in hard[1].items():
        if not artifacts.exists(f"look-{phase[-3:]}.npz"):
            continue
        found = artifacts.arrays(f"look-{phase[-3:]}")
        painted, looked = asked[0]
        assert looked == setup.further[seen : seen + count]
        seen = int(found["end"])
        logits = setup.classifier.predict(FakeTarget().render(painted, looked, size=setup.size))
        own = logits[:, list(setup.labels)].max(1)
        margin = np.delete(logits, list(setup.labels), axis=1).max(1) - own
        wanted = [view for view, by in zip(looked, margin, strict=True) if by < 1]
        added = [setup.further[k] for k in found["index"]]
        assert added == (wanted if (margin < 0).mean() > 0.02 * known.mean() else [])
        assert [views for _, views in asked[1 : 1 + 3 * bool(added)]] == [tuple(added)] * 3 * bool(added)
    result = artifacts.result()
    assert result.attacked_views > 4 == len(result.views) == result.target.views
    assert result.further_renders == seen + 3 * (result.attacked_views - 4)


@pytest.mark.parametrize(("nearly_all", "steps"), [(0.99, 5), (0.0, 0)], ids=["steps follow", "no step follows"])
def test_an_attack_that_loses_few_of_the_further_views_adds_none(
    library: Library, monkeypatch: pytest.MonkeyPatch, nearly_all: float, steps: int
) -> None:
    monkeypatch.setattr("trompe_server.attack.search.NEARLY_ALL", nearly_all)
    monkeypatch.setattr("trompe_server.job.pool.LOOKS", (10,))
    monkeypatch.setattr("trompe_server.job.pool.FEW_LOST", 1.0)
    run = run_job(spec_of(**HARD), library)
    assert run.result.attacked_views == 4
    assert run.result.further_renders == 4
    assert run.result.evaluations == run.counts("attack")["classifier_images"]
    *_, last, _ = run.reports
    assert run.reports[last].counts["attack_steps"] == steps


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"surrogate": "diffuse"}, marks=pytest.mark.thorough),
        pytest.param({"surrogate": "curve", "background": ["white", "black", "#808080"]}, marks=pytest.mark.thorough),
    ],
    ids=str,
)
def test_a_pool_grows_alike_after_interruption(library: Library, hard: Watched, options: dict[str, Any]) -> None:
    spec = spec_of(**HARD | options)
    once = run_job(spec, library) if options else hard[0]
    anew = run_job(spec, library, new=True, times=2)
    assert once.result.attacked_views > 4
    assert anew.artifacts.lasting() == once.artifacts.lasting()


@pytest.mark.thorough
def test_held_out_views_cannot_influence_the_texture(library: Library) -> None:
    setup = setup_of(library, **HARD)
    honest, target = run_job(spec_of(**HARD), library), Recorder(setup.held_out)
    lied = run_job(spec_of(**HARD), library, target=target)
    assert lied.result.held_out != honest.result.held_out
    assert lied.artifacts.files["chair-adversarial.zip"] == honest.artifacts.files["chair-adversarial.zip"]
    judged = [views for _, views in target.asked if set(views) & set(setup.held_out)]
    assert judged == [setup.held_out] * 2


def test_images_of_looks_are_counted(hard: Watched) -> None:
    run, asked = hard
    assert run.counts()["target_renders"] == sum(len(views) for phase in asked.values() for _, views in phase)
    assert run.result.evaluations == run.counts("attack")["classifier_images"]


def test_a_damaged_look_is_taken_anew(library: Library, hard: Watched) -> None:
    spec, artifacts = spec_of(**HARD), MemoryArtifacts()
    whole = hard[0].artifacts.files["look-001.npz"]
    artifacts.files = hard[0].artifacts.files | {"look-001.npz": whole[:-40]}
    with pytest.raises(DamagedFileError, match="look-001"):
        opened(spec, library, artifacts).run("attack-002", lambda _: None)
    opened(spec, library, artifacts).run("attack-001", lambda _: None)
    assert artifacts.files["look-001.npz"] == whole


@pytest.mark.parametrize("options", [{"tau": 0.05}, {"keep": 0.1}, {"pool": 4}], ids=["tau", "keep", "few views"])
def test_attacks_whose_choice_rests_on_all_views_start_with_all(library: Library, options: dict[str, Any]) -> None:
    setup = setup_of(library, **HARD | options)
    assert (len(setup.views), setup.further) == (options.get("pool", 16), ())
