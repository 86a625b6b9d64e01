"""The pages as people use them: a real service, a real browser."""

import io
import json
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Page, Response, expect

from tests.pages.conftest import LIMIT, REPORTED, Service, drop, held_back, inaccessible, slowed, turntables, width
from tests.served import wait_until
from trompe_shared.api import OPTIONS, JobRequest
from trompe_shared.shipped import shipped_objects

pytestmark = pytest.mark.timeout(1200)


MEANS = """
    <ir_version: 10, opset_import: ["": 18]>
    means (float[n, 3, 32, 32] image) => (float[n, 3] logits) {
        pooled = GlobalAveragePool(image)
        logits = Flatten(pooled)
    }
"""
"""A network: the means of the image's channels."""


@pytest.fixture(scope="module")
def done(service: Service) -> str:
    """A job that has ended well, in an experiment."""
    return service.finished(labels={"experiment": "tries"})


@pytest.fixture(scope="module")
def stronger(service: Service) -> str:
    """Another job, of a larger epsilon and an object with a long name."""
    with service.client() as client:
        mug = client.upload_object(shipped_objects()["mug"].path, name=f"mug{100 * 'W'}")
    return service.finished(object=mug.id, epsilon=0.2, steps=1)


def test_the_start_page_shows_an_example_before_there_is_any_job(service: Service, page: Page) -> None:
    responses: list[Response] = []
    page.on("response", lambda response: responses.append(response))

    page.goto(service.url)

    expect(page.get_by_role("heading", level=1)).to_contain_text("teapot")
    before, after = (int(share) for share in re.findall(r"in (\d+)%", page.inner_text(".lead")))
    assert before - after >= 70
    expect(page.locator(".hero")).to_contain_text("trompe attack teapot --label teapot --classifier mobilenet_v2.pt2")
    for kind in ("before", "after"):
        assert width(page.locator(f"trompe-viewer img.{kind}"))
    assert sum(len(each.body()) for each in responses if "stream" not in each.url) < 150_000


def test_a_wrong_file_and_a_wrong_class_are_told_in_the_servers_words(
    service: Service, page: Page, tmp_path: Path, faults: list[str]
) -> None:
    page.goto(f"{service.url}/jobs/new")
    file = tmp_path / "notes.zip"
    file.write_bytes(b"no zip at all")

    drop(page, file)
    expect(page.locator('[data-error="object"]')).to_contain_text("zip")
    expect(page.locator("#file-says")).to_contain_text("refused")
    page.fill("[name='goal.label']", "mug")
    for place, field, told, epsilon in (
        ("#file", "object", "zip", "0.1"),
        ("#classifier-file", "victim.classifier", "not a supported classifier", "0.2"),
    ):
        page.set_input_files(place, file)
        expect(page.locator(f'[data-error^="{field}"]')).to_contain_text(told)
        with page.expect_response("**/v1/jobs/check"):
            page.fill("[name='paint.epsilon']", epsilon)
        page.wait_for_timeout(500)  # for the answer's effect
        expect(page.locator(f'[data-error^="{field}"]')).to_be_visible()
    expect(page.locator('[data-error="object"]')).to_be_visible()
    page.select_option("[name=object]", "mug")
    page.select_option("[name='victim.classifier']", "tiny")
    expect(page.locator(".error:visible")).to_have_count(0)

    for label, told in (("", "Field required"), ("elephant", "elephant")):
        page.fill("[name='goal.label']", label)
        page.get_by_role("button", name="Submit").click()
        expect(page.locator(".error:visible").last).to_contain_text(re.compile(f"^{told}|'{told}'"))
    faults.clear()  # browsers report answers of 422 on the console


