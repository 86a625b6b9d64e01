"""The pages as people use them: a real service, a real browser."""

import json
import re
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserContext, Page, expect

from trompe_shared.shipped import shipped_objects

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def done(service: Any) -> str:
    """A job that has ended well, in an experiment."""
    job: str = service.finished(labels={"experiment": "tries"})
    return job


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


def test_the_start_page_shows_an_example_before_there_is_any_job(service: Any, page: Page) -> None:
    received: list[int] = []
    page.on(
        "response", lambda response: received.append(len(response.body())) if "stream" not in response.url else None
    )

    page.goto(service.url)

    expect(page.get_by_role("heading", level=1)).to_contain_text("mug")
    for kind in ("before", "after"):
        assert page.locator(f"trompe-viewer img.{kind}").evaluate(
            "image => image.decode().then(() => image.naturalWidth)"
        )
    assert sum(received) < 200_000


def test_a_file_is_dropped_watched_and_its_result_opened(
    service: Any, page: Page, tmp_path: Path, context: BrowserContext
) -> None:
    file = tmp_path / "my_teapot.zip"
    file.write_bytes(shipped_objects()["teapot"].read())
    page.goto(f"{service.url}/jobs/new")

    drop(page, file)
    expect(page.locator("#file-says")).to_contain_text("triangles")
    expect(page.locator(".turntable")).to_be_visible(timeout=30_000)
    page.fill("[name=label]", "teapot")
    page.check("[name=preset][value=fast]")
    page.get_by_role("button", name="Submit").click()
    page.wait_for_url(re.compile(r"/jobs/[0-9a-f]+$"))

    expect(page.locator("[data-field=step]")).to_contain_text("of", timeout=120_000)
    page.reload()
    expect(page.get_by_role("heading", name="What the classifier sees")).to_be_visible(timeout=240_000)
    assert "my_teapot" in page.inner_text("h1")


def test_a_wrong_file_and_a_wrong_class_are_told_in_the_servers_words(
    service: Any, page: Page, tmp_path: Path, faults: list[str]
) -> None:
    page.goto(f"{service.url}/jobs/new")
    file = tmp_path / "notes.zip"
    file.write_bytes(b"no zip at all")

    drop(page, file)
    expect(page.locator('[data-error="object"]')).to_contain_text("zip")
    expect(page.locator("#file-says")).to_contain_text("not taken")

    page.fill("[name=label]", "elephant")
    page.get_by_role("button", name="Submit").click()
    expect(page.locator(".error:visible").last).to_contain_text("elephant")
    faults.clear()  # browsers report answers of 422 on the console


def asked_when(page: Page, select: str, value: str) -> dict[str, Any]:
    """What the form asks the server to check once ``value`` was chosen."""
    with page.expect_request("**/v1/jobs/check") as checked:
        page.select_option(select, value)
    asked: dict[str, Any] = json.loads(checked.value.post_data or "")
    return asked


def test_the_scope_of_saliency_is_asked_for_with_a_threshold(service: Any, page: Page, faults: list[str]) -> None:
    page.goto(f"{service.url}/jobs/new")
    page.select_option("[name=object]", "mug")
    page.fill("[name=label]", "mug")
    page.get_by_text("More options").click()
    assert "saliency_scope" not in asked_when(page, "[name=saliency_scope]", "each_view")

    page.fill("[name=tau]", "0.2")
    asked = asked_when(page, "[name=attack_on]", "texture")
    assert (asked["tau"], asked["saliency_scope"]) == (0.2, "each_view")
    assert asked_when(page, "[name=saliency_scope]", "all_views")["saliency_scope"] == "all_views"
    assert {"tau", "saliency_scope"}.isdisjoint(asked_when(page, "[name=attack_on]", "light"))
    expect(page.locator(".error:visible")).to_have_count(0)

    page.select_option("[name=attack_on]", "texture")
    page.fill("[name=tau]", "2")
    asked_when(page, "[name=saliency_scope]", "each_view")
    expect(page.locator('[data-error="tau saliency_scope"]')).to_contain_text("less than 1")
    faults.clear()  # browsers report answers of 422 on the console


