"""The map of views: where each view lies, how large and in which order it is drawn."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_server.pages.sphere import BOTTOM, LEAST, LEFT, MOST, RIGHT, TOP, sphere


def view(azimuth: float = 0.0, elevation: float = 30.0, confidence: float = 0.5, fate: str = "kept") -> dict[str, Any]:
    says = {"says_before": "mug 90%", "says_after": "mug 80%"}
    return {"azimuth": azimuth, "elevation": elevation, "confidence": confidence, "fate": fate} | says


views = st.lists(
    st.builds(
        view, st.floats(-720, 720), st.floats(-90, 90), st.floats(0, 1), st.sampled_from(["kept", "fooled", "never"])
    ),
    min_size=1,
    max_size=20,
)


@given(views, views)
def test_every_view_has_its_dot_within_the_axes(own: list[dict[str, Any]], unseen: list[dict[str, Any]]) -> None:
    drawn = sphere([own, unseen])
    assert {(dot["set"], dot["view"]) for dot in drawn.dots} == {
        (number, index) for number, views in enumerate((own, unseen)) for index in range(len(views))
    }
    assert sum(drawn.counts.values()) == len(own) + len(unseen)
    for dot in drawn.dots:
        assert LEFT <= dot["x"] <= RIGHT
        assert TOP <= dot["y"] <= BOTTOM
        assert LEAST <= dot["r"] <= MOST
    assert [dot["r"] for dot in drawn.dots] == sorted((dot["r"] for dot in drawn.dots), reverse=True)


def test_the_dots_lie_on_the_ticks_of_their_degrees() -> None:
    drawn = sphere([[view(-60, 0), view(0, 20), view(60, 40), view(300, 0)]])
    at = {(dot["view"]): (dot["x"], dot["y"]) for dot in drawn.dots}
    across = {tick["text"]: tick["at"] for tick in drawn.x_ticks}
    up = {tick["text"]: tick["at"] for tick in drawn.y_ticks}
    assert at == {0: (across["-60°"], up["0°"]), 1: (across["0°"], up["20°"]), 2: (across["60°"], up["40°"]), 3: at[0]}


@pytest.mark.parametrize("elevation", [-90.0, 0.0, 33.0, 90.0])
def test_views_of_one_elevation_have_an_axis_too(elevation: float) -> None:
    assert len(sphere([[view(0, elevation), view(90, elevation)]]).y_ticks) > 1