@pytest.mark.parametrize(("form", "place"), [("jobs", "#classifier-file"), ("judgements", "[data-for=networks]")])
def test_a_network_is_uploaded_with_the_names_of_its_classes(
    service: Service, page: Page, tmp_path: Path, form: str, place: str
) -> None:
    net, names = tmp_path / "means.onnx", tmp_path / "names.json"
    onnx.save(onnx.parser.parse_model(MEANS), net)
    names.write_text(json.dumps(["red", "green", "blue"]))
    page.goto(f"{service.url}/{form}/new")

    page.set_input_files(place, names)
    expect(page.locator(".error:visible")).to_contain_text("network's file together")
    page.set_input_files(place, [names, net])
    expect(page.locator("option:checked", has_text=net.stem)).to_have_count(1)
    expect(page.locator(".error:visible")).to_have_count(0)
    with service.client() as client:
        assert next(each for each in client.classifiers() if each.name == net.stem).classes == ["red", "green", "blue"]


def test_without_scripts_a_page_says_what_it_lacks(service: Service, browser: Browser) -> None:
    page = browser.new_page(java_script_enabled=False)
    page.goto(f"{service.url}/jobs/new")
    expect(page.locator("noscript p")).to_be_visible()
    page.close()


@pytest.mark.parametrize("dropped", [["candle"], ["mesh.obj", "mesh.mtl"]], ids=["a folder", "two files"])
def test_only_one_file_can_be_dropped(
    service: Service, page: Page, context: BrowserContext, tmp_path: Path, dropped: list[str]
) -> None:
    (tmp_path / "candle").mkdir()
    page.goto(f"{service.url}/jobs/new")
    hold = {"items": [], "files": [str(tmp_path / name) for name in dropped], "dragOperationsMask": 1}
    box = page.locator("#drop").bounding_box()
    assert box is not None
    session = context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        place = {"x": box["x"] + 20, "y": box["y"] + 10}
        session.send("Input.dispatchDragEvent", {"type": kind, "data": hold} | place)
    expect(page.locator('[data-error="object"]')).to_contain_text("Drop one file")


def test_nothing_is_submitted_before_the_file_that_was_picked_last_is_stored(service: Service, page: Page) -> None:
    page.goto(f"{service.url}/jobs/new")
    submit = page.get_by_role("button", name="Submit")
    held = held_back(page, "**/v1/objects")
    for name in ("teapot", "mug"):
        with page.expect_request("**/v1/objects"):
            page.set_input_files("#file", shipped_objects()[name].path)
        expect(submit).to_be_disabled()
    held[1].continue_()
    expect(page.locator("#file-says")).to_contain_text("mug: ")
    expect(submit).to_be_enabled()
    expect(page.locator("[name='goal.label']")).to_have_value("")  # not that of the object before


def test_a_form_to_which_one_returns_shows_the_object_that_it_submits(service: Service, page: Page) -> None:
    page.goto(f"{service.url}/jobs/new")
    page.select_option("[name=object]", "mug")
    page.fill("[name='paint.epsilon']", "0.2")
    page.goto(f"{service.url}/docs")
    page.go_back()
    expect(page.locator("[name=object]")).to_have_value("mug")
    expect(page.locator("[name='goal.label']")).to_have_value("mug")
    expect(page.locator("[name=epsilon-says]")).to_have_text("0.2")


def test_every_field_reaches_its_option_and_shows_its_fault(service: Service, page: Page, faults: list[str]) -> None:
    page.goto(f"{service.url}/jobs/new")
    page.select_option("[name=object]", "mug")
    page.get_by_text("More options").click()
    given = {
        "goal.label": "mug",
        "paint.tau": 0.2,
        "views.background": "black",
        "views.distance": 0.5,
        "search.seed": 7,
    }
    for name, value in given.items():
        page.fill(f"[name='{name}']", str(value))
    for label in ("table", "7", ""):
        page.get_by_text("Add a class").click()
        page.get_by_label("Another class").last.fill(label)
    with page.expect_request(
        lambda sent: sent.url.endswith("/check") and '"pool":60' in (sent.post_data or "")
    ) as checked:
        page.get_by_text("fast").click()
    asked: Any = checked.value.post_data_json
    assert {name: asked[part][field] for name in given for part, field in [name.split(".")]} == given | {
        "goal.label": ["mug", "table", 7]
    }
    assert (asked["paint"]["epsilon"], asked["victim"]["classifier"], asked["views"]["pool"]) == (0.05, "tiny", 60)
    shown = {str(name) for name in page.eval_on_selector_all("[name*='.']", "all => all.map(each => each.name)")}
    assert shown == {f"{option.part}.{option.field}" for option in OPTIONS.values() if option.in_form}
    expect(page.locator(".error:visible")).to_have_count(0)

    page.select_option("[name=object]", "teapot")
    expect(page.locator("[name='goal.label']")).to_have_count(1)
    page.fill("[name='paint.tau']", "2")
    page.locator("[name='paint.tau']").blur()
    expect(page.locator('[data-error="paint.tau"]')).to_contain_text("less than 1")
    faults.clear()  # browsers report answers of 422 on the console
    page.fill("[name='paint.tau']", "")
    page.locator("[name='search.seed']").fill("")
    page.locator("[name='search.seed']").press_sequentially("1e")
    page.get_by_role("button", name="Submit").click()
    expect(page.locator(".error:visible")).to_have_text(["This is not a number."])


