"""Objects, classifiers and backgrounds: what may come in, how it is found, what is kept."""

import asyncio
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.server.api.conftest import CLASSES, GIF, Api
from tests.small_models import triangle_zip
from trompe_server.api.services import UPLOADS
from trompe_server.classifiers.registry import LOADERS
from trompe_server.library import Library
from trompe_shared.api import ObjectInfo
from trompe_shared.local_files import CLASSIFIER_SUFFIXES


def stored_files(api: Api) -> list[Path]:
    return [file for file in (api.services.settings.data / "library").rglob("*") if file.is_file()]


def test_an_object_is_found_by_its_id_its_beginning_and_its_name(api: Api) -> None:
    uploaded = api.upload_object(triangle_zip()).json()
    assert uploaded["name"] == "triangle"
    assert (uploaded["triangles"], uploaded["materials"]) == (1, ["paint"])
    assert uploaded["textures"] == {"paint.png": [8, 8]}
    for reference in (uploaded["id"], uploaded["id"][:8], "triangle"):
        assert api.get(f"/v1/objects/{reference}").json() == uploaded
    assert uploaded in api.get("/v1/objects").json()


def test_a_text_in_place_of_a_file_is_told(api: Api) -> None:
    for path in ("/v1/objects", "/v1/classifiers", "/v1/backgrounds"):
        assert "file=@PATH" in api.problem(api.post(path, data={"file": "mug.zip"}), 422)["detail"]


def test_a_broken_archive_is_refused_and_nothing_is_kept(api: Api) -> None:
    refusal = api.problem(api.upload_object(triangle_zip()[:-40]), 422)
    assert refusal["type"] == "urn:trompe:invalid-object"
    assert stored_files(api) == []


def test_a_broken_classifier_is_refused_and_nothing_is_kept(api: Api) -> None:
    refusal = api.problem(api.upload_classifier(b"?"), 422)
    assert (refusal["type"], refusal["detail"]) == ("urn:trompe:invalid-classifier", "The classifier is broken.")
    for upload, words in (
        ({"name": "net.pth"}, "is not a supported classifier: upload a .pt2"),
        ({"classes": '["a", "b"]'}, "2 class names for a classifier of 3"),
        ({"classes": "a, b, c"}, "JSON list"),
    ):
        assert words in api.problem(api.upload_classifier(b"W", **upload), 422)["detail"]
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
    refused = api.post("/v1/backgrounds", files={"file": ("x.png", b"no")})
    assert "is not a readable image" in api.problem(refused, 422)["detail"]


@pytest.mark.parametrize(
    ("path", "told"),
    [
        ("/v1/objects", "The upload is larger than 0.0953674 MiB"),
        ("/v1/jobs", "The request is larger than 1 MiB"),
        ("/v1/judgements", "The request is larger than 1 MiB"),
        ("/login", "The request is larger than 1 MiB"),
    ],
)
def test_a_body_over_the_limit_is_refused_however_it_comes(api: Api, path: str, told: str) -> None:
    async def parts() -> AsyncIterator[bytes]:
        yield b'--b\r\nContent-Disposition: form-data; name="file"; filename="x.zip"\r\n\r\n'
        for _ in range(20):
            yield b"0" * 100_000
        yield b"\r\n--b--\r\n"

    for content in (b"0" * 2_000_000, parts()):
        answer = api.post(path, content=content, headers={"content-type": "multipart/form-data; boundary=b"})
        assert told in api.problem(answer, 413)["detail"]


def test_the_client_uploads_the_files_that_classifiers_are_read_from() -> None:
    assert set(CLASSIFIER_SUFFIXES) == set(LOADERS)


def test_shipped_things_are_named_by_name(stocked: Api) -> None:
    stocked.upload_object(triangle_zip(), "mug.zip")
    spec = stocked.submit("mug", classifier="tiny").json()["spec"]
    assert (spec["object"], spec["victim"]["classifier"]) == ("mug", "tiny")


def test_a_name_that_several_uploads_share_is_refused_with_their_ids(stocked: Api) -> None:
    other = stocked.upload_object(triangle_zip(colour=(0, 0, 255))).json()["id"]
    assert other[:12] in stocked.problem(stocked.submit(), 422)["detail"]
    assert stocked.submit(object=other).status_code == 201


def test_uploads_are_read_a_few_at_a_time_and_nothing_else_waits(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    at_work, most, lock, gate = 0, 0, threading.Lock(), threading.Event()
    add = Library.add_object

    def slowly(*arguments: Any, **options: Any) -> ObjectInfo:
        nonlocal at_work, most
        with lock:
            at_work += 1
            most = max(most, at_work)
        gate.wait(120)
        with lock:
            at_work -= 1
        return add(*arguments, **options)

    monkeypatch.setattr(Library, "add_object", slowly)

    async def many() -> list[httpx.Response]:
        async with api.connect() as client:
            posts = [client.post("/v1/objects", files={"file": ("a.zip", triangle_zip())}) for _ in range(10)]
            uploads = asyncio.gather(*posts)
            while at_work < UPLOADS:
                await asyncio.sleep(0.01)
            assert (await client.get("/v1/jobs")).status_code == 200
            assert not uploads.done()
            await asyncio.sleep(0.05)  # for one that comes in too many
            gate.set()
            return await uploads

    answers = asyncio.run(many())
    assert {answer.status_code for answer in answers} == {201}
    assert most == UPLOADS
