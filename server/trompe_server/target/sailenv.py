"""A target renderer behind SAILenv's socket protocol: a Trompe renderer worker, or SAILenv itself."""

import contextlib
import math
import socket
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.errors import ObjectError, ProtocolError, RendererError, RendererLostError
from trompe_shared.geometry import View, light_travel_direction, sailenv_pose
from trompe_shared.object3d import Object3D, decode_rgb
from trompe_shared.opacity import opacity_of
from trompe_shared.sailenv import (
    COMMANDS,
    EXTENSIONS,
    MAIN_LIGHT,
    REGISTER,
    VIEW_FLAGS,
    decode_frame,
    take_status,
)

__all__ = ["SailenvTarget", "answers"]

Size = tuple[int, int]
Images = NDArray[np.uint8]

CONNECT_TIMEOUT: Final = 10.0
BATCH: Final = 64
"""Views asked for at once, of a renderer that takes several."""
REASON_TIMEOUT: Final = 5.0
"""Seconds to wait for a refusal's reason, which only a Trompe worker gives."""


class SailenvTarget:
    """Renders through the worker at ``host``:``port``, with one connection for each image size, made when first needed.

    ``timeout`` is how many seconds any one answer may take. One thread at a time may use it, but for ``abort``.
    """

    def __init__(self, host: str, port: int, *, timeout: float = 120.0) -> None:
        self._host, self._port, self._timeout = host, port, timeout
        self._connections: dict[Size, _Connection] = {}
        self._aborted = False

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the worker."""
        return self._host, self._port

    def __repr__(self) -> str:
        return f"SailenvTarget({self._host!r}, {self._port})"

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: Size, on_frame: Callable[[], None] | None = None
    ) -> Images:
        """See ``TargetRenderer.render``. Raises ``RendererLostError`` for a renderer of which nothing is to be had."""
        images = np.zeros((len(views), *size, 3), np.uint8)
        with contextlib.closing(self.pictures(obj, views, images)) as pictures:
            for _ in pictures:
                if on_frame is not None:
                    on_frame()
        return images

    def pictures(self, obj: Object3D, views: Sequence[View], images: Images) -> Generator[None]:
        """Render into ``images`` (views, H, W, 3), and stop after each. To be closed, where it may not run to its end.

        Where a connection dies that had worked before, the rest is asked for through a new one.
        """
        size = (images.shape[1], images.shape[2])
        done, worked = 0, size in self._connections
        try:
            while True:
                try:
                    for _ in self._connection(size).pictures(obj, views[done:], images[done:]):
                        done, worked = done + 1, True
                        yield
                    return
                except (EOFError, OSError) as error:
                    if not worked or self._aborted or isinstance(error, TimeoutError):
                        raise
                self._drop(size)
                worked = False
        except (RendererError, ProtocolError, OSError, EOFError) as error:
            self._drop(size)
            raise self._explained(error) from error
        except BaseException:
            self._drop(size)  # cut off in the middle of an exchange, its stream cannot be used again
            raise

    def abort(self) -> None:
        """Make a ``render`` that goes on in another thread fail at once; this target cannot be used any more."""
        self._aborted = True
        for connection in list(self._connections.values()):
            connection.shut()

    def close(self) -> None:
        """Hang up; the next ``render`` connects anew."""
        for size in list(self._connections):
            self._drop(size)

    def _connection(self, size: Size) -> "_Connection":
        if size not in self._connections:
            self._connections[size] = _Connection(self._host, self._port, size, self._timeout)
            self._connections[size].register()
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
            return RendererLostError(f"What answers at {where} is no SAILenv renderer: {error} {remedy}")
        if isinstance(error, TimeoutError):
            return RendererLostError(f"The renderer at {where} does not answer in time ({self._timeout:g} s). {remedy}")
        return RendererLostError(f"There is no renderer at {where} ({error}). {remedy}")


def answers(host: str, port: int, *, timeout: float) -> bool:
    """Whether a renderer at ``host``:``port`` shakes hands within ``timeout`` seconds."""
    try:
        with contextlib.closing(_Connection(host, port, (1, 1), timeout)) as connection:
            connection.register()
    except (RendererError, ProtocolError, OSError, EOFError):
        return False
    return True


class _Connection:
    """One agent on the renderer, with what it last told it, so that nothing is said twice."""

    def __init__(self, host: str, port: int, size: Size, timeout: float) -> None:
        self._size = size
        self._told: dict[tuple[str, Any], Mapping[str, Any]] = {}
        self._shown: tuple[int, Object3D] | None = None
        self._socket = socket.create_connection((host, port), timeout=min(timeout, CONNECT_TIMEOUT))
        self._socket.settimeout(timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._extended = False

    def register(self) -> None:
        """Shake hands, and find out what the renderer can do."""
        height, width = self._size
        self._socket.sendall(REGISTER.encode_request(width=width, height=height, gzip=False))
        REGISTER.decode_reply(self._read)
        self._extended = self.ask("get_light_type", light=EXTENSIONS) == (EXTENSIONS,)

    def close(self) -> None:
        self._socket.close()

    def shut(self) -> None:
        """End what goes on here in another thread."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def pictures(self, obj: Object3D, views: Sequence[View], images: Images) -> Iterator[None]:
        """Fill ``images`` (views, H, W, 3), and stop after each."""
        self._show(obj)
        if not self._extended:
            for image, view in zip(images, views, strict=True):
                image[:] = self._frame(view)
                yield
            return
        for start in range(0, len(views), BATCH):
            asked = [self._changes(view) for view in views[start : start + BATCH]]
            self._socket.sendall(COMMANDS["render_views"].encode_request(views=asked))
            for image in images[start : start + BATCH]:
                take_status(self._read, "a view")
                self._read_into(memoryview(image).cast("B"))
                yield

    def ask(self, command: str, **values: Any) -> tuple[Any, ...]:
        """Send one command and return the values of its answer."""
        row = COMMANDS[command]
        self._socket.sendall(row.encode_request(**values))
        return row.decode_reply(self._read)

    def _show(self, obj: Object3D) -> None:
        """Have ``obj`` at the origin and nothing else; what stands there is repainted where that is enough."""
        if self._shown is not None:
            instance, before = self._shown
            if self._repaint(instance, before, obj):
                self._shown = instance, obj
                return
            self._shown = None
            self.ask("despawn_object", instance=instance)
        self._shown = self._spawn(obj), obj

    def _repaint(self, instance: int, before: Object3D, obj: Object3D) -> bool:
        """Whether the instance looks like ``obj`` now."""
        if obj.files.keys() != before.files.keys():
            return False
        changed = [name for name, data in obj.files.items() if before.files[name] != data]
        if not changed:
            return True
        if not self._extended or not set(changed) <= obj.textures.keys():
            return False
        if not all(_cut_alike(obj.files[name], before.files[name]) for name in changed):
            return False  # colours are sent, not what alpha cuts out
        pictures = [(name, (*obj.textures[name].shape[:2], obj.textures[name].tobytes())) for name in changed]
        try:
            self.ask("repaint_object", instance=instance, textures=pictures)
        except RendererError:  # the file is more than an albedo; the renderer has changed nothing
            return False
        return True

    def _spawn(self, obj: Object3D) -> int:
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

    def _frame(self, view: View) -> Images:
        """The picture of one view, (H, W, 3) uint8, mirrored back."""
        for command, values in self._changes(view):
            self.ask(command, **values)
        flags = VIEW_FLAGS["main"]
        self._socket.sendall(COMMANDS["frame"].encode_request(flags=flags))
        views, delta_time = decode_frame(self._read, flags=flags, compressed=False)
        if math.isnan(delta_time):
            raise RendererError(f"it could not render a view. {self._reason()}")
        return _picture(views["main"], self._size)[:, ::-1]

    def _changes(self, view: View) -> list[tuple[str, Mapping[str, Any]]]:
        """Commands that show ``view``, without those that would say again what was said before."""
        changes = [each for each in _setting(view) if self._told.get(_key(*each)) != each[1]]
        self._told |= {_key(*each): each[1] for each in changes}
        return changes

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

    def _read_into(self, room: memoryview) -> None:
        while room:
            count = self._socket.recv_into(room)
            if not count:
                raise EOFError("it closed the connection")
            room = room[count:]