def test_the_divider_is_dragged_and_views_are_chosen_by_key_and_map(service: Service, page: Page, done: str) -> None:
    page.goto(f"{service.url}/jobs/{done}")
    box = page.locator("trompe-viewer .stage").bounding_box()
    assert box is not None

    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + 50)
    page.mouse.up()
    assert float(page.input_value("trompe-viewer input[aria-label^=Divider]")) == pytest.approx(20, abs=1)

    shown = page.locator("trompe-viewer img.after")
    first = shown.get_attribute("src")
    page.get_by_label("View", exact=True).focus()
    page.keyboard.press("ArrowRight")
    assert shown.get_attribute("src") != first

    assert page.locator(".sphere circle").count() == page.locator('.sphere [data-set="0"]').count()
    dot = page.locator('.sphere rect[data-set="1"][data-view="3"]')
    dot.click()
    assert re.search(r"/pictures/own/\d+/after.png$", shown.get_attribute("src") or "")
    assert page.locator(".sphere .shown").count() == 1
    expect(dot).to_have_class(re.compile("shown"))
    for side in dot.locator("title").text_content().split(", then "):  # type: ignore[union-attr]
        assert side in page.inner_text("trompe-viewer .sides")

    page.get_by_label("difference").check()
    assert "difference" in (shown.get_attribute("src") or "")


def test_a_new_job_appears_in_the_list_with_its_result_and_is_deleted(service: Service, page: Page, done: str) -> None:
    page.goto(f"{service.url}/jobs")
    expect(page.locator(f"#job-{done}")).to_be_visible()
    job = service.submit()
    row = page.locator(f"#job-{job}")
    expect(row.locator(".state")).to_have_text("succeeded", timeout=600_000)
    result = service.result(job)
    assert result.held_out is not None
    expect(row).to_contain_text(f"{result.held_out.a_drop:.2f} held-out")
    assert width(row.locator("img")) > 100

    page.once("dialog", lambda dialog: dialog.dismiss())
    row.get_by_role("button", name="Delete").click()
    expect(row).to_be_visible()
    page.once("dialog", lambda dialog: dialog.accept())
    row.get_by_role("button", name="Delete").click()
    expect(row).to_have_count(0)
    page.reload()
    expect(row).to_have_count(0)


def test_a_row_with_the_focus_is_updated_once_the_focus_leaves_it(service: Service, page: Page) -> None:
    request = JobRequest.of("mug", label="mug", needs={"gpu": 1000})
    job = service.store.create(request)[0].id
    row = page.locator(f"#job-{job}")
    page.goto(f"{service.url}/jobs")
    row.get_by_role("checkbox").check()
    service.store.request_cancel(job)
    later = service.store.create(request)[0].id
    expect(page.locator(f"#job-{later}")).to_be_visible()
    expect(row.locator(".state")).to_have_text("queued")

    page.get_by_label("Find on this page").focus()

    expect(row.locator(".state")).to_have_text("cancelled")
    expect(row.get_by_role("checkbox")).to_be_checked()
    page.locator(f"#job-{later}").get_by_role("button", name="Cancel").click()
    expect(page.locator(f"#job-{later} .state")).to_have_text("cancelled")


