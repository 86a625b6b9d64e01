"""Take the documentation's pictures of the pages of a running server.

    python scripts/screenshots.py --server http://127.0.0.1:8000 [--out docs/images/pages]

Needs Chromium. Shows the latest two jobs that succeeded, and their experiment if they have one.
"""

import argparse
import shutil
import sys
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Final, Literal
from urllib.parse import quote

from playwright.sync_api import Page, sync_playwright

from trompe_client import Client

OUT: Final = Path(__file__).parents[1] / "docs" / "images" / "pages"
FLAGS: Final = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
]
HEIGHT: Final = 1250
LOOKS: Final[Mapping[str, tuple[int, Literal["light", "dark"]]]] = {
    "": (1100, "light"),
    "-dark": (1100, "dark"),
    "-phone": (390, "light"),
}
"""Ending of the file: width in pixels and colours."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="http://127.0.0.1:8000")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("Chromium is missing; on Debian: apt-get install chromium")
    options.out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for look, (width, scheme) in LOOKS.items():
            page = browser.new_page(viewport={"width": width, "height": HEIGHT}, color_scheme=scheme)
            for name, path in pages(options.server).items():
                shoot(page, options.server + path, options.out / f"{name}{look}.png")
        browser.close()


def pages(server: str) -> Mapping[str, str]:
    """Paths of the pages by the name of their picture."""
    with Client(server) as client:
        done = [handle.status for handle in islice(client.jobs(state="succeeded"), 2)]
    if len(done) < 2:
        sys.exit("The server needs two jobs that succeeded; submit some with trompe attack.")
    experiments = {job.labels["experiment"] for job in done if "experiment" in job.labels}
    grid = {"experiment": f"/experiments/{quote(experiments.pop())}"} if experiments else {}
    compared = f"/jobs/compare?job={done[0].id}&job={done[1].id}"
    return {
        "start": "/",
        "new": "/jobs/new",
        "jobs": "/jobs",
        "result": f"/jobs/{done[0].id}",
        "compare": compared,
        **grid,
    }


def shoot(page: Page, address: str, file: Path) -> None:
    """Save a picture of the page at ``address``, two seconds after it was opened; of a result also its 3D view."""
    page.goto(address)
    start = page.get_by_role("button", name="Show it in 3D")
    if start.is_visible():
        start.click()
        page.wait_for_selector("trompe-orbit[data-answered]")
        page.locator("trompe-orbit").screenshot(path=file.with_stem(f"{file.stem}-3d"))
    page.wait_for_timeout(2000)
    page.evaluate("scrollTo(0, 0)")
    page.screenshot(path=file)
    print(file)


if __name__ == "__main__":
    main()