def _setting(view: View) -> list[tuple[str, Mapping[str, Any]]]:
    """Commands and their fields that put camera, light and background where ``view`` has them."""
    light = view.light
    position, rotation = sailenv_pose(view.camera)
    direction = light_travel_direction(light)
    return [
        ("set_position", {"position": tuple(position.tolist())}),
        ("set_rotation", {"rotation": tuple(rotation.tolist())}),
        ("set_light_direction", {"light": MAIN_LIGHT, "direction": tuple(direction.tolist())}),
        ("set_light_intensity", {"light": MAIN_LIGHT, "intensity": float(light.intensity)}),
        ("set_light_color", {"light": MAIN_LIGHT, "color": light.colour}),
        ("set_ambient_light_color", {"color": (round(255 * light.ambient),) * 3}),
        ("set_clear_color", {"color": tuple(view.background)}),
    ]


def _cut_alike(one: bytes, other: bytes) -> bool:
    """Whether the alpha of two albedo files cuts the same out of their surfaces."""
    first, second = opacity_of(one), opacity_of(other)
    if first is None or second is None:
        return first is second
    return np.array_equal(first, second)


def _key(command: str, values: Mapping[str, Any]) -> tuple[str, Any]:
    """What a command sets."""
    return command, values.get("light")


def _picture(data: bytes, size: Size) -> Images:
    try:
        picture = decode_rgb(data, "view")
    except ObjectError as error:
        raise ProtocolError(f"A view of {len(data)} bytes is not an image ({error.__cause__ or error}).") from error
    if picture.shape[:2] != size:
        raise ProtocolError(f"A view of {picture.shape[:2]} pixels came where {size} was asked for (height, width).")
    return picture
