"""The contract of target renderers: the fake, workers with and without our extensions, and a pool of two."""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import closing
from unittest.mock import Mock

import numpy as np
import pytest

from tests.fakes import FakeTarget
from tests.surfaces import with_alpha
from tests.wire import boxes, plain
from trompe_server.renderers import RendererPool, SailenvTarget, TargetRenderer
from trompe_shared.errors import ObjectError, RendererError
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, object_from_files

SIZE = (40, 56)
VIEWS = [View(Camera(0.3, azimuth, elevation)) for azimuth, elevation in ((0, 0), (60, 30), (0, 90), (10, -90))]


@pytest.fixture(params=["fake", "one worker", "a worker without extensions", "pool"])
def renderer(request: pytest.FixtureRequest) -> Iterator[TargetRenderer]:
    makers: dict[str, Callable[[], TargetRenderer]] = {
        "fake": FakeTarget,
        "one worker": lambda: SailenvTarget(*request.getfixturevalue("worker"), timeout=240),
        "a worker without extensions": lambda: SailenvTarget(*request.getfixturevalue("plain_worker"), timeout=240),
        "pool": lambda: RendererPool([request.getfixturevalue(name) for name in ("worker", "second_worker")]),
    }
    with closing(makers[request.param]()) as renderer:
        yield renderer


def test_images_have_the_size_asked_for_one_for_each_view_and_are_the_same_again(renderer: TargetRenderer) -> None:
    called = Mock()
    images = renderer.render(boxes(), VIEWS, size=SIZE, on_frame=called)
    assert images.shape == (4, *SIZE, 3)
    assert images.dtype == np.uint8
    assert called.call_count == 4
    assert (renderer.render(boxes(), VIEWS, size=SIZE) == images).all()
    assert renderer.render(boxes(), [], size=SIZE).shape == (0, *SIZE, 3)


def test_a_view_does_not_depend_on_the_views_around_it(renderer: TargetRenderer) -> None:
    views = [View(Camera(0.3, 30, 10), Light(a, 40, i, 0.3), (a, 0, 9)) for a, i in ((0, 1.0), (90, 0.2), (0, 1.0))]
    together = renderer.render(boxes(), views, size=SIZE)
    assert (together[0] == together[2]).all()
    for view, image in zip(views, together, strict=True):
        assert (renderer.render(boxes(), [view], size=SIZE)[0] == image).all()


def test_background_texture_light_and_camera_all_show(renderer: TargetRenderer) -> None:
    box, view = boxes(), View(Camera(0.3, 30, 20), Light(0, 20, 0.5, 0.2), (9, 8, 7))
    image = renderer.render(box, [view], size=SIZE)[0].astype(int)
    assert (image[0, 0] == (9, 8, 7)).all()
    dark = renderer.render(box, [dataclasses.replace(view, light=Light(0, 20, 0.1, 0.2))], size=SIZE)[0]
    assert (dark <= image + 1).all()
    assert dark.sum() < 0.9 * image.sum()
    black = box.with_textures({name: np.zeros_like(t) for name, t in box.textures.items()})
    assert renderer.render(black, [view], size=SIZE).sum() < 0.5 * image.sum()
    away = renderer.render(box, [dataclasses.replace(view, camera=Camera(0.6, 30, 20))], size=SIZE)[0]
    assert (away == (9, 8, 7)).all(axis=-1).sum() > (image == (9, 8, 7)).all(axis=-1).sum()


def test_right_is_right_and_up_is_up(renderer: TargetRenderer) -> None:
    box = boxes(((0.05, 0.04, 0), (0.02, 0.02, 0.02)))
    image = renderer.render(box, [View(Camera(0.3, 0, 0))], size=SIZE)[0]
    rows, columns = np.nonzero((image != 255).any(axis=-1))
    assert rows.max() < SIZE[0] / 2
    assert columns.min() > SIZE[1] / 2


