"""A Trompe server without the attack: real HTTP on a real socket, jobs that play a script."""

import hashlib
import io
import json
import re
import threading
import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime
from email import message_from_bytes
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

import pytest
from pydantic import ValidationError

from trompe_client import Client, _job
from trompe_shared.api import (
    Accuracy,
    ClassifierInfo,
    Event,
    Job,
    JobList,
    JobSpec,
    JobState,
    Judgement,
    ObjectInfo,
    Progress,
    Result,
)

NOW = datetime(2025, 1, 2, 3, 4, tzinfo=UTC)
MUG = ObjectInfo(
    id="m" * 8, name="mug", materials=["m"], textures={"a.png": (4, 8)}, triangles=12, radius=0.1, shipped=True
)
TINY = ClassifierInfo(id="t" * 8, name="tiny", white_box=True, image_size=(32, 32), n_classes=10, shipped=True)


def result_of(spec: JobSpec, *, applicable: bool = True) -> Result:
    """A result with figures that a table must show."""
    own = Accuracy(
        views=60,
        a_before=0.9,
        a_after=0.3,
        a_drop=0.6667,
        a_drop_interval=(0.55, 0.78),
        a_before_interval=(0.8, 0.95),
        a_after_interval=(0.2, 0.43),
    )
    nothing = Accuracy(
        views=60, a_before=0, a_after=None, a_drop=None, a_before_interval=(0, 0.06), a_after_interval=None
    )
    return Result(
        spec=spec,
        object=spec.object,
        label=3,
        label_name="mug",
        classifier=spec.classifier,
        epsilon=spec.epsilon,
        alpha=spec.alpha,
        tau=spec.tau,
        surrogate_model="calibrated",
        surrogate_reason="error 0.4/255 is within tolerance",
        seed=spec.seed,
        steps=spec.steps,
        image_size=(32, 32),
        surrogate=own if applicable else None,
        target=own if applicable else nothing,
        held_out=own.model_copy(update={"views": 17}) if applicable else None,
        transfer_gap=0.0123 if applicable else None,
        judges=[Judgement(classifier=judge, target=own) for judge in spec.judges],
        texels_altered=0.421 if applicable else None,
        mean_texel_change=0.031 if applicable else None,
        max_view_change=0.2 if applicable else None,
        goal_reached=0.8333 if applicable else None,
        pixels_beyond_epsilon=0.0123 if applicable else None,
        views_beyond_epsilon=0.25 if applicable else None,
        ssim=0.987 if applicable else None,
        delta_e=1.234 if applicable else None,
        evaluations=4800 if applicable else None,
        queries=48_000 if applicable and spec.queries else None,
        warnings=["the [racket] is thin"],
        seconds={"calibrate": 1.25, "attack": 7.5},
        probe_renders=120,
        versions={"trompe": "0"},
        views=[],
        held_out_views=[],
    )


def adversarial_zip() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("mug.obj", "o mug")
        archive.writestr("a.png", b"repainted")
    return buffer.getvalue()


class FakeServer:
    """State and script of the fake. ``ending`` is how jobs end; ``drops`` how often an event stream breaks off."""

    def __init__(self) -> None:
        self.objects = [MUG]
        self.classifiers = [TINY]
        self.uploads: dict[str, tuple[str, bytes, dict[str, str]]] = {}
        self.jobs: dict[str, Job] = {}
        self.history: dict[str, list[Event]] = {}
        self.ending = JobState.succeeded
        self.drops = 0
        self.stalls = False
        self.resumed_after: list[str | None] = []
        self.page_size = 2
        self.ids = count(1)

    def add_job(self, spec: JobSpec) -> Job:
        job = Job(id=f"job-{next(self.ids)}", state=JobState.queued, spec=spec, created=NOW)
        self.jobs[job.id] = job
        self.history[job.id] = self.script(job)
        return job

    def script(self, job: Job) -> list[Event]:
        ids = count(1)

        def event(state: JobState, message: str | None = None, **progress: object) -> Event:
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
            update["artifacts"] = ["adversarial.zip", "report/index.html", "result.json"]
        if event.state is JobState.failed:
            update["error"] = "the renderer said no"
        if event.state is JobState.not_applicable:
            update["note"] = "no view was recognised before the attack"
        self.jobs[job_id] = self.jobs[job_id].model_copy(update=update)

    def artifact(self, job_id: str, name: str) -> bytes:
        if name == "adversarial.zip":
            return adversarial_zip()
        return b"<html>" if name.endswith(".html") else self.result(job_id).model_dump_json().encode()

    def result(self, job_id: str) -> Result:
        job = self.jobs[job_id]
        return result_of(job.spec, applicable=job.state is not JobState.not_applicable)