def test_the_page_of_a_result_says_what_the_result_says_and_gives_it_as_one_zip(
    service: Service, page: Page, done: str, tmp_path: Path
) -> None:
    result = service.result(done)
    page.goto(f"{service.url}/jobs/{done}")

    row = page.locator("tr", has=page.get_by_role("rowheader", name="target (own views)", exact=True))
    figures = [str(result.target.views), f"{result.target.a_before:.2f}", f"{result.target.a_after:.2f}"]
    assert row.locator("td").all_inner_texts()[:3] == figures
    judged = [*result.views, *result.held_out_views]
    assert page.locator(".sphere circle").count() == len(result.held_out_views)
    assert page.locator(".sphere rect").count() == len(result.views)
    kept = sum(view.after == result.label for view in judged)
    assert page.locator(".sphere .kept").count() == kept
    never = sum(result.label not in {view.before, view.after} for view in judged)
    assert page.locator(".sphere .never").count() == never
    assert page.locator("trompe-viewer .sides .true").count() == 1  # the first view shown was recognised before

    with page.expect_download() as download:
        page.get_by_role("link", name="All files as one zip").click()
    download.value.save_as(tmp_path / "all.zip")
    with zipfile.ZipFile(tmp_path / "all.zip") as archive:
        assert json.loads(archive.read("result.json"))["object"] == "mug"


def test_a_running_job_is_cancelled_from_the_list(service: Service, page: Page) -> None:
    job = service.submit(steps=5000, epsilon=0.004)  # so little that it does not win all views and end early
    row = page.locator(f"#job-{job}")
    page.goto(f"{service.url}/jobs")
    expect(row.locator(".state")).to_have_text("running")
    page.goto(f"{service.url}/jobs?state=running")

    row.get_by_role("button", name="Cancel").click()

    expect(row).to_have_count(0)
    page.goto(f"{service.url}/jobs")
    expect(row.locator(".state")).to_have_text("cancelled")


def test_a_job_that_is_deleted_while_its_page_is_open_is_told(service: Service, page: Page, faults: list[str]) -> None:
    job = service.store.create(JobRequest.of("mug", label="mug", needs={"gpu": 1000}))[0].id
    page.goto(f"{service.url}/jobs/{job}")
    expect(page.locator("[data-field=phase]")).to_be_visible()
    service.store.request_cancel(job)
    service.store.delete(job)
    expect(page.get_by_role("main")).to_contain_text(f"There is no job '{job}'")
    faults.clear()  # browsers report answers of 404 on the console


def test_a_list_that_is_not_seen_holds_no_connection(service: Service, page: Page, done: str) -> None:
    page.goto(f"{service.url}/jobs")
    expect(page.locator(f"#job-{done}")).to_be_visible()
    show = """(hidden) => {
        Object.defineProperty(document, "hidden", {value: hidden, configurable: true});
        document.dispatchEvent(new Event("visibilitychange"));
    }"""
    with page.expect_event("requestfailed", lambda request: "/stream" in request.url):
        page.evaluate(show, True)
    with page.expect_request("**/jobs/stream*"):
        page.evaluate(show, False)


def test_the_list_is_sorted_and_filtered(service: Service, page: Page, done: str, stronger: str) -> None:
    service.submit(epsilon=0.1, steps=1)
    page.goto(f"{service.url}/jobs")
    epsilons = page.locator("tbody tr:visible td:nth-child(4)")
    for order in (sorted, lambda found: sorted(found, reverse=True)):
        page.get_by_role("button", name="Epsilon").click()
        found = [float(text) for text in epsilons.all_inner_texts()]
        assert len(set(found)) > 2
        assert found == order(found)

    page.get_by_label("Find on this page").fill("no such object")
    expect(epsilons).to_have_count(0)
    page.get_by_label("Find on this page").fill("MUG")
    expect(epsilons).not_to_have_count(0)


