"""The views that label pixels, against geometry: rays through the centres of pixels, and boxes of known place."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from trompe_renderer.views import instance_color
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, euler_to_matrix
from trompe_shared.object3d import Object3D, encode_png

Boxes = Callable[..., Object3D]
Array = NDArray[np.float64]

SIZE = (60, 80)
HALF = np.array([0.10, 0.06, 0.04])
"""Half the sides of the box that ``make_boxes`` makes."""
DEPTH_RANGE = 0.8

few = settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
cameras = st.builds(Camera, st.floats(0.25, 0.6), st.floats(-180, 180), st.floats(-85, 85))


@pytest.fixture(scope="module")
def agent(
    running_worker: Callable[..., AbstractContextManager[tuple[str, int]]], wire_to: Callable[..., Any]
) -> Iterator[Any]:
    with running_worker("--depth-range", str(DEPTH_RANGE)) as address:
        agent = wire_to(address, size=SIZE, long=True)
        yield agent
        agent.socket.close()


@pytest.fixture
def empty(agent: Any) -> Any:
    agent.ask("change_scene", scene="object_view/scene")
    return agent


@dataclass(frozen=True)
class Box:
    """The test's box, put somewhere as SPAWN_OBJECT has it."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def placed(self) -> dict[str, Any]:
        return {"position": self.position, "rotation": self.rotation, "scale": self.scale}

    def matrix(self) -> Array:
        matrix = np.eye(4)
        matrix[:3, :3] = euler_to_matrix(np.array(self.rotation)) * np.array(self.scale)
        matrix[:3, 3] = self.position
        return matrix


def pixel_rays(camera: Camera) -> Array:
    """(H, W, 3): what the centre of each pixel sees at depth 1, in camera coordinates, of the picture as sent."""
    height, width = SIZE
    slope = np.tan(np.radians(FIELD_OF_VIEW / 2)) / (height / 2)
    x = -(np.arange(width) + 0.5 - width / 2) * slope  # Unity's picture is the mirror image
    y = (height / 2 - np.arange(height) - 0.5) * slope
    return np.stack([*np.meshgrid(x, y), np.full(SIZE, -1.0)], axis=-1)


