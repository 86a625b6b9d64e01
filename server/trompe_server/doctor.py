"""``trompe doctor``: what the service needs from the machine, tried out one by one."""

import errno
import http.client
import json
import os
import re
import secrets
import selectors
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final

from trompe_server.settings import Settings
from trompe_shared.errors import RendererError, TrompeError

__all__ = ["Finding", "check_all", "in_json", "in_words"]

PATIENCE: Final = 60.0
"""Seconds that a child process has for what takes a healthy machine a few."""
ROOM: Final = 2 * 2**30
"""Bytes that should be free: an upload of the largest kind, its job's files, and some air."""
PORTS: Final = {8000: "trompe serve", 8085: "trompe render"}
"""Ports that commands listen on unless told otherwise."""
MESA: Final = "Install EGL and Mesa (Debian and Ubuntu: apt install libegl1 libgl1 libgl1-mesa-dri)."
AGAIN: Final = "Install trompe again: pip install --force-reinstall 'trompe[server]'"
_RENDER: Final = """
from trompe_renderer.platform import GL, pyrender
scene = pyrender.Scene(bg_color=[255, 0, 0])
scene.add(pyrender.PerspectiveCamera(yfov=1.0))
renderer = pyrender.OffscreenRenderer(8, 8)
color, _ = renderer.render(scene)
assert color[4, 4].tolist() == [255, 0, 0], color[4, 4]
print(GL.glGetString(GL.GL_RENDERER).decode())
"""
_TORCH: Final = """
import sys, torch
torch.ones(2, device=sys.argv[1]).sum().item()
gpus = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
print(torch.__version__ + (f", GPU: {', '.join(gpus)}" if gpus else ", no GPU"))
"""


@dataclass(frozen=True)
class Finding:
    """One thing that was checked, how it is, and, where something is wrong, how to mend it."""

    what: str
    ok: bool
    words: str
    remedy: str | None = None


class _UnwellError(Exception):
    """A check failed; ``remedy`` is how to mend it."""

    def __init__(self, words: str, remedy: str) -> None:
        super().__init__(words)
        self.words, self.remedy = words, remedy


def check_all(settings: Settings) -> Iterator[Finding]:
    """Check one thing after the other; each check stands for itself. Takes some seconds."""
    checks: dict[str, Callable[[], str]] = {
        "data folder": partial(_check_folder, settings.data),
        "disk space": partial(_check_space, settings.data),
        "store": partial(_check_store, settings),
        "database": partial(_check_database, settings),
        "engine": partial(_check_engine, settings),
        "torch": partial(_check_torch, settings.device),
        "rendering": _check_rendering,
        "renderer": _check_renderer,
        "shipped objects": _check_shipped,
        "TROMPE_ASSETS": _check_assets,
        **{f"port {port}": partial(_check_port, port, command) for port, command in PORTS.items()},
    }
    return (_finding(what, check) for what, check in checks.items())


def in_words(finding: Finding) -> str:
    """A line for people; a second one says how to mend what is wrong."""
    line = f"{'ok  ' if finding.ok else 'FAIL'} {finding.what}: {finding.words}"
    return line if finding.remedy is None else f"{line}\n     {finding.remedy}"


def in_json(findings: Sequence[Finding]) -> str:
    """All findings for programs."""
    return json.dumps({"ok": all(each.ok for each in findings), "findings": [asdict(each) for each in findings]})


def _finding(what: str, check: Callable[[], str]) -> Finding:
    try:
        return Finding(what, ok=True, words=check())
    except _UnwellError as error:
        return Finding(what, ok=False, words=error.words, remedy=error.remedy)


def _check_folder(folder: Path) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return f"{folder} can be written"
    except OSError as error:
        raise _UnwellError(
            f"{folder} cannot be written ({error}).", "Choose another with --data or TROMPE_DATA."
        ) from error