def test_two_jobs_are_compared(service: Service, page: Page, done: str, stronger: str) -> None:
    page.goto(f"{service.url}/jobs")

    for job in (done, stronger):
        page.locator(f"#job-{job}").get_by_role("checkbox").check()
    copies = "row => { for (let copies = 0; copies < 5; copies += 1) row.after(row.cloneNode(true)); }"
    page.locator(f"#job-{done}").evaluate(copies)
    page.locator(f"#job-{stronger}").get_by_role("checkbox").dispatch_event("change")
    expect(page.locator("#compare")).to_have_text("Compare at most 6")
    assert page.locator("#compare").get_attribute("href") is None
    page.reload()
    for job in (done, stronger):
        page.locator(f"#job-{job}").get_by_role("checkbox").check()
    page.get_by_role("link", name="Compare these 2").click()

    differing = page.locator("tr.differs th").all_inner_texts()
    assert "epsilon" in differing
    assert "seed" not in differing
    row = page.locator("tr", has=page.get_by_role("rowheader", name="classifier", exact=True))
    expect(row.locator("td")).to_have_text(["tiny", "tiny"])


def test_an_experiment_shows_its_jobs_as_points_that_open(service: Service, page: Page, done: str) -> None:
    page.goto(f"{service.url}/experiments")
    page.get_by_role("link", name="tries").click()

    page.locator(".chart a").first.click()

    expect(page).to_have_url(f"{service.url}/jobs/{done}")


def test_a_result_is_judged_with_the_form_and_shown(service: Service, page: Page, done: str, faults: list[str]) -> None:
    page.goto(f"{service.url}/jobs/{done}")
    page.get_by_role("link", name="Judge the painted object").click()
    expect(page.locator("[name=after]")).to_have_value(f"job:{done}")
    expect(page.locator("[name=before]")).to_have_value("mug")
    expect(page.get_by_text("In the target renderer", exact=True)).to_have_count(2)
    first = turntables(page)
    assert (np.abs(first[0] - first[1]) > 2).any(), "the painted object is another"
    assert (np.abs(first[0] - first[1]) > 60).mean() < 0.01, "and stands at the same place"
    page.locator("input[type=range]").last.fill("4")
    turned = turntables(page)
    assert (np.abs(turned[0] - first[0]) > 60).any(), "both turn together"
    assert (np.abs(turned[0] - turned[1]) > 60).mean() < 0.01

    page.fill("[name=views]", "5000")
    page.get_by_role("button", name="Judge").click()
    expect(page.locator('[data-error="suite views seed epsilon"]')).to_contain_text("1000")
    faults.clear()  # browsers report answers of 422 on the console

    page.fill("[name=views]", "6")
    page.get_by_role("button", name="Judge").click()
    page.wait_for_url(re.compile(r"/jobs/[0-9a-f]+$"))
    shown = page.frame_locator("iframe.judgement")
    expect(shown.get_by_role("heading", level=1)).to_contain_text("still recognised as mug")
    expect(shown.get_by_role("cell", name="tiny").first).to_be_visible()
    page.goto(f"{service.url}/jobs")
    expect(page.get_by_role("link", name="judged beside mug").first).to_be_visible()


def test_all_classes_of_an_attack_count_in_its_judgement(service: Service, page: Page, faults: list[str]) -> None:
    job = service.store.create(JobRequest.of("mug", label=["mug", 7], needs={"gpu": 1000}))[0].id
    page.goto(f"{service.url}/judgements/new?job={job}")
    with page.expect_request("**/v1/judgements") as sent:
        page.get_by_role("button", name="Judge").click()
    asked: Any = sent.value.post_data_json
    assert asked["label"] == ["mug", 7]
    expect(page.locator(".error:visible")).to_contain_text("no painted object")
    service.store.request_cancel(job)
    faults.clear()  # browsers report answers of 409 on the console


def test_a_missing_painted_object_is_refused_beside_its_field(service: Service, page: Page, faults: list[str]) -> None:
    page.goto(f"{service.url}/judgements/new")
    page.fill("[name=label]", "mug")
    page.get_by_role("button", name="Judge").click()
    expect(page.locator('[data-error="after"]')).to_be_visible()
    faults.clear()  # browsers report answers of 422 on the console


