"""A real service, and Debian's Chromium to look at it with."""

import base64
import io
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import (
    Browser,
    BrowserContext,
    ConsoleMessage,
    Locator,
    Page,
    Request,
    Route,
    expect,
    sync_playwright,
)

from tests.served import Served
from trompe_client import Client
from trompe_shared.api import Result

FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
OTHERS = "ERR_NETWORK_CHANGED"
"""What Chromium reports when something else on the machine adds or removes a network, such as a container's."""


LIMIT = 120_000
"""Milliseconds that a busy machine has for anything."""

REPORTED = """
    (place) => {
        const element = document.querySelector(place);
        window.told = [];
        new MutationObserver(() => window.told.push(element.textContent)).observe(element, {childList: true});
    }
"""
"""Keeps in ``told`` every text that the element shows from now on."""

SMALL: Any = {"grid": True, "azimuths": 3, "elevations": 2, "held_out": 4, "steps": 5, "surrogate": "diffuse"}
"""A job of some seconds."""


class Service(Served):
    """A running service with real attacks. ``token`` opens it if it has one."""

    token: str | None = None

    def client(self) -> Client:
        return Client(self.url, token=self.token)

    def submit(  # type: ignore[override]
        self, *, object: str = "mug", labels: dict[str, str] | None = None, **options: Any
    ) -> str:
        """Submit a small job, on the shipped mug unless told otherwise. Returns its id."""
        with self.client() as client:
            return client.attack(object, label="mug", labels=labels or {}, **SMALL | options).id

    def finished(self, **options: Any) -> str:
        """The id of a small job that has succeeded."""
        job = self.submit(**options)
        with self.client() as client:
            client.job(job).wait(timeout=480)
        return job

    def result(self, job: str) -> Result:
        with self.client() as client:
            return client.job(job).result()


def drop(page: Page, file: Path) -> None:
    """Drop a file on the form, as a hand does."""
    transfer = page.evaluate_handle(
        """([name, bytes]) => {
            const transfer = new DataTransfer();
            transfer.items.add(new File([new Uint8Array(bytes)], name));
            return transfer;
        }""",
        [file.name, list(file.read_bytes())],
    )
    page.dispatch_event("#drop", "drop", {"dataTransfer": transfer})


def turntables(page: Page) -> list[NDArray[np.int16]]:
    """Pixels (H, W, 3) of the pictures of objects on a form."""
    shown = [canvas.evaluate("canvas => canvas.toDataURL()") for canvas in page.locator(".turntable canvas").all()]
    pictures = [Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))) for data in shown]
    return [np.asarray(picture.convert("RGB"), np.int16) for picture in pictures]


def width(image: Locator) -> int:
    """Pixels of a picture from left to right, once it is decoded."""
    found: int = image.evaluate("image => image.decode().then(() => image.naturalWidth)")
    return found


def inaccessible(page: Page) -> dict[str, str]:
    """Serious faults of accessibility, each with its first place."""
    found = Axe().run(page).response["violations"]
    return {each["id"]: each["nodes"][0]["html"] for each in found if each["impact"] in {"serious", "critical"}}


def held_back(page: Page, address: str) -> list[Route]:
    """The requests to an address, held back until they are continued."""
    held: list[Route] = []
    page.route(address, lambda route: held.append(route))
    return held


def slowed(context: BrowserContext, page: Page, *, bytes_per_second: int) -> None:
    network = {"offline": False, "latency": 200, "downloadThroughput": bytes_per_second}
    session = context.new_cdp_session(page)
    session.send("Network.emulateNetworkConditions", network | {"uploadThroughput": bytes_per_second})


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """For a module alone: as long as it lives, no other test could run an event loop."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("There is no Chromium here: apt-get install chromium")
    expect.set_options(timeout=LIMIT)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS, timeout=LIMIT)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def new_service(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Service]:
    """Makes a service, to be entered, with options of ``trompe serve``."""
    return lambda *options: Service(
        tmp_path_factory.mktemp("service") / "data", *options, environment={"OMP_NUM_THREADS": "1"}
    )


@pytest.fixture(scope="session")
def service(new_service: Callable[..., Service]) -> Iterator[Service]:
    with new_service() as service:
        yield service


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    context = browser.new_context(viewport={"width": 1200, "height": 900}, accept_downloads=True)
    context.set_default_timeout(LIMIT)
    yield context
    context.close()


@pytest.fixture
def faults() -> list[str]:
    """What the browser complained of; empty at the end of a good test."""
    return []


@pytest.fixture
def page(context: BrowserContext, faults: list[str]) -> Iterator[Page]:
    """A page that sees to it that nothing is wrong: no error on the console, nothing asked of another host."""
    page = context.new_page()

    def on_console(message: ConsoleMessage) -> None:
        if message.type in {"error", "warning"} and OTHERS not in message.text:
            faults.append(message.text)

    def on_request(request: Request) -> None:
        if not request.url.startswith(("http://127.0.0.1:", "blob:", "data:", "file:")):
            faults.append(f"asked {request.url}")

    page.on("console", on_console)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", on_request)
    yield page
    assert faults == []
