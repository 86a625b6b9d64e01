"""All engines by the properties of their pictures, through real workers; and what each tells of itself."""

import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from trimesh.creation import uv_sphere

from tests.documentation import blocks
from tests.made_objects import CANDLE, FLAG, GLASS, LATTICE, lantern
from tests.served import descendants, process_table, wait_until
from tests.surfaces import object_of, quad
from tests.wire import Wire, boxes, linear, on_screen, plain
from tests.worker_process import Worker, started
from trompe_renderer.engines.engine import draw
from trompe_renderer.engines.loading import ENGINES, engine_maker
from trompe_server.formats import read_object
from trompe_server.renderers import SailenvTarget
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError
from trompe_shared.geometry import FIELD_OF_VIEW, Camera, Light, View
from trompe_shared.object3d import Object3D

SETTINGS: Final = {"mitsuba": ["samples=32"], "cycles": ["samples=32"]}
RANDOM: Final = {"mitsuba", "cycles"}
PACKAGES: Final = {"three": "playwright", "cycles": "bpy"}
BLENDER: Final = os.environ.get("TROMPE_BLENDER_PYTHON", sys.executable)
"""A Python with bpy."""
SIZE: Final = (60, 80)
AMBIENT: Final = Light(intensity=0.0, ambient=1.0)
BEHIND: Final = (9, 200, 77)
OWN: Final = "tests.renderer_worker.noisy_engine:Noisy"

Picture = NDArray[np.float64]


def options_of(name: str) -> list[str]:
    """Options of a worker with an engine that is installed here; skips the test otherwise."""
    if name == "cycles":
        found = subprocess.run([BLENDER, "-c", "import importlib.util as u; exit(not u.find_spec('bpy'))"], check=False)
        if found.returncode:
            pytest.skip("no bpy: TROMPE_BLENDER_PYTHON names a Python that has it")
        return [*(f"--set={each}" for each in SETTINGS["cycles"]), f"--set=python={BLENDER}", "--engine=cycles"]
    if importlib.util.find_spec(PACKAGES.get(name, name)) is None:
        pytest.skip(f"NOT TESTED: {name}. {ENGINES[name][1]}")
    return [*(f"--set={each}" for each in SETTINGS.get(name, [])), f"--engine={name}"]


@pytest.fixture(scope="module")
def running() -> Iterator[dict[str, Worker]]:
    """Workers by their engine; tests share them."""
    with ExitStack() as stack:

        class Running(dict[str, Worker]):
            def __missing__(self, name: str) -> Worker:
                self[name] = stack.enter_context(started(*options_of(name)))
                return self[name]

        yield Running()


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def shown(engine: str, running: dict[str, Worker]) -> Iterator[SailenvTarget]:
    with closing(SailenvTarget(*running[engine].address, timeout=240)) as target:
        yield target


def picture(target: SailenvTarget, obj: Object3D, camera: Camera, light: Light = AMBIENT, **more: Any) -> Picture:
    """(H, W, 3), 0 to 255."""
    options: dict[str, Any] = {"background": BEHIND, "noise": 1, "size": SIZE} | more
    size = options.pop("size")
    image: Picture = target.render(obj, [View(camera, light, **options)], size=size)[0].astype(float)
    return image


@cache
def sphere(radius: float) -> Object3D:
    """A white ball, smooth."""
    corners = radius * np.array(uv_sphere(count=(48, 96)).triangles)
    return object_of((corners, np.full((len(corners), 3, 2), 0.5), plain(255, 255, 255)))


def test_a_texture_is_upright_not_mirrored_and_repeats(shown: SailenvTarget) -> None:
    colors = np.array([[[250, 20, 20], [20, 250, 20]], [[20, 20, 250], [250, 250, 250]]], np.uint8)
    texture = colors.repeat(32, axis=0).repeat(32, axis=1)
    once, twice = (object_of(quad(texture, repeat=repeat)) for repeat in (1, 2))
    image = picture(shown, once, Camera(0.5, 0, 0))
    corners = [image[row, column] for row in (24, 36) for column in (34, 46)]
    assert np.abs(np.array(corners).reshape(2, 2, 3) - colors).max() < 70  # 20 is read as 80 by a glossy material
    again = picture(shown, twice, Camera(0.5, 0, 0))
    starts = [again[row, column] for row in (21, 33) for column in (31, 43)]  # of each repetition, its first quarter
    assert np.abs(np.array(starts) - colors[0, 0]).max() < 70
    assert (image[0] == BEHIND).all()


