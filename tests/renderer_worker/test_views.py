"""Label views against geometry: rays through pixel centres, and boxes of known pose."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from tests.surfaces import with_alpha
from tests.wire import Wire, boxes, on_screen, pixel_rays
from trompe_renderer.protocol.label_views import instance_color
from trompe_shared.geometry import Camera, euler_to_matrix

Array = NDArray[np.float64]

SIZE = (60, 80)
RAYS = pixel_rays(SIZE)[:, ::-1]  # Unity's picture is the mirror image
HALF = np.array([0.10, 0.06, 0.04])
"""Half the sides of the box that ``boxes`` makes."""
DEPTH_RANGE = 0.8


@pytest.fixture(scope="module")
def agent(ticking_worker: tuple[str, int]) -> Iterator[Wire]:
    with closing(Wire(ticking_worker, size=SIZE, long=True)) as agent:
        yield agent


@pytest.fixture
def empty(agent: Wire) -> Wire:
    agent.ask("change_scene", scene="object_view/scene")
    return agent


@dataclass(frozen=True)
class Box:
    """The test's box, put somewhere as SPAWN_OBJECT has it."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def matrix(self) -> Array:
        matrix = np.eye(4)
        matrix[:3, :3] = euler_to_matrix(np.array(self.rotation)) * np.array(self.scale)
        matrix[:3, 3] = self.position
        return matrix


