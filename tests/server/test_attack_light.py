"""Where the light may stand: the search over it, and what it may look at."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from trompe_server.array_files import pack_arrays
from trompe_server.attack import Goal
from trompe_server.attack.beyond import (
    FoundLight,
    LightPlace,
    LightRanges,
    LightTrial,
    find_light,
    light_map,
    load_light,
    save_light,
)
from trompe_server.classifiers import NetworkClassifier, fake_classifier
from trompe_server.target import FakeTarget
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, Light, View, spherical
from trompe_shared.object3d import Object3D

VIEWS = [View(Camera(0.4, azimuth, elevation)) for azimuth in range(0, 360, 45) for elevation in (0, 30)]
SIZE = (32, 32)


class Hill:
    """A target whose pictures are the brighter, the nearer the light is to a place; notes what it was asked."""

    def __init__(self, azimuth: float, elevation: float) -> None:
        self.top, self.asked = spherical(azimuth, elevation), list[View]()

    def __call__(self, views: Sequence[View]) -> NDArray[np.uint8]:
        self.asked += views
        images = np.zeros((len(views), *SIZE, 3), np.uint8)
        for image, view in zip(images, views, strict=True):
            image[:] = round(100 + 100 * float(spherical(view.light.azimuth, view.light.elevation) @ self.top))
        return images


class Brightness:
    """Says class 1 where a picture is bright, class 0 where it is dark."""

    name, image_size, n_classes, classes = "brightness", SIZE, 2, None

    def predict(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        bright = images.mean(axis=(1, 2, 3)) / 100 - 1.5
        return np.stack([-bright, bright], axis=1).astype(np.float32)


@pytest.mark.parametrize("top", [(100.0, 40.0), (-175.0, 20.0), (0.0, 85.0)])
def test_the_search_finds_the_top_of_a_hill(top: tuple[float, float]) -> None:
    found = find_light(Hill(*top), VIEWS, Brightness(), goal=Goal(0), ranges=LightRanges(), n_views=1)
    apart = np.degrees(
        np.arccos(np.clip(spherical(found.place.azimuth, found.place.elevation) @ spherical(*top), -1, 1))
    )
    assert apart < 12


def test_what_is_found_is_the_best_of_all_that_was_tried() -> None:
    found = find_light(Hill(50, 50), VIEWS, Brightness(), goal=Goal(0), ranges=LightRanges(), n_views=2)
    best = max(found.trials, key=lambda trial: trial.won)
    assert found.place == best.place
    assert best.fooled == 1


def test_it_looks_at_the_views_it_says_and_at_no_others() -> None:
    target = Hill(50, 50)
    found = find_light(target, VIEWS, Brightness(), goal=Goal(0), ranges=LightRanges(), n_views=5, seed=3)
    assert {view.camera for view in target.asked} == {VIEWS[k].camera for k in found.asked}
    assert len(found.asked) == 5
    assert found.renders == len(target.asked) == 5 * 56


def test_views_that_are_not_asked_for_cannot_change_what_is_found() -> None:
    def search(views: Sequence[View]) -> FoundLight:
        return find_light(Hill(50, 50), views, Brightness(), goal=Goal(0), ranges=LightRanges(), n_views=4)

    found = search(VIEWS)
    others = [view if k in found.asked else View(Camera(9, 0, 0)) for k, view in enumerate(VIEWS)]
    assert search(others) == found


def test_the_same_seed_finds_the_same_light_on_a_renderer(mug: Object3D) -> None:
    target, network = FakeTarget(points=3000), fake_classifier(image_size=SIZE)
    label = int(network.predict(target.render(mug, VIEWS, size=SIZE)).sum(0).argmax())

    def search(seed: int) -> FoundLight:
        def ask(views: Sequence[View]) -> NDArray[np.uint8]:
            return target.render(mug, views, size=SIZE)

        return find_light(ask, VIEWS, network, goal=Goal(label), ranges=LightRanges(), n_views=2, places=12, seed=seed)

    assert search(1) == search(1)
    assert search(1).trials != search(2).trials


def test_a_search_goes_on_where_it_stopped_also_from_a_file() -> None:
    target = Hill(50, 50)

    def search(**options: Any) -> FoundLight:
        return find_light(target, VIEWS, Brightness(), goal=Goal(0), ranges=LightRanges(), n_views=2, **options)

    whole = search(places=30)
    state = search(places=30, until=3)
    for until in (16, 17, 30):
        target.asked.clear()
        before = load_light(save_light(state))
        assert before == state
        state = search(places=30, tried=before.trials, until=until)
        assert len(target.asked) == 2 * (until - before.step)
    assert state == whole


def test_a_file_that_holds_something_else_is_no_search() -> None:
    with pytest.raises(ValueError, match="no search for a light"):
        load_light(pack_arrays({"places": np.zeros((1, 4))}))


RANGE = st.tuples(st.floats(0, 1), st.floats(0, 1)).map(sorted)


@given(RANGE, RANGE, RANGE, RANGE, st.lists(st.floats(-3, 3), min_size=4, max_size=4))
def test_no_light_leaves_its_ranges(
    azimuth: list[float], elevation: list[float], intensity: list[float], ambient: list[float], shares: list[float]
) -> None:
    ranges = LightRanges(
        (-180 + 360 * azimuth[0], -180 + 360 * azimuth[1]),
        (90 * elevation[0], 90 * elevation[1]),
        (intensity[0], intensity[1]),
        (ambient[0], ambient[1]),
    )
    place = ranges.place(np.array(shares))
    for name, (low, high) in ranges.given.items():
        assert low <= getattr(place, name) <= high + 1e-9 * abs(high)


def test_a_full_circle_has_no_ends() -> None:
    assert LightRanges().place(np.array([1.25, 0.5])) == LightRanges().place(np.array([0.25, 0.5]))
    assert LightRanges((-90, 90)).place(np.array([1.25, 0.5])).azimuth == 90


def test_equal_shares_are_equal_areas_of_the_sky() -> None:
    ranges = LightRanges(elevation=(0, 90))
    assert [ranges.place(np.array([0, share])).elevation for share in (0, 0.5, 1)] == pytest.approx([0, 30, 90])


def test_what_is_not_searched_stays_each_views_own() -> None:
    views = [View(Camera(1, 0, 0), Light(0, 75, intensity, 0.1, (9, 8, 7))) for intensity in (0.5, 1.0)]
    lit = LightPlace(20, 30, ambient=0.4).light_up(views)
    assert [view.light for view in lit] == [Light(20, 30, intensity, 0.4, (9, 8, 7)) for intensity in (0.5, 1.0)]


@pytest.mark.parametrize(
    "ranges",
    [{"azimuth": (10, -10)}, {"elevation": (0, 91)}, {"intensity": (-1, 1)}, {"ambient": (0.5, 1.5)}],
    ids=str,
)
def test_ranges_that_cannot_be_are_refused(ranges: dict[str, tuple[float, float]]) -> None:
    with pytest.raises(SpecError, match="low end first"):
        LightRanges(**ranges)


def test_a_search_without_views_is_refused() -> None:
    with pytest.raises(SpecError, match="needs a view"):
        find_light(Hill(0, 0), [], Brightness(), goal=Goal(0), ranges=LightRanges())


def test_a_goal_that_the_classifier_does_not_know_is_refused() -> None:
    network: NetworkClassifier = fake_classifier(image_size=SIZE)
    with pytest.raises(SpecError, match="label 12"):
        find_light(Hill(0, 0), VIEWS, network, goal=Goal(12), ranges=LightRanges())


def test_the_map_shows_each_light_where_it_stands() -> None:
    """From above: the front below, azimuth 90 on the right; blue fools least, red most."""
    low, high = LightTrial(LightPlace(0, 30), 0.2, -1.0, 0.0), LightTrial(LightPlace(90, 30), 0.9, 2.0, 1.0)
    picture = light_map(FoundLight(high.place, (low, high), (0,)), radius=90)
    middle = picture.shape[1] // 2
    front, right = picture[middle + 60, middle], picture[middle, middle + 60]
    assert front[2] > front[0]
    assert right[0] > right[2]
