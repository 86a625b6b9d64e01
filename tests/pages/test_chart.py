"""Chart of an experiment."""

from types import SimpleNamespace
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from tests.shared.test_comparison import HARD_AND_EASY
from trompe_server.pages.chart import Point, chart
from trompe_server.pages.experiment import differing_options, points_of
from trompe_shared.comparison import Job, charged


def point(object: str, configuration: str, seconds: float, drop: float) -> Point:
    return Point(f"{object}-{configuration}", Job(object, configuration, 0, seconds, drop))


def drawn(*points: Point) -> Any:
    return chart(points)


def test_a_job_on_an_easy_object_does_not_beat_jobs_on_a_hard_one() -> None:
    made = drawn(*(Point(f"{job.object}-{job.configuration}", job) for job in HARD_AND_EASY))
    assert made.best == ["short: A_drop 0.60 in 11 s", "long: A_drop 0.90 in 110 s"]
    assert [mean["title"] for mean in made.means] == made.best
    assert len(made.front.split()) == 2
    assert len(made.points) == 4


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
        judged = SimpleNamespace(a_drop=0.5, views=60)
        costs = {"seconds": {"attack": 9.0}, "probe_renders": 9, "image_size": (128, 128)}
        result = SimpleNamespace(held_out=judged, target=judged, **costs)
        asked = {"label": label, "epsilon": 0.1, "seed": seed, "tau": tau}
        return SimpleNamespace(id="1", object=object), asked, result

    entries = [entry("mug", "cup", 0, None), entry("mug", "cup", 1, 0.2), entry("pot", "pot", 0, 0.2)]
    found = points_of(entries, differing_options(entries))
    assert [one.job.configuration for one in found] == ["epsilon 0.1, tau –", *["epsilon 0.1, tau 0.2"] * 2]


def test_a_job_pays_for_the_calibration_of_a_job_with_the_same_probes_alone() -> None:
    def entry(renders: int, *, size: int = 128, **options: Any) -> Any:
        judged = SimpleNamespace(a_drop=0.5, views=60)
        seconds = {"attack": 9.0, "calibrate": 0.1 * renders}
        result = SimpleNamespace(
            held_out=judged, target=judged, seconds=seconds, probe_renders=renders, image_size=(size, size)
        )
        asked = {"epsilon": 0.1, "seed": 0, "pool": 60, "held_out": 60, "background": ["white"]} | options
        return SimpleNamespace(id="1", object="mug"), asked, result

    entries = [entry(100), entry(0, held_out=9, pool=240), entry(0, size=224), entry(0, background=["black"])]
    assert [job.cost for job in charged(one.job for one in points_of(entries, ["epsilon"]))] == [19.0, 19.0, 9.0, 9.0]


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
