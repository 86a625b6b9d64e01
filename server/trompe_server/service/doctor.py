"""``trompe doctor``: checks of the machine, each with a remedy."""

import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final

from trompe_server.settings import Settings
from trompe_shared.addresses import without_password
from trompe_shared.errors import TrompeError

PATIENCE: Final = 60.0
"""Time limit of a check in a child process, seconds; a healthy machine takes a few."""
MIN_FREE: Final = 2 * 2**30
"""Bytes that should be free: the largest upload and the files of its job."""
PORT: Final = 8000
"""Default port of ``trompe serve``."""
_RENDERER: Final = """
import sys
from trompe_server.renderers import local_renderer
from trompe_server.renderers.local import COMMAND
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects
if sys.argv[1:] == []:
    from trompe_renderer.engines.pyrender.platform import pyrender
    pyrender.OffscreenRenderer(8, 8).delete()  # without EGL, raises the cause
mug = shipped_objects()["mug"]
with local_renderer([*COMMAND, *sys.argv[1:]]) as target:
    view = View(Camera(distance=mug.distance, azimuth=30, elevation=20))
    image = target.render(load_object(mug.read()), [view], size=(32, 32))
assert image.min() < image.max(), "the image of an object is empty"
print(f"a renderer worker with {target.engine} starts and renders an object")
"""
_TORCH: Final = """
import sys, torch
torch.ones(2, device=sys.argv[1]).sum().item()
gpus = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
print(torch.__version__ + (f", GPU: {', '.join(gpus)}" if gpus else ", no GPU"))
"""


@dataclass(frozen=True)
class Finding:
    """Result of one check. ``remedy`` is set if it failed."""

    what: str
    ok: bool
    words: str
    remedy: str | None = None


class _CheckError(Exception):
    """Words and remedy of a failed check."""


def check_all(settings: Settings) -> Iterator[Finding]:
    """Run all checks, independent of each other. Takes some seconds."""
    checks: dict[str, Callable[[], str]] = {
        "data folder": partial(_check_folder, settings.data),
        "store": partial(_check_store, settings),
        "database": partial(_check_database, settings),
        "torch": partial(_check_torch, settings.device),
        "renderer": partial(_check_renderer, engine=settings.engine_flags),
        "shipped objects": _check_shipped,
        f"port {PORT}": partial(_check_port, PORT),
    }
    return (_finding(what, check) for what, check in checks.items())


def in_words(finding: Finding) -> str:
    """One line for people, and a second one with the remedy of a failed check."""
    line = f"{'ok  ' if finding.ok else 'FAIL'} {finding.what}: {finding.words}"
    return line if finding.remedy is None else f"{line}\n     {finding.remedy}"


def in_json(findings: Sequence[Finding]) -> str:
    return json.dumps({"ok": all(each.ok for each in findings), "findings": [asdict(each) for each in findings]})


def _finding(what: str, check: Callable[[], str]) -> Finding:
    try:
        return Finding(what, True, check())
    except _CheckError as error:
        return Finding(what, False, *error.args)


@contextmanager
def _or(remedy: str, *kinds: type[Exception], words: str) -> Iterator[None]:
    """Errors of these kinds within the block are a failed check."""
    try:
        yield
    except kinds as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise _CheckError(f"{words} ({reason}).", remedy) from error


