"""Comparison of configurations: means over the same objects, Pareto front, and the same front in pages and reports."""

from itertools import pairwise, product
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_experiments.pareto import configurations
from trompe_experiments.table import ResultRow
from trompe_server.pages.chart import chart
from trompe_server.pages.experiment import differing_options, points_of
from trompe_shared.comparison import Job, Mean, means_of, pareto_front


def job(object: str, configuration: str, cost: float, drop: float, seed: int = 0) -> Job[str]:
    return Job(object, configuration, seed, cost, drop)


def beats(one: Mean[str], other: Mean[str]) -> bool:
    no_worse = one.cost <= other.cost and one.drop >= other.drop
    return no_worse and (one.cost < other.cost or one.drop > other.drop)


MEANS = st.lists(st.builds(Mean, st.text(max_size=3), st.floats(0.1, 100), st.floats(-1, 1), st.just(0.0)), max_size=30)
HARD_AND_EASY = [
    job("easy", "short", 10, 1.0),
    job("hard", "short", 12, 0.2),
    job("easy", "long", 100, 1.0),
    job("hard", "long", 120, 0.8),
]


@given(MEANS)
def test_nothing_beats_a_point_of_the_front_and_something_beats_or_equals_every_other(means: list[Mean[str]]) -> None:
    front = pareto_front(means)
    for each in means:
        if each in front:
            assert not any(beats(other, each) for other in means)
        else:
            assert any(beats(other, each) or (other.cost, other.drop) == (each.cost, each.drop) for other in front)


@given(MEANS)
def test_along_the_front_more_cost_gives_more(means: list[Mean[str]]) -> None:
    for cheap, dear in pairwise(pareto_front(means)):
        assert cheap.cost < dear.cost
        assert cheap.drop < dear.drop


@given(MEANS, st.randoms(use_true_random=False))
def test_the_front_does_not_depend_on_the_order(means: list[Mean[str]], random: Any) -> None:
    shuffled = random.sample(means, len(means))
    values = [[(each.cost, each.drop) for each in pareto_front(order)] for order in (means, shuffled)]
    assert values[0] == values[1]


def test_the_deviation_is_over_seeds_with_all_objects() -> None:
    jobs = [job("easy", "a", 1, 0.9), job("hard", "a", 1, 0.1), job("easy", "a", 1, 0.7, seed=1)]
    assert means_of(jobs)[0][0].spread == 0
    (mean,), _ = means_of([*jobs, job("hard", "a", 1, 0.1, seed=1)])
    assert mean.spread == pytest.approx(0.1 / 2**0.5)


def test_means_are_over_the_objects_that_all_configurations_have() -> None:
    means, common = means_of([*HARD_AND_EASY, job("other", "short", 10, 0.0)])
    assert common == {"easy", "hard"}
    assert [(mean.configuration, mean.drop) for mean in means] == [("short", 0.6), ("long", 0.9)]


def test_a_configuration_that_has_just_begun_is_left_out() -> None:
    others = [job("other", "short", 10, 0.0), job("other", "long", 10, 0.0)]
    means, common = means_of([*HARD_AND_EASY, *others, job("easy", "begun", 10, 1.0)])
    assert common == {"easy", "hard", "other"}
    assert [mean.configuration for mean in means] == ["short", "long"]


def test_an_object_counts_once_however_many_seeds_it_has() -> None:
    means, _ = means_of([job("a", "c", 10, 1.0), job("a", "c", 30, 0.8, seed=1), job("b", "c", 40, 0.1)])
    assert len(means) == 1
    assert (means[0].cost, means[0].drop) == pytest.approx((30, 0.5))


def test_a_page_and_a_report_show_the_same_front_for_the_same_jobs() -> None:
    """Objects of different difficulty with different numbers of seeds, and a reused calibration."""
    entries: list[Any] = []
    rows = []
    for (steps, seconds, drops), (object, seeds) in product(
        [(10, 20.0, (0.9, 0.1)), (30, 40.0, (0.9, 0.3)), (90, 41.0, (1.0, 0.2))], [("easy", 3), ("hard", 1)]
    ):
        for seed in range(seeds):
            drop = drops[object == "hard"] - 0.01 * seed
            probes, calibrate = (100, 8.0) if steps == 10 else (0, 0.5)
            judged = SimpleNamespace(a_drop=drop, views=60)
            phases = {"attack": seconds - calibrate, "calibrate": calibrate}
            costs = {"seconds": phases, "probe_renders": probes, "image_size": (128, 128)}
            asked = {"epsilon": 0.05, "steps": steps, "seed": seed}
            result = SimpleNamespace(held_out=judged, target=judged, **costs)
            entries.append((SimpleNamespace(id="1", object=object), asked, result))
            found = {"held_out_a_drop": drop, "probe_renders": probes, "calibrate_s": calibrate, "seconds": seconds}
            place = {"experiment": "x", "key": "k", "configuration": f"steps {steps}", "state": "succeeded"}
            options = asked | {"object": object, "image_size": "128x128", "views": 60}
            rows.append(ResultRow.model_validate(place | options | found))
    report = [f"{mean.drop:.3f} in {mean.cost:.1f} s" for mean in pareto_front(configurations(rows))]
    page = chart(points_of(entries, differing_options(entries)))
    assert report == ["0.495 in 20.0 s", "0.595 in 47.5 s"]
    assert [words.partition("A_drop ")[2] for words in page.best] == ["0.49 in 20 s", "0.59 in 48 s"]
