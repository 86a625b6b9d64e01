"""A real service, and Debian's Chromium to look at it with."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, sync_playwright

from trompe_client import Client
from trompe_shared.api import Job, JobRequest

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
OTHERS = "ERR_NETWORK_CHANGED"
"""What Chromium reports when something else on the machine adds or removes a network, such as a container's."""


SMALL = {"pool": 0, "azimuths": 3, "elevations": 2, "held_out": 4, "steps": 5}
"""A job of some seconds."""


class Service:
    """The service on ``folder``; ``token`` opens it where it has one."""

    def __init__(self, folder: Path, *, token: str | None = None) -> None:
        self.folder, self.token, self.port = folder, token, 0
        self._process: subprocess.Popen[str] | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Start it, on the port that it had before."""
        command = [sys.executable, "-m", "trompe_client.cli", "serve", "--data", str(self.folder), "--port"]
        self._process = subprocess.Popen(
            [*command, str(self.port)], stdout=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
        )
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if match := re.search(r"serving on http://127\.0\.0\.1:(\d+)", line):
                self.port = int(match[1])
                self._reader = threading.Thread(target=self._drain, daemon=True)
                self._reader.start()
                return
        raise RuntimeError("trompe serve ended before it was up")

    def stop(self) -> None:
        """End it as Ctrl-C does."""
        process = self._process
        if process is not None and process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.wait(60)
            self._reader.join()

    def client(self) -> Client:
        return Client(self.url, token=self.token)

    def submit(self, *, labels: dict[str, str] | None = None, **options: Any) -> str:
        """Submit a small job on the shipped mug; its id."""
        spec = {"object": "mug", "label": "mug", "labels": labels or {}} | SMALL | options
        with self.client() as client:
            return client.submit(JobRequest.model_validate(spec)).id

    def finished(self, **options: Any) -> str:
        """The id of a small job that has ended well."""
        job = self.submit(**options)
        with self.client() as client:
            client.job(job).wait(timeout=240)
        return job

    def state(self, job: str) -> Job:
        with self.client() as client:
            return client.job(job).status

    def _drain(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for _ in lines:
                pass


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """For a module alone: as long as it lives, no other test could run an event loop."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("There is no Chromium here: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def new_service(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Service]:
    """A service of its own, to be entered."""
    return lambda: Service(tmp_path_factory.mktemp("service"))


@pytest.fixture(scope="session")
def service(new_service: Callable[[], Service]) -> Iterator[Service]:
    with new_service() as service:
        yield service


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    context = browser.new_context(viewport={"width": 1200, "height": 900}, accept_downloads=True)
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
        if not request.url.startswith(("http://127.0.0.1:", "blob:")):
            faults.append(f"asked {request.url}")

    page.on("console", on_console)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", on_request)
    yield page
    assert faults == []