def test_the_divider_and_the_views_are_dragged(service: Any, page: Page, done: str) -> None:
    page.goto(f"{service.url}/jobs/{done}")
    stage = page.locator("trompe-viewer .stage")
    box = stage.bounding_box()
    assert box is not None

    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + 50)
    page.mouse.up()
    assert float(page.input_value("trompe-viewer input[aria-label^=Divider]")) == pytest.approx(20, abs=1)

    first = page.get_attribute("trompe-viewer img.after", "src")
    page.get_by_label("View", exact=True).focus()
    page.keyboard.press("ArrowRight")
    assert page.get_attribute("trompe-viewer img.after", "src") != first
    page.get_by_label("difference").check()
    assert "difference" in (page.get_attribute("trompe-viewer img.after", "src") or "")


def test_a_picture_of_the_strip_opens_the_same_view(service: Any, page: Page, done: str) -> None:
    page.goto(f"{service.url}/jobs/{done}")
    button = page.locator(".strip button").nth(3)

    button.click()

    shown = button.locator("img").get_attribute("src")
    assert page.get_attribute("trompe-viewer img.after", "src") == shown
    says = (button.locator("span").inner_text()).split(" ", 1)[1]
    assert says in page.inner_text("trompe-viewer .sides")


def test_everything_is_downloaded_as_one_zip(service: Any, page: Page, done: str, tmp_path: Path) -> None:
    page.goto(f"{service.url}/jobs/{done}")

    with page.expect_download() as download:
        page.get_by_role("link", name="Everything as one zip").click()

    download.value.save_as(tmp_path / "all.zip")
    with zipfile.ZipFile(tmp_path / "all.zip") as archive:
        assert json.loads(archive.read("result.json"))["object"] == "mug"


def test_the_page_of_a_result_says_what_the_result_says(service: Any, page: Page, done: str) -> None:
    with service.client() as client:
        result = client.job(done).result()

    page.goto(f"{service.url}/jobs/{done}")

    row = page.locator("tr", has=page.get_by_role("rowheader", name="target", exact=True))
    assert row.locator("td").all_inner_texts()[:3] == [
        str(result.target.views),
        f"{result.target.a_before:.2f}",
        f"{result.target.a_after:.2f}",
    ]
    assert page.locator(".strip li").count() == len(result.views)
    kept = sum(view.after == result.label for view in result.views)
    assert page.locator(".strip li.kept").count() == kept


def test_a_running_job_is_cancelled_from_the_list(service: Any, page: Page) -> None:
    job = service.submit(steps=5000)
    page.goto(f"{service.url}/jobs")

    page.locator(f"#job-{job}").get_by_role("button", name="Cancel").click()

    expect(page.locator(f"#job-{job} .state")).to_have_text("cancelled", timeout=60_000)


def test_a_new_job_appears_in_the_list_by_itself(service: Any, page: Page, done: str) -> None:
    page.goto(f"{service.url}/jobs")
    expect(page.locator(f"#job-{done}")).to_be_visible()

    job = service.submit(steps=1)

    expect(page.locator(f"#job-{job}")).to_be_visible(timeout=15_000)
    expect(page.locator(f"#job-{job} .state")).to_have_text("succeeded", timeout=120_000)


def test_two_jobs_are_compared(service: Any, page: Page, done: str) -> None:
    other = service.finished(epsilon=0.2)
    page.goto(f"{service.url}/jobs")

    for job in (done, other):
        page.locator(f"#job-{job}").get_by_role("checkbox").check()
    page.get_by_role("link", name="Compare the two").click()

    differing = page.locator("tr.differs th").all_inner_texts()
    assert "epsilon" in differing
    assert "seed" not in differing
    row = page.locator("tr", has=page.get_by_role("rowheader", name="classifier", exact=True))
    expect(row.locator("td")).to_have_text(["tiny", "tiny"])


