"""The REST API over a real library, store and queue; no worker runs, so jobs stay where the test puts them."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from trompe_client._plan import CLASSIFIER_SUFFIXES
from trompe_server import library as library_module
from trompe_server.api.services import Services
from trompe_server.app import create_app
from trompe_server.classifiers.registry import ENDINGS
from trompe_server.jobs.engine import DbosQueue
from trompe_server.jobs.store import JobStore
from trompe_server.jobs.worker import prepare_data
from trompe_server.library import Library
from trompe_server.settings import Settings
from trompe_shared.api import JobState, Progress
from trompe_shared.errors import ClassifierError

CLASSES = ["mug, cup", "vase", "toilet tissue, toilet paper"]
GIF = bytes.fromhex("47494638396101000100800000000000ffffff2c00000000010001000002024401003b")
"""A picture of one pixel."""


class Api:
    """Requests to the application, made in this process."""

    def __init__(self, services: Services) -> None:
        self.services = services
        self._app = create_app(services)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        return asyncio.run(self._request(method, path, options))

    async def _request(self, method: str, path: str, options: dict[str, Any]) -> httpx.Response:
        transport = httpx.ASGITransport(self._app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://trompe") as client:
            return await client.request(method, path, **options)

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.request("GET", path, **options)

    def post(self, path: str, **options: Any) -> httpx.Response:
        return self.request("POST", path, **options)

    def upload_object(self, data: bytes, name: str = "triangle.zip") -> httpx.Response:
        return self.post("/v1/objects", files={"file": (name, data)})

    def upload_classifier(self, data: bytes, name: str = "net.pt2", **form: str) -> httpx.Response:
        return self.post("/v1/classifiers", files={"file": (name, data)}, data=form)

    def submit(self, **spec: Any) -> httpx.Response:
        return self.post("/v1/jobs", json={"object": "triangle", "label": 0, "classifier": "net"} | spec)


@pytest.fixture
def missing() -> list[str]:
    """What the service says is not up; a test fills it."""
    return []


@pytest.fixture
def api(tmp_path: Path, missing: list[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Api]:
    """An API whose classifiers are read by their first byte: b"W" is white box, b"B" is not, others are broken."""
    settings = Settings(data=tmp_path, max_upload=100_000)
    prepare_data(settings)
    store, queue = JobStore(settings.database), DbosQueue(settings.database)
    monkeypatch.setattr(library_module, "_inspect", _inspect)
    yield Api(Services(settings, Library(settings.library), store, queue, lambda: missing))
    queue.close()
    store.close()


@pytest.fixture
def stocked(api: Api, triangle_zip: Callable[..., bytes]) -> Api:
    """An API with an object and a classifier with class names."""
    assert api.upload_object(triangle_zip()).status_code == 201
    assert api.upload_classifier(b"W", classes=json.dumps(CLASSES)).status_code == 201
    return api


def _inspect(path: str) -> dict[str, object]:
    kinds = {b"W": {"white_box": True, "n_classes": 3}, b"B": {"white_box": False, "n_classes": 3}}
    found = kinds.get(Path(path).read_bytes()[:1])
    if found is None:
        raise ClassifierError("The classifier is broken.")
    return found | {"image_size": [224, 224]}


def stored_files(api: Api) -> list[Path]:
    return [file for file in api.services.settings.library.rglob("*") if file.is_file()]


def problem(response: httpx.Response, status: int) -> dict[str, Any]:
    """The problem details of a response, checked to be well formed."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = response.json()
    assert body["status"] == status
    assert body["request_id"] == response.headers["x-request-id"]
    return body


def test_an_object_is_found_by_its_id_its_beginning_and_its_name(api: Api, triangle_zip: Callable[..., bytes]) -> None:
    uploaded = api.upload_object(triangle_zip()).json()
    assert uploaded["name"] == "triangle"
    assert (uploaded["triangles"], uploaded["materials"]) == (1, ["paint"])
    assert uploaded["textures"] == {"paint.png": [8, 8]}
    for reference in (uploaded["id"], uploaded["id"][:8], "triangle"):
        assert api.get(f"/v1/objects/{reference}").json() == uploaded
    assert uploaded in api.get("/v1/objects").json()


def test_the_same_object_is_stored_once(api: Api, triangle_zip: Callable[..., bytes]) -> None:
    first = api.upload_object(triangle_zip()).json()
    again = api.upload_object(triangle_zip(), "other.zip").json()
    assert again["id"] == first["id"]
    assert [each["name"] for each in api.get("/v1/objects").json() if not each["shipped"]] == ["other"]


