"""A bare client of a real worker process, and boxes of known shape and colour to show it."""

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from trompe_shared.geometry import Camera, sailenv_pose
from trompe_shared.object3d import Object3D, encode_png, object_from_files
from trompe_shared.sailenv import COMMANDS, REGISTER, decode_frame

Triple = tuple[float, float, float]
Picture = NDArray[np.uint8]

FACES: dict[str, tuple[Triple, Triple, tuple[int, int, int]]] = {
    "right": ((1, 0, 0), (0, 1, 0), (200, 0, 0)),
    "left": ((-1, 0, 0), (0, 1, 0), (0, 200, 0)),
    "top": ((0, 1, 0), (0, 0, -1), (0, 0, 200)),
    "bottom": ((0, -1, 0), (0, 0, 1), (200, 200, 0)),
    "front": ((0, 0, 1), (0, 1, 0), (200, 0, 200)),
    "back": ((0, 0, -1), (0, 1, 0), (0, 200, 200)),
}
"""Each face's outward normal, the direction of growing v on it, and its colour."""


class Wire:
    """A bare client: sends commands of the table and returns their answers. ``long`` is the git client's dialect."""

    def __init__(
        self, address: tuple[str, int], *, size: tuple[int, int] = (32, 48), gzip: bool = False, long: bool = False
    ) -> None:
        self.socket = socket.create_connection(address, timeout=60)
        self.gzip, self.size = gzip, size
        self.tail = {"frustum_limited": True, "dynamic": None} if long else {}
        try:
            self.socket.sendall(REGISTER.encode_request(width=size[1], height=size[0], gzip=gzip))
            self.agent, self.scenes = REGISTER.decode_reply(self.read)
        except BaseException:
            self.socket.close()
            raise

    def read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.socket.recv(count - len(data))
            if not part:
                raise EOFError
            data += part
        return data

    def ask(self, command: str, **values: Any) -> Any:
        self.socket.sendall(COMMANDS[command].encode_request(**values))
        answer = COMMANDS[command].decode_reply(self.read)
        return answer[0] if len(answer) == 1 else answer

    def load(self, scenario: dict[str, Any]) -> tuple[str, ...]:
        """LOAD_SCENARIO: one id for each of its objects."""
        self.socket.sendall(COMMANDS["load_scenario"].encode_request(scenario=scenario))
        return COMMANDS["load_scenario"].decode_reply(self.read, count=len(scenario["objects"]))

    def views(self, flags: int) -> tuple[dict[str, bytes], float]:
        self.socket.sendall(COMMANDS["frame"].encode_request(flags=flags))
        return decode_frame(self.read, flags=flags, compressed=self.gzip)

    def picture(self) -> Picture:
        """The main view as it was sent, (H, W, 3) uint8."""
        return np.array(Image.open(io.BytesIO(self.views(1)[0]["main"])))

    def look(self, camera: Camera) -> None:
        """Stand where ``camera`` stands and look where it looks."""
        position, rotation = sailenv_pose(camera)
        self.ask("set_position", position=tuple(position))
        self.ask("set_rotation", rotation=tuple(rotation))

    def labels(self) -> dict[str, NDArray[Any]]:
        """All views but the main one, as SAILenv's client decodes them: row 0 on top, mirrored as Unity shows them.

        category (H, W) uint8, object (H, W, 3) uint8, depth (H, W) uint8, optical (H, W, 2) float32.
        """
        views = self.views(4 + 8 + 16 + 32)[0]
        raw = np.frombuffer(views["category"], np.uint8).reshape(*self.size, 3)[::-1]
        assert (raw == raw[..., :1]).all()
        flow = np.frombuffer(views["optical"], "<f4").reshape(*self.size, 2)[::-1]
        images = {name: np.array(Image.open(io.BytesIO(views[name]))) for name in ("object", "depth")}
        return {"category": raw[..., 0], "optical": flow, **images}

    def spawn(self, obj: Object3D, **placed: Any) -> str:
        path = self.ask("send_obj_zip", file=("càndle€.zip", obj.to_zip()))
        return self.spawn_named(f"file:{path}", **placed)

    def spawn_named(self, name: str, **placed: Any) -> str:
        place: dict[str, Any] = {"position": (0, 0, 0), "rotation": (0, 0, 0), "scale": (1, 1, 1)} | self.tail | placed
        return str(self.ask("spawn_object", name=name, remove_dynamics=True, use_parent=True, **place))


@pytest.fixture
def wire(worker: tuple[str, int]) -> Iterator[Callable[..., Wire]]:
    opened: list[Wire] = []

    def connect(**options: Any) -> Wire:
        opened.append(Wire(worker, **options))
        return opened[-1]

    yield connect
    for each in opened:
        each.socket.close()


@pytest.fixture(scope="session")
def wire_to() -> type[Wire]:
    """The class itself, to connect to another worker than the one all tests share."""
    return Wire


@pytest.fixture(scope="session")
def shadowless_worker(
    running_worker: Callable[..., AbstractContextManager[tuple[str, int]]],
) -> Iterator[tuple[str, int]]:
    with running_worker("--no-shadows") as address:
        yield address


