"""A double of the server: real HTTP on a real socket, with scripted jobs and faults."""

import asyncio
import hashlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from email import message_from_bytes
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock
from urllib.parse import parse_qs, unquote, urlsplit

import pytest
from click import testing
from pydantic import ValidationError
from pydantic_core import to_json

from trompe_client import Client, _following
from trompe_client._embedded import embedded_server
from trompe_client._http import AsyncPort, BlockingPort
from trompe_client._plan import Upload, object_source
from trompe_client.cli import main
from trompe_server.api import examples
from trompe_shared.api import (
    MANIFEST,
    MANIFEST_PAGE,
    Accuracy,
    BackgroundInfo,
    ClassifierInfo,
    Event,
    FooledAs,
    Job,
    JobList,
    JobRequest,
    JobSpec,
    JobState,
    Judgement,
    JudgementRequest,
    JudgementSpec,
    Manifest,
    ObjectInfo,
    PipelineJudgement,
    Progress,
    RendererInfo,
    Result,
    WorkerInfo,
)
from trompe_shared.faults import faults_of
from trompe_shared.local_files import pack_zip

NOW = datetime(2025, 1, 2, 3, 4, tzinfo=UTC)
SPEC = JobSpec.of("mug", label="mug")
"""The shortest job."""
MUG = ObjectInfo(
    id="m" * 8, name="mug", materials=["m"], textures={"a.png": (4, 8)}, triangles=12, radius=0.1, shipped=True
)
WORKER = WorkerInfo(id="w1", host="here", device="cpu", alive=True, started=NOW, seen=NOW, jobs=["job-1"])
RENDERER = RendererInfo(address="127.0.0.1:8085", alive=True)
TINY = ClassifierInfo(
    id="t" * 8, name="tiny", white_box=True, image_size=(32, 32), n_classes=10, classes=None, shipped=True
)
OWN = Accuracy(
    views=60,
    distinct=50,
    a_before=0.9,
    a_after=0.3,
    a_drop=0.6667,
    a_drop_interval=(0.55, 0.78),
    a_before_interval=(0.8, 0.95),
    a_after_interval=(0.2, 0.43),
)
NOTHING = dict.fromkeys(("a_after", "a_after_interval", "a_drop", "a_drop_interval"))
NOT_RECOGNISED = OWN.model_copy(update=NOTHING | {"a_before": 0, "a_before_interval": (0, 0.06)})
HELD_OUT = OWN.model_copy(update={"views": 17, "distinct": 17})
FIGURES: dict[str, Any] = {
    "surrogate": OWN,
    "held_out": HELD_OUT,
    "image_pipelines": [PipelineJudgement(pipeline="half size", held_out=HELD_OUT)],
    "transfer_gap": 0.0123,
    "texels_altered": 0.421,
    "mean_texel_change": 0.031,
    "max_view_change": 0.2,
    "goal_reached": 0.8333,
    "fooled_as": [
        FooledAs(label=k, name=name, own=9, held_out=6 - k, neighbour=k == 5)
        for k, name in enumerate(("jug, ewer", "cup", "vase", "pot", "pan", "beer mug", None))
        if k != 1
    ],
    "pixels_beyond_epsilon": 0.0123,
    "views_beyond_epsilon": 0.25,
    "ssim": 0.987,
    "delta_e": 1.234,
    "delta_e_95": 2.5,
    "evaluations": 4800,
}
"""Figures of an attack; None if nothing was recognised."""


def result_of(spec: JobSpec, *, applicable: bool = True) -> Result:
    """The API's example of a result, with figures for all rows of a table."""
    paint, search, classifier = spec.paint, spec.search, spec.victim.classifier
    asked = {"spec": spec, "object": spec.object, "classifier": classifier, "seed": search.seed, "steps": search.steps}
    asked |= {"epsilon": paint.epsilon, "alpha": spec.alpha, "tau": paint.tau}
    found = {
        "label": 3,
        "labels": [3, 1],
        "label_names": ["mug", "cup"],
        "surrogate_model": "calibrated",
        "surrogate_reason": "error 0.4/255 is within tolerance",
        "target": OWN if applicable else NOT_RECOGNISED,
        "judges": [Judgement(classifier=judge, target=OWN) for judge in spec.judges.networks],
        "queries": 48_000 if applicable and spec.victim.queries else None,
        "seconds": {"calibrate": 1.25, "attack": 7.5},
    }
    figures = FIGURES if applicable else dict.fromkeys(FIGURES) | {"fooled_as": [], "image_pipelines": []}
    return Result.model_validate(examples.RESULT | asked | found | figures)