class Handler(BaseHTTPRequestHandler):
    """The contract's routes over a ``FakeServer``."""

    protocol_version = "HTTP/1.1"
    fake: FakeServer

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    def reply(self, body: bytes, status: int = 200, kind: str = "application/json") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("X-Request-ID", "req-7")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def problem(self, status: int, title: str, **more: object) -> None:
        self.reply(json.dumps({"title": title, "status": status, **more}).encode(), status, "application/problem+json")

    def do_GET(self) -> None:
        url = urlsplit(self.path)
        query = {key: values[0] for key, values in parse_qs(url.query).items()}
        if url.path in {"/v1/objects", "/v1/classifiers"}:
            stored = self.fake.objects if url.path.endswith("objects") else self.fake.classifiers
            return self.reply(json.dumps([one.model_dump(mode="json") for one in stored]).encode())
        if url.path == "/v1/jobs":
            return self.reply(self.page(query).model_dump_json().encode())
        match = re.fullmatch(r"/v1/jobs/([^/]+)(?:/(events|result|artifacts)(?:/(.+))?)?", url.path)
        if match is None or match[1] not in self.fake.jobs:
            return self.problem(404, "No such job")
        job_id, what, name = match.groups()
        if what == "events":
            return self.stream(job_id)
        if what == "artifacts":
            return self.reply(self.fake.artifact(job_id, unquote(name)), kind="application/octet-stream")
        job = self.fake.jobs[job_id]
        if what == "result" and not job.artifacts:
            return self.problem(409, "No result", detail=f"The job is {job.state.value}")
        return self.reply((self.fake.result(job_id) if what else job).model_dump_json().encode())

    def page(self, query: dict[str, str]) -> JobList:
        wanted = [job for job in reversed(self.fake.jobs.values()) if query.get("state") in {None, job.state.value}]
        start = int(query.get("cursor", 0))
        stop = start + self.fake.page_size
        return JobList(jobs=wanted[start:stop], next_cursor=str(stop) if stop < len(wanted) else None)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.path == "/v1/jobs":
            return self.submit(body)
        if self.path.endswith("/cancel"):
            job_id = self.path.split("/")[-2]
            job = self.fake.jobs[job_id]
            self.fake.jobs[job_id] = job.model_copy(update={"state": JobState.cancelled})
            return self.reply(self.fake.jobs[job_id].model_dump_json().encode())
        return self.store(self.path.rsplit("/", 1)[-1], *self.multipart(body))

    def submit(self, body: bytes) -> None:
        try:
            spec = JobSpec.model_validate_json(body)
        except ValidationError as error:
            return self.problem(
                422, "Invalid", errors=[{"loc": list(e["loc"]), "msg": e["msg"]} for e in error.errors()]
            )
        if spec.object not in {key for one in self.fake.objects for key in (one.id, one.name)}:
            return self.problem(404, "No such object", detail=f"{spec.object!r} is not stored")
        return self.reply(self.fake.add_job(spec).model_dump_json().encode(), 201)

    def multipart(self, body: bytes) -> tuple[str, bytes, dict[str, str]]:
        head = f"Content-Type: {self.headers['Content-Type']}\r\n\r\n".encode()
        parts = message_from_bytes(head + body).get_payload()
        fields = {part.get_param("name", header="content-disposition"): part for part in parts}
        file = fields.pop("file")
        form = {name: part.get_payload(decode=True).decode() for name, part in fields.items()}
        return file.get_filename(), file.get_payload(decode=True), form

    def store(self, kind: str, filename: str, data: bytes, form: dict[str, str]) -> None:
        stored_id = hashlib.sha256(data).hexdigest()[:12]
        self.fake.uploads[kind] = (filename, data, form)
        named = {"id": stored_id, "name": form.get("name", Path(filename).stem), "shipped": False}
        if kind == "objects":
            self.fake.objects.append(MUG.model_copy(update=named))
            return self.reply(self.fake.objects[-1].model_dump_json().encode())
        if kind == "classifiers":
            classes = json.loads(form["classes"]) if "classes" in form else None
            self.fake.classifiers.append(TINY.model_copy(update=named | {"classes": classes}))
            return self.reply(self.fake.classifiers[-1].model_dump_json().encode())
        return self.reply(json.dumps({"id": stored_id, "name": filename}).encode())

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
    http = ThreadingHTTPServer(("127.0.0.1", 0), type("BoundHandler", (Handler,), {"fake": fake}))
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    fake.url = f"http://127.0.0.1:{http.server_port}"
    yield fake
    http.shutdown()
    thread.join()
    http.server_close()


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client(server.url) as connected:
        yield connected


@pytest.fixture(autouse=True)
def _hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test waits for politeness; none sees the caller's server."""
    monkeypatch.setattr(_job, "PAUSE", 0.01)
    monkeypatch.setattr(_job, "PATIENCE", 0.2)
    monkeypatch.delenv("TROMPE_SERVER", raising=False)
    monkeypatch.delenv("TROMPE_DATA", raising=False)


@pytest.fixture
def mug_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "mug"
    folder.mkdir()
    for name, data in {"mug.obj": b"o mug", "mug_mat_def.json": b"{}", "a.png": b"paint", ".DS_Store": b"x"}.items():
        (folder / name).write_bytes(data)
    return folder