def test_an_experiment_shows_its_jobs_as_points_that_open(service: Any, page: Page, done: str) -> None:
    page.goto(f"{service.url}/experiments")
    page.get_by_role("link", name="tries").click()

    page.locator(".chart a").first.click()

    assert page.url == f"{service.url}/jobs/{done}"


def test_a_job_that_is_not_there_is_told_on_a_page(service: Any, page: Page, faults: list[str]) -> None:
    page.goto(f"{service.url}/jobs/0123456789abcdef")

    expect(page.get_by_role("heading", level=1)).to_have_text("Not Found")
    faults.clear()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_serious_fault_of_accessibility(service: Any, browser: Browser, done: str, scheme: Any) -> None:
    context = browser.new_context(color_scheme=scheme)
    page = context.new_page()
    for path in (
        "/",
        "/jobs",
        "/jobs/new",
        f"/jobs/{done}",
        f"/jobs/compare?a={done}&b={done}",
        "/experiments/tries",
        "/login",
    ):
        page.goto(service.url + path)
        page.wait_for_timeout(500)
        found = Axe().run(page).response["violations"]
        serious = {each["id"]: each["nodes"][0]["html"] for each in found if each["impact"] in {"serious", "critical"}}
        assert serious == {}, path
    context.close()


def test_nothing_is_wider_than_a_phone(service: Any, browser: Browser, done: str) -> None:
    context = browser.new_context(viewport={"width": 360, "height": 740})
    page = context.new_page()
    for path in ("/", "/jobs", "/jobs/new", f"/jobs/{done}", "/experiments/tries"):
        page.goto(service.url + path)
        assert page.evaluate("document.documentElement.scrollWidth") <= 360, path
    context.close()


def test_a_server_that_restarts_in_mid_job_is_waited_for(service: Any, page: Page, faults: list[str]) -> None:
    job = service.submit(steps=400, epsilon=0.004)  # so little that it does not win all views and end early
    page.goto(f"{service.url}/jobs/{job}")
    expect(page.locator("[data-field=step]")).to_contain_text("of", timeout=120_000)

    expect(page.locator("#preview img")).to_be_visible(timeout=60_000)
    assert page.locator("#preview img").evaluate("image => image.naturalWidth / image.naturalHeight") == 2

    service.stop()
    expect(page.locator("#notice")).to_contain_text("lost", timeout=15_000)
    service.start()

    expect(page.get_by_role("heading", name="What the classifier sees")).to_be_visible(timeout=240_000)
    faults.clear()  # the browser reports the lost connection


@pytest.fixture(scope="module")
def guarded(new_service: Any) -> Iterator[Any]:
    """A service with a token that may read."""
    with new_service() as service:
        command = [sys.executable, "-m", "trompe_client.cli", "token", "create", "me", "--right", "read", "--json"]
        made = subprocess.run([*command, "--data", str(service.folder)], capture_output=True, text=True, check=True)
        service.token = json.loads(made.stdout)["secret"]
        time.sleep(2)  # the server looks for new tokens every second
        yield service


def test_with_tokens_it_asks_for_one_and_goes_on_to_where_one_wanted(
    guarded: Any, page: Page, faults: list[str]
) -> None:
    page.goto(f"{guarded.url}/jobs")
    assert page.url == f"{guarded.url}/login?next=/jobs"
    page.fill("[name=token]", "trompe_wrong")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("no valid token")
    faults.clear()  # the answer's status is 401

    page.fill("[name=token]", guarded.token)
    page.get_by_role("button", name="Sign in").click()

    expect(page.get_by_role("heading", level=1)).to_have_text("Jobs")
    page.goto(f"{guarded.url}/jobs/new")
    page.select_option("[name=object]", "mug")
    page.get_by_role("button", name="Submit").click()
    expect(page.locator(".error:visible")).to_contain_text("may only read")

    page.get_by_role("button", name="Sign out").click()
    page.goto(f"{guarded.url}/jobs")
    assert "/login" in page.url
    faults[:] = [fault for fault in faults if "403" not in fault]  # of the job, and of the check before it
