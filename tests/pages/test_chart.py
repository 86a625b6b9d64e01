"""The chart of an experiment: what is compared are means over the same objects, never jobs on different ones."""

from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_server.pages.chart import Point, chart, means_of
from trompe_server.pages.experiment import differing_options, points_of


def point(object: str, configuration: str, seconds: float, drop: float) -> Point:
    return Point(f"{object}-{configuration}", object, configuration, seconds, drop)


def drawn(*points: Point) -> Any:
    return chart(points, measure="A_drop")


HARD_AND_EASY = [
    point("easy", "short", 10, 1.0),
    point("hard", "short", 12, 0.2),
    point("easy", "long", 100, 1.0),
    point("hard", "long", 120, 0.8),
]


def test_a_job_on_an_easy_object_does_not_beat_jobs_on_a_hard_one() -> None:
    made = drawn(*HARD_AND_EASY)
    assert made.best == ["short: A_drop 0.60 in 11 s", "long: A_drop 0.90 in 110 s"]
    assert [mean["title"] for mean in made.means] == made.best
    assert len(made.front.split()) == 2
    assert len(made.points) == 4


def test_means_are_over_the_objects_that_all_configurations_have() -> None:
    means, common = means_of([*HARD_AND_EASY, point("other", "short", 10, 0.0)])
    assert common == {"easy", "hard"}
    assert [(mean.configuration, mean.drop) for mean in means] == [("short", 0.6), ("long", 0.9)]


def test_a_configuration_that_has_just_begun_is_left_out() -> None:
    begun = point("easy", "begun", 10, 1.0)
    means, common = means_of([*HARD_AND_EASY, point("other", "short", 10, 0.0), point("other", "long", 10, 0.0), begun])
    assert common == {"easy", "hard", "other"}
    assert [mean.configuration for mean in means] == ["short", "long"]


def test_an_object_counts_once_however_many_seeds_it_has() -> None:
    means, _ = means_of([point("a", "c", 10, 1.0), point("a", "c", 30, 0.8), point("b", "c", 40, 0.1)])
    assert len(means) == 1
    assert (means[0].seconds, means[0].drop) == pytest.approx((30, 0.5))


def test_on_one_object_the_jobs_themselves_are_compared() -> None:
    made = drawn(point("mug", "short", 10, 0.5), point("mug", "long", 100, 0.9), point("mug", "worse", 120, 0.8))
    assert made.means == made.best == made.common == []
    assert len(made.front.split()) == 2


def test_there_is_no_line_where_no_object_has_all_configurations() -> None:
    made = drawn(point("easy", "short", 10, 1.0), point("hard", "long", 100, 0.2))
    assert (made.front, made.means, made.best, made.common) == ("", [], [], [])
    assert len(made.points) == 2


def test_a_configuration_is_what_differs_on_the_same_object_but_the_seed() -> None:
    def entry(object: str, label: str, seed: int, tau: float | None) -> Any:
        judged = SimpleNamespace(a_drop=0.5)
        asked = {"label": label, "epsilon": 0.1, "seed": seed, "tau": tau}
        return SimpleNamespace(id="1", object=object), asked, SimpleNamespace(held_out=judged, seconds={"attack": 9.0})

    entries = [entry("mug", "cup", 0, None), entry("mug", "cup", 1, 0.2), entry("pot", "pot", 0, 0.2)]
    found = points_of(entries, differing_options(entries))
    assert [one.configuration for one in found] == ["epsilon 0.1, tau –", *["epsilon 0.1, tau 0.2"] * 2]


@given(
    st.lists(
        st.tuples(st.sampled_from("abc"), st.sampled_from("xyz"), st.floats(0.1, 1e4), st.floats(-1, 1)),
        min_size=1,
        max_size=20,
    )
)
def test_whatever_the_jobs_everything_that_is_drawn_lies_within_the_chart(jobs: list[Any]) -> None:
    made = drawn(*(point(*job) for job in jobs))
    for one in [*made.points, *made.means]:
        assert 60 <= one["x"] <= 700
        assert 20 <= one["y"] <= 310
    assert set(made.best) <= {mean["title"] for mean in made.means}
