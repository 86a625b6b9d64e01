"""What a worker's options do: coverage samples, shaded samples, shadow maps, anisotropy."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.surfaces import object_of, quad
from tests.wire import WHITE, boxes
from tests.worker_process import started
from trompe_server.renderers import SailenvTarget
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, load_object

Show = Callable[..., NDArray[np.int64]]

SIZE = (60, 80)
WAYS = (("--set", "msaa=1"), (), ("--set", "supersample=4"))
"""Options for more and more samples a pixel."""
AMBIENT = Light(intensity=0.0, ambient=1.0)
RACKET = Path(os.environ.get("TROMPE_ASSETS", "none")) / "objects" / "tennis_racket"
PIXEL = 2 * 0.5 * np.tan(np.radians(30)) / SIZE[0]
"""Side of a pixel at 0.5 m, metres."""


@pytest.fixture(scope="module")
def show(worker: tuple[str, int]) -> Iterator[Show]:
    """An image (H, W, 3) in front of black by a worker with options; tests share the workers."""
    with ExitStack() as running:
        addresses: dict[tuple[str, ...], Any] = {(): worker}

        def image(options: tuple[str, ...], obj: Object3D, camera: Camera, light: Light = AMBIENT) -> Any:
            if options not in addresses:
                addresses[options] = running.enter_context(started(*options)).address
            with closing(SailenvTarget(*addresses[options])) as target:
                return target.render(obj, [View(camera, light, (0, 0, 0))], size=SIZE)[0].astype(int)

        yield image


@pytest.mark.thorough
def test_more_samples_a_pixel_show_more_levels_of_an_edge(show: Show) -> None:
    levels = [len(np.unique(show(options, boxes(textures=WHITE), Camera(0.5, 30, 20)))) for options in WAYS]
    assert levels[:2] == [2, 5]
    assert levels[2] > 10


def test_thin_structures_keep_their_share_of_the_picture_the_more_samples_there_are(show: Show) -> None:
    """Seven bars, a third of a pixel wide and 40 pixels high, each shifted further against the pixel grid."""
    bars = [((PIXEL * (8.13 * k - 25), 0, 0), (PIXEL / 6, 20 * PIXEL, 1e-6)) for k in range(7)]
    covered = [show(options, boxes(*bars, textures=WHITE), Camera(0.5, 0, 0))[..., 0].sum() / 255 for options in WAYS]
    errors = [abs(area / (7 * 40 / 3) - 1) for area in covered]
    assert errors[0] > 0.2
    assert errors[1] < 0.2
    assert errors[2] < 0.05


@pytest.mark.assets
@pytest.mark.skipif(not RACKET.is_dir(), reason="TROMPE_ASSETS does not name the folder with the real objects")
def test_the_strings_of_a_racket_are_smooth(show: Show) -> None:
    obj, camera, light = load_object(RACKET), Camera(0.7, 20, 30), Light(0, 75, 1.0, 0.5)
    images = [show(options, obj, camera, light) for options in WAYS]
    jagged, smooth = (np.abs(image - images[2]).mean() for image in images[:2])
    assert smooth < 0.6 * jagged


@pytest.mark.thorough
def test_the_larger_a_shadow_map_is_the_truer_are_the_edges_of_shadows(show: Show) -> None:
    plates = boxes(((0, -0.1, 0), (0.3, 0.005, 0.3)), ((0, 0.05, 0), (0.06, 0.005, 0.06)), textures=WHITE)
    ways = (("--set", "shadow_map=64"), ("--set", "shadow_map=256"), (), ("--set", "shadow_map=4096"))
    images = [show(options, plates, Camera(0.7, 0, 40), Light(60, 60, 0.7, 0.1)) for options in ways]
    off = [np.abs(image - images[-1]).mean() for image in images[:-1]]
    assert off[0] > 1.5 * off[1] > 3 * off[2] > 0


def test_an_anisotropic_filter_keeps_stripes_on_a_slanted_floor(show: Show) -> None:
    stripes = np.broadcast_to(np.array([0, 0, 255, 255], np.uint8)[:, None, None].repeat(3, 2), (4, 1, 3))
    floor = object_of(quad(np.tile(stripes, (32, 128, 1)), half=0.2))
    images = [show(options, floor, Camera(0.5, 78, 0)) for options in ((), ("--set", "anisotropy=16"))]
    contrast = [image[20:40, 38:42, 0].std(axis=0).mean() for image in images]
    assert contrast[1] > 1.5 * contrast[0]


def test_a_worker_that_cannot_start_says_why(worker: tuple[str, int]) -> None:
    wrong = {
        ("--port", "0", "--set", "msaa=32"): "MSAA samples: 32 is more than",
        ("--port", str(worker[1])): f"Cannot listen on 127.0.0.1:{worker[1]}",
    }
    for options, reason in wrong.items():
        command = [sys.executable, "-m", "trompe_renderer", *options]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
        assert ended.returncode == 1
        assert ended.stdout == ""
        assert reason in ended.stderr
