"""The three.js engine: a page in Chromium with software WebGL draws the snapshot. Nothing is asked of a network."""

import shutil
from base64 import b64decode, b64encode
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from click import FloatRange, IntRange
from numpy.typing import NDArray
from playwright.sync_api import Error, Page, Route, sync_playwright

from trompe_renderer.engines.surfaces import (
    ContentCache,
    Surface,
    TextureImage,
    background_pixels,
    clipping_planes,
    rgba_of,
    scene_table,
    sphere_around,
    surfaces_of,
)
from trompe_renderer.world.snapshot import Sky, Snapshot
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError
from trompe_shared.three import FOLDER, LIGHTS, THREE

SCRIPTS: Final = {"page.js": Path(__file__).parent, THREE: FOLDER, LIGHTS: FOLDER}
"""Folders of the scripts by name."""
ORIGIN: Final = "http://three.invalid"
PAGE: Final = '<script type="module" src="page.js"></script>'
START_LIMIT: Final = 60_000
"""Milliseconds until the page is ready."""
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
FLAGS: Final = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-proxy-server",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)


@dataclass(frozen=True)
class ThreeOptions:
    """``tone``: three's tone mapping, with ``exposure``. ``antialias``: 4 samples at edges. ``shadows``: of suns."""

    tone: Literal["none", "aces", "agx", "neutral", "reinhard", "cineon"] = "none"
    exposure: Annotated[float, FloatRange(0, 100)] = 1.0
    antialias: bool = True
    anisotropy: Annotated[int, IntRange(1, 16)] = 1
    shadows: bool = True


class ThreeEngine:
    """Chromium ends with this process. Playwright's errors, of a crashed page for one, are left to the caller."""

    def __init__(self, options: ThreeOptions) -> None:
        self._page = _page()
        revision = self._call("start", asdict(options))
        self.info = EngineInfo("three", f"0.{revision}.0")
        self._kept: ContentCache[str] = ContentCache(lambda key: self._call("drop", key))

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        surfaces = list(surfaces_of(world))
        near, far = clipping_planes(world.camera, [surface.ball for surface in surfaces])
        centre, radius = sphere_around(surfaces)
        background: Any = world.background
        if isinstance(background, Sky):
            background = _text(rgba_of(background_pixels(world, width=width, height=height)))
        table = scene_table(world, surfaces, self._kept, add_mesh=self._add_mesh, add_image=self._add_texture) | {
            "near": near,
            "far": far,
            "centre": centre.tolist(),
            "radius": radius,
            "background": background,
        }
        picture = self._call("draw", table, width, height)
        self._kept.trim()
        return np.frombuffer(b64decode(picture), np.uint8).reshape(height, width, 4)[::-1, :, :3]

    def _call(self, function: str, *arguments: Any) -> Any:
        return self._page.evaluate(f"given => trompe.{function}(...given)", list(arguments))

    def _add_mesh(self, surface: Surface) -> tuple[str, int]:
        part = surface.part
        arrays = {"position": part.vertices, "normal": part.normals, "uv": part.uvs, "index": part.faces}
        self._call("addMesh", surface.key, {name: _text(array) for name, array in arrays.items()})
        return surface.key, sum(array.nbytes for array in arrays.values())

    def _add_texture(self, image: TextureImage) -> tuple[str, int]:
        pixels = image.pixels()
        height, width, _ = pixels.shape
        self._call("addTexture", image.key, width, height, _text(rgba_of(pixels)), image.use == "albedo")
        return image.key, 4 * width * height


def _page() -> Page:
    """A page of this folder in a new Chromium."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)  # else playwright's own, if it is installed
    try:
        browser = sync_playwright().start().chromium.launch(executable_path=path, args=FLAGS)
        page = browser.new_page()
        page.route("**/*", _answer)
        page.goto(f"{ORIGIN}/")
        page.wait_for_function("window.trompe", timeout=START_LIMIT)
    except Error as error:
        raise RendererError(
            f"Chromium cannot be started ({error.message.splitlines()[0]}). "
            "Install it: apt-get install chromium, or playwright install chromium."
        ) from error
    return page


def _answer(route: Route) -> None:
    """Serve the scripts and nothing else."""
    path = route.request.url.removeprefix(f"{ORIGIN}/")
    if not path:
        route.fulfill(body=PAGE, content_type="text/html")
    elif path in SCRIPTS:
        route.fulfill(path=SCRIPTS[path] / path, content_type="text/javascript")
    else:
        route.abort()


def _text(array: NDArray[Any]) -> str:
    return b64encode(array.tobytes()).decode()