@pytest.fixture(scope="session")
def ticking_worker(
    running_worker: Callable[..., AbstractContextManager[tuple[str, int]]],
) -> Iterator[tuple[str, int]]:
    """A worker in whose world half a second passes from frame to frame."""
    with running_worker("--time-step", "0.5") as address:
        yield address


@pytest.fixture(scope="session")
def make_boxes() -> Callable[..., Object3D]:
    return boxes


def boxes(
    *centre_and_half: tuple[Triple, Triple],
    textures: Mapping[str, Picture] | None = None,
    maps: Mapping[str, Picture] | None = None,
) -> Object3D:
    """Boxes with a material for each side (``FACES``).

    ``textures`` gives sides another albedo than their plain colour; ``maps`` are a "normal" and a "metallic" for all.
    """
    corners: list[str] = []
    faces: dict[str, list[str]] = {name: [] for name in FACES}
    for centre, half in centre_and_half or (((0, 0, 0), (0.10, 0.06, 0.04)),):
        for name, (normal, up, _) in FACES.items():
            across = np.cross(up, normal)
            for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
                point = np.array(centre) + half * (normal + (2 * u - 1) * across + (2 * v - 1) * np.array(up))
                corners.append("v {} {} {}\nvn {} {} {}\nvt {} {}".format(*point, *normal, u, v))
            faces[name].append("f " + " ".join(f"{k}/{k}/{k}" for k in range(len(corners) - 3, len(corners) + 1)))
    text = [*corners, *(f"usemtl {name}\n" + "\n".join(lines) for name, lines in faces.items())]
    files = {"box.obj": "\n".join(text).encode()}
    extra = {name: f"{name}.png" for name in maps or {}}
    table = {name: {"albedo": f"{name}_albedo.png", **extra} for name in FACES}
    files["box_mat_def.json"] = json.dumps(table).encode()
    for name, (_, _, color) in FACES.items():
        plain = np.full((4, 4, 3), color, np.uint8)
        files[f"{name}_albedo.png"] = encode_png((textures or {}).get(name, plain))
    return object_from_files(files | {f"{name}.png": encode_png(image) for name, image in (maps or {}).items()})


@pytest.fixture(scope="session")
def second_worker(
    running_worker: Callable[..., AbstractContextManager[tuple[str, int]]],
) -> Iterator[tuple[str, int]]:
    with running_worker() as address:
        yield address


_WITHOUT_EXTENSIONS = """
from trompe_renderer.command import render
from trompe_renderer.session import Session
from trompe_shared import sailenv

del Session.get_light_type, sailenv._BY_CODE[0xE1], sailenv._BY_CODE[0xE2]
render(["--port", "0"])
"""


@pytest.fixture(scope="session")
def plain_worker() -> Iterator[tuple[str, int]]:
    """A worker that knows SAILenv's own commands and nothing of ours but ``last_error``."""
    process = subprocess.Popen([sys.executable, "-c", _WITHOUT_EXTENSIONS], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    host, port = process.stdout.readline().split()[-1].split(":")
    yield host, int(port)
    process.kill()
    process.communicate()


@dataclass(frozen=True)
class Worker:
    """A worker process of the test's own. The supervisor is ``process``; ``serving`` is its child of the moment."""

    process: subprocess.Popen[str]
    address: tuple[str, int]

    @property
    def memory(self) -> int:
        """Resident bytes of the serving process."""
        status = Path(f"/proc/{self.serving}/status").read_text(encoding="ascii")
        return 1024 * int(re.search(r"VmRSS:\s+(\d+)", status)[1])  # type: ignore[index]

    @property
    def threads(self) -> int:
        return len(list(Path(f"/proc/{self.serving}/task").iterdir()))

    @property
    def files(self) -> int:
        """Open file descriptors of the serving process."""
        return len(list(Path(f"/proc/{self.serving}/fd").iterdir()))

    @property
    def serving(self) -> int:
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text(encoding="ascii")
        return int(children.split()[0])

    def send(self, number: signal.Signals) -> None:
        os.kill(self.serving, number)

    def end(self) -> None:
        """Supervisor and all, at once."""
        with suppress(IndexError, OSError):
            self.send(signal.SIGKILL)
        self.process.kill()
        self.process.wait()


@pytest.fixture
def own_worker(tmp_path: Path) -> Iterator[Callable[[], Worker]]:
    """Starts workers that the test may harm; gives each as a ``Worker``. What they say is in worker.log."""
    started: list[Worker] = []

    def start_one() -> Worker:
        command = [sys.executable, "-m", "trompe_renderer", "--port", "0"]
        environment = os.environ | {"PYTHONFAULTHANDLER": "1"}
        with (tmp_path / "worker.log").open("a") as said:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said, text=True, env=environment)
        assert process.stdout is not None
        ready = re.search(r"listening on ([\d.]+):(\d+)", process.stdout.readline())
        assert ready
        started.append(Worker(process, (ready[1], int(ready[2]))))
        return started[-1]

    yield start_one
    for worker in started:
        worker.end()
        assert worker.process.stdout is not None
        worker.process.stdout.close()