def test_a_broken_archive_is_refused_and_nothing_is_kept(api: Api, triangle_zip: Callable[..., bytes]) -> None:
    refusal = problem(api.upload_object(triangle_zip()[:-40]), 422)
    assert refusal["type"] == "urn:trompe:invalid-object"
    assert stored_files(api) == []


def test_a_broken_classifier_is_refused_and_nothing_is_kept(api: Api) -> None:
    refusal = problem(api.upload_classifier(b"?"), 422)
    assert (refusal["type"], refusal["detail"]) == ("urn:trompe:invalid-classifier", "The classifier is broken.")
    assert "neither a .pt2" in problem(api.upload_classifier(b"W", "net.pth"), 422)["detail"]
    assert (
        "2 class names came with a classifier of 3"
        in problem(api.upload_classifier(b"W", classes='["a", "b"]'), 422)["detail"]
    )
    assert "JSON list" in problem(api.upload_classifier(b"W", classes="a, b, c"), 422)["detail"]
    assert stored_files(api) == []


def test_a_classifier_sent_again_without_its_class_names_keeps_them(stocked: Api) -> None:
    again = stocked.upload_classifier(b"W", "again.pt2").json()
    assert (again["name"], again["classes"]) == ("again", CLASSES)
    renamed = stocked.upload_classifier(b"W", classes='["a", "b", "c"]').json()
    assert (renamed["id"], renamed["classes"]) == (again["id"], ["a", "b", "c"])


def test_a_background_is_an_image(api: Api, tmp_path: Path) -> None:
    stored = api.post("/v1/backgrounds", files={"file": ("beach.gif", GIF)}).json()
    assert stored["name"] == "beach"
    assert api.get("/v1/backgrounds").json() == [stored]
    assert (
        "cannot be read as an image"
        in problem(api.post("/v1/backgrounds", files={"file": ("x.png", b"no")}), 422)["detail"]
    )


def test_an_upload_over_the_limit_is_refused_however_it_comes(api: Api) -> None:
    announced = api.upload_object(b"0" * 200_000)
    assert "0.0953674 MiB" in problem(announced, 413)["detail"]

    async def parts() -> AsyncIterator[bytes]:
        yield b'--b\r\nContent-Disposition: form-data; name="file"; filename="x.zip"\r\n\r\n'
        for _ in range(20):
            yield b"0" * 10_000
        yield b"\r\n--b--\r\n"

    chunked = api.post("/v1/objects", content=parts(), headers={"content-type": "multipart/form-data; boundary=b"})
    assert "larger than" in problem(chunked, 413)["detail"]


def test_a_job_keeps_the_ids_of_what_it_names(stocked: Api) -> None:
    answer = stocked.submit(label="CUP", judges=["net"])
    job = answer.json()
    assert answer.status_code == 201
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    assert job["state"] == "queued"
    assert job["spec"]["object"] == stocked.get("/v1/objects/triangle").json()["id"]
    assert job["spec"]["classifier"] == job["spec"]["judges"][0] == stocked.get("/v1/classifiers/net").json()["id"]
    assert stocked.get(f"/v1/jobs/{job['id']}").json() == job


def test_ensemble_masks_and_backgrounds_are_kept_by_id_too(stocked: Api) -> None:
    member = stocked.upload_classifier(b"W2", "member.pt2").json()
    picture = stocked.post("/v1/backgrounds", files={"file": ("beach.gif", GIF)}).json()
    answer = stocked.submit(
        ensemble=["member"], masks={"paint.png": "beach"}, materials=["paint"], background=["beach", "#00ff00"]
    )
    spec = answer.json()["spec"]
    assert spec["ensemble"] == [member["id"]]
    assert spec["masks"] == {"paint.png": picture["id"]}
    assert spec["background"] == [picture["id"], "#00ff00"]


def test_a_classifier_without_gradients_can_be_attacked_by_its_scores(stocked: Api) -> None:
    stocked.upload_classifier(b"B", "judge.onnx")
    assert stocked.submit(classifier="judge", queries=10).status_code == 201


def test_the_client_uploads_the_files_that_classifiers_are_read_from() -> None:
    assert set(CLASSIFIER_SUFFIXES) == set(ENDINGS)


def test_shipped_things_are_named_by_name(stocked: Api, triangle_zip: Callable[..., bytes]) -> None:
    stocked.upload_object(triangle_zip(), "mug.zip")
    spec = stocked.submit(object="mug", classifier="tiny").json()["spec"]
    assert (spec["object"], spec["classifier"]) == ("mug", "tiny")


