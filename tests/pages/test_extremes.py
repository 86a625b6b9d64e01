"""What is large, on the pages: ten thousand jobs, two thousand views, an object of 30 MB."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench.job_list import fill
from bench.pages import served
from PIL import Image
from playwright.sync_api import BrowserContext, Page, expect

from tests.pages.conftest import REPORTED, Service, slowed, turntables, width
from tests.pages.test_orbit import opened, pixels, turned
from tests.server.api.conftest import running
from trompe_server.formats import write_glb
from trompe_server.job.protocol import VIEWS_AFTER, VIEWS_BEFORE
from trompe_server.settings import Settings
from trompe_server.storage.arrays import pack_arrays, unpack_arrays
from trompe_shared.api import Result
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects

pytestmark = [pytest.mark.timeout(1200), pytest.mark.thorough]

MANY = 10_000
VIEWS = 1000
"""Of each kind; the most that a job may ask for."""
LARGE = 30_000_000
"""Bytes of a large object."""


@pytest.fixture
def many(tmp_path: Path) -> Iterator[str]:
    """Address of a server with ten thousand jobs."""
    with running(Settings(data=tmp_path, rate_limit=1e6)) as api:
        fill(api.services.store, MANY)
        with served(api.app) as client:
            yield str(client.base_url).rstrip("/")


def test_ten_thousand_jobs_are_listed_a_page_at_a_time(many: str, page: Page) -> None:
    page.goto(f"{many}/jobs")
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(50)
    assert page.locator("[name=state] option").all_inner_texts()[:3] == ["all", "queued (100)", "running (0)"]
    newest = rows.first.get_attribute("id")
    assert newest == f"job-{MANY:016x}"
    assert page.evaluate("document.documentElement.outerHTML.length") < 200_000

    page.get_by_role("link", name="Older").click()
    expect(rows.first).to_have_attribute("id", f"job-{MANY - 50:016x}")
    page.get_by_role("link", name="Newest").click()
    expect(rows.first).to_have_attribute("id", newest)

    page.fill("[name=label]", "run:run-0")
    page.get_by_role("button", name="Show").click()
    expect(rows.first).to_have_attribute("id", f"job-{499:016x}")
    expect(rows).to_have_count(50)
    page.get_by_label("Find on this page").fill("no such object")
    expect(page.locator("tbody tr:visible")).to_have_count(0)


@pytest.fixture
def vast(service: Service) -> tuple[str, Result]:
    """A result of two thousand views: those of a small job again and again, from other sides."""
    job = service.finished(held_out=8, steps=1)
    folder = service.folder(job) / "1"
    result = Result.model_validate_json((folder / "result.json").read_bytes())
    generator = np.random.default_rng(0)

    def repeated(views: list[Any]) -> list[Any]:
        places = zip(generator.uniform(0, 360, VIEWS), generator.uniform(0, 80, VIEWS), strict=True)
        return [
            views[k % len(views)].model_copy(update={"azimuth": azimuth, "elevation": elevation})
            for k, (azimuth, elevation) in enumerate(places)
        ]

    views, held_out = repeated(result.views), repeated(result.held_out_views)
    result = result.model_copy(update={"views": views, "held_out_views": held_out})
    (folder / "result.json").write_text(result.model_dump_json())
    for name in (VIEWS_BEFORE, VIEWS_AFTER):
        images = unpack_arrays((folder / f"{name}.npz").read_bytes())
        more = {kind: np.resize(shown, (VIEWS, *shown.shape[1:])) for kind, shown in images.items()}
        (folder / f"{name}.npz").write_bytes(pack_arrays(more))
    return job, result


def test_a_result_shows_and_keeps_two_thousand_views(service: Service, page: Page, vast: tuple[str, Result]) -> None:
    job, result = vast
    answer = page.goto(f"{service.url}/jobs/{job}")
    assert answer is not None
    assert len(answer.body()) < 2_500_000
    assert (page.locator(".sphere circle").count(), page.locator(".sphere rect").count()) == (VIEWS, VIEWS)
    widths = page.eval_on_selector_all(".sphere circle", "all => all.map(each => Number(each.getAttribute('r')))")
    assert max(widths) < 4

    page.get_by_label("View", exact=True).focus()
    page.keyboard.press("End")
    last = max(range(VIEWS), key=lambda k: (result.held_out_views[k].azimuth % 360, result.held_out_views[k].elevation))
    shown = page.locator("trompe-viewer img.after")
    expect(shown).to_have_attribute("src", f"/jobs/{job}/pictures/held_out/{last}/after.png")
    assert width(shown) == result.image_size[1]
    confidence = result.held_out_views[last].after_confidence
    assert f"{confidence:.0%}" in page.inner_text("trompe-viewer .sides")

    page.locator(".sphere rect").last.click()
    expect(shown).to_have_attribute("src", re.compile(f"/jobs/{job}/pictures/own/\\d+/after.png"))
    file = service.http.get(f"/jobs/{job}/result.html")
    assert len(file.content) < 8_000_000


def large(folder: Path) -> Path:
    """A GLB of 30 MB: the mug with camera noise on a texture of many texels."""
    mug = load_object(shipped_objects()["mug"].read())
    ((name, texture),) = mug.textures.items()
    side = 3400
    noise = np.random.default_rng(0).integers(-40, 41, (side, side, 3))
    painted = np.asarray(Image.fromarray(texture).resize((side, side)), np.int64) + noise
    file = folder / "large.glb"
    file.write_bytes(write_glb(mug.with_textures({name: painted.clip(0, 255).astype(np.uint8)})))
    return file


def test_an_object_of_30_megabytes_is_sent_with_its_progress_attacked_and_turned(
    service: Service, page: Page, context: BrowserContext, tmp_path: Path
) -> None:
    file = large(tmp_path)
    assert file.stat().st_size > LARGE
    page.goto(f"{service.url}/jobs/new")
    expect(page.locator(".turntable figcaption")).to_have_text("In the target renderer")
    page.evaluate(REPORTED, "#file-says")
    slowed(context, page, bytes_per_second=10_000_000)
    page.set_input_files("#file", file)
    expect(page.locator("#file-says")).to_contain_text("triangles")
    told = page.evaluate("window.told")
    assert [each for each in told if re.search(r"large.glb: [1-9]\d? % uploaded", each)]
    assert "large.glb: the server reads it" in told
    expect(page.locator(".turntable figcaption")).to_have_text("In the target renderer")
    assert 500 < (turntables(page)[0].min(axis=2) < 200).sum() < 40_000

    views = {"azimuths": 1, "elevations": 1, "held_out": 1}
    job = service.finished(object=page.locator("[name=object]").input_value(), **views)
    page.goto(f"{service.url}/jobs/{job}")
    page.evaluate(REPORTED, "trompe-orbit [role=status]")
    opened(page, page.url)
    for azimuth in (0, 90):
        turned(page, {"azimuth": azimuth})
        before, after = pixels(page, (64, 64))
        assert np.abs(before - after).max() > 4
