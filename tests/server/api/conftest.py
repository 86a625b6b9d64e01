"""The REST API over a real library, store and files; no worker runs, so jobs stay where a test puts them."""

import asyncio
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.small_models import triangle_zip
from trompe_server.api import guard
from trompe_server.api.services import Services
from trompe_server.library import Library
from trompe_server.queue.store import JobStore
from trompe_server.queue.tables import update_job
from trompe_server.service.app import create_app
from trompe_server.service.dispatch import prepare_data
from trompe_server.settings import Settings
from trompe_server.storage.database import clock, write
from trompe_server.storage.folders import job_artifacts, open_folder
from trompe_server.storage.tokens import Right, Tokens
from trompe_shared.api import JobState, RendererInfo, in_parts
from trompe_shared.errors import ClassifierError

GIF = bytes.fromhex("47494638396101000100800000000000ffffff2c00000000010001000002024401003b")
"""A picture of one pixel."""
CLASSES = ["mug, cup", "vase", "toilet tissue, toilet paper"]


class Api:
    """Requests to the application, made in this process; ``headers`` go with each of them."""

    def __init__(self, services: Services) -> None:
        self.services, self.headers = services, dict[str, str]()
        self.app = create_app(services)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        return asyncio.run(self._request(method, path, options))

    async def _request(self, method: str, path: str, options: dict[str, Any]) -> httpx.Response:
        async with self.connect() as client:
            return await client.request(method, path, **options)

    def connect(self) -> httpx.AsyncClient:
        """A client to enter, for requests at the same time."""
        transport = httpx.ASGITransport(self.app, raise_app_exceptions=False)
        return httpx.AsyncClient(transport=transport, base_url="http://trompe", headers=self.headers)

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.request("GET", path, **options)

    def post(self, path: str, **options: Any) -> httpx.Response:
        return self.request("POST", path, **options)

    def delete(self, path: str, **options: Any) -> httpx.Response:
        return self.request("DELETE", path, **options)

    def upload_object(self, data: bytes, name: str = "triangle.zip") -> httpx.Response:
        return self.post("/v1/objects", files={"file": (name, data)})

    def upload_classifier(self, data: bytes, name: str = "net.pt2", **form: str) -> httpx.Response:
        return self.post("/v1/classifiers", files={"file": (name, data)}, data=form)

    def submit(self, object: str = "triangle", *, key: str | None = None, **spec: Any) -> httpx.Response:
        headers = {"Idempotency-Key": key} if key else {}
        body = {"object": object} | in_parts({"label": 0, "classifier": "net"} | spec)
        return self.post("/v1/jobs", json=body, headers=headers)

    def job(self, **spec: Any) -> str:
        """The id of a new job, by keywords."""
        answer = self.submit(**spec)
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])

    def token(self, name: str, right: str) -> dict[str, str]:
        """The header that a new token is sent in."""
        return {"Authorization": f"Bearer {self.services.tokens.create(name, Right(right))}"}

    def problem(self, response: httpx.Response, status: int, row: object = "") -> dict[str, Any]:
        """The problem details of a response, checked to be well formed; ``row`` of a table is told on failure."""
        assert response.status_code == status, f"{row} {response.text}"
        assert response.headers["content-type"] == "application/problem+json"
        body: dict[str, Any] = response.json()
        assert body["status"] == status
        assert body["request_id"] == response.headers["x-request-id"]
        return body

    def tell(self, job: str, message: str | None, **values: Any) -> None:
        """Write to a job's record what a worker would write."""
        with write(self.services.store.engine) as connection:
            update_job(connection, job, message=message, **values)

    def end(self, job: str, state: JobState = JobState.succeeded, **files: bytes) -> None:
        """End a job with these files, whose names have '__' for '.'."""
        artifacts = job_artifacts(self.services.files, job, attempt=1)
        named = {name.replace("__", "."): data for name, data in files.items()}
        for name, data in named.items():
            artifacts.write(name, data)
        self.tell(job, "ended", state=state.value, finished=clock(), artifacts=list(named))


@pytest.fixture
def missing() -> list[str]:
    """What the service says is not up; a test fills it."""
    return []


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data=tmp_path, max_upload=100_000)


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A service's data with an object and a classifier with class names, for copies: to make it takes seconds."""
    settings = Settings(data=tmp_path_factory.mktemp("template"))
    with running(settings) as api:
        assert api.upload_object(triangle_zip()).status_code == 201
        assert api.upload_classifier(b"W", classes=json.dumps(CLASSES)).status_code == 201
    return settings.data


@pytest.fixture
def api(settings: Settings, missing: list[str], monkeypatch: pytest.MonkeyPatch, template: Path) -> Iterator[Api]:
    """An API whose classifiers are read by their first byte: b"W" is white box, b"B" is not, others are broken.

    What it knows of tokens is never older than the request.
    """
    monkeypatch.setattr(guard, "FRESH", -1.0)
    for file in template.glob("*.sqlite*"):
        shutil.copy(file, settings.data)
    with running(settings, missing, [RendererInfo(address="127.0.0.1:8085", alive=True)]) as api:
        yield api


@contextmanager
def running(settings: Settings, missing: Sequence[str] = (), renderers: Sequence[RendererInfo] = ()) -> Iterator[Api]:
    """The application on these settings, without a process."""
    prepare_data(settings)
    store, files = JobStore(settings.database_url), open_folder(settings.store_url)
    library, tokens = Library(files.within("library"), inspect=_inspect), Tokens(store.engine)
    yield Api(Services(settings, library, store, files, tokens, lambda: list(renderers), lambda: list(missing)))
    store.close()


@pytest.fixture
def stocked(api: Api, template: Path) -> Api:
    """An API with an object and a classifier with class names."""
    shutil.copytree(template / "library", api.services.settings.data / "library", dirs_exist_ok=True)
    return api


def _inspect(path: str) -> dict[str, object]:
    """A white box, a black box or one with a class for the background, by the first byte."""
    kinds = {b"W": (True, 3), b"B": (False, 3), b"G": (False, 4)}
    found = kinds.get(Path(path).read_bytes()[:1])
    if found is None:
        raise ClassifierError("The classifier is broken.")
    return {"white_box": found[0], "n_classes": found[1], "image_size": [224, 224]}
