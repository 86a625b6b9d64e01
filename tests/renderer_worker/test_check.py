"""The check names each fault of an adapter, and nothing else; right adapters of many kinds pass."""

import contextlib
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from tests.wire import linear
from tests.worker_process import started
from trompe_renderer.check import REMEDIES, EngineRender, check, questions
from trompe_renderer.command import render
from trompe_renderer.engines.engine import Engine, noise_seed
from trompe_renderer.engines.pyrender import PyrenderEngine, PyrenderOptions
from trompe_renderer.world.model import model_of
from trompe_renderer.world.snapshot import Instance, Snapshot, WorldLight
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import look_rotation
from trompe_shared.sailenv_client import SailenvTarget
from trompe_shared.wavefront import Part

Picture = NDArray[np.uint8]
Levels = NDArray[np.float64]
Aim = Callable[[Snapshot, int, int], Snapshot]
See = Callable[[Levels, Snapshot], Levels]

RANDOM = EngineInfo("random", "1", deterministic=False)


class Remembering:
    """An engine that draws each world once: most faults change only the finished picture."""

    def __init__(self, inner: Engine) -> None:
        self.info, self._inner, self._pictures = inner.info, inner, dict[object, Picture]()

    def render(self, world: Snapshot, *, width: int, height: int) -> Picture:
        shown = tuple((each.model.key, each.pose.tobytes()) for each in world.instances)
        asked = (shown, world.camera.tobytes(), world.lights, world.ambient, world.background, width, height)
        if asked not in self._pictures:
            self._pictures[asked] = self._inner.render(world, width=width, height=height)
        return self._pictures[asked].copy()


class Wrong:
    """An engine with changed worlds (``aim``, given width and height) and pictures (``see``, float, 0 to 255)."""

    def __init__(
        self, inner: Engine, *, aim: Aim | None = None, see: See | None = None, info: EngineInfo | None = None
    ):
        self.inner, self.aim, self.see, self.info = inner, aim, see, info or inner.info

    def render(self, world: Snapshot, *, width: int, height: int) -> Picture:
        shown = world if self.aim is None else self.aim(world, width, height)
        picture = self.inner.render(shown, width=width, height=height)
        if self.see is None:
            return picture
        return np.clip(np.round(self.see(picture.astype(float), world)), 0, 255).astype(np.uint8)


Fault = Callable[[Engine], Engine]


def seen(see: See, info: EngineInfo | None = None) -> Fault:
    return lambda engine: Wrong(engine, see=see, info=info)


def aimed(aim: Aim) -> Fault:
    return lambda engine: Wrong(engine, aim=aim)


def lens(scale: Callable[[float], tuple[float, float]]) -> Fault:
    """Half the width and half the height of what is seen at depth 1, over the right ones, from width / height."""

    def aim(world: Snapshot, width: int, height: int) -> Snapshot:
        return replace(world, camera=world.camera @ np.diag([*scale(width / height), 1, 1]))

    return aimed(aim)


def wide(degrees: float) -> Fault:
    k = np.tan(np.radians(degrees / 2)) / np.tan(np.radians(30))
    return lens(lambda _: (k, k))


def shifted(right: float, down: float) -> Fault:
    """By pixels of a picture that is 160 high: the camera is turned a little."""
    turn, nod = np.arctan(np.array([right, -down]) * np.tan(np.radians(30)) / 80)
    change = np.eye(4)
    change[:3, :3] = look_rotation(np.degrees(turn), np.degrees(nod))
    return aimed(lambda world, *_: replace(world, camera=world.camera @ change))


def lit(change: Callable[[WorldLight, Snapshot], WorldLight]) -> Fault:
    return aimed(lambda world, *_: replace(world, lights=tuple(change(light, world) for light in world.lights)))


def turned(light: WorldLight, matrix: Levels) -> WorldLight:
    x, y, z = (matrix @ np.array(light.direction)).tolist()
    return replace(light, direction=(x, y, z))


