"""What every target renderer promises, asked of the fake and of a worker behind its socket."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from trompe_server.target import FakeTarget, SailenvTarget, TargetRenderer
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (40, 56)
VIEWS = [View(Camera(0.3, azimuth, elevation)) for azimuth, elevation in ((0, 0), (60, 30), (0, 90), (10, -90))]
Boxes = Callable[..., Object3D]


@pytest.fixture(params=["fake", "sailenv"])
def renderer(request: pytest.FixtureRequest) -> TargetRenderer:
    if request.param == "fake":
        return FakeTarget()
    target: SailenvTarget = request.getfixturevalue("target")
    return target


def test_images_have_the_size_asked_for_one_for_each_view(renderer: TargetRenderer, make_boxes: Boxes) -> None:
    called: list[None] = []
    images = renderer.render(make_boxes(), VIEWS, size=SIZE, on_frame=lambda: called.append(None))
    assert images.shape == (4, *SIZE, 3)
    assert images.dtype == np.uint8
    assert len(called) == 4
    assert renderer.render(make_boxes(), [], size=SIZE).shape == (0, *SIZE, 3)


def test_the_same_question_gets_the_same_answer(renderer: TargetRenderer, make_boxes: Boxes) -> None:
    first, second = (renderer.render(make_boxes(), VIEWS, size=SIZE) for _ in range(2))
    assert (first == second).all()


def test_a_view_does_not_depend_on_the_views_around_it(renderer: TargetRenderer, make_boxes: Boxes) -> None:
    views = [View(Camera(0.3, 30, 10), Light(a, 40, i, 0.3), (a, 0, 9)) for a, i in ((0, 1.0), (90, 0.2), (0, 1.0))]
    together = renderer.render(make_boxes(), views, size=SIZE)
    assert (together[0] == together[2]).all()
    for view, image in zip(views, together, strict=True):
        assert (renderer.render(make_boxes(), [view], size=SIZE)[0] == image).all()


def test_background_texture_light_and_camera_all_show(renderer: TargetRenderer, make_boxes: Boxes) -> None:
    box, view = make_boxes(), View(Camera(0.3, 30, 20), Light(0, 20, 0.5, 0.2), (9, 8, 7))
    image = renderer.render(box, [view], size=SIZE)[0].astype(int)
    assert (image[0, 0] == (9, 8, 7)).all()
    dark = renderer.render(box, [dataclasses.replace(view, light=Light(0, 20, 0.1, 0.2))], size=SIZE)[0]
    assert (dark <= image + 1).all()
    assert dark.sum() < 0.9 * image.sum()
    black = box.with_textures({name: np.zeros_like(t) for name, t in box.textures.items()})
    assert renderer.render(black, [view], size=SIZE).sum() < 0.5 * image.sum()
    away = renderer.render(box, [dataclasses.replace(view, camera=Camera(0.6, 30, 20))], size=SIZE)[0]
    assert (away == (9, 8, 7)).all(axis=-1).sum() > (image == (9, 8, 7)).all(axis=-1).sum()


def test_right_is_right_and_up_is_up(renderer: TargetRenderer, make_boxes: Boxes) -> None:
    box = make_boxes(((0.05, 0.04, 0), (0.02, 0.02, 0.02)))
    image = renderer.render(box, [View(Camera(0.3, 0, 0))], size=SIZE)[0]
    rows, columns = np.nonzero((image != 255).any(axis=-1))
    assert rows.max() < SIZE[0] / 2
    assert columns.min() > SIZE[1] / 2


def test_fake_and_worker_show_the_same_shape_and_colours(target: SailenvTarget, make_boxes: Boxes) -> None:
    views = [View(Camera(0.3, azimuth, 35), Light(20, 50, 0.6, 0.3)) for azimuth in (30, 150, 270)]
    ours, theirs = (t.render(make_boxes(), views, size=SIZE).astype(int) for t in (FakeTarget(), target))
    assert np.median(np.abs(ours - theirs)[(theirs != 255).any(axis=-1)]) < 12
    assert ((ours != 255).any(axis=-1) != (theirs != 255).any(axis=-1)).mean() < 0.05


def test_a_broken_object_is_refused_with_the_renderers_reason(target: SailenvTarget, make_boxes: Boxes) -> None:
    box = make_boxes()
    broken = dataclasses.replace(box, files={"box.obj": b"v 1 2\n"})
    with pytest.raises(RendererError, match=r"refused the object 'box'.*box\.obj"):
        target.render(broken, VIEWS, size=SIZE)
    assert (target.render(box, VIEWS, size=SIZE) != 255).any()


def test_a_target_goes_on_after_it_was_interrupted_or_closed(target: SailenvTarget, make_boxes: Boxes) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    expected = target.render(make_boxes(), VIEWS, size=SIZE)
    with pytest.raises(KeyboardInterrupt):
        target.render(make_boxes(), VIEWS, size=SIZE, on_frame=interrupt)
    assert (target.render(make_boxes(), VIEWS, size=SIZE) == expected).all()
    target.close()
    assert (target.render(make_boxes(), VIEWS, size=SIZE) == expected).all()