def trompe(*words: object) -> testing.Result:
    """Run a command in this process."""
    return testing.CliRunner().invoke(main, [str(word) for word in words])


def stored_id(data: bytes) -> str:
    """The double's id of an upload."""
    return hashlib.sha256(data).hexdigest()[:12]


def zipped(source: str | Path) -> bytes:
    """What is sent for an object of several files."""
    upload = object_source(source)
    assert isinstance(upload, Upload)
    assert isinstance(upload.content, bytes)
    return upload.content


ADVERSARIAL = pack_zip({"mug.obj": b"o mug", "a.png": b"repainted", "maps/b.png": b"kept"})
JUDGED = [MANIFEST, MANIFEST_PAGE]
"""Files of a judgement."""


def manifest_of(job: Job) -> Manifest:
    """The API's example of a judgement, of this job's objects."""
    assert isinstance(job.spec, JudgementSpec)
    example = examples.MANIFEST
    files = {name: example[name] | {"source": getattr(job.spec, name)} for name in ("before", "after")}
    asked = {"suite": None, "label": job.spec.label, "epsilon": job.spec.epsilon}
    return Manifest.model_validate(example | asked | files)


class FakeServer:
    """State and script of the double.

    ``ending``: final state of jobs. ``drops``: number of event streams to break off. ``cut``: bytes of the next files
    before they break off. ``refusals``: answers (status, headers) to the next requests, with ``detail``. ``lies``:
    number of files with wrong bytes. ``token``: required if set. ``when_listed``: called before jobs are listed.
    """

    def __init__(self) -> None:
        self.objects = [MUG]
        self.classifiers = [TINY]
        self.backgrounds: list[BackgroundInfo] = []
        self.keys: dict[str, str] = {}
        self.requests: list[tuple[str, str, dict[str, str]]] = []
        self.cut: list[int] = []
        self.refusals: list[tuple[int, dict[str, str]]] = []
        self.detail: str | None = None
        self.lies = 0
        self.token: str | None = None
        self.note = "no view was recognised before the attack"
        self.warnings = ["the [racket] is thin"]
        self.artifacts = ["NAME-adversarial.zip", "report/index.html", "result.json"]
        self.when_listed: Callable[[], None] = lambda: None
        self.url = ""
        self.uploads: dict[str, tuple[str, bytes, dict[str, str]]] = {}
        self.jobs: dict[str, Job] = {}
        self.history: dict[str, list[Event]] = {}
        self.ending = JobState.succeeded
        self.drops = 0
        self.stalls = False
        self.resumed_after: list[str | None] = []
        self.page_size = 2
        self.ids = count(1)

    def add_job(self, request: JobRequest | JudgementRequest) -> Job:
        queued: dict[str, Any] = request.model_dump(include={"priority", "labels", "needs"})
        queued["names"] = {one.id: one.name for one in self.objects if not one.shipped}
        queued["names"] |= {one.id: one.name for one in self.classifiers if not one.shipped}
        job = Job(id=f"job-{next(self.ids)}", state=JobState.queued, spec=request.spec(), created=NOW, **queued)
        self.jobs[job.id] = job
        self.history[job.id] = self.script(job)
        return job

    def script(self, job: Job) -> list[Event]:
        ids = count(1)

        def event(state: JobState, message: str | None = None, **progress: Any) -> Event:
            return Event(id=next(ids), time=NOW, state=state, progress=Progress(**progress), message=message)

        return [
            event(JobState.queued),
            event(JobState.running, phase="calibrate", fraction=0.2, message="chose the calibrated model"),
            event(JobState.running, phase="attack", fraction=0.5, step=7, steps=15, loss=0.25, fooled=0.5),
            event(JobState.running, phase="attack", fraction=0.8, step=15, steps=15, loss=0.0, fooled=0.9),
            event(self.ending, phase="judge", fraction=1.0),
        ]

    def reach(self, job_id: str, event: Event) -> None:
        """The job is now where ``event`` says."""
        update: dict[str, object] = {"state": event.state, "progress": event.progress}
        if event.state in {JobState.succeeded, JobState.not_applicable}:
            attack = isinstance(self.jobs[job_id].spec, JobSpec)
            files = [each.replace("NAME", self.name_of(job_id)) for each in self.artifacts] if attack else JUDGED
            update["artifacts"] = files
        if event.state is JobState.failed:
            update["error"] = "the renderer said no"
        if event.state is JobState.not_applicable:
            update["note"] = self.note
        self.jobs[job_id] = self.jobs[job_id].model_copy(update=update)

    def cancel(self, job_id: str) -> None:
        first = self.history[job_id][0]
        self.history[job_id] = [first, first.model_copy(update={"id": 2, "state": JobState.cancelled})]
        self.reach(job_id, self.history[job_id][-1])

    def finish_all(self) -> None:
        for job_id, job in self.jobs.items():
            if not job.state.final:
                self.reach(job_id, self.history[job_id][-1])

    def artifact(self, job_id: str, name: str) -> bytes:
        if name == MANIFEST:
            return manifest_of(self.jobs[job_id]).model_dump_json().encode()
        if name.endswith("-adversarial.zip"):
            return ADVERSARIAL
        return b"<html>" if name.endswith(".html") else self.result(job_id).model_dump_json().encode()

    def name_of(self, job_id: str) -> str:
        reference = self.jobs[job_id].attack.object
        return [one.name for one in self.objects if reference in {one.id, one.name}][-1]

    def result(self, job_id: str) -> Result:
        job = self.jobs[job_id]
        found = result_of(job.attack, applicable=job.state is not JobState.not_applicable)
        return found.model_copy(update={"warnings": self.warnings})