def tinted(change: Callable[[Levels], Levels]) -> Fault:
    """Lights of another colour; 0 to 255 in, 0 to 1 out."""

    def other(light: WorldLight, _: Snapshot) -> WorldLight:
        red, green, blue = np.round(255 * change(np.array(light.color, float))).astype(int).tolist()
        return replace(light, color=(red, green, blue))

    return lit(other)


def encoded(light: Levels) -> Levels:
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.clip(light, 1e-9, None) ** (1 / 2.4) - 0.055)


def showing(other: Callable[[Instance], Instance]) -> Fault:
    """Another one in the place of each object."""
    return aimed(lambda world, *_: replace(world, instances=tuple(map(other, world.instances))))


def painted(change: Callable[[Picture], NDArray[Any]]) -> Fault:
    def other(each: Instance) -> Instance:
        images = {name: change(texture) for name, texture in each.model.obj.textures.items()}
        new = {name: np.ascontiguousarray(image).astype(np.uint8) for name, image in images.items()}
        return replace(each, model=model_of(each.model.obj.with_textures(new)))

    return showing(other)


def read(change: Callable[[Levels], Levels]) -> Fault:
    """Textures are read at other coordinates."""

    def moved(part: Part) -> Part:
        return replace(part, uvs=change(part.uvs.astype(float)).astype(np.float32))

    return showing(lambda each: of_parts(each, map(moved, each.model.obj.parts), f"read {id(change)}"))


def of_parts(each: Instance, parts: Iterable[Part], shape: str) -> Instance:
    """The instance with other parts, called ``shape`` in its key."""
    obj = replace(each.model.obj, parts=tuple(parts))
    return replace(each, model=replace(each.model, shape=f"{each.model.shape} {shape}", obj=obj))


def reshaped(change: Callable[[Levels, Levels], Levels]) -> Fault:
    """Corners (faces, 3, 3) of each part changed in the camera's coordinates; also given their depth at the origin."""

    def aim(world: Snapshot, *_: int) -> Snapshot:
        to_world, to_camera = world.camera, np.linalg.inv(world.camera)

        def moved(part: Part) -> Part:
            corners = part.vertices[part.faces].astype(float) @ to_camera[:3, :3].T + to_camera[:3, 3]
            corners = change(corners, to_camera[2, 3]) @ to_world[:3, :3].T + to_world[:3, 3]
            flat = part.faces.ravel()
            return Part(
                part.material,
                corners.reshape(-1, 3).astype(np.float32),
                part.normals[flat],
                part.uvs[flat],
                np.arange(len(flat), dtype=np.int32).reshape(-1, 3),
            )

        shown = [
            of_parts(each, map(moved, each.model.obj.parts), f"{change.__name__} {to_world}")
            for each in world.instances
        ]
        return replace(world, instances=tuple(shown))

    return aimed(aim)


def parallel(corners: Levels, depth: Levels) -> Levels:
    """What a perspective camera sees as another one without perspective sees it."""
    return np.asarray(corners * np.concatenate([np.repeat(corners[..., 2:] / depth, 2, -1), corners[..., 2:] ** 0], -1))


def later_is_nearer(corners: Levels, _: Levels) -> Levels:
    """Each of the eight faces of ``probes.layers`` moves towards the camera along its rays, the last one farthest."""
    return np.asarray(corners * np.linspace(1, 0.5, 8)[:, None, None]) if len(corners) == 8 else corners


def back_to_front(each: Instance) -> Instance:
    parts = (replace(part, faces=part.faces[:, ::-1]) for part in each.model.obj.parts)
    return of_parts(each, parts, "inside out")


def first_texture(each: Instance) -> Instance:
    obj = each.model.obj
    first = obj.textures[min(obj.textures)]
    return replace(each, model=model_of(obj.with_textures(dict.fromkeys(obj.textures, first))))


