"""The content of the worker's pictures: geometry, colours, light, shadows."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from tests import wire
from tests.wire import WHITE, boxes, plain
from trompe_server.renderers import SailenvTarget
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (60, 80)
AMBIENT = Light(intensity=0.0, ambient=1.0)
"""Light in which every surface shows its albedo (apart from gamma 2.2 instead of sRGB)."""

Picture = NDArray[np.uint8]
on_screen = partial(wire.on_screen, size=SIZE)


def show(target: SailenvTarget, obj: Object3D, camera: Camera, light: Light = AMBIENT, **options: object) -> Picture:
    view = View(camera, light, **options)  # type: ignore[arg-type]
    return np.asarray(target.render(obj, [view], size=SIZE)[0])


def of_color(picture: Picture, color: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels (H, W) with a face's colour."""
    return np.asarray(np.abs(picture.astype(int) - color).max(axis=-1) < 12)


def where(picture: Picture, color: tuple[int, int, int]) -> tuple[float, float]:
    """Mean row and column of the pixels with a face's colour."""
    rows, columns = np.nonzero(of_color(picture, color))
    assert len(rows), f"{color} is nowhere to be seen"
    return float(rows.mean()), float(columns.mean())


def linear(picture: Picture) -> NDArray[np.float64]:
    return np.asarray((picture / 255.0) ** 2.2)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "color"),
    [
        pytest.param(0, 0, (200, 0, 200), id="front"),
        pytest.param(90, 0, (200, 0, 0), id="right"),
        pytest.param(180, 0, (0, 200, 200), id="back"),
        pytest.param(270, 0, (0, 200, 0), id="left"),
        pytest.param(0, 90, (0, 0, 200), id="top, from straight above"),
        pytest.param(0, -90, (200, 200, 0), id="bottom, from straight below"),
    ],
)
def test_each_side_is_seen_from_its_side(
    target: SailenvTarget, azimuth: float, elevation: float, color: tuple[int, int, int]
) -> None:
    picture = show(target, boxes(), Camera(0.3, azimuth, elevation))
    assert np.abs(picture[SIZE[0] // 2, SIZE[1] // 2].astype(int) - color).max() < 12


def test_from_straight_above_the_front_is_at_the_bottom(target: SailenvTarget) -> None:
    picture = show(target, boxes(((0.02, 0, 0.06), (0.02, 0.01, 0.04))), Camera(0.3, 0, 90))
    row, column = where(picture, (0, 0, 200))
    assert row > SIZE[0] / 2 + 5
    assert column > SIZE[1] / 2 + 1


def outline(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The convex polygon (N, 2) around points (K, 2), in order."""
    return np.asarray(points[ConvexHull(points).vertices])


def area_and_middle(polygon: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    following = np.roll(polygon, -1, axis=0)
    cross = polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]
    return float(cross.sum() / 2), ((polygon + following) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.floats(0.25, 0.6), st.floats(-180, 180), st.floats(-90, 90))
@example(0.5, 0.0, 0.0)
def test_a_box_is_where_the_camera_puts_it_to_a_fraction_of_a_pixel(
    target: SailenvTarget, distance: float, azimuth: float, elevation: float
) -> None:
    box, camera = boxes(textures=WHITE), Camera(distance, azimuth, elevation)
    cover = show(target, box, camera, background=(0, 0, 0))[..., 0] / 255.0
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    shape = outline(on_screen(camera, signs * (0.10, 0.06, 0.04)))
    rows, columns = np.nonzero(cover)
    seen = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    assert np.abs(np.concatenate([shape.min(axis=0), shape.max(axis=0)]) - seen).max() < 1
    # Four samples a pixel place an edge along the pixels' rows or columns to an eighth of a pixel.
    area, middle = area_and_middle(shape)
    assert abs(cover.sum() - area) <= np.linalg.norm(shape - np.roll(shape, 1, axis=0), axis=1).sum() / 8
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] + 0.5
    assert np.abs(np.array([(cover * x).sum(), (cover * y).sum()]) / cover.sum() - middle).max() <= 0.13


def test_reflected_light_is_linear_in_the_lights_intensity(target: SailenvTarget) -> None:
    box = boxes(maps={"metallic": plain(80, 80, 80, 128)})
    intensities = np.linspace(0, 0.8, 9)
    levels = [
        linear(show(target, box, Camera(0.3, 20, 20), Light(40, 40, float(intensity), 0.1)))[30, 40]
        for intensity in intensities
    ]
    assert np.ptp(levels, axis=0).max() > 0.1
    for channel in np.transpose(levels):
        line = np.polyval(np.polyfit(intensities, channel, 1), intensities)
        assert np.abs(channel - line).max() < 0.005  # a level of 255 in the middle of the range


def test_repainting_a_side_changes_that_side_alone(target: SailenvTarget) -> None:
    box, camera = boxes(), Camera(0.3, 60, 30)
    before = show(target, box, camera)
    after = show(target, box.with_textures({"right_albedo.png": np.full((8, 8, 3), 30, np.uint8)}), camera)
    red, purple, blue, white = (of_color(before, c) for c in ((200, 0, 0), (200, 0, 200), (0, 0, 200), (255,) * 3))
    assert red.sum() > 100
    assert (np.abs(after[red].astype(int) - 30) < 12).all()
    assert not (before != after).any(axis=-1)[purple | blue | white].any()


def test_each_texel_of_a_texture_of_odd_size_appears_at_its_uv(target: SailenvTarget) -> None:
    texture = np.random.default_rng(1).integers(0, 256, (5, 3, 3), dtype=np.uint8)
    camera = Camera(0.3, 0, 0)
    picture = show(target, boxes(textures={"front": texture}), camera)
    for row, column in np.ndindex(5, 3):
        u, v = (column + 0.5) / 3, 1 - (row + 0.5) / 5
        x, y = on_screen(camera, np.array([[0.2 * u - 0.1, 0.12 * v - 0.06, 0.04]]))[0].astype(int)
        assert np.abs(picture[y, x].astype(int) - texture[row, column]).max() < 40


@pytest.mark.parametrize(("level", "brighter"), [(200, True), (56, False)])
@pytest.mark.parametrize(("channel", "light"), [(1, Light(0, 60, 1.0, 0.0)), (0, Light(60, 0, 1.0, 0.0))])
def test_a_normal_maps_green_leans_towards_growing_v_and_its_red_towards_growing_u(
    target: SailenvTarget, channel: int, light: Light, level: int, brighter: bool
) -> None:
    leaning = plain(128, 128, 200)
    leaning[..., channel] = level
    flat, leant = (
        linear(show(target, boxes(maps={"normal": normal}), Camera(0.3, 0, 0), light))[30, 40, 0]
        for normal in (plain(128, 128, 255), leaning)
    )
    assert (leant > 1.2 * flat) if brighter else (leant < 0.8 * flat)


def test_metallic_is_read_from_red_and_smoothness_from_alpha_and_nothing_from_the_rest(target: SailenvTarget) -> None:
    def picture(*color: int) -> Picture:
        maps = {"metallic": plain(*color)} if color else None
        return show(target, boxes(maps=maps), Camera(0.3, 0, 0), Light(0, 20, 0.5, 0.2))

    base = picture(100, 100, 100, 128)
    assert (picture(100, 255, 0, 128) == base).all()
    assert (picture(200, 100, 100, 128) != base).any()
    assert (picture(100, 100, 100, 200) != base).any()
    assert (picture(100, 100, 100) != base).any()  # without alpha the surface is as rough as one without a map
    assert np.abs(picture(0, 0, 0).astype(int) - picture()).max() <= 1


def test_metal_has_no_matt_colour_and_gloss_has_a_highlight(target: SailenvTarget) -> None:
    def level(metallic: int, smoothness: int, elevation: float) -> float:
        box = boxes(maps={"metallic": plain(metallic, metallic, metallic, smoothness)})
        return float(linear(show(target, box, Camera(0.3, 0, 0), Light(0, elevation, 0.5, 0.0)))[30, 40, 0])

    assert level(255, 200, 60) < 0.3 * level(0, 200, 60)
    assert level(255, 200, 0) > 2 * level(255, 20, 0)


def test_an_object_between_light_and_surface_casts_a_shadow(
    target: SailenvTarget, shadowless_worker: tuple[str, int]
) -> None:
    plates = boxes(((0, -0.1, 0), (0.2, 0.005, 0.2)), ((0, 0.02, 0), (0.05, 0.005, 0.05)))
    camera, light = Camera(0.6, 0, 30), Light(0, 90, 1.0, 0.2)
    spots = on_screen(camera, np.array([[0, -0.095, 0], [0.15, -0.095, 0]])).astype(int)
    other = SailenvTarget(*shadowless_worker)
    with_shadows, without = show(target, plates, camera, light), show(other, plates, camera, light)
    other.close()
    covered, free = (int(with_shadows[row, column, 2]) for column, row in spots)
    assert covered < 0.7 * free
    assert [int(without[row, column, 2]) for column, row in spots] == [free, free]


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 60), (90, 50), (-60, 70)])
def test_a_shadow_lies_where_the_light_throws_it(target: SailenvTarget, azimuth: float, elevation: float) -> None:
    height, half = 0.1, 0.04
    plates = boxes(((0, -0.01, 0), (0.25, 0.01, 0.25)), ((0, height, 0), (half, 0.001, half)))
    light, camera = Light(azimuth, elevation, 0.8, 0.2), Camera(0.7, 20, 75)
    a, e = np.radians(azimuth), np.radians(elevation)
    shift = -height / np.tan(e) * np.array([np.sin(a), 0, np.cos(a)])
    picture = show(target, plates, camera, light)[..., 2].astype(int)
    offsets = np.array([(x, 0, z) for x in (-1, 0, 1) for z in (-1, 0, 1)], float)
    inside, outside = (
        [picture[row, column] for column, row in on_screen(camera, shift + reach * offsets * half).astype(int)]
        for reach in (0.6, 1.6)
    )
    lit = picture[tuple(on_screen(camera, np.array([[0.2, 0, 0.2]])).astype(int)[0, ::-1])]
    shaded = np.array(inside) < 0.75 * lit
    covered = np.abs(on_screen(camera, shift + 0.6 * offsets * half) - on_screen(camera, np.array([[0, height, 0]])))
    assert shaded[(covered > 12).any(axis=1)].all()  # the plate hides nearer spots
    assert (np.array(outside)[[0, 2, 6, 8]] > 0.9 * lit).sum() >= 3


@pytest.mark.parametrize("scale", [1e-3, 1e2, 1e4, 1e6])
@pytest.mark.parametrize("order", [1, -1])
def test_a_plate_close_behind_another_is_hidden_at_any_size(target: SailenvTarget, scale: float, order: int) -> None:
    def picture(size: float) -> Picture:
        plates = [((0.0, 0.0, 0.0), (0.1, 0.1, 1e-4)), ((-0.05, 0.0, 1e-3), (0.05, 0.1, 1e-4))]
        scaled: Any = [np.multiply(plate, size) for plate in plates[::order]]
        halves = np.repeat(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8), 2, axis=0)
        return show(target, boxes(*scaled, textures={"front": halves}), Camera(0.4 * size, 20, 15))

    different = np.abs(picture(scale).astype(int) - picture(1.0)).max(axis=-1) > 40
    assert different.mean() < 0.02


@pytest.mark.parametrize("scale", [0.1, 1.0, 20.0])
def test_a_lit_box_of_any_size_has_no_stripes_of_its_own_shadow(target: SailenvTarget, scale: float) -> None:
    box = boxes(((0, 0, 0), (0.1 * scale, 0.1 * scale, 0.1 * scale)))
    for elevation in (10, 40, 80):
        picture = show(target, box, Camera(0.25 * scale, 0, 0), Light(0, elevation, 1.0, 0.2))
        assert np.ptp(linear(picture)[10:50, 20:60, 0]) < 0.05


def test_the_same_view_gives_the_same_bytes_whatever_was_rendered_between(target: SailenvTarget) -> None:
    box, other = boxes(), boxes(((0, 0, 0), (0.02, 0.2, 0.02)))
    view = View(Camera(0.3, 20, 20), Light(40, 50))
    first = target.render(box, [view], size=SIZE)
    target.render(other, [View(Camera(0.4, 50, 0), Light(-40, 20))], size=(33, 17))
    for _ in range(20):  # more objects than the worker keeps
        target.render(boxes(((0, 0, 0), tuple(np.random.default_rng(_).uniform(0.01, 0.1, 3)))), [view], size=SIZE)
    assert (target.render(box, [view, view], size=SIZE) == first).all()