def test_an_object_too_large_to_be_sent_is_refused_and_the_renderer_is_not_blamed(
    renderer: TargetRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    if isinstance(renderer, FakeTarget):
        pytest.skip("nothing is sent")
    monkeypatch.setattr("trompe_shared.sailenv_client.MAX_FILE", 100)
    with pytest.raises(ObjectError, match=r"^The object 'box' has 0 MiB as a zip, more than"):
        renderer.render(boxes(), VIEWS, size=SIZE)
    monkeypatch.undo()
    assert renderer.render(boxes(), VIEWS, size=SIZE).any()


def test_every_way_to_a_worker_shows_exactly_the_same_bytes(
    worker: tuple[str, int], plain_worker: tuple[str, int], second_worker: tuple[str, int]
) -> None:
    box = boxes(textures={"front": np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)})
    random = np.random.default_rng(1)

    def cut(columns: int) -> Object3D:
        """The box without the first columns of its front's texture."""
        opaque = np.arange(53) >= columns
        return with_alpha(box, "front_albedo.png", np.full((37, 53), 255 * opaque, np.uint8))

    lit = boxes(maps={"normal": plain(128, 128, 255)})
    table = lit.files["box_mat_def.json"].replace(b"front_albedo.png", b"normal.png")
    albedo_is_normal_map = object_from_files({**lit.files, "box_mat_def.json": table})
    objects = [
        box,
        box.with_textures({"front_albedo.png": random.integers(0, 256, (37, 53, 3), dtype=np.uint8)}),
        box.with_textures({"front_albedo.png": random.integers(0, 256, (64, 8, 3), dtype=np.uint8)}),
        box.with_textures({name: np.full((5, 5, 3), 99, np.uint8) for name in box.textures}),
        *(cut(20), cut(10), box, cut(30), albedo_is_normal_map),
        albedo_is_normal_map.with_textures({"normal.png": plain(128, 200, 200)}),
    ]
    views = [View(Camera(0.3, 20 * k, 3 * k), Light(10 * k, 40, 0.5 + k / 20, 0.3), (k, 0, 9)) for k in range(10)]
    expected = []
    for obj in objects:  # a fresh connection for each: nothing repainted, every view asked for by itself
        with closing(SailenvTarget(*plain_worker)) as fresh:
            expected.append(fresh.render(obj, views, size=SIZE))
    assert len({images.tobytes() for images in expected}) == len(objects) - 1  # the box itself comes twice
    targets: list[TargetRenderer] = [
        SailenvTarget(*worker),
        SailenvTarget(*plain_worker),
        RendererPool([worker, second_worker]),
    ]
    for target in targets:
        with closing(target):
            for obj, images in zip(objects, expected, strict=True):
                assert (target.render(obj, views, size=SIZE) == images).all()


def test_many_textures_one_after_the_other_are_all_shown_right(target: SailenvTarget) -> None:
    box, view = boxes(), View(Camera(0.3, 0, 0), Light(0, 0, 0.0, 1.0))
    greys = range(20, 230, 2)

    def shown(grey: int) -> int:
        painted = box.with_textures({"front_albedo.png": np.full((8, 8, 3), grey, np.uint8)})
        return int(target.render(painted, [view], size=SIZE)[0, SIZE[0] // 2, SIZE[1] // 2, 0])

    rising = [shown(grey) for grey in greys]
    assert (np.diff(rising) >= 0).all()
    assert rising[0] + 150 < rising[-1]
    assert [shown(grey) for grey in greys[::-1]] == rising[::-1]


def test_fake_and_worker_show_the_same_shape_and_colours(target: SailenvTarget) -> None:
    views = [View(Camera(0.3, azimuth, 35), Light(20, 50, 0.6, 0.3)) for azimuth in (30, 150, 270)]
    ours, theirs = (t.render(boxes(), views, size=SIZE).astype(int) for t in (FakeTarget(), target))
    assert np.median(np.abs(ours - theirs)[(theirs != 255).any(axis=-1)]) < 12
    assert ((ours != 255).any(axis=-1) != (theirs != 255).any(axis=-1)).mean() < 0.05


def test_a_broken_object_is_refused_with_the_renderers_reason(target: SailenvTarget) -> None:
    box = boxes()
    broken = dataclasses.replace(box, files={"box.obj": b"v 1 2\n"})
    with pytest.raises(RendererError, match=r"refused the object 'box'.*box\.obj"):
        target.render(broken, VIEWS, size=SIZE)
    assert (target.render(box, VIEWS, size=SIZE) != 255).any()


def test_a_target_goes_on_after_it_was_interrupted_or_closed(target: SailenvTarget) -> None:
    expected = target.render(boxes(), VIEWS, size=SIZE)
    with pytest.raises(KeyboardInterrupt):
        target.render(boxes(), VIEWS, size=SIZE, on_frame=Mock(side_effect=KeyboardInterrupt))
    assert (target.render(boxes(), VIEWS, size=SIZE) == expected).all()
    target.close()
    assert (target.render(boxes(), VIEWS, size=SIZE) == expected).all()