@pytest.mark.parametrize(
    ("spec", "status", "words"),
    [
        pytest.param({"object": "trumpet"}, 404, "no object 'trumpet'", id="object"),
        pytest.param({"classifier": "resnet"}, 404, "no classifier 'resnet'", id="classifier"),
        pytest.param({"judges": ["resnet"]}, 404, "no classifier 'resnet'", id="judge"),
        pytest.param({"label": "vaze"}, 422, "did you mean 'vase'?", id="label"),
        pytest.param({"label": 3}, 422, "indices are 0..2", id="index"),
        pytest.param({"background": "beach"}, 404, "no background 'beach'", id="background"),
        pytest.param({"background": "#12345"}, 404, "no background '#12345'", id="colour"),
        pytest.param({"ensemble": ["resnet"]}, 404, "no classifier 'resnet'", id="ensemble"),
        pytest.param({"masks": {"paint.png": "beach"}}, 404, "no background 'beach'", id="mask"),
        pytest.param({"masks": {"wood.png": "beach"}}, 422, "no texture ['wood.png'] to mask", id="texture"),
        pytest.param({"materials": ["paint", "wood"]}, 422, "no material ['wood']", id="material"),
        pytest.param({"target_label": "vaze"}, 422, "did you mean 'vase'?", id="target"),
        pytest.param({"target_label": "mug"}, 422, "is the object's own class", id="target is the label"),
        pytest.param({"top_k": 3}, 422, "less than the 3 classes", id="top k"),
        pytest.param({"queries": 10}, 422, "'net' gives gradients", id="queries of a white box"),
        pytest.param({"classifier": "judge"}, 422, "gives no gradients", id="black box"),
        pytest.param({"classifier": "judge", "queries": 4, "tau": 0.1}, 422, "need saliency", id="its tau"),
        pytest.param({"classifier": "judge", "queries": 4, "keep": 0.1}, 422, "need saliency", id="its saliency"),
        pytest.param({"ensemble": ["judge"]}, 422, "not in the ensemble", id="black box in the ensemble"),
    ],
)
def test_a_job_that_names_what_is_not_there_is_refused_at_once(
    stocked: Api, spec: dict[str, Any], status: int, words: str
) -> None:
    stocked.upload_classifier(b"B", "judge.onnx")
    assert words in problem(stocked.submit(**spec), status)["detail"]
    assert stocked.get("/v1/jobs").json()["jobs"] == []


def test_a_name_that_several_uploads_share_is_refused_with_their_ids(
    stocked: Api, triangle_zip: Callable[..., bytes]
) -> None:
    other = stocked.upload_object(triangle_zip(colour=(0, 0, 255))).json()["id"]
    assert other[:12] in problem(stocked.submit(), 422)["detail"]
    assert stocked.submit(object=other).status_code == 201


def test_invalid_fields_are_listed_one_by_one(api: Api) -> None:
    refusal = problem(api.post("/v1/jobs", json={"object": "mug", "epsilon": 2, "colour": "red"}), 422)
    assert {error["field"] for error in refusal["errors"]} == {"label", "epsilon", "colour"}
    assert all(error["message"] for error in refusal["errors"])
    contradiction = problem(
        api.post("/v1/jobs", json={"object": "mug", "label": 0, "epsilon": 0.01, "alpha": 0.5}), 422
    )
    assert "alpha (0.5) is the step" in contradiction["detail"]


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/nothing", 404),
        ("DELETE", "/v1/jobs", 405),
        ("GET", "/v1/jobs/unknown", 404),
        ("POST", "/v1/jobs/unknown/cancel", 404),
        ("GET", "/v1/jobs/unknown/events", 404),
        ("GET", "/v1/jobs/unknown/artifacts/x", 404),
        ("GET", "/v1/jobs?limit=0", 422),
        ("GET", "/v1/jobs?state=asleep", 422),
        ("GET", "/v1/jobs?cursor=x", 422),
        ("GET", "/v1/objects/unknown", 404),
        ("POST", "/v1/objects", 422),
        ("GET", "/v1/classifiers/unknown", 404),
    ],
)
def test_every_error_is_problem_details(api: Api, method: str, path: str, status: int) -> None:
    assert problem(api.request(method, path), status)["instance"] == path.partition("?")[0]


def test_a_mistake_of_the_server_is_problem_details_without_its_secrets(
    api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JobStore, "page", lambda *_, **__: 1 / 0)
    assert "division" not in problem(api.get("/v1/jobs"), 500)["detail"]