NEXT_PICTURE = """() => {
    window.decoded = new Promise((done) => {
        const decode = window.createImageBitmap;
        window.createImageBitmap = async (file) => decode(file).finally(() => setTimeout(done));
    });
}"""
"""Promises in ``decoded`` that the next picture was fetched and shown, or not."""


def test_the_picture_of_an_object_that_is_no_longer_chosen_is_not_shown(service: Service, page: Page) -> None:
    page.goto(f"{service.url}/jobs/new")
    drawn = page.get_by_text("In the target renderer", exact=True)
    expect(drawn).to_be_visible()
    held = held_back(page, "**/turntable/ball.png*")
    page.select_option("[name=object]", "ball")
    assert not turntables(page)[0].any(), "nor that of the object before, while it is drawn"
    page.select_option("[name=object]", "mug")
    expect(drawn).to_be_visible()
    (shown,) = turntables(page)
    page.evaluate(NEXT_PICTURE)
    held[0].continue_()
    page.evaluate("window.decoded")
    (kept,) = turntables(page)
    assert (kept == shown).all()


SHIFTS = """
    window.shifted = 0;
    new PerformanceObserver((list) => { for (const each of list.getEntries()) window.shifted += each.value; })
        .observe({type: "layout-shift", buffered: true});
"""
TOO_WIDE = """
    () => [...document.querySelectorAll("main *")]
        .filter((each) => each.scrollWidth > each.clientWidth + 1)
        .filter((each) => getComputedStyle(each).overflowX !== "visible")
        .map((each) => each.outerHTML.slice(0, 100))
"""


