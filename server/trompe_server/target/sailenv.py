"""A target renderer behind SAILenv's socket protocol: a Trompe renderer worker, or SAILenv itself."""

import io
import math
import socket
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_shared.errors import ProtocolError, RendererError
from trompe_shared.geometry import View, light_travel_direction, sailenv_pose
from trompe_shared.object3d import Object3D
from trompe_shared.sailenv import COMMANDS, MAIN_LIGHT, REGISTER, VIEW_FLAGS, decode_frame

__all__ = ["SailenvTarget"]

Size = tuple[int, int]
Images = NDArray[np.uint8]

CONNECT_TIMEOUT: Final = 10.0
REASON_TIMEOUT: Final = 5.0
"""Seconds to wait for a refusal's reason, which only a Trompe worker gives."""


class SailenvTarget:
    """Renders through the worker at ``host``:``port``, with one connection for each image size, made when first needed.

    ``timeout`` is how many seconds any one answer may take. Use an instance from one thread at a time.
    """

    def __init__(self, host: str, port: int, *, timeout: float = 120.0) -> None:
        self._host, self._port, self._timeout = host, port, timeout
        self._connections: dict[Size, _Connection] = {}

    def __repr__(self) -> str:
        return f"SailenvTarget({self._host!r}, {self._port})"

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: Size, on_frame: Callable[[], None] | None = None
    ) -> Images:
        """See ``TargetRenderer.render``."""
        images = np.zeros((len(views), *size, 3), np.uint8)
        try:
            connection = self._connection(size)
            instance = connection.spawn(obj)
            for image, view in zip(images, views, strict=True):
                image[:] = connection.frame(view)
                if on_frame is not None:
                    on_frame()
            connection.ask("despawn_object", instance=instance)
        except (RendererError, ProtocolError, OSError, EOFError) as error:
            self._drop(size)
            raise self._explained(error) from error
        except BaseException:
            self._drop(size)  # cut off in the middle of an exchange, its stream cannot be used again
            raise
        return images

    def close(self) -> None:
        """Hang up; the next ``render`` connects anew."""
        for size in list(self._connections):
            self._drop(size)

    def _connection(self, size: Size) -> "_Connection":
        if size not in self._connections:
            self._connections[size] = _Connection(self._host, self._port, size, self._timeout)
        return self._connections[size]

    def _drop(self, size: Size) -> None:
        connection = self._connections.pop(size, None)
        if connection is not None:
            connection.close()

    def _explained(self, error: Exception) -> RendererError:
        """The error to raise instead: with the renderer's address, and what to do."""
        where = f"{self._host}:{self._port}"
        remedy = f"Start one with `trompe render --host {self._host} --port {self._port}`, or name another address."
        if isinstance(error, RendererError):
            return RendererError(f"Renderer at {where}: {error}")
        if isinstance(error, ProtocolError):
            return RendererError(f"What answers at {where} is no SAILenv renderer: {error} {remedy}")
        if isinstance(error, TimeoutError):
            return RendererError(f"The renderer at {where} does not answer in time ({self._timeout:g} s). {remedy}")
        return RendererError(f"There is no renderer at {where} ({error}). {remedy}")


class _Connection:
    """One agent on the renderer, with what it last told it, so that nothing is said twice."""

    def __init__(self, host: str, port: int, size: Size, timeout: float) -> None:
        self._size = size
        self._told: dict[tuple[str, Any], dict[str, Any]] = {}
        self._socket = socket.create_connection((host, port), timeout=min(timeout, CONNECT_TIMEOUT))
        self._socket.settimeout(timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            height, width = size
            self._socket.sendall(REGISTER.encode_request(width=width, height=height, gzip=False))
            REGISTER.decode_reply(self._read)
        except BaseException:
            self._socket.close()
            raise

    def close(self) -> None:
        self._socket.close()

    def ask(self, command: str, **values: Any) -> tuple[Any, ...]:
        """Send one command and return the values of its answer."""
        row = COMMANDS[command]
        self._socket.sendall(row.encode_request(**values))
        return row.decode_reply(self._read)

    def spawn(self, obj: Object3D) -> int:
        """Upload the object and put it at the origin; the number of the instance."""
        (path,) = self.ask("send_obj_zip", file=(f"{obj.name}.zip", obj.to_zip()))
        (instance,) = self.ask(
            "spawn_object",
            name=f"file:{path}",
            position=(0.0, 0.0, 0.0),
            rotation=(0.0, 0.0, 0.0),
            remove_dynamics=True,
            scale=(1.0, 1.0, 1.0),
            use_parent=True,
            frustum_limited=False,
            dynamic=None,
        )
        if not instance.isdecimal():
            raise RendererError(f"it refused the object {obj.name!r}. {self._reason()}")
        return int(instance)

    def frame(self, view: View) -> Images:
        """The picture of one view, (H, W, 3) uint8, mirrored back."""
        self._set_view(view)
        flags = VIEW_FLAGS["main"]
        self._socket.sendall(COMMANDS["frame"].encode_request(flags=flags))
        views, delta_time = decode_frame(self._read, flags=flags, compressed=False)
        if math.isnan(delta_time):
            raise RendererError(f"it could not render a view. {self._reason()}")
        return _picture(views["main"], self._size)[:, ::-1]

    def _set_view(self, view: View) -> None:
        light = view.light
        position, rotation = sailenv_pose(view.camera)
        ambient = (round(255 * light.ambient),) * 3
        self._tell("set_position", position=tuple(position.tolist()))
        self._tell("set_rotation", rotation=tuple(rotation.tolist()))
        self._tell("set_light_direction", light=MAIN_LIGHT, direction=tuple(light_travel_direction(light).tolist()))
        self._tell("set_light_intensity", light=MAIN_LIGHT, intensity=float(light.intensity))
        self._tell("set_ambient_light_color", color=ambient)
        self._tell("set_clear_color", color=tuple(view.background))

    def _tell(self, command: str, **values: Any) -> None:
        key = (command, values.get("light"))
        if self._told.get(key) != values:
            self.ask(command, **values)
            self._told[key] = values

    def _reason(self) -> str:
        """Why the last command was refused, as far as the renderer tells (a Trompe worker does)."""
        try:
            self._socket.settimeout(REASON_TIMEOUT)
            return str(self.ask("last_error")[0]) or "It gave no reason."
        except (OSError, EOFError, ProtocolError):
            return "It gave no reason."

    def _read(self, count: int) -> bytes:
        data = bytearray()
        while len(data) < count:
            part = self._socket.recv(min(count - len(data), 2**20))
            if not part:
                raise EOFError("it closed the connection")
            data += part
        return bytes(data)


def _picture(data: bytes, size: Size) -> Images:
    try:
        with Image.open(io.BytesIO(data)) as image:
            picture = np.array(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise ProtocolError(f"A view of {len(data)} bytes is not an image ({error}).") from error
    if picture.shape[:2] != size:
        raise ProtocolError(f"A view of {picture.shape[:2]} pixels came where {size} was asked for (height, width).")
    return picture
