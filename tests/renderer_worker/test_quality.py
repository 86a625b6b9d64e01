"""What a worker's options do: coverage samples, shaded samples, shadow maps."""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trompe_server.target import SailenvTarget
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, load_object

Boxes = Callable[..., Object3D]
Make = Callable[..., Any]
Running = Callable[..., AbstractContextManager[tuple[str, int]]]
Picture = NDArray[np.uint8]

SIZE = (60, 80)
RACKET = Path(os.environ.get("TROMPE_ASSETS", "none")) / "objects" / "tennis_racket"
WHITE = {name: np.full((4, 4, 3), 255, np.uint8) for name in ("right", "left", "top", "bottom", "front", "back")}
PIXEL = 2 * 0.5 * np.tan(np.radians(30)) / SIZE[0]
"""Side of a pixel at 0.5 m, metres."""


def thin_bars(make_boxes: Boxes) -> Object3D:
    """A third of a pixel wide and 40 pixels high, seven of them, each a little further from the pixels' grid."""
    bars = [((PIXEL * (8.13 * k - 25), 0, 0), (PIXEL / 6, 20 * PIXEL, 1e-6)) for k in range(7)]
    return make_boxes(*bars, textures=WHITE)


def shown(address: tuple[str, int], obj: Object3D, camera: Camera, light: Light) -> Picture:
    target = SailenvTarget(*address)
    image = target.render(obj, [View(camera, light, (0, 0, 0))], size=SIZE)[0]
    target.close()
    return np.asarray(image)


def covered(running_worker: Running, make_boxes: Boxes, *options: str) -> NDArray[np.float64]:
    """How much of each pixel the thin bars are said to cover, (H, W)."""
    with running_worker(*options) as address:
        image = shown(address, thin_bars(make_boxes), Camera(0.5, 0, 0), Light(0, 0, 0.0, 1.0))
    return np.asarray(image[..., 0] / 255.0)


def test_more_samples_a_pixel_show_more_levels_of_an_edge(running_worker: Running, make_boxes: Boxes) -> None:
    levels = []
    for options in (["--msaa", "1"], ["--msaa", "4"], ["--supersample", "3"]):
        with running_worker(*options) as address:
            image = shown(address, make_boxes(textures=WHITE), Camera(0.5, 30, 20), Light(0, 0, 0.0, 1.0))
        levels.append(len(np.unique(image)))
    assert levels[0] == 2
    assert levels[1] == 5
    assert levels[2] > 10


def test_thin_structures_keep_their_share_of_the_picture_the_more_samples_there_are(
    running_worker: Running, make_boxes: Boxes
) -> None:
    area = 7 * 40 / 3
    errors = [
        abs(covered(running_worker, make_boxes, *options).sum() / area - 1)
        for options in (("--msaa", "1"), (), ("--supersample", "4"))
    ]
    assert errors[0] > 0.2
    assert errors[1] < 0.2
    assert errors[2] < 0.05


@pytest.mark.assets
@pytest.mark.skipif(not RACKET.is_dir(), reason="TROMPE_ASSETS does not name the folder with the real objects")
def test_the_strings_of_a_racket_are_smooth(running_worker: Running) -> None:
    obj, camera, light = load_object(RACKET), Camera(0.7, 20, 30), Light(0, 75, 1.0, 0.5)
    images = []
    for options in (["--msaa", "1"], ["--msaa", "4"], ["--supersample", "4"]):
        with running_worker(*options) as address:
            images.append(shown(address, obj, camera, light).astype(int))
    jagged, smooth = (np.abs(image - images[2]).mean() for image in images[:2])
    assert smooth < 0.6 * jagged


def test_the_larger_a_shadow_map_is_the_truer_are_the_edges_of_shadows(
    running_worker: Running, make_boxes: Boxes
) -> None:
    boxes = make_boxes(((0, -0.1, 0), (0.3, 0.005, 0.3)), ((0, 0.05, 0), (0.06, 0.005, 0.06)), textures=WHITE)
    images = []
    for side in ("64", "256", "1024", "4096"):
        with running_worker("--shadow-map", side) as address:
            images.append(shown(address, boxes, Camera(0.7, 0, 40), Light(60, 60, 0.7, 0.1)).astype(int))
    off = [np.abs(image - images[-1]).mean() for image in images[:-1]]
    assert off[0] > 1.5 * off[1] > 3 * off[2] > 0


def test_an_anisotropic_filter_keeps_stripes_that_run_away_from_the_eye(
    running_worker: Running, make_object: Make, make_quad: Make
) -> None:
    stripes = np.broadcast_to(np.array([0, 0, 255, 255], np.uint8)[:, None, None].repeat(3, 2), (4, 1, 3))
    floor = make_object(make_quad(np.tile(stripes, (32, 128, 1)), half=0.2))
    contrast = []
    for options in ((), ("--anisotropy", "16")):
        with running_worker(*options) as address:
            image = shown(address, floor, Camera(0.5, 78, 0), Light(0, 0, 0.0, 1.0))
        contrast.append(image[20:40, 38:42, 0].std(axis=0).mean())
    assert contrast[1] > 1.5 * contrast[0]


def test_the_help_names_every_option_and_where_its_cost_stands() -> None:
    command = [sys.executable, "-m", "trompe_renderer", "--help"]
    text = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    for option in (
        "--shadows",
        "--shadow-map",
        "--msaa",
        "--supersample",
        "--anisotropy",
        "--depth-range",
        "--time-step",
    ):
        assert option in text
    assert "docs/worker.md" in text


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        pytest.param(["--msaa", "32"], "MSAA samples: 32 is more than", id="more samples than the driver has"),
        pytest.param(["--msaa", "0"], "--msaa", id="no samples"),
        pytest.param(["--supersample", "9"], "--supersample", id="too many samples"),
        pytest.param(["--anisotropy", "17"], "--anisotropy", id="too much anisotropy"),
        pytest.param(["--shadow-map", "3"], "--shadow-map", id="no shadow map"),
        pytest.param(["--depth-range", "0"], "--depth-range", id="no depth"),
    ],
)
def test_a_worker_that_cannot_do_what_its_options_ask_says_so_and_ends(options: list[str], reason: str) -> None:
    command = [sys.executable, "-m", "trompe_renderer", "--port", "0", *options]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode != 0
    assert ended.stdout == ""
    assert reason in ended.stderr
