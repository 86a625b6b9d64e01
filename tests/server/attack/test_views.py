"""Random views, the paper's grid, and both in the renderers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.fakes import FakeTarget
from trompe_server.attack import ViewDistribution, grid_views
from trompe_server.renderers import SailenvTarget, TargetRenderer
from trompe_server.surrogate import SamplingModel, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.api import ViewRanges
from trompe_shared.errors import SpecError
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, Light, View, framing_distance
from trompe_shared.object3d import Object3D

PLAIN = ViewDistribution(2.0, (-10.0, 45.0), backgrounds=((9, 9, 9),))
WIDE = replace(
    PLAIN,
    ranges=ViewRanges(
        roll=(-20.0, 20.0),
        intensity=(0.5, 2.0),
        ambient=(0.1, 0.9),
        light_colours=((255, 150, 60), (205, 250, 160)),
    ),
    backgrounds=((0, 0, 0), (255, 255, 255), (1, 2, 3)),
)


def sample(distribution: ViewDistribution, n: int = 1000, *, seed: int = 0) -> list[View]:
    return distribution.sample(n, generator=np.random.default_rng(seed))


def test_the_views_of_a_seed_are_those_of_earlier_releases() -> None:
    generator = np.random.default_rng([0, 1])
    views = PLAIN.sample(2, generator=generator)
    assert views == [
        View(
            Camera(2.155895516511254, 200.56969807424147, 34.049944779058464),
            Light(63.911934446547406, 38.106603487915784),
            (9, 9, 9),
        ),
        View(
            Camera(1.8945602781198325, 283.6123912339793, -9.983046780356668),
            Light(31.601230270561103, 67.79463304665998),
            (9, 9, 9),
        ),
    ]


@pytest.mark.parametrize(
    ("values", "low", "high"),
    [
        pytest.param([v.camera.distance for v in sample(WIDE)], 1.8, 2.2, id="distance"),
        pytest.param([v.camera.azimuth for v in sample(WIDE)], 0, 360, id="azimuth"),
        pytest.param([v.camera.elevation for v in sample(WIDE)], -10, 45, id="elevation"),
        pytest.param([v.camera.roll for v in sample(WIDE)], -20, 20, id="roll"),
        pytest.param([v.light.azimuth for v in sample(WIDE)], -70, 70, id="light azimuth"),
        pytest.param([v.light.elevation for v in sample(WIDE)], 35, 88, id="light elevation"),
        pytest.param([v.light.intensity for v in sample(WIDE)], 0.5, 2, id="intensity"),
        pytest.param([v.light.ambient for v in sample(WIDE)], 0.1, 0.9, id="ambient"),
        pytest.param([v.light.colour[2] for v in sample(WIDE)], 60, 160, id="blue of the light"),
    ],
)
def test_views_fill_their_ranges_evenly_and_nothing_else(values: list[float], low: float, high: float) -> None:
    assert low <= min(values) < low + 0.03 * (high - low)
    assert high - 0.03 * (high - low) < max(values) <= high
    quarters, _ = np.histogram(values, bins=4, range=(low, high))
    assert quarters.min() > 200


def test_backgrounds_are_equally_likely() -> None:
    shown = [view.background for view in sample(WIDE)]
    assert set(shown) == set(WIDE.backgrounds)
    assert min(shown.count(colour) for colour in WIDE.backgrounds) > 280


def test_a_lights_colour_lies_between_the_two_given() -> None:
    for red, green, blue in (view.light.colour for view in sample(WIDE)):
        share = (255 - red) / 50
        assert (green, blue) == pytest.approx((150 + 100 * share, 60 + 100 * share), abs=1.6)


def test_quantities_do_not_depend_on_each_other() -> None:
    views = sample(WIDE, 2000)
    numbers = [
        [*list(vars(v.camera).values())[:4], *list(vars(v.light).values())[:4], v.light.colour[0], sum(v.background)]
        for v in views
    ]
    correlation = np.corrcoef(np.array(numbers).T) - np.eye(len(numbers[0]))
    assert np.abs(correlation).max() < 0.08


@pytest.mark.parametrize("name", ["roll", "intensity", "ambient", "light_colours", "backgrounds", "azimuth"])
def test_fixing_one_quantity_leaves_the_others_as_they_were(name: str) -> None:
    if name == "backgrounds":
        fixed = replace(WIDE, backgrounds=WIDE.backgrounds[:1])
    else:
        one = getattr(WIDE.ranges, name)[:1] * 2
        fixed = replace(WIDE, ranges=WIDE.ranges.model_copy(update={name: one}))

    def without(view: View) -> list[object]:
        values = vars(view.camera) | {f"light {key}": value for key, value in vars(view.light).items()}
        values |= {"background": view.background}
        hidden = {"roll": "roll", "azimuth": "azimuth", "backgrounds": "background", "light_colours": "light colour"}
        return [value for key, value in values.items() if key != hidden.get(name, f"light {name}")]

    before, after = sample(WIDE, 20), sample(fixed, 20)
    assert before != after
    assert [without(view) for view in before] == [without(view) for view in after]


@given(st.integers(0, 9), st.integers(0, 99))
def test_fewer_views_of_a_seed_are_the_first_of_more(n: int, seed: int) -> None:
    assert sample(WIDE, n, seed=seed) == sample(WIDE, 10, seed=seed)[:n]
    assert sample(WIDE, 10, seed=seed) != sample(WIDE, 10, seed=seed + 1)


def test_a_generator_goes_on_where_it_stopped() -> None:
    generator = np.random.default_rng(0)
    first, second = (WIDE.sample(200, generator=generator) for _ in range(2))
    assert {view.camera for view in first}.isdisjoint(view.camera for view in second)
    assert {view.light.intensity for view in first}.isdisjoint(view.light.intensity for view in second)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param({"elevation": (40, 10)}, "elevation .* low end first; got 40 10", id="ends exchanged"),
        pytest.param({"elevation": (0, 91)}, "elevation must be a range within -90..90", id="over the pole"),
        pytest.param({"distance": -1.0}, "distance must be more than 0", id="behind itself"),
        pytest.param({"backgrounds": ()}, "at least one colour", id="no background"),
    ],
)
def test_a_distribution_that_makes_no_sense_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecError, match=words):
        replace(PLAIN, **change)


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        pytest.param("ambient", (0.5, 1.5), "ambient must be a range within 0..1", id="more than all light"),
        pytest.param("intensity", (-1, 1), "intensity must be", id="negative light"),
        pytest.param("roll", (float("nan"), 0), "roll must be", id="no number"),
        pytest.param("distance_factor", (0, 1), "distance_factor must be", id="at the object"),
        pytest.param("light_colours", ((0, 0, 0), (256, 0, 0)), "less than or equal to 255", id="no colour"),
    ],
)
def test_ranges_beyond_their_limits_are_refused(name: str, values: object, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        ViewRanges.model_validate({name: values})


# The paper's grid


def test_the_grid_is_the_papers() -> None:
    views = grid_views(distance=2.0, elevation=(10, 50), azimuths=None, elevations=10, background=(1, 2, 3))
    assert len(views) == 60
    assert {view.camera.azimuth for view in views} == {0, 72, 144, 216, 288, 360}
    assert sorted({view.camera.elevation for view in views}) == pytest.approx(np.linspace(10, 50, 10))
    assert len({view.camera for view in views}) == 60
    others = {(view.camera.distance, view.light, view.background) for view in views}
    assert others == {(2.0, Light(azimuth=0, elevation=75), (1, 2, 3))}


@pytest.mark.parametrize("azimuths", [2, 3, 6])
def test_a_grid_of_so_many_azimuths_has_so_many_distinct_ones(azimuths: int) -> None:
    views = grid_views(distance=2.0, elevation=(10, 50), azimuths=azimuths, elevations=1, background=(1, 2, 3))
    around = sorted(view.camera.azimuth % 360 for view in views)
    assert around == pytest.approx([k * 360 / azimuths for k in range(azimuths)])


def test_a_grid_of_one_is_the_first_end_of_both_ranges() -> None:
    (view,) = grid_views(distance=1, elevation=(20, 40), azimuths=1, elevations=1, background=(0, 0, 0))
    assert view.camera == Camera(1, 0, 20)


@given(st.floats(0, 360), st.floats(-90, 90))
@settings(max_examples=30)
def test_from_the_framing_distance_all_of_the_object_is_seen(mug: Object3D, azimuth: float, elevation: float) -> None:
    matrix = Camera(framing_distance(mug.radius), azimuth, elevation).world_to_camera()
    points = np.concatenate([part.vertices for part in mug.parts]) @ matrix[:3, :3].T + matrix[:3, 3]
    reach = np.abs(points[:, :2] / -points[:, 2:]) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    assert (points[:, 2] < 0).all()
    assert reach.max() < 1


# Views in the renderers


@pytest.fixture(params=["fake", "sailenv"])
def renderer(request: pytest.FixtureRequest) -> TargetRenderer:
    if request.param == "fake":
        return FakeTarget()
    target: SailenvTarget = request.getfixturevalue("target")
    return target


UPRIGHT = View(Camera(0.18, 30, 25), Light(azimuth=20, elevation=40))
ROLLED = replace(UPRIGHT, camera=replace(UPRIGHT.camera, roll=90))


def shown(images: np.ndarray) -> np.ndarray:
    """Where images are not white."""
    return np.asarray((images != 255).any(axis=-1))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_a_camera_that_rolls_turns_the_picture_clockwise(renderer: TargetRenderer, mug: Object3D) -> None:
    upright, rolled = shown(renderer.render(mug, [UPRIGHT, ROLLED], size=(64, 64)))
    assert overlap(np.rot90(upright, -1), rolled) > 0.9
    assert overlap(np.rot90(upright, 1), rolled) < 0.8


def test_the_surrogate_rolls_with_the_target(mug: Object3D, target: SailenvTarget) -> None:
    views = [replace(UPRIGHT, camera=replace(UPRIGHT.camera, roll=roll)) for roll in (0, 90, -25)]
    surrogate = diffuse_surrogate(prepare_geometry(mug, views, size=(64, 64), sampling=SamplingModel()), views)
    images = surrogate.render_all(surrogate.texels(textures_of(mug))).mul(255).byte().permute(0, 2, 3, 1).numpy()
    for mine, theirs in zip(shown(images), shown(target.render(mug, views, size=(64, 64))), strict=True):
        assert overlap(mine, theirs) > 0.97


def test_coloured_light_takes_colour_off_what_it_lights_and_white_none(renderer: TargetRenderer, mug: Object3D) -> None:
    views = [replace(UPRIGHT, light=replace(UPRIGHT.light, colour=c)) for c in ((255, 255, 255), (255, 0, 0))]
    white, red, plain = renderer.render(mug, [*views, UPRIGHT], size=(64, 64))
    lit, reddish = white[shown(plain)].astype(float), red[shown(plain)].astype(float)
    np.testing.assert_array_equal(plain, white)
    assert reddish[:, 0].mean() == pytest.approx(lit[:, 0].mean(), abs=2)
    assert reddish[:, 1:].mean() < lit[:, 1:].mean() - 20