def test_jobs_are_listed_newest_first_in_pages_and_by_state(stocked: Api) -> None:
    ids = [stocked.submit().json()["id"] for _ in range(5)]
    stocked.post(f"/v1/jobs/{ids[2]}/cancel")
    seen, cursor = [], None
    while cursor != "":
        page = stocked.get("/v1/jobs", params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
        assert len(page["jobs"]) <= 2
        seen += [job["id"] for job in page["jobs"]]
        cursor = page["next_cursor"] or ""
    assert seen == ids[::-1]
    cancelled = stocked.get("/v1/jobs", params={"state": "cancelled"}).json()
    assert [job["id"] for job in cancelled["jobs"]] == [ids[2]]


def test_cancelling_a_queued_job_ends_it_and_cancelling_again_changes_nothing(stocked: Api) -> None:
    job = stocked.submit().json()["id"]
    cancelled = stocked.post(f"/v1/jobs/{job}/cancel").json()
    assert cancelled["state"] == "cancelled"
    assert stocked.post(f"/v1/jobs/{job}/cancel").json() == cancelled


def test_a_result_is_refused_until_the_job_has_ended_and_then_served_as_it_was_written(stocked: Api) -> None:
    job = stocked.submit().json()["id"]
    assert "is queued" in problem(stocked.get(f"/v1/jobs/{job}/result"), 409)["detail"]

    store, artifacts = stocked.services.store, stocked.services.artifacts(job)
    store.begin(job)
    artifacts.write("result.json", b'{"a": 1.50}')
    artifacts.write("secret.txt", b"")
    store.advance(job, Progress(phase="judge", fraction=1.0), public=("result.json",))
    store.finish(job, JobState.succeeded)

    assert stocked.get(f"/v1/jobs/{job}/result").content == b'{"a": 1.50}'
    artifact = stocked.get(f"/v1/jobs/{job}/artifacts/result.json")
    assert (artifact.content, artifact.headers["content-type"]) == (b'{"a": 1.50}', "application/json")
    for private in ("secret.txt", "..%2F..%2Ftrompe.sqlite"):
        problem(stocked.get(f"/v1/jobs/{job}/artifacts/{private}"), 404)


def test_a_job_that_failed_has_no_result_but_a_reason(stocked: Api) -> None:
    job = stocked.submit().json()["id"]
    stocked.services.store.finish(job, JobState.failed, error="The renderer is gone.")
    assert "The renderer is gone." in problem(stocked.get(f"/v1/jobs/{job}/result"), 409)["detail"]


def test_events_are_replayed_from_the_beginning_or_after_the_last_one_seen(stocked: Api) -> None:
    job, store = stocked.submit().json()["id"], stocked.services.store
    store.begin(job)
    for fraction in (0.25, 0.5):
        store.advance(job, Progress(phase="attack-000", fraction=fraction))
    store.finish(job, JobState.succeeded, note="well done")

    events = sse(stocked.get(f"/v1/jobs/{job}/events"))
    assert [event["id"] for event in events] == ["1", "2", "3", "4", "5"]
    assert {event["event"] for event in events} == {"progress"}
    data = [json.loads(event["data"]) for event in events]
    assert [each["state"] for each in data] == ["queued", "running", "running", "running", "succeeded"]
    assert [each["progress"]["fraction"] for each in data] == [0, 0, 0.25, 0.5, 0.5]
    assert data[-1]["message"] == "well done"
    assert sse(stocked.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "3"})) == events[3:]
    assert sse(stocked.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "5"})) == []


def sse(response: httpx.Response) -> list[dict[str, str]]:
    """The events of a stream that has ended."""
    assert response.headers["content-type"].startswith("text/event-stream")
    blocks = [block for block in response.text.replace("\r\n", "\n").split("\n\n") if block and block[0] != ":"]
    return [dict(line.split(": ", 1) for line in block.splitlines()) for block in blocks]


def test_the_service_is_ready_when_nothing_is_missing(api: Api, missing: list[str]) -> None:
    assert api.get("/healthz").json() == {"status": "ok"}
    assert api.get("/readyz").json() == {"status": "ready"}
    missing.append("the attack worker is not up")
    assert problem(api.get("/readyz"), 503)["detail"] == "the attack worker is not up"
    assert api.get("/healthz").status_code == 200


def test_the_documentation_works_without_any_other_host(api: Api) -> None:
    assert api.get("/").headers["location"] == "/docs"
    page = api.get("/docs").text
    assert "://" not in page
    assert "script src" not in page
    contract = api.get("/openapi.json").json()
    assert contract["components"]["schemas"]["JobSpec"]["examples"][0]["object"] == "mug"
    submit = contract["paths"]["/v1/jobs"]["post"]
    assert "application/problem+json" in submit["responses"]["4XX"]["content"]
    assert all(spec["description"] for methods in contract["paths"].values() for spec in methods.values())
