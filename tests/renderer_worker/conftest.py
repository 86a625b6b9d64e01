"""A bare client of a real worker process, and boxes of known shape and colour to show it."""

import io
import json
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

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
    """A bare client: sends commands of the table and returns their answers."""

    def __init__(self, address: tuple[str, int], *, size: tuple[int, int] = (32, 48), gzip: bool = False) -> None:
        self.socket = socket.create_connection(address, timeout=60)
        self.gzip = gzip
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

    def views(self, flags: int) -> tuple[dict[str, bytes], float]:
        self.socket.sendall(COMMANDS["frame"].encode_request(flags=flags))
        return decode_frame(self.read, flags=flags, compressed=self.gzip)

    def picture(self) -> Picture:
        """The main view as it was sent, (H, W, 3) uint8."""
        return np.array(Image.open(io.BytesIO(self.views(1)[0]["main"])))

    def spawn(self, obj: Object3D, **placed: Any) -> str:
        path = self.ask("send_obj_zip", file=("càndle€.zip", obj.to_zip()))
        place: dict[str, Any] = {"position": (0, 0, 0), "rotation": (0, 0, 0), "scale": (1, 1, 1)} | placed
        return str(self.ask("spawn_object", name=f"file:{path}", remove_dynamics=True, use_parent=True, **place))


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