def _check_folder(folder: Path, *, min_free: int = MIN_FREE) -> str:
    with _or("Choose another folder with --data or TROMPE_DATA.", OSError, words=f"{folder} cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            free = shutil.disk_usage(folder).free
    if free < min_free:
        raise _CheckError(
            f"only {free / 2**30:.1f} GiB free in {folder}; {min_free / 2**30:.0f} GiB recommended.",
            "Delete jobs (trompe jobs delete), set TROMPE_RETENTION_DAYS, or choose another folder with --data.",
        )
    return f"{folder} is writable, {free / 2**30:.1f} GiB free"


def _check_store(settings: Settings) -> str:
    from trompe_server.storage.folders import open_folder

    name, data, shown = f"doctor-{secrets.token_hex(8)}", b"content", without_password(settings.store_url)
    remedy = "Check the URL and the access rights (--store, TROMPE_STORE, credentials of the storage's own tools)."
    with _or(remedy, Exception, words=f"{shown} does not store a file"):  # fsspec raises any kind
        folder = open_folder(settings.store_url)
        folder.write(name, data)
        try:
            if folder.read(name) != data:
                raise OSError("reads back other bytes than written")
        finally:
            folder.delete(name)
    return f"{shown} stores a file"


def _check_database(settings: Settings) -> str:
    """The database answers, and its tables are up to date."""
    import sqlalchemy as sa

    from trompe_server.queue.store import JobStore

    remedy = "Start the database or correct its URL (--database, TROMPE_DATABASE). Without tables: trompe migrate"
    with (
        _or(remedy, TrompeError, sa.exc.SQLAlchemyError, words="the jobs cannot be read"),
        closing(JobStore(settings.database_url, silence=settings.silence)) as store,
    ):
        path = store.engine.url.database if store.engine.dialect.name == "sqlite" else None
        if path is not None and not Path(path).exists():
            return f"{store.engine.url!r} will be created by the first `trompe serve`"
        jobs = ", ".join(f"{count} {state.value}" for state, count in store.counts().items() if count) or "none"
        alive = sum(worker.alive for worker in store.workers())
    return f"{store.engine.url!r} answers; jobs: {jobs}; attack workers alive: {alive}"


def _check_torch(device: str) -> str:
    remedy = (
        "pip install 'trompe[server]'; for a GPU, torch in the build for your driver (https://pytorch.org). "
        "Or compute on the CPU: --device cpu."
    )
    words = _child(_TORCH, device, failure=f"torch does not compute on {device}", remedy=remedy)
    return f"{words}, computes on {device}, {len(os.sched_getaffinity(0))} cores"


def _check_renderer(code: str = _RENDERER, *, engine: Sequence[str] = ()) -> str:
    remedy = (
        f"Start it to see the cause: trompe render {' '.join(engine)}. docs/engines.md has each engine's needs."
        if engine
        else "Install EGL and Mesa (Debian and Ubuntu: apt install libegl1 libgl1 libgl1-mesa-dri)."
    )
    return _child(code, *engine, failure="no image can be rendered", remedy=remedy)


def _child(code: str, *arguments: str, failure: str, remedy: str) -> str:
    """Output of ``code`` in a child process: a broken driver may kill the process."""
    command = [sys.executable, "-W", "ignore", "-c", code, *arguments]
    with _or(remedy, subprocess.TimeoutExpired, ChildProcessError, words=failure):
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
        if done.returncode != 0:
            raise ChildProcessError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
    return done.stdout.strip()


def _check_shipped() -> str:
    from trompe_server.library import Library

    remedy = "Install trompe again: pip install --force-reinstall 'trompe[server]'"
    with (
        _or(remedy, ImportError, OSError, TrompeError, words="the shipped objects cannot be read"),
        tempfile.TemporaryDirectory() as empty,
    ):
        library = Library(Path(empty))
        return ", ".join(info.name for info in (*library.objects.all(), *library.classifiers.all()))


def _check_port(port: int) -> str:
    """The port is free, or a ``trompe serve`` listens on it."""
    if _is_ours(port):
        return "`trompe serve` is running"
    remedy = "Stop the program that uses it, or choose another port: trompe serve --port PORT (0: a free one)."
    with _or(remedy, OSError, words="`trompe serve` cannot listen on it"), socket.create_server(("127.0.0.1", port)):
        return "free for `trompe serve`"


def _is_ours(port: int) -> bool:
    import httpx

    try:
        answer = httpx.get(f"http://127.0.0.1:{port}/healthz", timeout=5, trust_env=False)
        return bool(answer.json() == {"status": "ok"})
    except (httpx.HTTPError, ValueError):
        return False