def on_a_floor(picture: Levels, _: Snapshot) -> Levels:
    picture[-len(picture) // 6 :] = 90
    return picture


def labelled(picture: Levels, _: Snapshot) -> Levels:
    picture[2:9, 2:14] = 255 - picture[2:9, 2:14]
    return picture


BEHIND = WorldLight((0.0, 0.0, 1.0), 0.5)


def turned_world(matrix: list[list[int]]) -> Fault:
    pose = np.eye(4)
    pose[:3, :3] = matrix
    return showing(lambda each: replace(each, pose=pose @ each.pose))


def upright(world: Snapshot, *_: int) -> Snapshot:
    """A camera that looks at the origin, whatever was asked."""
    back = world.camera[:3, 3] / np.linalg.norm(world.camera[:3, 3])
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    camera = world.camera.copy()
    camera[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    return replace(world, camera=camera)


Known = dict[str, Instance]


def keeping(shown: Callable[[Known, Sequence[Instance]], Iterable[Instance]]) -> Fault:
    """Shows ``shown`` of what it keeps, which that may change, and of the world's objects."""

    def wrong(engine: Engine) -> Engine:
        known: Known = {}
        return aimed(lambda world, *_: replace(world, instances=tuple(shown(known, world.instances))))(engine)

    return wrong


def late(known: Known, now: Sequence[Instance]) -> list[Instance]:
    """A repaint shows one picture later."""
    shown = [known.get(each.model.shape, each) for each in now]
    known.update({each.model.shape: each for each in now})
    return shown


def hoarded(known: Known, now: Sequence[Instance]) -> Iterable[Instance]:
    """Never removes an object."""
    known.update({each.model.shape: each for each in now})
    return known.values()


frozen = keeping(lambda known, now: [known.setdefault(each.model.shape, each) for each in now])
by_name = keeping(lambda known, now: [known.setdefault(each.model.obj.name, each) for each in now])


def paint_by_name(engine: Engine) -> Engine:
    """The first texture with a file name is kept for all objects."""
    known: dict[str, Picture] = {}

    def other(each: Instance) -> Instance:
        shown = {name: known.setdefault(name, texture) for name, texture in each.model.obj.textures.items()}
        return replace(each, model=model_of(each.model.obj.with_textures(shown)))

    return showing(other)(engine)


def centred(each: Instance) -> Instance:
    pose = np.eye(4)
    pose[:3, 3] = -np.concatenate([part.vertices for part in each.model.obj.parts]).mean(axis=0)
    return replace(each, pose=pose)


def between(near: float, far: float) -> Aim:
    """Shows objects at these distances alone."""
    return lambda world, *_: world if near < np.linalg.norm(world.camera[:3, 3]) < far else replace(world, instances=())


def grain(sigma: float, seed: Callable[[Snapshot], int | None]) -> See:
    return lambda picture, world: picture + np.random.default_rng(seed(world)).normal(0, sigma, picture.shape)


def one_pixel(engine: Engine) -> Engine:
    """Every other picture differs by one level in one pixel."""
    count = iter(range(10**6))

    def see(picture: Levels, _: Snapshot) -> Levels:
        picture[50, 50, 1] += (-1) ** next(count)
        return picture

    return Wrong(engine, see=see)


def one_behind(engine: Engine) -> Engine:
    """Each picture is of the request before it, as with asynchronous read-back."""
    past: list[Levels] = []

    def see(picture: Levels, _: Snapshot) -> Levels:
        past.append(picture)
        return past[-2:][0]

    return Wrong(engine, see=see)


def adapting(engine: Engine) -> Engine:
    """Its exposure follows the pictures of before."""
    past = [80.0]

    def see(picture: Levels, world: Snapshot) -> Levels:
        exposed = on_object(lambda levels: levels * (1 + 0.0005 * (past[0] - 80)))(picture, world)
        past[0] = picture.mean()
        return exposed

    return Wrong(engine, see=see)


def on_object(change: Callable[[Levels], Levels], *, background: bool = False) -> See:
    """``change`` of all but the background, or of that alone."""

    def see(picture: Levels, world: Snapshot) -> Levels:
        asked = np.round(255 * np.array(world.background))
        behind = (picture == asked).all(axis=-1, keepdims=True)
        return np.where(behind == background, change(picture), picture)

    return see


def metered(shown: bool) -> See:
    """Exposure by the brightness of the picture, or of its object alone (``shown``)."""

    def see(picture: Levels, world: Snapshot) -> Levels:
        there = (picture != np.round(255 * np.array(world.background))).any(axis=-1)
        mean = linear(picture)[there if shown else ...].mean() if there.any() else 0.0
        return on_object(lambda levels: encoded(linear(levels) * 0.3 / (mean + 0.05)))(picture, world)

    return see


def slow(picture: Levels, _: Snapshot) -> Levels:
    time.sleep(0.1)
    return picture


def padded(picture: Levels, _: Snapshot) -> Levels:
    """Rows are read as if they were multiples of four bytes."""
    height, width = picture.shape[:2]
    row = -(-3 * width // 4) * 4
    flat = np.zeros(height * row)
    flat[: picture.size] = picture.ravel()
    return flat.reshape(height, row)[:, : 3 * width].reshape(picture.shape)


def attached(light: WorldLight, world: Snapshot) -> WorldLight:
    return turned(light, world.camera[:3, :3])


def headlight(light: WorldLight, world: Snapshot) -> WorldLight:
    x, y, z = (-world.camera[:3, 2]).tolist()
    return replace(light, direction=(x, y, z))


FAULTS: dict[str, tuple[str, Fault]] = {
    "one pixel": ("not repeatable", one_pixel),
    "grain": ("not repeatable", seen(grain(3, lambda _: None))),
    "one picture behind": ("late picture", one_behind),
    "adaptive exposure": ("not repeatable", adapting),
    "exposure by the whole picture": ("exposure", seen(metered(shown=False))),
    "exposure by the object": ("exposure", seen(metered(shown=True))),
    "noise without seed": ("noise not numbered", seen(grain(3, lambda _: None), RANDOM)),
    "noise with a constant seed": ("noise number ignored", seen(grain(3, lambda _: 7), RANDOM)),
    "noise declared, and none": ("noise number ignored", seen(lambda picture, _: picture, RANDOM)),
    "mirrored": ("mirrored", seen(lambda picture, _: picture[:, ::-1])),
    "upside down": ("upside down", seen(lambda picture, _: picture[::-1])),
    "v flipped": ("v flipped", painted(lambda texture: texture[::-1])),
    "u flipped": ("u flipped", painted(lambda texture: texture[:, ::-1])),
    "transposed": ("texture turned", painted(lambda texture: texture.swapaxes(0, 1))),
    "wrapped at vertices": ("texture turned", read(lambda uvs: uvs % 1)),
    "clamped": ("texture not repeated", read(lambda uvs: uvs.clip(0, 1))),
    "repeated by mirroring": ("texture not repeated", read(lambda uvs: np.abs((uvs + 1) % 2 - 1))),
    "no textures": ("untextured", painted(lambda texture: np.full_like(texture, 180))),
    "61 degrees": ("field of view", wide(61)),
    "62 degrees": ("field of view", wide(62)),
    "45 degrees": ("field of view", wide(45)),
    "59 degrees": ("field of view", wide(59)),
    "a square camera": ("aspect", lens(lambda aspect: (1 / aspect, 1))),
    "4 percent too narrow": ("aspect", lens(lambda aspect: (1.04, 1))),
    "horizontal field of view": ("aspect", lens(lambda aspect: (1 / aspect, 1 / aspect))),
    "field of view of the shorter side": ("aspect", lens(lambda aspect: (1 / min(aspect, 1),) * 2)),
    "padded rows": ("sheared", seen(padded)),
    "BGR": ("channel order", seen(lambda picture, _: picture[..., ::-1])),
    "GBR": ("channel order", seen(lambda picture, _: picture[..., [1, 2, 0]])),
    "encoded twice": ("gamma twice", seen(on_object(lambda picture: encoded(picture / 255)))),
    "not encoded": ("gamma missing", seen(on_object(lambda picture: 255 * linear(picture)))),
    "8 times as bright in sRGB": ("overexposed", seen(on_object(lambda picture: 8 * picture))),
    "8 times as bright": ("overexposed", seen(on_object(lambda picture: encoded(np.clip(8 * linear(picture), 0, 1))))),
    "texture not decoded": ("texture not decoded", painted(lambda texture: np.round(encoded(texture / 255)))),
    "decoded twice": ("texture decoded twice", painted(lambda texture: np.round(255 * linear(texture.astype(float))))),
    "half a pixel right": ("shifted", shifted(0.5, 0)),
    "half a pixel up": ("shifted", shifted(0, -0.5)),
    "left and down": ("shifted", shifted(-2, 3)),
    "frozen": ("frozen texture", frozen),
    "late": ("late texture", keeping(late)),
    "earlier objects": ("stale scene", keeping(hoarded)),
    "cached by name": ("stale object", by_name),
    "textures cached by file name": ("stale texture", paint_by_name),
    "centred": ("moved object", showing(centred)),
    "cut off at 0.2 m": ("clipped", aimed(between(0.2, 100))),
    "cut off at 5 m": ("clipped", aimed(between(0.01, 5))),
    "light reversed": ("light reversed", lit(lambda light, _: turned(light, -np.eye(3)))),
    "light mirrored": ("light direction", lit(lambda light, _: turned(light, np.diag([-1, 1, 1])))),
    "z up": ("light direction", lit(lambda light, _: turned(light, np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])))),
    "camera light": ("light follows camera", lit(attached)),
    "headlight": ("light follows camera", lit(headlight)),
    "no light": ("light missing", lit(lambda light, _: replace(light, intensity=0.0))),
    "constant light": ("light intensity", lit(lambda light, _: replace(light, intensity=0.6))),
    "pi times as strong": ("light balance", lit(lambda light, _: replace(light, intensity=np.pi * light.intensity))),
    "divided by pi": ("light balance", lit(lambda light, _: replace(light, intensity=light.intensity / np.pi))),
    "white light": ("light colour", tinted(np.ones_like)),
    "BGR light": ("light colour", tinted(lambda levels: levels[::-1] / 255)),
    "light colour decoded": ("light colour", tinted(linear)),
    "light colour encoded": ("light colour", tinted(lambda levels: encoded(levels / 255) / 255)),
    "a sky of its own": ("extra light", aimed(lambda world, *_: replace(world, ambient=(world.ambient[0] + 0.2,) * 3))),
    "textures as they are without lights": (
        "not shaded",
        aimed(lambda world, *_: world if world.lights else replace(world, ambient=(1.0, 1.0, 1.0))),
    ),
    "no ambient light": ("ambient missing", aimed(lambda world, *_: replace(world, ambient=(0.0, 0.0, 0.0)))),
    "3 levels off": ("background", seen(on_object(lambda asked: asked + 3 * np.sign(127 - asked), background=True))),
    "background not encoded": ("background", seen(on_object(lambda asked: 255 * linear(asked), background=True))),
    "z up world": ("axes", turned_world([[1, 0, 0], [0, 0, -1], [0, 1, 0]])),
    "from behind": ("axes", turned_world([[-1, 0, 0], [0, 1, 0], [0, 0, -1]])),
    "left-handed world": ("axes", turned_world([[-1, 0, 0], [0, 1, 0], [0, 0, 1]])),
    "looks at the origin": ("camera", aimed(upright)),
    "no perspective": ("orthographic", reshaped(parallel)),
    "no depth test": ("depth", reshaped(later_is_nearer)),
    "culls the front": ("inside out", showing(back_to_front)),
    "one texture for all parts": ("parts", showing(first_texture)),
    "the first part alone": ("parts", showing(lambda each: of_parts(each, each.model.obj.parts[:1], "first"))),
    "a floor": ("extra object", seen(on_a_floor)),
    "a label": ("extra object", seen(labelled)),
    "a lamp behind": ("extra light", aimed(lambda world, *_: replace(world, lights=(*world.lights, BEHIND)))),
    "nothing": ("invisible", aimed(lambda world, *_: replace(world, instances=()))),
}
"""Name in the check, and fault, of wrong adapters."""

SAID = {
    "half a pixel right": r"0\.5\d pixels too far right\.",
    "half a pixel up": r"0\.5\d pixels too far up\.",
    "62 degrees": r"is 62\.0 degrees, not 60\.",
    "horizontal field of view": r"1\.3\d x 1\.3\d in a wide picture, 0\.7\d x 0\.7\d in a tall",
    "light mirrored": r"from azimuth 60, elevation 35 seems to come from azimuth -[56]\d, elevation [23]\d",
    "one pixel": "differ in 1 pixel, by up to [12] levels?",
}
"""What the check says of some of them."""


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Remembering(PyrenderEngine(PyrenderOptions()))


@pytest.fixture(autouse=True)
def _never_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine may be held up: that is no fault of an adapter."""
    monkeypatch.setattr(questions, "SLOW", 600.0)


def faults(engine: Engine) -> dict[str, str]:
    """Level and words of all that is not right, by name."""
    found = [each for each in check(EngineRender(engine), engine.info) if each.level != "ok"]
    return {each.name: f"{each.level}: {each.seen}" for each in found if each.name != "stopped"}


@pytest.mark.parametrize("case", FAULTS)
def test_the_fault_of_an_adapter_is_named_with_its_figure_and_no_other(case: str, engine: Engine) -> None:
    name, fault = FAULTS[case]
    found = faults(fault(engine))
    assert set(found) == {name}
    assert re.search("^fault: .*" + SAID.get(case, ""), found[name]), found


def reinhard(light: Levels) -> Levels:
    return light / (1 + light)


def aces(light: Levels) -> Levels:
    """Narkowicz's fit."""
    return np.clip(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), 0, 1)