def depth_of(camera: Camera, box: Box) -> Array:
    """(H, W): distance along the camera's axis at which each pixel's ray enters the box; infinite where it misses."""
    to_box = np.linalg.inv(box.matrix()) @ np.linalg.inv(camera.world_to_camera())
    start, rays = to_box[:3, 3], pixel_rays(camera) @ to_box[:3, :3].T
    with np.errstate(divide="ignore"):
        times = (np.stack([-HALF, HALF])[:, None, None] - start) / rays
    enter, leave = times.min(axis=0).max(axis=-1), times.max(axis=0).min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def inside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels whose neighbours are all in the mask too."""
    padded = np.pad(mask, 1)
    shifted = [np.roll(padded, step, axis)[1:-1, 1:-1] for axis in (0, 1) for step in (-1, 1)]
    return np.asarray(np.logical_and.reduce([mask, *shifted]))


def seen_at(camera: Camera, points: Array) -> Array:
    """(..., 2): column and row of world points (..., 3) in the picture as sent, pixels."""
    height, width = SIZE
    matrix = camera.world_to_camera()
    x, y, z = np.moveaxis(points @ matrix[:3, :3].T + matrix[:3, 3], -1, 0)
    scale = height / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2)) / -z
    return np.stack([width / 2 - scale * x, height / 2 - scale * y], axis=-1)


TURNED = Box((0.03, -0.02, 0.05), (20.0, 35.0, -50.0), (1.2, 0.8, 1.0))


@few
@given(cameras)
def test_a_pixel_belongs_to_the_object_that_its_centre_sees(empty: Any, make_boxes: Boxes, camera: Camera) -> None:
    empty.ask("change_scene", scene="object_view/scene")
    empty.spawn(make_boxes(), **TURNED.placed())
    empty.look(camera)
    views = empty.labels()
    expected = np.isfinite(depth_of(camera, TURNED))
    for found in (views["object"].any(axis=-1), views["category"] == 1):
        assert (found != expected).sum() <= 2  # centres that lie on an edge to the last digit


@few
@given(cameras)
def test_depth_is_the_distance_along_the_cameras_axis(empty: Any, make_boxes: Boxes, camera: Camera) -> None:
    empty.ask("change_scene", scene="object_view/scene")
    empty.spawn(make_boxes(), **TURNED.placed())
    empty.look(camera)
    levels, depth = empty.labels()["depth"], depth_of(camera, TURNED)
    hit = inside(np.isfinite(depth))
    assert hit.sum() > 50
    assert np.abs(levels[hit] - 255 * np.minimum(depth[hit] / DEPTH_RANGE, 1)).max() < 0.52
    assert (levels[inside(~np.isfinite(depth))] == 255).all()


@dataclass(frozen=True)
class Moment:
    """Where camera and box are in one frame."""

    camera: Camera
    box: Box = field(default_factory=lambda: TURNED)


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
def test_flow_is_how_far_what_a_pixel_shows_has_moved(
    empty: Any, make_boxes: Boxes, first: Moment, second: Moment
) -> None:
    number = int(empty.spawn(make_boxes(), **first.box.placed()))
    empty.look(first.camera)
    empty.views(1)
    empty.look(second.camera)
    empty.ask("move_object", instance=number, position=second.box.position, rotation=second.box.rotation)
    flow, depth = empty.labels()["optical"], depth_of(second.camera, second.box)
    hit = inside(np.isfinite(depth))
    points = (
        np.linalg.inv(second.camera.world_to_camera())[:3]
        @ np.append(pixel_rays(second.camera)[hit] * depth[hit][:, None], np.ones((hit.sum(), 1)), axis=1).T
    )
    on_box = np.linalg.inv(second.box.matrix()) @ np.append(points, np.ones((1, points.shape[1])), axis=0)
    earlier = (first.box.matrix() @ on_box)[:3].T
    expected = seen_at(second.camera, points.T) - seen_at(first.camera, earlier)
    assert np.abs(expected).max() > 2
    assert np.abs(flow[hit] - expected).max() < 0.01
    assert (flow[inside(~np.isfinite(depth))] == 0).all()


def test_to_the_right_and_down_are_positive_in_the_flow_as_the_client_sees_it(empty: Any, make_boxes: Boxes) -> None:
    number = int(empty.spawn(make_boxes()))
    empty.look(Camera(0.4, 0, 0))
    before = np.argwhere(empty.labels()["object"].any(axis=-1)).mean(axis=0)
    empty.ask("move_object", instance=number, position=(-0.02, -0.01, 0), rotation=(0, 0, 0))
    views = empty.labels()
    mask = views["object"].any(axis=-1)
    down, right = np.argwhere(mask).mean(axis=0) - before
    assert right > 1
    assert down > 0.5
    assert np.allclose(views["optical"][mask].mean(axis=0), (right, down), atol=0.5)


def test_nothing_flows_where_nothing_moves_and_a_new_object_has_not_moved(empty: Any, make_boxes: Boxes) -> None:
    empty.look(Camera(0.4, 30, 20))
    empty.views(1)
    empty.spawn(make_boxes())
    assert (empty.labels()["optical"] == 0).all()
    assert (empty.labels()["optical"] == 0).all()


def test_another_scene_is_no_motion(empty: Any, make_boxes: Boxes) -> None:
    empty.spawn(make_boxes())
    empty.look(Camera(0.4, 30, 20))
    empty.views(1)
    empty.ask("change_scene", scene="object_view/scene")
    empty.spawn(make_boxes(), position=(0.05, 0, 0))
    empty.look(Camera(0.3, 30, 20))
    assert (empty.labels()["optical"] == 0).all()


def test_what_was_behind_the_camera_has_no_flow(empty: Any, make_boxes: Boxes) -> None:
    empty.spawn(make_boxes())
    empty.look(Camera(0.4, 0, 0))
    empty.ask("set_rotation", rotation=(0, 0, 0))  # looks away
    empty.views(1)
    empty.look(Camera(0.4, 0, 0))
    views = empty.labels()
    assert views["object"].any()
    assert (views["optical"] == 0).all()


def test_every_instance_has_its_own_colour_and_the_nearer_one_is_seen(empty: Any, make_boxes: Boxes) -> None:
    near, far = Box((0.05, 0, 0.1)), Box((0, 0, -0.1))
    numbers = [int(empty.spawn(make_boxes(), **box.placed())) for box in (near, far)]
    camera = Camera(0.5, 0, 0)
    empty.look(camera)
    depths = np.stack([depth_of(camera, box) for box in (near, far)])
    expected = np.where(np.isfinite(depths).any(axis=0), np.take([*numbers], depths.argmin(axis=0)), 0)
    found = empty.labels()["object"]
    sure = np.logical_or.reduce([inside(expected == number) for number in (0, *numbers)])
    assert (found == instance_color(expected))[sure].all()
    assert len(np.unique(found.reshape(-1, 3), axis=0)) == 3


def test_categories_are_named_and_tell_kinds_of_objects_apart(empty: Any, make_boxes: Boxes) -> None:
    ids = {name: number for number, name in empty.ask("get_categories")}
    assert ids["none"] == 0
    assert len(set(ids.values())) == len(ids)
    empty.spawn_named("mug", position=(0.08, 0, 0))
    empty.spawn(make_boxes(), position=(-0.12, 0, 0))
    empty.look(Camera(0.5, 0, 10))
    views = empty.labels()
    assert set(np.unique(views["category"])) == {0, ids["mug"], ids["uploaded"]}
    left, right = views["category"][:, : SIZE[1] // 2], views["category"][:, SIZE[1] // 2 :]
    assert (left == ids["mug"]).any()  # x grows to the left in Unity's mirror
    assert (right == ids["uploaded"]).any()


def test_labels_lie_on_the_objects_of_the_main_view(empty: Any) -> None:
    empty.spawn_named("teapot", rotation=(10, 20, 30))
    empty.look(Camera(0.3, 70, 20))
    empty.ask("set_clear_color", color=(0, 255, 0))
    shown, labels = (empty.picture() != (0, 255, 0)).any(axis=-1), empty.labels()
    mask = labels["object"].any(axis=-1)
    assert shown[mask].all()
    assert not mask[~shown].any()
    assert (shown & ~mask).sum() < 0.2 * mask.sum()  # edge pixels of which the centre is not covered


def test_what_a_texture_cuts_out_belongs_to_what_is_behind_it(empty: Any, make_boxes: Boxes) -> None:
    front = np.full((8, 8, 4), 255, np.uint8)
    front[:, :4, 3] = 0
    box = make_boxes()
    empty.spawn(replace(box, files=dict(box.files) | {"front_albedo.png": encode_png(front)}))
    empty.look(Camera(0.4, 0, 0))
    empty.ask("set_clear_color", color=(0, 255, 0))
    mask, shown = empty.labels()["object"].any(axis=-1), (empty.picture() != (0, 255, 0)).any(axis=-1)
    assert (mask != shown).mean() < 0.02
    assert not mask[:, SIZE[1] // 2 + 2 :].any()  # growing u is to the left in Unity's mirror
    assert mask[SIZE[0] // 2, SIZE[1] // 2 - 8]


@given(st.integers(0, 2**24 - 1), st.integers(0, 2**24 - 1))
def test_no_two_instances_share_a_colour_and_none_is_black(first: int, second: int) -> None:
    colors = instance_color(np.array([first, second]))
    assert (colors[0] == colors[1]).all() == (first == second)
    assert colors[0].any() == (first != 0)
