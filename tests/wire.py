"""A bare client of SAILenv's protocol, and boxes of known shape and colour for it to show."""

import io
import json
import socket
from collections.abc import Mapping
from gzip import decompress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_shared.geometry import FIELD_OF_VIEW, Camera, sailenv_pose
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
"""Outward normal, direction of growing v, and colour of each face."""
ORIGIN: dict[str, Any] = {"position": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}


def plain(*color: int) -> Picture:
    """A texture of one colour, (4, 4, channels)."""
    return np.full((4, 4, len(color)), color, np.uint8)


WHITE = dict.fromkeys(FACES, plain(255, 255, 255))


def boxes(
    *centre_and_half: tuple[Triple, Triple],
    textures: Mapping[str, Picture] | None = None,
    maps: Mapping[str, Picture] | None = None,
) -> Object3D:
    """Boxes with a material for each side (``FACES``), one of 0.2 x 0.12 x 0.08 m by default.

    ``textures`` replaces the plain colours of sides; ``maps`` are a "normal" and a "metallic" map for all.
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
        files[f"{name}_albedo.png"] = encode_png((textures or {}).get(name, plain(*color)))
    return object_from_files(files | {f"{name}.png": encode_png(image) for name, image in (maps or {}).items()})


def speckled(*seed: int) -> Object3D:
    """A box with a random texture on each side."""
    random, box = np.random.default_rng(seed), boxes()
    return box.with_textures({name: random.integers(0, 256, (16, 16, 3), dtype=np.uint8) for name in box.textures})


def linear(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear light of sRGB levels from 0 to 255."""
    level = picture / 255
    return np.asarray(np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4))


def pixel_rays(size: tuple[int, int]) -> NDArray[np.float64]:
    """Points (H, W, 3) at depth 1, in camera coordinates, behind the pixel centres of a picture of (height, width)."""
    height, width = size
    slope = np.tan(np.radians(FIELD_OF_VIEW / 2)) / (height / 2)
    x, y = (np.arange(width) + 0.5 - width / 2) * slope, (height / 2 - np.arange(height) - 0.5) * slope
    return np.stack([*np.meshgrid(x, y), np.full(size, -1.0)], axis=-1)


def on_screen(camera: Camera, points: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """(column, row) of world points (..., 3), in pixels from the top left corner of a picture of (height, width)."""
    height, width = size
    matrix = camera.world_to_camera()
    x, y, z = np.moveaxis(points @ matrix[:3, :3].T + matrix[:3, 3], -1, 0)
    scale = height / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2)) / -z
    return np.stack([width / 2 + scale * x, height / 2 - scale * y], axis=-1)


def received(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise EOFError("the worker hung up")
        data += part
    return data


class Wire:
    """Sends commands and returns their answers. ``long`` is the git client's dialect; ``size`` is (height, width)."""

    def __init__(
        self, address: tuple[str, int], *, size: tuple[int, int] = (32, 48), gzip: bool = False, long: bool = False
    ) -> None:
        self.socket = socket.create_connection(address, timeout=240)
        self.gzip, self.size = gzip, size
        self.tail = {"frustum_limited": True, "dynamic": None} if long else {}
        try:
            self.socket.sendall(REGISTER.encode_request(width=size[1], height=size[0], gzip=gzip))
            self.agent, self.scenes = REGISTER.decode_reply(self.read)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self.socket.close()

    def read(self, count: int) -> bytes:
        return received(self.socket, count)

    def send(self, command: str, **values: Any) -> None:
        self.socket.sendall(COMMANDS[command].encode_request(**values))

    def ask(self, command: str, **values: Any) -> Any:
        self.send(command, **values)
        answer = COMMANDS[command].decode_reply(self.read)
        return answer[0] if len(answer) == 1 else answer

    def load(self, scenario: Mapping[str, Any]) -> tuple[str, ...]:
        """LOAD_SCENARIO: one id for each of its objects."""
        self.send("load_scenario", scenario=scenario)
        return tuple(COMMANDS["load_scenario"].decode_reply(self.read)[0] for _ in scenario["objects"])

    def views(self, flags: int) -> tuple[dict[str, bytes], float]:
        self.send("frame", flags=flags)
        views, delta_time = decode_frame(self.read, flags=flags)
        return {name: decompress(view) if self.gzip else view for name, view in views.items()}, delta_time

    def picture(self) -> Picture:
        """The main view as sent, (H, W, 3) uint8."""
        return np.array(Image.open(io.BytesIO(self.views(1)[0]["main"])))

    def look(self, camera: Camera) -> None:
        position, rotation = sailenv_pose(camera)
        self.ask("set_position", position=tuple(position))
        self.ask("set_rotation", rotation=tuple(rotation))

    def labels(self) -> dict[str, NDArray[Any]]:
        """All views but the main one, as SAILenv's client decodes them: row 0 on top, mirrored as Unity's.

        category (H, W) uint8, object (H, W, 3) uint8, depth (H, W) uint8, optical (H, W, 2) float32.
        """
        views = self.views(4 + 8 + 16 + 32)[0]
        raw = np.frombuffer(views["category"], np.uint8).reshape(*self.size, 3)[::-1]
        assert (raw == raw[..., :1]).all()
        flow = np.frombuffer(views["optical"], "<f4").reshape(*self.size, 2)[::-1]
        images = {name: np.array(Image.open(io.BytesIO(views[name]))) for name in ("object", "depth")}
        return {"category": raw[..., 0], "optical": flow, **images}

    def mask(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that show an object."""
        return np.asarray(self.labels()["object"].any(axis=-1))

    def spawn(self, obj: Object3D, **placed: Any) -> str:
        path = self.ask("send_obj_zip", file=("càndle€.zip", obj.to_zip()))
        return self.spawn_named(f"file:{path}", **placed)

    def spawn_named(self, name: str, **placed: Any) -> str:
        place = ORIGIN | self.tail | placed
        return str(self.ask("spawn_object", name=name, remove_dynamics=True, use_parent=True, **place))