def depth_of(camera: Camera, box: Box) -> Array:
    """(H, W): distance along the camera's axis at which each pixel's ray enters the box; infinite where it misses."""
    to_box = np.linalg.inv(box.matrix()) @ np.linalg.inv(camera.world_to_camera())
    start, rays = to_box[:3, 3], RAYS @ to_box[:3, :3].T
    with np.errstate(divide="ignore"):
        times = (np.stack([-HALF, HALF])[:, None, None] - start) / rays
    enter, leave = times.min(axis=0).max(axis=-1), times.max(axis=0).min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def inside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels whose neighbours are all in the mask too."""
    return np.asarray(binary_erosion(mask))


TURNED = Box((0.03, -0.02, 0.05), (20.0, 35.0, -50.0), (1.2, 0.8, 1.0))


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.builds(Camera, st.floats(0.25, 0.6), st.floats(-180, 180), st.floats(-85, 85)))
def test_a_pixel_shows_the_object_at_its_centre_and_its_depth_along_the_cameras_axis(
    empty: Wire, camera: Camera
) -> None:
    empty.ask("change_scene", scene="object_view/scene")
    empty.spawn(boxes(), **vars(TURNED))
    empty.look(camera)
    views, depth = empty.labels(), depth_of(camera, TURNED)
    expected = np.isfinite(depth)
    for found in (views["object"].any(axis=-1), views["category"] == 1):
        assert (found != expected).sum() <= 2  # centres that lie on an edge to the last digit
    hit = inside(expected)
    assert hit.sum() > 50
    assert np.abs(views["depth"][hit] - 255 * np.minimum(depth[hit] / DEPTH_RANGE, 1)).max() < 0.52
    assert (views["depth"][inside(~expected)] == 255).all()


@dataclass(frozen=True)
class Moment:
    """Where camera and box are in one frame."""

    camera: Camera
    box: Box = TURNED


@pytest.mark.parametrize(
    ("first", "second"),
    [
        pytest.param(Moment(Camera(0.4, 20, 10)), Moment(Camera(0.4, 24, 13)), id="the camera goes round"),
        pytest.param(Moment(Camera(0.4, 20, 10)), Moment(Camera(0.3, 20, 10)), id="the camera comes nearer"),
        pytest.param(
            Moment(Camera(0.4, 0, 0), Box()), Moment(Camera(0.4, 0, 0), Box((0.03, 0.01, 0))), id="the box moves"
        ),
        pytest.param(
            Moment(Camera(0.4, 50, 30), TURNED),
            Moment(Camera(0.45, 40, 35), Box((0, 0.02, 0), (60, 10, 5), TURNED.scale)),
            id="both move and the box turns",
        ),
    ],
)
def test_flow_is_the_motion_of_the_surface_point_at_a_pixel(empty: Wire, first: Moment, second: Moment) -> None:
    number = int(empty.spawn(boxes(), **vars(first.box)))
    empty.look(first.camera)
    empty.views(1)
    empty.look(second.camera)
    empty.ask("move_object", instance=number, position=second.box.position, rotation=second.box.rotation)
    flow, depth = empty.labels()["optical"], depth_of(second.camera, second.box)
    hit = inside(np.isfinite(depth))
    points = (
        np.linalg.inv(second.camera.world_to_camera())[:3]
        @ np.append(RAYS[hit] * depth[hit][:, None], np.ones((hit.sum(), 1)), axis=1).T
    )
    on_box = np.linalg.inv(second.box.matrix()) @ np.append(points, np.ones((1, points.shape[1])), axis=0)
    earlier = (first.box.matrix() @ on_box)[:3].T
    expected = (on_screen(second.camera, points.T, SIZE) - on_screen(first.camera, earlier, SIZE)) * (-1, 1)
    assert np.abs(expected).max() > 2
    assert np.abs(flow[hit] - expected).max() < 0.01
    assert (flow[inside(~np.isfinite(depth))] == 0).all()


def test_to_the_right_and_down_are_positive_in_the_flow_as_the_client_sees_it(empty: Wire) -> None:
    number = int(empty.spawn(boxes()))
    empty.look(Camera(0.4, 0, 0))
    before = np.argwhere(empty.mask()).mean(axis=0)
    empty.ask("move_object", instance=number, position=(-0.02, -0.01, 0), rotation=(0, 0, 0))
    views = empty.labels()
    mask = views["object"].any(axis=-1)
    down, right = np.argwhere(mask).mean(axis=0) - before
    assert right > 1
    assert down > 0.5
    assert np.allclose(views["optical"][mask].mean(axis=0), (right, down), atol=0.5)


def test_flow_is_zero_without_motion_for_a_new_object_and_after_a_change_of_scene(empty: Wire) -> None:
    empty.look(Camera(0.4, 30, 20))
    empty.views(1)
    empty.spawn(boxes())
    for _ in range(2):
        assert (empty.labels()["optical"] == 0).all()
    empty.ask("change_scene", scene="object_view/scene")
    empty.spawn(boxes(), position=(0.05, 0, 0))
    empty.look(Camera(0.3, 30, 20))
    assert (empty.labels()["optical"] == 0).all()


def test_a_point_that_was_behind_the_camera_has_no_flow(empty: Wire) -> None:
    empty.spawn(boxes())
    empty.look(Camera(0.4, 0, 0))
    empty.ask("set_rotation", rotation=(0, 0, 0))  # looks away
    empty.views(1)
    empty.look(Camera(0.4, 0, 0))
    views = empty.labels()
    assert views["object"].any()
    assert (views["optical"] == 0).all()


def test_every_instance_has_its_own_colour_and_the_nearer_one_is_seen(empty: Wire) -> None:
    near, far = Box((0.05, 0, 0.1)), Box((0, 0, -0.1))
    numbers = [int(empty.spawn(boxes(), **vars(box))) for box in (near, far)]
    camera = Camera(0.5, 0, 0)
    empty.look(camera)
    depths = np.stack([depth_of(camera, box) for box in (near, far)])
    expected = np.where(np.isfinite(depths).any(axis=0), np.take([*numbers], depths.argmin(axis=0)), 0)
    found = empty.labels()["object"]
    sure = np.logical_or.reduce([inside(expected == number) for number in (0, *numbers)])
    assert (found == instance_color(expected))[sure].all()
    assert len(np.unique(found.reshape(-1, 3), axis=0)) == 3


def test_categories_are_named_and_tell_kinds_of_objects_apart(empty: Wire) -> None:
    ids = {name: number for number, name in empty.ask("get_categories")}
    assert ids["none"] == 0
    assert len(set(ids.values())) == len(ids)
    empty.spawn_named("mug", position=(0.08, 0, 0))
    empty.spawn(boxes(), position=(-0.12, 0, 0))
    empty.look(Camera(0.5, 0, 10))
    views = empty.labels()
    assert set(np.unique(views["category"])) == {0, ids["mug"], ids["uploaded"]}
    left, right = views["category"][:, : SIZE[1] // 2], views["category"][:, SIZE[1] // 2 :]
    assert (left == ids["mug"]).any()  # x grows to the left in Unity's mirror
    assert (right == ids["uploaded"]).any()


def test_labels_lie_on_the_objects_of_the_main_view(empty: Wire) -> None:
    empty.spawn_named("teapot", rotation=(10, 20, 30))
    empty.look(Camera(0.3, 70, 20))
    empty.ask("set_clear_color", color=(0, 255, 0))
    shown, mask = np.asarray((empty.picture() != (0, 255, 0)).any(axis=-1)), empty.mask()
    assert shown[mask].all()
    assert not mask[~shown].any()
    assert (shown & ~mask).sum() < 0.2 * mask.sum()  # edge pixels with an uncovered centre


def test_pixels_in_a_texture_hole_belong_to_the_scene_behind_it(empty: Wire) -> None:
    hole = np.array([[0, 0, 255, 255]] * 4, np.uint8)
    empty.spawn(with_alpha(boxes(), "front_albedo.png", hole))
    empty.look(Camera(0.4, 0, 0))
    empty.ask("set_clear_color", color=(0, 255, 0))
    mask, shown = empty.mask(), np.any(empty.picture() != (0, 255, 0), axis=-1)
    assert (mask != shown).mean() < 0.02
    assert not mask[:, SIZE[1] // 2 + 2 :].any()  # growing u is to the left in Unity's mirror
    assert mask[SIZE[0] // 2, SIZE[1] // 2 - 8]


@given(st.integers(0, 2**24 - 1), st.integers(0, 2**24 - 1))
def test_no_two_instances_share_a_colour_and_none_is_black(first: int, second: int) -> None:
    colors = instance_color(np.array([first, second]))
    assert (colors[0] == colors[1]).all() == (first == second)
    assert colors[0].any() == (first != 0)
