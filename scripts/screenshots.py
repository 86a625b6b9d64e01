"""Take the documentation's pictures of all pages of a running server, which may be a fresh one.

    python scripts/screenshots.py --server http://127.0.0.1:8000 [--classifier mobilenet_v2.pt2] [--out FOLDER]

Needs Chromium. Submits the jobs of the pictures, unless an earlier call did: an attack on the shipped teapot with
``--classifier``, on the shipped mug without; four on the mug as an experiment; a judgement; one that is still running.
"""

import argparse
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Literal

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from trompe_client import Client, JobHandle

OUT: Final = Path(__file__).parents[1] / "docs" / "images" / "pages"
FLAGS: Final = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
]
LOOKS: Final[Mapping[str, tuple[int, int, Literal["light", "dark"]]]] = {
    "": (1280, 800, "light"),
    "-dark": (1280, 800, "dark"),
    "-phone": (390, 800, "light"),
}
"""Ending of the file: width and height in pixels, and colours."""
LIMIT: Final = 300_000
"""Milliseconds that a busy machine has for a page."""
SHOWN: Final = "pictures"
"""Key of the label that names the job of a picture."""
EXPERIMENT: Final = "tau"
FAST: Final[Mapping[str, Any]] = {"pool": 60, "steps": 25, "held_out": 30}
WEAK: Final[Mapping[str, Any]] = {"epsilon": 0.004, "steps": 5000}
"""A job that does not end meanwhile."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="http://127.0.0.1:8000")
    parser.add_argument("--classifier", type=Path, help="a .pt2 file that knows ImageNet's classes")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("Chromium is missing; on Debian: apt-get install chromium")
    options.out.mkdir(parents=True, exist_ok=True)
    with Client(options.server) as client, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        shoot_all(browser, options.server, pages(client, options.classifier), options.out)
        live = running(client)
        shoot_all(browser, options.server, {"live": f"/jobs/{live.id}"}, options.out)
        browser.close()
        live.cancel()


def shoot_all(browser: Browser, server: str, shown: Mapping[str, str], out: Path) -> None:
    """Save pictures of the pages ``shown``, which have paths by name, in all looks."""
    for look, (width, height, scheme) in LOOKS.items():
        page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
        page.set_default_timeout(LIMIT)
        for name, path in shown.items():
            shoot(page, server + path, out / f"{name}{look}.png")
        page.close()


def pages(client: Client, classifier: Path | None) -> dict[str, str]:
    """Paths of the pages by the name of their picture; waits for the jobs that they show."""
    victim: dict[str, Any] = {"classifier": str(classifier)} if classifier else {}
    attacked = "teapot" if classifier else "mug"
    result = ensured(client, "result", lambda labels: client.attack(attacked, label=attacked, labels=labels, **victim))
    grid = [
        ensured(
            client,
            f"{EXPERIMENT}-{epsilon}-{tau}",
            lambda labels, given={"epsilon": epsilon, "tau": tau}: client.attack(
                "mug", label="mug", labels=labels | {"experiment": EXPERIMENT}, **FAST, **given
            ),
        )
        for epsilon in (0.05, 0.1)
        for tau in (None, 0.2)
    ]
    judgement = ensured(
        client,
        "judgement",
        lambda labels: client.judge("mug", f"job:{grid[-1].id}", label="mug", networks=["tiny"], labels=labels),
    )
    return {
        "start": "/",
        "new": "/jobs/new",
        "jobs": "/jobs",
        "result": f"/jobs/{result.id}",
        "compare": f"/jobs/compare?job={grid[1].id}&job={grid[2].id}",
        "new-judgement": "/judgements/new",
        "judgement": f"/jobs/{judgement.id}",
        "experiments": "/experiments",
        "experiment": f"/experiments/{EXPERIMENT}",
        "api": "/docs",
        "sign-in": "/login",
    }


def ensured(client: Client, name: str, submit: Callable[[dict[str, str]], JobHandle]) -> JobHandle:
    """The job of the picture ``name`` that has succeeded; submitted now unless an earlier call did."""
    labels = {SHOWN: name}
    job = next(client.jobs(state="succeeded", labels=labels), None) or submit(labels)
    print(f"{name}: job {job.id}", flush=True)
    return job.wait()


def running(client: Client) -> JobHandle:
    """A job that has taken some steps."""
    job = client.attack("mug", label="mug", labels={SHOWN: "live"}, **WEAK)
    for event in job.events():
        if (event.progress.step or 0) > 20:
            break
    return job


def shoot(page: Page, address: str, file: Path) -> None:
    """Save a picture of the page at ``address``, two seconds after it was loaded; of a result also its 3D view."""
    page.goto(address)
    start = page.get_by_role("button", name="Show it in 3D")
    if start.is_visible():
        start.click()
        page.wait_for_selector("trompe-orbit[data-answered]")
        turned = file.with_stem(f"{file.stem}-3d")
        page.locator("trompe-orbit").screenshot(path=turned)
        shrink(turned)
    for caption in page.get_by_text("The target renderer is drawing it.").all():
        caption.wait_for(state="hidden")
    page.wait_for_timeout(2000)
    page.evaluate("scrollTo(0, 0)")
    page.screenshot(path=file)
    shrink(file)
    print(file)


def shrink(file: Path) -> None:
    """Save a picture again with 256 colours: a third of the bytes."""
    with Image.open(file) as image:
        small = image.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    small.save(file, optimize=True)


if __name__ == "__main__":
    main()