class Handler(BaseHTTPRequestHandler):
    """The contract's routes over a ``FakeServer``."""

    protocol_version = "HTTP/1.1"
    fake: FakeServer

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    def reply(self, body: bytes, status: int = 200, kind: str = "application/json", **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("X-Request-ID", "req-7")
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        for name, value in ({"Content-Length": str(len(body))} | given).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def problem(self, status: int, title: str, headers: Mapping[str, str] = {}, **more: object) -> None:
        body = json.dumps({"title": title, "status": status, **more}).encode()
        self.reply(body, status, "application/problem+json", **headers)

    def answer(self, value: object, status: int = 200) -> None:
        self.reply(to_json(value), status)

    def refused(self) -> bool:
        """Note the request; refuse it if the script says so, or if the token is not right."""
        self.fake.requests.append((self.command, self.path, dict(self.headers)))
        if self.fake.refusals:
            status, headers = self.fake.refusals.pop(0)
            self.problem(status, "Not now", headers, detail=self.fake.detail)
            return True
        if self.fake.token and self.headers.get("Authorization") != f"Bearer {self.fake.token}":
            self.problem(401, "Who are you")
            return True
        return False

    def do_GET(self) -> None:
        if self.refused():
            return None
        url = urlsplit(self.path)
        lists = {
            "/v1/objects": self.fake.objects,
            "/v1/classifiers": self.fake.classifiers,
            "/v1/backgrounds": self.fake.backgrounds,
            "/v1/workers": [WORKER],
            "/v1/renderers": [RENDERER],
        }
        if url.path in lists:
            return self.answer(lists[url.path])
        if url.path == "/v1/jobs":
            self.fake.when_listed()
            return self.answer(self.page(parse_qs(url.query)))
        routes = "events|result|manifest|archive|artifacts"
        match = re.fullmatch(rf"/v1/(?:jobs|judgements)/([^/]+)(?:/({routes})(?:/(.+))?)?", url.path)
        if match is None or match[1] not in self.fake.jobs:
            return self.problem(404, "No such job")
        job_id, what, name = match.groups()
        if what == "events":
            return self.stream(job_id)
        if what == "artifacts":
            return self.file(self.fake.artifact(job_id, unquote(name)))
        if what == "archive":
            return self.reply(ADVERSARIAL, kind="application/zip")
        job = self.fake.jobs[job_id]
        if what in {"result", "manifest"} and not job.artifacts:
            return self.problem(409, "No result", detail=f"The job is {job.state.value}")
        if what == "manifest":
            return self.answer(manifest_of(job)) if isinstance(job.spec, JudgementSpec) else self.problem(404, "None")
        return self.answer(self.fake.result(job_id) if what else job)

    def file(self, data: bytes) -> None:
        """A file with its checksum, or what is asked for of it; cut off, or wrong, where the script says so."""
        etag = f'"{hashlib.sha256(data).hexdigest()}"'
        if self.headers.get("If-None-Match") == etag:
            return self.reply(b"", 304, ETag=etag)
        start = 0
        if self.headers.get("If-Range") == etag:
            start = int(self.headers["Range"].removeprefix("bytes=").removesuffix("-"))
            if start >= len(data):
                return self.problem(416, "No such range")
        body = data[start:]
        if self.fake.lies:
            self.fake.lies -= 1
            body = bytes(len(body))
        sent = body[: self.fake.cut.pop(0)] if self.fake.cut else body
        self.close_connection = len(sent) < len(body)
        length, status = str(len(body)), 206 if start else 200
        return self.reply(sent, status, "application/octet-stream", Content_Length=length, ETag=etag)

    def page(self, query: dict[str, list[str]]) -> JobList:
        def wanted(job: Job) -> bool:
            labels = dict(label.split(":", 1) for label in query.get("label", []))
            known = {"state": job.state.value}
            if isinstance(job.spec, JobSpec):
                known |= {"object": job.spec.object, "classifier": job.spec.victim.classifier}
            asked = all(query.get(name) in (None, [value]) for name, value in known.items())
            return asked and labels.items() <= job.labels.items()

        found = [job for job in reversed(self.fake.jobs.values()) if wanted(job)]
        start = int(query.get("cursor", ["0"])[0])
        stop = start + self.fake.page_size
        return JobList(jobs=found[start:stop], next_cursor=str(stop) if stop < len(found) else None)

    def do_DELETE(self) -> None:
        if self.refused():
            return None
        job = self.fake.jobs[self.path.rsplit("/", 1)[-1]]
        if not job.state.final:
            return self.problem(409, "The job goes on")
        del self.fake.jobs[job.id]
        return self.reply(b"", 204)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.refused():
            return None
        if self.path == "/v1/jobs":
            return self.submit(body)
        if self.path == "/v1/judgements":
            return self.make(JudgementRequest.model_validate_json(body))
        *_, job_id, what = self.path.split("/")
        if what == "cancel":
            self.fake.cancel(job_id)
            return self.answer(self.fake.jobs[job_id])
        if what == "retry":
            old = self.fake.jobs[job_id]
            more = {"priority": old.priority, "labels": old.labels, "needs": old.needs}
            return self.make(JobRequest.model_validate(old.spec.model_dump() | more))
        return self.store(what, *self.multipart(body))

    def submit(self, body: bytes) -> None:
        try:
            request = JobRequest.model_validate_json(body)
        except ValidationError as error:
            wrong = [{"field": fault.place, "message": fault.message} for fault in faults_of(error)]
            return self.problem(422, "Invalid", errors=wrong)
        if request.object not in {key for one in self.fake.objects for key in (one.id, one.name)}:
            return self.problem(404, "No such object", detail=f"{request.object!r} is not stored")
        return self.make(request)

    def make(self, request: JobRequest | JudgementRequest) -> None:
        """A new job, or the one of the same key."""
        key = self.headers["Idempotency-Key"]
        new = key not in self.fake.keys
        if new:
            self.fake.keys[key] = self.fake.add_job(request).id
        job = self.fake.jobs[self.fake.keys[key]]
        if job.spec != request.spec():
            return self.problem(409, "Another job has this key")
        return self.answer(job, 201 if new else 200)

    def multipart(self, body: bytes) -> tuple[str, bytes, dict[str, str]]:
        head = f"Content-Type: {self.headers['Content-Type']}\r\n\r\n".encode()
        parts: Any = message_from_bytes(head + body).get_payload()
        fields = {part.get_param("name", header="content-disposition"): part for part in parts}
        file = fields.pop("file")
        form = {name: part.get_payload(decode=True).decode() for name, part in fields.items()}
        return file.get_filename(), file.get_payload(decode=True), form

    def store(self, kind: str, filename: str, data: bytes, form: dict[str, str]) -> None:
        self.fake.uploads[kind] = (filename, data, form)
        named = {"id": stored_id(data), "name": form.get("name", Path(filename).stem), "shipped": False}
        if kind == "objects":
            self.fake.objects.append(MUG.model_copy(update=named))
            return self.answer(self.fake.objects[-1], 201)
        if kind == "classifiers":
            classes = json.loads(form["classes"]) if "classes" in form else None
            self.fake.classifiers.append(TINY.model_copy(update=named | {"classes": classes}))
            return self.answer(self.fake.classifiers[-1], 201)
        self.fake.backgrounds.append(BackgroundInfo(id=stored_id(data), name=filename))
        return self.answer(self.fake.backgrounds[-1], 201)

    def stream(self, job_id: str) -> None:
        last = self.headers.get("Last-Event-ID")
        self.fake.resumed_after.append(last)
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        self.chunk(": welcome\r\n\r\n")
        if self.fake.stalls:
            self.close_connection = True
            return
        for event in self.fake.history[job_id][int(last or 0) :]:
            self.chunk(f"id: {event.id}\r\nevent: progress\r\ndata: {event.model_dump_json()}\r\n\r\n")
            self.fake.reach(job_id, event)
            if event.id == 2 and self.fake.drops:
                self.fake.drops -= 1
                self.close_connection = True
                return
        self.chunk("")

    def chunk(self, text: str) -> None:
        self.wfile.write(f"{len(text):x}\r\n{text}\r\n".encode())


@pytest.fixture
def server() -> Iterator[FakeServer]:
    fake = FakeServer()
    http: Any = ThreadingHTTPServer(("127.0.0.1", 0), type("BoundHandler", (Handler,), {"fake": fake}))
    http.handle_error = Mock()  # clients may hang up at any time: whichever test runs by then would print a trace
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    fake.url = f"http://127.0.0.1:{http.server_port}"
    yield fake
    http.shutdown()
    thread.join()
    http.server_close()


@pytest.fixture(scope="package")
def service() -> Iterator[str]:
    """The address of a real service, as `trompe serve` starts it."""
    with embedded_server() as url:
        yield url


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client(server.url) as connected:
        yield connected


@pytest.fixture(autouse=True)
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """How long the clients would have slept: no test waits for politeness, and none sees the caller's server.

    While they follow a job, the time that passes for them is that of their sleep.
    """
    pauses: list[float] = []

    async def block(_port: BlockingPort, seconds: float) -> None:
        pauses.append(seconds)
        time.sleep(min(seconds, 0.01))

    async def suspend(_port: AsyncPort, seconds: float) -> None:
        pauses.append(seconds)
        await asyncio.sleep(min(seconds, 0.01))

    monkeypatch.setattr(BlockingPort, "sleep", block)
    monkeypatch.setattr(AsyncPort, "sleep", suspend)
    monkeypatch.setattr(_following, "PATIENCE", 2.0)
    monkeypatch.setattr(_following, "time", SimpleNamespace(monotonic=lambda: sum(pauses)))
    for name in ("TROMPE_SERVER", "TROMPE_TOKEN", "TROMPE_DATA"):
        monkeypatch.delenv(name, raising=False)
    return pauses


@pytest.fixture
def mug_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "mug"
    folder.mkdir()
    for name, data in {"mug.obj": b"o mug", "mug_mat_def.json": b"{}", "a.png": b"paint", ".DS_Store": b"x"}.items():
        (folder / name).write_bytes(data)
    return folder