def _check_space(folder: Path) -> str:
    there = next(place for place in (folder, *folder.absolute().parents) if place.is_dir())
    free = shutil.disk_usage(there).free
    words = f"{free / 2**30:.1f} GiB free where {folder} is"
    if free < ROOM:
        raise _UnwellError(
            f"only {words}; {ROOM / 2**30:.0f} GiB should be.",
            "Delete jobs (trompe jobs delete), let old ones go by themselves (TROMPE_RETENTION_DAYS), or choose "
            "another folder with --data.",
        )
    return words


def _check_store(settings: Settings) -> str:
    """Write, read and delete a file where artifacts go."""
    from trompe_server.artifacts import open_folder

    name, data = f"doctor-{secrets.token_hex(8)}", b"still there"
    try:
        folder = open_folder(settings.store_url)
        folder.write(name, data)
        try:
            if folder.read(name) != data:
                raise OSError("what is read is not what was written")
        finally:
            folder.delete(name)
    except Exception as error:  # an fsspec file system raises what it likes
        raise _UnwellError(
            f"{settings.store_url} does not keep a file ({error}).",
            "Check the URL and the rights to it (--store, TROMPE_STORE, credentials of the storage's own tools).",
        ) from error
    return f"{settings.store_url} keeps a file"


def _check_database(settings: Settings) -> str:
    import sqlalchemy as sa

    from trompe_server.database import connect

    if settings.database_url.startswith("sqlite") and not _sqlite_file(settings.database_url).exists():
        return f"{_without_password(settings)} will be made by the first `trompe serve`"
    try:
        engine = connect(settings.database_url)
        try:
            with engine.connect() as connection:
                connection.execute(sa.text("select 1"))
        finally:
            engine.dispose()
    except (TrompeError, sa.exc.SQLAlchemyError) as error:
        raise _UnwellError(
            f"{_without_password(settings)} does not answer ({error}).",
            "Start it, or give the right address (--database, TROMPE_DATABASE).",
        ) from error
    return f"{_without_password(settings)} answers"


def _check_engine(settings: Settings) -> str:
    """Whether jobs can be queued, and whether there is anybody to run them."""
    import sqlalchemy as sa

    from trompe_server.jobs.store import JobStore

    if settings.database_url.startswith("sqlite") and not _sqlite_file(settings.database_url).exists():
        return "no job was ever queued here"
    store = JobStore(settings.database_url, silence=settings.silence)
    try:
        jobs = ", ".join(f"{count} {state.value}" for state, count in store.counts().items() if count) or "none"
        alive = sum(worker.alive for worker in store.workers())
        return f"jobs: {jobs}; attack workers alive: {alive}"
    except (TrompeError, sa.exc.SQLAlchemyError) as error:
        raise _UnwellError(
            f"the tables of jobs cannot be read ({error}).", "Make them, or bring them up to date: trompe migrate"
        ) from error
    finally:
        store.close()


def _check_torch(device: str) -> str:
    """In a process of its own: a broken driver may end the process."""
    words = _child(
        "-c",
        _TORCH,
        device,
        unwell=f"torch does not compute on {device}",
        remedy=(
            "pip install 'trompe[server]'; for a GPU, torch in the build for your driver (https://pytorch.org). "
            "Or compute on the CPU: --device cpu."
        ),
    )
    return f"{words}, computes on {device}, {len(os.sched_getaffinity(0))} cores"


def _check_rendering() -> str:
    """In a process of its own: a broken GL driver may end the process."""
    return "EGL, " + _child("-c", _RENDER, unwell="no picture can be rendered without a screen", remedy=MESA)