def agx(light: Levels) -> Levels:
    """three.js's, with its polynomial; linear light out."""
    into = np.array(
        [[0.842479, 0.0784336, 0.0792237], [0.0423303, 0.878469, 0.0791661], [0.0423745, 0.0784336, 0.879142]]
    )
    x = np.clip((np.log2(np.clip(light @ into.T, 1e-10, None)) + 12.47393) / 16.5, 0, 1)
    curve = np.polyval([15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232], x)
    return np.asarray(np.clip(curve @ np.linalg.inv(into).T, 0, None) ** 2.2)


def toned(curve: Callable[[Levels], Levels]) -> Fault:
    return seen(on_object(lambda picture: encoded(np.clip(curve(linear(picture)), 0, 1))))


def grained(engine: Engine) -> Engine:
    """A film: ACES's curve and strong, numbered grain, over all."""
    return Wrong(toned(aces)(engine), see=grain(6, noise_seed), info=RANDOM)


def composited_in_light(engine: Engine) -> Engine:
    """Edges mix linear light, as path tracers do."""

    def see(picture: Levels, world: Snapshot) -> Levels:
        height, width = picture.shape[:2]
        large = engine.render(world, width=2 * width, height=2 * height).astype(float)
        return encoded(linear(large).reshape(height, 2, width, 2, 3).mean(axis=(1, 3)))

    return Wrong(engine, see=see)