@pytest.mark.parametrize(("size", "radius"), [((90, 120), 0.1), ((130, 70), 2e-4), ((90, 120), 1e5)])
def test_the_outline_of_a_sphere_of_any_size_is_where_the_field_of_view_puts_it(
    size: tuple[int, int], radius: float, shown: SailenvTarget
) -> None:
    distance, row, column = 4.2 * radius, size[0] // 2, size[1] // 2
    image = picture(shown, sphere(radius), Camera(distance, 30, 20), size=size, background=(0, 0, 0))
    covered = image[..., 1] > 0.5 * np.median(image[row - 9 : row + 9, column - 9 : column + 9, 1])
    expected = size[0] / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2)) * radius / np.sqrt(distance**2 - radius**2)
    for line, side in ((covered.any(axis=1), size[0]), (covered.any(axis=0), size[1])):
        first, last = np.flatnonzero(line)[[0, -1]]
        assert first == pytest.approx(side / 2 - expected, abs=1.0)
        assert last + 1 == pytest.approx(side / 2 + expected, abs=1.0)
    assert np.sqrt(covered.sum() / np.pi) == pytest.approx(expected, abs=0.5)


def test_light_comes_from_its_side_with_its_colour(shown: SailenvTarget) -> None:
    ball, camera = sphere(0.1), Camera(0.4, 0, 0)
    right = picture(shown, ball, camera, Light(90, 0, 0.8, 0.1, (255, 128, 0)))
    height, width = SIZE
    lit, dark = right[height // 2, width // 2 + 10], right[height // 2, width // 2 - 10]
    assert lit[0] > lit[1] > lit[2]
    assert lit[0] > dark[0] + 50
    above = picture(shown, ball, camera, Light(0, 80, 0.8, 0.1))
    assert above[height // 2 - 10, width // 2].min() > above[height // 2 + 10, width // 2].max() + 50
    unlit = picture(shown, ball, camera, Light(180, 0, 0.8, 0.1))
    assert linear(unlit[height // 2, width // 2]).mean() == pytest.approx(0.1, abs=0.02)


def test_white_reflects_the_intensity_and_linear_light_follows_albedo(shown: SailenvTarget) -> None:
    def light(albedo: int, intensity: float) -> float:
        obj = object_of(quad(plain(albedo, albedo, albedo)))
        image = picture(shown, obj, Camera(0.5, 0, 0), Light(0, 0, intensity, 0.0))
        return float(linear(image[25:35, 35:45]).mean())

    assert light(255, 1.0) > 0.938
    assert light(255, 0.5) == pytest.approx(0.5, abs=0.05)
    dark, middle, bright = (light(albedo, 0.9) for albedo in (90, 150, 200))
    steps = np.diff(linear(np.array([90.0, 150.0, 200.0])))
    assert (bright - middle) / (middle - dark) == pytest.approx(steps[1] / steps[0], rel=0.06)


def test_a_repaint_changes_its_surface_alone(shown: SailenvTarget) -> None:
    box, camera = boxes(), Camera(0.3, 0, 0)
    other = box.with_textures({"front_albedo.png": plain(20, 40, 60)})
    before, after = (picture(shown, obj, camera, Light(0, 0, 0.5, 0.3)) for obj in (box, other))
    changed = np.abs(before - after).max(axis=-1) > 30
    assert changed[25:35, 35:45].all()
    assert not changed[:8].any()
    hidden = box.with_textures({"back_albedo.png": plain(255, 255, 255)})
    assert (picture(shown, hidden, camera, Light(0, 0, 0.5, 0.3)) == before).all()
    assert (picture(shown, box, camera, Light(0, 0, 0.5, 0.3)) == before).all()


@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (1, 128, 254)], ids=str)
def test_the_background_is_exact(color: tuple[int, int, int], shown: SailenvTarget) -> None:
    image = picture(shown, boxes(), Camera(0.5, 20, 10), background=color)
    assert (image[:10] == color).all()
    assert (image != color).any()


def test_equal_noise_numbers_give_equal_bytes(engine: str, shown: SailenvTarget) -> None:
    first, again, other = (picture(shown, boxes(), Camera(0.3, 40, 30), Light(20, 40), noise=n) for n in (1, 1, 2))
    assert (first == again).all()
    assert (first != other).any() == (engine in RANDOM)
    assert np.abs(first - other).mean() < 5


@pytest.mark.thorough
def test_several_objects_and_a_point_light_are_drawn_as_by_pyrender(engine: str, running: dict[str, Worker]) -> None:
    images = []
    for name in ("pyrender", engine):
        with closing(Wire(running[name].address, size=(60, 80))) as wire:
            wire.ask("set_ambient_light_color", color=(60, 60, 60))
            wire.ask("set_light_intensity", light="Main Light", intensity=0.3)
            for x in (-0.12, 0.12):
                wire.spawn(boxes(((0, 0, 0), (0.05, 0.05, 0.05))), position=(x, 0.0, 0.0), rotation=(20.0, 30.0, 0.0))
            wire.look(Camera(0.45, 0, 15))
            images.append(wire.picture().astype(float))
            wire.ask("change_scene", scene="room_01/scene")
            for light in ("Main Light", "Rim Light"):
                wire.ask("set_light_intensity", light=light, intensity=0.0)
            wire.ask("set_ambient_light_color", color=(0, 0, 0))
            wire.ask("set_light_color", light="Ceiling Light", color=(255, 60, 60))
            wire.ask("set_light_position", light="Ceiling Light", position=(0.0, 1.8, 0.2))
            images.append(wire.picture().astype(float))
    for ours, theirs in ((images[0], images[2]), (images[1], images[3])):
        assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.9
    assert images[3][..., 0].mean() > images[3][..., 1].mean() + 5


@pytest.mark.parametrize("engine", ["pyrender", "three"])
def test_a_surface_casts_a_shadow_if_light_meets_its_front(shown: SailenvTarget) -> None:
    white, camera, size = plain(255, 255, 255), Camera(0.6, -50, 20), (120, 160)
    corners, uvs, _ = quad(white, half=0.03, z=0.1)
    sun = Light(azimuth=40, elevation=0, intensity=0.8, ambient=0.2)
    points = np.array([[-0.1 * np.tan(np.radians(40)), y, 0] for y in (0, 0.07)])  # one behind the small square
    levels = []
    for small in (corners, corners[:, ::-1]):
        image = picture(shown, object_of(quad(white), (small, uvs, white)), camera, sun, size=size)
        levels.append([image[row, column].mean() for column, row in on_screen(camera, points, size).astype(int)])
    (shadow, beside), turned = levels
    assert shadow < 0.7 * beside
    assert np.ptp([*turned, beside]) < 5


def test_surfaces_show_what_is_behind_them(shown: SailenvTarget) -> None:
    camera, size = Camera(0.8, 0, 0), (160, 160)
    image = picture(shown, read_object(lantern(opacity=0.4), name="lantern.glb").obj, camera, size=size)
    expected = {
        (0, 0, 0): 0.4 * np.array(GLASS) + 0.6 * np.array(CANDLE),  # a pane before the candle
        (0, 0.2, 0): BEHIND,  # the hole of the lattice
        (0.08, 0.2, 0): LATTICE,
        (0.15, 0, 0): FLAG,
    }
    for point, color in expected.items():
        column, row = np.rint(on_screen(camera, np.array(point), size)).astype(int)
        around = image[row - 1 : row + 2, column - 1 : column + 2].mean(axis=(0, 1))
        assert np.abs(around - color).max() < 60, point


@pytest.mark.parametrize(
    ("normal", "light"),
    [
        pytest.param((218, 128, 218), (60, 0), id="x"),
        pytest.param((128, 218, 218), (0, 60), id="y", marks=pytest.mark.thorough),
    ],
)
def test_a_normal_map_turns_the_surface_to_the_light(
    normal: tuple[int, int, int], light: tuple[int, int], engine: str, shown: SailenvTarget
) -> None:
    if engine == "panda3d":
        pytest.xfail("normal maps are left out (docs/engines.md)")
    gray = {"front": plain(128, 128, 128)}
    bumpy, flat = (boxes(textures=gray, maps={"normal": plain(*each)}) for each in (normal, (128, 128, 255)))
    towards, away = Light(*light, 0.8, 0.0), Light(-light[0], -light[1], 0.8, 0.0)
    images = [picture(shown, bumpy, Camera(0.3, 0, 0), towards), picture(shown, flat, Camera(0.3, 0, 0), towards)]
    images.append(picture(shown, bumpy, Camera(0.3, 0, 0), away))
    turned, straight, averted = (image[28:32, 38:42].mean() for image in images)
    assert turned > straight + 10 > averted + 20


def test_each_engine_tells_who_it_is(engine: str, running: dict[str, Worker], shown: SailenvTarget) -> None:
    info = shown.engine
    assert info.name == engine
    assert "llvmpipe" not in info.settings
    assert info.version[0].isdigit()
    assert info.deterministic == (engine not in RANDOM)
    assert all(each in info.settings for each in SETTINGS.get(engine, []))


def test_pictures_of_a_graphics_card_are_told_from_those_of_a_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    platform = pytest.importorskip("trompe_renderer.engines.pyrender.platform")
    monkeypatch.setattr(platform.GL, "glGetString", lambda _: b"A card/PCIe/SSE2")
    info = engine_maker("pyrender", {})().info
    assert (info.name, info.settings) == ("pyrender", "A card/PCIe/SSE2")


def test_an_engine_of_ones_own_has_its_name_its_options_and_the_noise() -> None:
    views = [View(Camera(0.3, 0, 0), noise=number) for number in (1, 1, 2, 2**31)]
    worker = "--engine", OWN, "--set", "level=20", "--set", "spread=200"
    with started(*worker) as running, closing(SailenvTarget(*running.address)) as target:
        greys = target.render(boxes(), views, size=SIZE)[:, 0, 0, 0]
        assert target.engine == EngineInfo(OWN, "7", "level=20, spread=200.0", deterministic=False)
    assert greys[0] == greys[1]
    assert len(set(greys.tolist())) == 3


def test_the_documented_engine_runs(tmp_path: Path) -> None:
    ((_, code),) = blocks("engines.md", "python")
    (tmp_path / "points.py").write_text(code)
    worker = started("--engine", "points:Points", "--set", "size=3", folder=tmp_path)
    with worker as running, closing(SailenvTarget(*running.address)) as target:
        image = picture(target, boxes(((0.05, 0.04, 0), (0.02, 0.02, 0.02))), Camera(0.3, 0, 0))
        assert str(target.engine) == "points:Points 1 (size=3)"
    rows, columns = np.nonzero((image != BEHIND).any(axis=-1))
    assert rows.max() < SIZE[0] / 2
    assert columns.min() > SIZE[1] / 2


@pytest.mark.parametrize(
    ("name", "settings", "reason"),
    [
        pytest.param("unreal", {}, "There is no engine 'unreal'. Choose pyrender, three", id="an unknown engine"),
        pytest.param("nowhere:Engine", {}, "cannot be imported.*PYTHONPATH", id="an unknown module"),
        pytest.param("json:loads", {}, "not an engine", id="no engine"),
        pytest.param(
            "pyrender", {"mssa": "4"}, r"no option 'mssa'.*msaa \(1 to 32, default 4\)", id="an unknown option"
        ),
        pytest.param("pyrender", {"msaa": "0"}, "--set msaa: 0 is not in the range", id="out of range"),
        pytest.param("pyrender", {"shadows": "perhaps"}, "--set shadows: 'perhaps' is not", id="no boolean"),
        pytest.param(OWN, {"level": "much"}, r"--set level: 'much'.*spread \(float, default 50", id="by keyword"),
        pytest.param(f"{__name__}:Unknown", {}, "types of Unknown are unknown.*'Later'", id="a type without an import"),
        pytest.param("mitsuba", {"filter": "sinc"}, "--set filter: 'sinc' is not one of 'gaussian'", id="a choice"),
    ],
)
def test_a_wrong_engine_or_option_is_refused(name: str, settings: dict[str, str], reason: str) -> None:
    if name == "mitsuba":
        pytest.importorskip("mitsuba", reason="NOT TESTED: pip install mitsuba")
    with pytest.raises(RendererError, match=reason):
        engine_maker(name, settings)


def test_a_missing_package_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("playwright.sync_api", "trompe_renderer.engines.three", "trompe_renderer.engines.three.engine"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(RendererError, match=r"engine three cannot be imported.*pip install 'trompe\[three\]'"):
        engine_maker("three", {})


def test_an_engine_may_draw_all_pictures_into_the_same_memory() -> None:
    canvas = np.zeros((2, 3, 3), np.uint8)

    def render(world: Any, **_: int) -> NDArray[np.uint8]:
        canvas[:] = world
        return canvas

    engine: Any = SimpleNamespace(info=EngineInfo("canvas", "1"), render=render)
    pictures = [draw(engine, level, width=3, height=2) for level in (1, 2)]  # type: ignore[arg-type]
    assert [int(each.mean()) for each in pictures] == [1, 2]


class NoInfo:
    info: Any = None

    def render(self) -> None: ...


class Tuples(NoInfo):
    info = EngineInfo("blender", (4, 2, 0))  # type: ignore[arg-type]


class Fixed(NoInfo):
    @property
    def info(self) -> EngineInfo:
        return EngineInfo("fixed", "1")


class Unknown(NoInfo):
    def __init__(self, size: "Later" = 2) -> None: ...  # type: ignore[name-defined]  # noqa: F821


@pytest.mark.parametrize(
    ("kind", "reason"),
    [(NoInfo, "no attribute"), (Tuples, "version: Input should be a valid string"), (Fixed, "setter")],
)
def test_an_engine_without_a_usable_identity_is_refused(kind: type[NoInfo], reason: str) -> None:
    with pytest.raises(RendererError, match=f"needs an attribute `info`.*{reason}"):
        engine_maker(f"{__name__}:{kind.__name__}", {})()


def test_a_picture_of_the_wrong_kind_is_refused() -> None:
    worker = started("--engine", OWN, "--set", "wrong=yes")
    refused = pytest.raises(RendererError, match=r"Noisy gave float32 \(60, 80, 3\); expected uint8")
    with worker as running, closing(SailenvTarget(*running.address)) as target, refused:
        picture(target, boxes(), Camera(0.3, 0, 0))


@pytest.mark.parametrize("name", ["three", "cycles"])
def test_a_worker_ends_with_the_process_of_its_engine(name: str, tmp_path: Path) -> None:
    with (tmp_path / "log").open("w+") as log, started(*options_of(name), log=log) as worker:
        with closing(SailenvTarget(*worker.address, timeout=240)) as target:
            picture(target, boxes(), Camera(0.3, 0, 0))
            for child in descendants(worker.process.pid):
                with suppress(ProcessLookupError):  # it may have ended with the one before
                    os.kill(child, signal.SIGKILL)
            with pytest.raises(RendererError):
                picture(target, boxes(), Camera(0.3, 0, 0))
        assert worker.process.wait(240) == os.EX_TEMPFAIL
        log.seek(0)
        assert "The engine is lost" in log.read()


@pytest.mark.parametrize("name", ["three", "cycles"])
def test_the_process_of_an_engine_ends_with_its_worker(name: str, running: dict[str, Worker]) -> None:
    worker = running[name]
    with closing(SailenvTarget(*worker.address, timeout=240)) as target:
        picture(target, boxes(), Camera(0.3, 0, 0))
    left = descendants(worker.process.pid)
    assert left
    del running[name]  # no other test gets a dead worker
    worker.process.kill()
    wait_until(lambda: not process_table().keys() & left)
