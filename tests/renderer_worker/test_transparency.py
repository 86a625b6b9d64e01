"""Blended, masked and double-sided surfaces of a GLB, as the worker shows them."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.made_objects import CANDLE, FLAG, GLASS, LATTICE, lantern
from tests.surfaces import with_alpha
from tests.wire import Wire, on_screen
from trompe_server.formats import read_object
from trompe_server.renderers import SailenvTarget
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (160, 160)
GREY = (90, 90, 90)
AMBIENT = Light(intensity=0.0, ambient=1.0)
OPACITY = 0.4
FRONT, BACK = Camera(0.8, 0, 0), Camera(0.8, 180, 0)
Colour = NDArray[np.float64]


@pytest.fixture(scope="module")
def made() -> Object3D:
    return read_object(lantern(opacity=OPACITY), name="lantern.glb").obj


def colour_at(
    target: SailenvTarget, obj: Object3D, camera: Camera, point: tuple[float, float, float], **options: Any
) -> Colour:
    """Mean colour around a point of the world."""
    (picture,) = target.render(obj, [View(camera, AMBIENT, background=GREY, **options)], size=SIZE)
    column, row = np.rint(on_screen(camera, np.array(point), SIZE)).astype(int)
    return np.asarray(picture[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0))


def over(*layers: tuple[int, int, int], behind: tuple[int, int, int]) -> Colour:
    """Layers of ``OPACITY``, the front one first, over a colour."""
    colour = np.array(behind, float)
    for layer in reversed(layers):
        colour = OPACITY * np.array(layer) + (1 - OPACITY) * colour
    return colour


@pytest.mark.parametrize("camera", [FRONT, BACK], ids=["from the front", "from behind"])
@pytest.mark.parametrize(
    ("point", "expected"),
    [
        pytest.param((0, 0, 0), over(GLASS, behind=CANDLE), id="one pane before the candle, whatever its alpha"),
        pytest.param((0.065, 0, 0), over(GLASS, GLASS, behind=GREY), id="two panes before the background"),
        pytest.param((0, 0.2, 0), np.array(GREY), id="the hole of the lattice"),
        pytest.param((0.08, 0.2, 0), np.array(LATTICE), id="the lattice, both sides"),
        pytest.param((0.15, 0, 0), np.array(FLAG), id="the flag, both sides"),
    ],
)
def test_surfaces_show_what_is_behind_them_by_their_alpha_mode(
    camera: Camera, point: tuple[float, float, float], expected: Colour, made: Object3D, target: SailenvTarget
) -> None:
    assert np.abs(colour_at(target, made, camera, point) - expected).max() < 6


def test_glass_casts_no_shadow(made: Object3D, target: SailenvTarget) -> None:
    """Light from above passes the glass around the candle, whose top would show half of its colour in a shadow."""
    lit = View(Camera(0.8, 0, 40), Light(azimuth=0, elevation=80), background=GREY)
    (picture,) = target.render(read_object(lantern(opacity=0.02), name="lantern.glb").obj, [lit], size=SIZE)
    column, row = np.rint(on_screen(lit.camera, np.array([0, 0.06, 0.02]), SIZE)).astype(int)
    assert picture[row, column, 0] >= CANDLE[0]


def test_a_repaint_of_glass_shows_through_it(made: Object3D, target: SailenvTarget) -> None:
    albedo = made.materials["glass"].albedo
    red = made.with_textures({albedo: np.full_like(made.textures[albedo], (255, 0, 0))})
    seen = [colour_at(target, obj, FRONT, (0, 0, 0)) for obj in (made, red, made)]
    assert np.abs(seen[1] - over((255, 0, 0), behind=CANDLE)).max() < 6
    assert (seen[0] == seen[2]).all()


def test_the_same_paint_with_another_alpha_is_another_object(target: SailenvTarget) -> None:
    solid = read_object(lantern(opacity=1.0), name="lantern.glb").obj
    name = solid.materials["glass"].albedo
    clear = with_alpha(solid, name, np.full((64, 64), 200, np.uint8))
    seen = [colour_at(target, obj, FRONT, (0, 0, 0)) for obj in (solid, clear, solid)]
    assert np.abs(seen[0] - GLASS).max() < 6
    assert np.abs(seen[1] - (200 * np.array(GLASS) + 55 * np.array(CANDLE)) / 255).max() < 6
    assert (seen[0] == seen[2]).all()


@pytest.mark.parametrize("background", [(200, 100, 0), (-1, -1, -1)], ids=["a colour", "the sky"])
def test_clear_glass_changes_hardly_a_pixel_of_what_is_behind_it_but_its_labels(
    background: tuple[int, int, int], agent: Wire
) -> None:
    agent.ask("set_clear_color", color=background)
    agent.look(FRONT)
    size = agent.size
    column, row = np.rint(on_screen(FRONT, np.array([[0.065, 0, 0], [0, 0.2, 0]]), size)).astype(int).T
    before = agent.picture().astype(int)
    agent.spawn(read_object(lantern(opacity=0.02), name="lantern.glb").obj)
    after, mask = agent.picture().astype(int), agent.mask()
    column = size[1] - 1 - column  # Unity's picture is the mirror image
    assert np.abs(after - before)[row, column].max() <= 12
    assert mask[row, column].tolist() == [True, False]
    assert (agent.picture() == after).all()