RIGHT: dict[str, Fault] = {
    **{curve.__name__: toned(curve) for curve in (reinhard, aces, agx)},
    "film with grain": grained,
    "edges mixed in linear light": composited_in_light,
    "gamma 2.0": seen(on_object(lambda picture: 255 * (picture / 255) ** (2.2 / 2.0))),
    "a warm tint": seen(on_object(lambda picture: picture * [1, 0.9, 0.75])),
    "60.3 degrees": wide(60.3),
    "0.15 pixels": shifted(0.15, -0.15),
}


@pytest.mark.parametrize("adapter", RIGHT.values(), ids=RIGHT)
def test_a_right_adapter_passes(adapter: Fault, engine: Engine) -> None:
    assert not faults(adapter(engine))


@pytest.mark.parametrize("setting", ["msaa=1", "supersample=2", "anisotropy=8", "shadows=no"])
def test_our_own_engine_passes_with_all_settings(setting: str) -> None:
    with started("--set", setting) as worker, contextlib.closing(SailenvTarget(*worker.address)) as target:
        assert {each.level for each in check(target.render, target.engine)} == {"ok"}


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("mirrored", "v flipped"),
        ("upside down", "light reversed"),
        ("BGR", "62 degrees"),
        ("texture not decoded", "frozen"),
        ("texture not decoded", "encoded twice"),
        ("a square camera", "padded rows"),
        ("half a pixel right", "a square camera"),
        ("noise with a constant seed", "camera light"),
        ("3 levels off", "earlier objects"),
        ("no ambient light", "looks at the origin"),
        ("white light", "8 times as bright"),
    ],
)
def test_two_faults_at_once_are_both_named(one: str, other: str, engine: Engine) -> None:
    (first, spoil), (second, spoil_too) = FAULTS[one], FAULTS[other]
    assert set(faults(spoil_too(spoil(engine)))) == {first, second}