def _child(*arguments: str, unwell: str, remedy: str) -> str:
    """What a Python process of its own prints."""
    command = [sys.executable, "-W", "ignore", *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except subprocess.TimeoutExpired as error:
        raise _UnwellError(f"{unwell}: it took more than {PATIENCE:.0f} s.", remedy) from error
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        raise _UnwellError(f"{unwell} ({last}).", remedy)
    return done.stdout.strip()


def _check_renderer() -> str:
    """A renderer worker as `trompe serve` starts it shows an object."""
    try:
        with _running_renderer() as address:
            _ask_for_a_picture(address)
    except (TrompeError, OSError) as error:
        raise _UnwellError(f"a renderer worker shows no object ({error}).", MESA) from error
    return "a renderer worker comes up and shows an object"


def _ask_for_a_picture(address: tuple[str, int]) -> None:
    """Raises ``RendererError`` unless what listens there is a renderer worker that shows an object."""
    from trompe_server.target import SailenvTarget
    from trompe_shared.geometry import Camera, View
    from trompe_shared.object3d import load_object
    from trompe_shared.shipped import shipped_objects

    mug = shipped_objects()["mug"]
    view = View(Camera(distance=mug.distance, azimuth=30, elevation=20))
    target = SailenvTarget(*address, timeout=PATIENCE)
    try:
        image = target.render(load_object(mug.read()), [view], size=(32, 32))
    finally:
        target.close()
    if image.min() == image.max():
        raise RendererError("its picture of an object is empty")


@contextmanager
def _running_renderer() -> Iterator[tuple[str, int]]:
    """The address of a renderer worker that runs as long as the block. Raises ``OSError`` if it does not come up."""
    command = [sys.executable, "-m", "trompe_server.jobs.leash", "render", "--port", "0"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            with selectors.DefaultSelector() as ready:
                ready.register(process.stdout, selectors.EVENT_READ)
                line = process.stdout.readline() if ready.select(PATIENCE) else ""
            match = re.search(r"listening on (\S+):(\d+)", line)
            if match is None:
                raise OSError(errno.ECHILD, "it does not come up")
            yield match[1], int(match[2])
        finally:
            process.kill()


def _check_shipped() -> str:
    from trompe_server.library import Library

    try:
        with tempfile.TemporaryDirectory() as nothing:
            library = Library(Path(nothing))
            names = [info.name for info in library.objects()], [info.name for info in library.classifiers()]
    except (ImportError, OSError, TrompeError) as error:
        raise _UnwellError(f"the shipped objects cannot be read ({error}).", AGAIN) from error
    if not all(names):
        raise _UnwellError("no objects or no classifier came with this installation.", AGAIN)
    return ", ".join([*names[0], *names[1]])


def _check_assets() -> str:
    if "TROMPE_ASSETS" not in os.environ:
        return "not set; only the tests and benches with real objects ask for it"
    folder = Path(os.environ["TROMPE_ASSETS"])
    missing = [name for name in ("objects/objects.json", "classifiers") if not (folder / name).exists()]
    if missing:
        raise _UnwellError(
            f"{folder} has no {' and no '.join(missing)}.",
            "Let TROMPE_ASSETS name the folder that holds objects/ and classifiers/, or unset it.",
        )
    return f"{folder} holds objects and classifiers"


def _check_port(port: int, command: str) -> str:
    """Whether a command can listen where it does unless told otherwise; one of ours may be there already."""
    try:
        with socket.create_server(("127.0.0.1", port)):
            return f"free for `{command}`"
    except OSError as error:
        if error.errno == errno.EADDRINUSE and _is_ours(port):
            return f"a `{command}` runs there"
        raise _UnwellError(
            f"`{command}` cannot listen there ({error.strerror}).",
            f"End the program that does, or choose another: {command} --port PORT (0 takes a free one).",
        ) from error


def _is_ours(port: int) -> bool:
    """Whether what listens at one of ``PORTS`` is what should."""
    if port == 8085:
        with suppress(TrompeError):
            _ask_for_a_picture(("127.0.0.1", port))
            return True
        return False
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", "/healthz")
        return bool(json.load(connection.getresponse()) == {"status": "ok"})
    except (OSError, ValueError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def _sqlite_file(url: str) -> Path:
    import sqlalchemy as sa

    return Path(sa.make_url(url).database or "")


def _without_password(settings: Settings) -> str:
    import sqlalchemy as sa

    try:
        return sa.make_url(settings.database_url).render_as_string(hide_password=True)
    except sa.exc.ArgumentError:
        return "the address given"
