"""``trompe doctor``: what the service needs from the machine, tried out one by one."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from trompe_server.settings import Settings
from trompe_shared.errors import TrompeError

__all__ = ["Finding", "check_all"]

RENDER_TIMEOUT: Final = 60.0
_RENDER: Final = """
from trompe_renderer.platform import GL, pyrender
scene = pyrender.Scene(bg_color=[255, 0, 0])
scene.add(pyrender.PerspectiveCamera(yfov=1.0))
renderer = pyrender.OffscreenRenderer(8, 8)
color, _ = renderer.render(scene)
assert color[4, 4].tolist() == [255, 0, 0], color[4, 4]
print(GL.glGetString(GL.GL_RENDERER).decode())
"""


@dataclass(frozen=True)
class Finding:
    """One thing that was checked, and in ``words`` how it is, or what is wrong and how to mend it."""

    what: str
    ok: bool
    words: str


def check_all(settings: Settings) -> list[Finding]:
    """Check everything; each check stands for itself."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("data folder", lambda: _check_folder(settings.data)),
        ("torch", _check_torch),
        ("rendering", _check_rendering),
        ("shipped objects", _check_objects),
    ]
    return [_finding(what, check) for what, check in checks]


class _UnwellError(Exception):
    """A check failed; the message says how to mend it."""


def _finding(what: str, check: Callable[[], str]) -> Finding:
    try:
        return Finding(what, ok=True, words=check())
    except _UnwellError as error:
        return Finding(what, ok=False, words=str(error))


def _check_folder(folder: Path) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return f"{folder} can be written"
    except OSError as error:
        raise _UnwellError(
            f"{folder} cannot be written ({error}); choose another with --data or TROMPE_DATA."
        ) from error


def _check_torch() -> str:
    try:
        return f"version {version('torch')}, {len(os.sched_getaffinity(0))} cores"
    except PackageNotFoundError as error:
        raise _UnwellError("torch is not installed; install it with: pip install 'trompe[server]'") from error


def _check_rendering() -> str:
    """Render in a process of its own, since a broken GL driver may end the process."""
    command = [sys.executable, "-W", "ignore", "-c", _RENDER]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT, check=False)
    except subprocess.TimeoutExpired as error:
        raise _UnwellError(f"a picture of 8 x 8 pixels took more than {RENDER_TIMEOUT:.0f} s.") from error
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        raise _UnwellError(
            f"no picture can be rendered without a screen ({last}). "
            "Install EGL and Mesa (Debian and Ubuntu: apt install libegl1 libgl1 libgl1-mesa-dri)."
        )
    return f"EGL, {done.stdout.strip()}"


def _check_objects() -> str:
    from trompe_server.library import Library

    try:
        objects = [info.name for info in Library(Path(os.devnull)).objects()]
    except (ImportError, OSError, TrompeError) as error:
        raise _UnwellError(f"the shipped objects cannot be read ({error}); install trompe again.") from error
    if not objects:
        raise _UnwellError("no objects came with this installation; install trompe again.")
    return ", ".join(objects)