def test_light_on_encoded_colours_is_a_warning(engine: Engine) -> None:
    old = FAULTS["not encoded"][1](FAULTS["texture not decoded"][1](engine))
    levels = {each.name: each.level for each in check(EngineRender(old), old.info)}
    assert levels.pop("light on encoded colours") == "warning"
    assert set(levels.values()) == {"ok"}


def test_a_slow_adapter_is_told_by_a_warning(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "SLOW", 0.1)
    (told,) = (each for each in check(EngineRender(seen(slow)(engine)), engine.info) if each.level != "ok")
    assert (told.level, told.name) == ("warning", "slow")


def test_each_fault_has_a_test_and_a_remedy() -> None:
    tested = {name for name, _ in FAULTS.values()} | {"slow", "light on encoded colours"}
    assert tested == set(REMEDIES)
    assert set(SAID) <= set(FAULTS)


@pytest.mark.parametrize("kind", ["worker", "plain_worker"])
def test_a_running_renderer_is_checked_over_its_socket_with_and_without_extensions(
    kind: str, request: pytest.FixtureRequest
) -> None:
    host, port = request.getfixturevalue(kind)
    found = CliRunner().invoke(render, ["--check", f"{host}:{port}"])
    assert found.exit_code == 0, found.output
    assert found.output.splitlines()[-1] == "No fault."
    assert found.output.startswith("sailenv\n" if kind == "plain_worker" else "pyrender 0")