def inked(page: Page) -> float:
    """Share of the pixels of the emptiest half of the window that are not background."""
    shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("L"), np.int16)
    drawn = np.abs(shown - shown[0, 0]) > 30
    height, width = (side // 2 for side in drawn.shape)
    return min(float(half.mean()) for half in (drawn[:height], drawn[height:], drawn[:, :width], drawn[:, width:]))


@pytest.mark.parametrize(
    ("wide", "high", "scheme"),
    [
        pytest.param(360, 740, "light", id="phone"),
        pytest.param(1280, 800, "light", id="desk"),
        pytest.param(1280, 800, "dark", id="dark", marks=pytest.mark.thorough),
    ],
)
def test_every_page_is_accessible_and_none_is_too_wide_cut_off_half_empty_or_moves_while_it_loads(
    service: Service, browser: Browser, done: str, stronger: str, wide: int, high: int, scheme: Any
) -> None:
    context = browser.new_context(viewport={"width": wide, "height": high}, color_scheme=scheme)
    context.set_default_timeout(LIMIT)
    context.add_init_script(SHIFTS)
    page = context.new_page()
    for path in (
        "/",
        "/jobs",
        "/jobs/new",
        "/judgements/new",
        f"/jobs/{done}",
        f"/jobs/{stronger}",
        f"/jobs/compare?job={done}&job={done}",
        "/experiments",
        "/experiments/tries",
        "/docs",
    ):
        page.goto(service.url + path)
        assert inaccessible(page) == {}, path  # takes half a second, in which the page may move
        assert page.evaluate("document.documentElement.scrollWidth") <= wide, path
        assert page.evaluate(TOO_WIDE) == [], path
        assert page.evaluate("window.shifted") < 0.02, path
        assert inked(page) > 0.005, path
    context.close()


@pytest.mark.thorough
def test_on_a_slow_network_a_result_is_read_before_its_viewer_is_there_and_3d_says_what_it_loads(
    service: Service, page: Page, context: BrowserContext, done: str
) -> None:
    result = service.result(done)
    slowed(context, page, bytes_per_second=150_000)
    held = held_back(page, "**/viewer.js*")
    page.goto(f"{service.url}/jobs/{done}", wait_until="commit")
    expect(page.locator(".lead")).to_contain_text("views hidden from the attack")
    expect(page.get_by_role("cell", name=f"{result.target.a_after:.2f}", exact=True).first).to_be_visible()
    assert page.evaluate("customElements.get('trompe-viewer') === undefined")
    held[0].continue_()
    assert width(page.locator("trompe-viewer img.after"))

    page.evaluate(REPORTED, "trompe-orbit [role=status]")
    page.get_by_role("button", name="Show it in 3D").click()
    expect(page.locator("trompe-orbit")).to_have_attribute("data-answered", re.compile("azimuth"))
    told = page.evaluate("window.told")
    assert told[0] == "Loading three.js"
    loading = [text for text in told if "Loading the object" in text]
    loaded = [[float(each) for each in re.findall(r"([\d.]+) MB", text)] for text in loading]
    assert len(loaded) > 2
    assert loaded == sorted(loaded, key=sum)


@pytest.mark.thorough
def test_a_server_that_restarts_in_mid_job_is_waited_for(service: Service, page: Page, faults: list[str]) -> None:
    job = service.submit(steps=200, epsilon=0.004)  # so little that it does not win all views and end early
    page.goto(f"{service.url}/jobs/{job}")
    expect(page.locator("[data-field=step]")).to_contain_text("of")

    expect(page.locator("[data-field=phase]")).to_have_text("attacking")

    for name in ("loss", "fooled"):
        curve = page.locator(f"[data-curve={name}] polyline")
        expect(curve).to_have_attribute("points", re.compile(" "))
        points = curve.get_attribute("points")
        assert points is not None
        steps = [float(each.split(",")[0]) for each in points.split()]
        assert steps == sorted(steps)
    expect(page.locator("#preview img")).to_be_visible()
    assert page.locator("#preview img").evaluate("image => image.naturalWidth / image.naturalHeight") == 2

    service.stop()
    expect(page.locator("#notice")).to_contain_text("lost")
    service.start()

    expect(page.get_by_role("heading", name="What the classifier sees")).to_be_visible(timeout=600_000)
    faults.clear()  # the browser reports the lost connection


@pytest.fixture(scope="module")
def guarded(new_service: Callable[..., Service]) -> Iterator[Service]:
    """A service with a token that may read; it attacks nothing."""
    with new_service("--workers", "0") as service:
        command = [sys.executable, "-m", "trompe_client.cli", "token", "create", "me", "--right", "read", "--json"]
        made = subprocess.run([*command, "--data", str(service.data)], capture_output=True, text=True, check=True)
        service.token = json.loads(made.stdout)["secret"]
        wait_until(lambda: service.http.get("/v1/jobs").status_code == 401)  # it looks for new tokens every second
        yield service


def test_with_tokens_it_asks_for_one_and_goes_on_as_wanted(guarded: Service, page: Page, faults: list[str]) -> None:
    page.goto(f"{guarded.url}/jobs?state=queued")
    assert page.url == f"{guarded.url}/login?next=/jobs%3Fstate%3Dqueued"
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        assert inaccessible(page) == {}
    page.fill("[name=token]", "trompe_wrong")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("not a valid token")

    page.fill("[name=token]", guarded.token or "")
    page.get_by_role("button", name="Sign in").click()

    expect(page).to_have_url(f"{guarded.url}/jobs?state=queued")
    page.goto(f"{guarded.url}/jobs/new")
    page.select_option("[name=object]", "mug")
    page.get_by_role("button", name="Submit").click()
    expect(page.locator(".error:visible")).to_contain_text("may only read")

    page.get_by_role("button", name="Sign out").click()
    expect(page).to_have_url(re.compile("/login"))
    page.goto(f"{guarded.url}/jobs?state=queued")
    assert "/login" in page.url

    guarded.store.create(JobRequest.of("mug", label="mug"))
    page.fill("[name=token]", guarded.token or "")
    page.get_by_role("button", name="Sign in").click()
    expect(page).to_have_url(f"{guarded.url}/jobs?state=queued")
    command = [sys.executable, "-m", "trompe_client.cli", "token", "revoke", "me", "--data", str(guarded.data)]
    subprocess.run(command, capture_output=True, check=True)
    expect(page).to_have_url(re.compile("/login"), timeout=30_000)
    # The console tells, some time later, the 401 of the wrong token and the 403 of the job and of the check before it.
    faults[:] = [fault for fault in faults if "401" not in fault and "403" not in fault]