def test_an_engine_of_ones_own_is_checked_by_the_command_and_fails_it(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from trompe_renderer.engines.pyrender import PyrenderEngine, PyrenderOptions\n\n\n"
        "class Mirrored(PyrenderEngine):\n"
        "    def __init__(self):\n        super().__init__(PyrenderOptions())\n\n"
        "    def render(self, world, *, width, height):\n"
        "        return super().render(world, width=width, height=height)[:, ::-1]\n"
    )
    command = [sys.executable, "-m", "trompe_renderer", "--engine", "mine:Mirrored", "--check"]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert found.returncode == 1
    lines = found.stdout.splitlines()
    assert lines[0] == "mine:Mirrored " + version("pyrender")
    assert [line for line in lines if not line.startswith("ok")][1:] == [
        "FAULT    mirrored: Left and right are exchanged. Flip the columns: picture[:, ::-1]. "
        "Trompe's world is right-handed.",
        "1 fault.",
    ]


@pytest.mark.parametrize("address", ["somewhere", "127.0.0.1:99999", "a..b:9", "127.0.0.1:9"])
def test_the_check_says_what_it_cannot_reach(address: str) -> None:
    found = CliRunner().invoke(render, ["--check", address])
    assert found.exit_code == 1
    assert re.search("expected HOST:PORT|There is no renderer at 127.0.0.1:9 ", found.output)
