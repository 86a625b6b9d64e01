"""Client of SAILenv's socket protocol: a target renderer in a Trompe worker or in SAILenv itself."""

import contextlib
import math
import socket
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_shared.engine import EngineInfo
from trompe_shared.errors import ObjectError, ProtocolError, RendererError, RendererLostError
from trompe_shared.geometry import View, light_travel_direction, sailenv_pose
from trompe_shared.object3d import Object3D, decode_rgb
from trompe_shared.opacity import opacity_of
from trompe_shared.sailenv import (
    COMMANDS,
    EXTENSIONS,
    LIGHT_NOT_FOUND,
    MAIN_LIGHT,
    MAX_FILE,
    REGISTER,
    VIEW_FLAGS,
    decode_frame,
    take_status,
)

Size = tuple[int, int]
Images = NDArray[np.uint8]

CONNECT_TIMEOUT: Final = 10.0
BATCH: Final = 64
"""Views per request, if the renderer supports several."""
SAILENV: Final = EngineInfo("sailenv", "", deterministic=False)
"""Any renderer without Trompe's extensions: SAILenv itself, for one."""
REASON_TIMEOUT: Final = 5.0
"""Seconds to wait for the reason of a refusal; only Trompe workers give one."""


class SailenvTarget:
    """Renders through the worker at ``host``:``port`` over one connection for each image size, opened on first use.

    timeout: seconds for any one answer. engine: the only one accepted; by default the one that answers first. Not
    thread-safe except for ``abort``.
    """

    def __init__(self, host: str, port: int, *, timeout: float = 120.0, engine: EngineInfo | None = None) -> None:
        self._host, self._port, self._timeout, self._engine = host, port, timeout, engine
        self._connections: dict[Size, _Connection] = {}
        self._aborted = False

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the worker."""
        return self._host, self._port

    def __repr__(self) -> str:
        return f"SailenvTarget({self._host!r}, {self._port})"

    @property
    def engine(self) -> EngineInfo:
        """See ``TargetRenderer.engine``."""
        if self._engine is None:
            try:
                return self._connection((1, 1)).engine
            except (RendererError, ProtocolError, OSError, EOFError) as error:
                self._drop((1, 1))
                raise self._explained(error) from error
        return self._engine

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: Size, on_frame: Callable[[], None] | None = None
    ) -> Images:
        """Render as ``TargetRenderer.render``. Raises ``RendererLostError`` if the renderer cannot be reached."""
        images = np.zeros((len(views), *size, 3), np.uint8)
        with contextlib.closing(self.pictures(obj, views, images)) as pictures:
            for _ in pictures:
                if on_frame is not None:
                    on_frame()
        return images

    def pictures(self, obj: Object3D, views: Sequence[View], images: Images) -> Generator[None]:
        """Render into ``images`` (views, H, W, 3), yielding after each. Close the generator if it may not finish.

        After the loss of a connection that had worked before, the rest comes through a new one.
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
            self._drop(size)  # interrupted within an exchange: the stream is out of step
            raise

    def abort(self) -> None:
        """Make a ``render`` in another thread fail at once; afterwards the target is unusable."""
        self._aborted = True
        for connection in list(self._connections.values()):
            connection.shut()

    def close(self) -> None:
        """Close all connections; the next ``render`` connects again."""
        for size in list(self._connections):
            self._drop(size)

    def _connection(self, size: Size) -> "_Connection":
        if size not in self._connections:
            self._connections[size] = _Connection(self._host, self._port, size, self._timeout)
            if self._aborted:
                raise RendererLostError("it was given up.")
            self._connections[size].register()
            found = self._connections[size].engine
            self._engine = self._engine or found
            if found != self._engine:
                raise RendererLostError(f"its engine is {found}, but {self._engine} was asked for.")
        return self._connections[size]

    def _drop(self, size: Size) -> None:
        connection = self._connections.pop(size, None)
        if connection is not None:
            connection.close()

    def _explained(self, error: Exception) -> RendererError:
        """The error to raise instead, with the renderer's address and a remedy."""
        where = f"{self._host}:{self._port}"
        remedy = f"Start one with `trompe render --host {self._host} --port {self._port}`, or give another address."
        if self._aborted:
            return RendererLostError(f"The renderer at {where} was given up: it did not answer.")
        if isinstance(error, RendererError):
            return type(error)(f"Renderer at {where}: {error}")
        if isinstance(error, ProtocolError):
            return RendererLostError(f"The server at {where} is not a SAILenv renderer: {error} {remedy}")
        if isinstance(error, TimeoutError):
            return RendererLostError(f"The renderer at {where} did not answer within {self._timeout:g} s. {remedy}")
        return RendererLostError(f"There is no renderer at {where} ({error}). {remedy}")


def engine_at(host: str, port: int, *, timeout: float) -> EngineInfo | None:
    """The engine of the renderer at ``host``:``port``; ``None`` without an answer within ``timeout`` seconds."""
    with contextlib.suppress(RendererError), contextlib.closing(SailenvTarget(host, port, timeout=timeout)) as target:
        return target.engine
    return None


class _Connection:
    """One agent on the renderer; remembers its settings and sends changes only."""

    def __init__(self, host: str, port: int, size: Size, timeout: float) -> None:
        self._size = size
        self._told: dict[tuple[str, Any], Mapping[str, Any]] = {}
        self._shown: tuple[int, Object3D] | None = None
        try:
            self._socket = socket.create_connection((host, port), timeout=min(timeout, CONNECT_TIMEOUT))
        except UnicodeError as error:  # of a host name with an empty or too long label
            raise OSError(error) from error
        self._socket.settimeout(timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._extended = False
        self.engine = SAILENV

    def register(self) -> None:
        """Complete the handshake and detect Trompe's extensions."""
        height, width = self._size
        self._socket.sendall(REGISTER.encode_request(width=width, height=height, gzip=False))
        REGISTER.decode_reply(self._read)
        (told,) = self.ask("get_light_type", light=EXTENSIONS)
        self.engine = SAILENV if told == LIGHT_NOT_FOUND else EngineInfo.from_text(told)
        self._extended = self.engine is not SAILENV

    def close(self) -> None:
        self._socket.close()

    def shut(self) -> None:
        """Interrupt an exchange in another thread."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def pictures(self, obj: Object3D, views: Sequence[View], images: Images) -> Iterator[None]:
        """Fill ``images`` (views, H, W, 3), yielding after each."""
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
        """Send one command; return the values of its answer."""
        row = COMMANDS[command]
        self._socket.sendall(row.encode_request(**values))
        return row.decode_reply(self._read)

    def _show(self, obj: Object3D) -> None:
        """Put ``obj`` alone at the origin; repaint the present object if that suffices."""
        if self._shown is not None:
            instance, before = self._shown
            if self._repaint(instance, before, obj):
                self._shown = instance, obj
                return
            self._shown = None
            self.ask("despawn_object", instance=instance)
        self._shown = self._spawn(obj), obj

    def _repaint(self, instance: int, before: Object3D, obj: Object3D) -> bool:
        """Try to turn the instance into ``obj`` by new textures; return whether that worked."""
        if obj.files.keys() != before.files.keys() or obj.materials != before.materials:
            return False
        changed = [name for name, data in obj.files.items() if before.files[name] != data]
        if not changed:
            return True
        if not self._extended or not set(changed) <= obj.textures.keys():
            return False
        if not all(_opaque_alike(obj.files[name], before.files[name], name in obj.blended) for name in changed):
            return False  # only colours are sent, not alpha
        pictures = [(name, (*obj.textures[name].shape[:2], obj.textures[name].tobytes())) for name in changed]
        try:
            self.ask("repaint_object", instance=instance, textures=pictures)
        except RendererError:  # the file has another use too; the renderer changed nothing
            return False
        return True

    def _spawn(self, obj: Object3D) -> int:
        """Upload the object and spawn it at the origin; return the number of the instance."""
        archive = obj.to_zip()
        if len(archive) > MAX_FILE:
            raise ObjectError(
                f"The object {obj.name!r} has {len(archive) >> 20} MiB as a zip, more than the {MAX_FILE >> 20} MiB "
                "that can be sent to a renderer. Use smaller textures or a simpler mesh."
            )
        (path,) = self.ask("send_obj_zip", file=(f"{obj.name}.zip", archive))
        if not path:
            raise RendererError(f"it refused the file of {obj.name!r}. {self._reason()}")
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
        """The image of one view, (H, W, 3) uint8, no longer mirrored."""
        for command, values in self._changes(view):
            self.ask(command, **values)
        flags = VIEW_FLAGS["main"]
        self._socket.sendall(COMMANDS["frame"].encode_request(flags=flags))
        views, delta_time = decode_frame(self._read, flags=flags)
        if math.isnan(delta_time):
            raise RendererError(f"it could not render a view. {self._reason()}")
        return _picture(views["main"], self._size)[:, ::-1]

    def _changes(self, view: View) -> list[tuple[str, Mapping[str, Any]]]:
        """Commands that set up ``view``, except for settings already in place."""
        wanted = _setting(view)
        if self._extended and not self.engine.deterministic:
            wanted.append(("set_noise", {"number": view.noise}))
        changes = [each for each in wanted if self._told.get(_key(*each)) != each[1]]
        self._told |= {_key(*each): each[1] for each in changes}
        return changes

    def _reason(self) -> str:
        """The renderer's reason for refusing the last command (Trompe workers give one)."""
        try:
            self._socket.settimeout(REASON_TIMEOUT)
            return str(self.ask("last_error")[0]) or "It gave no reason."
        except (OSError, EOFError, ProtocolError):
            return "It gave no reason."

    def _read(self, count: int) -> bytes:
        data = bytearray(count)
        self._read_into(memoryview(data))
        return bytes(data)

    def _read_into(self, room: memoryview) -> None:
        while room:
            count = self._socket.recv_into(room)
            if not count:
                raise EOFError("it closed the connection")
            room = room[count:]


def _setting(view: View) -> list[tuple[str, Mapping[str, Any]]]:
    """Commands, with their fields, for camera, light and background of ``view``."""
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


def _opaque_alike(one: bytes, other: bytes, blended: bool) -> bool:
    """Whether two albedo files have the same cut-out or blended alpha."""
    first, second = opacity_of(one, blended=blended), opacity_of(other, blended=blended)
    if first is None or second is None:
        return first is second
    return np.array_equal(first, second)


def _key(command: str, values: Mapping[str, Any]) -> tuple[str, Any]:
    """The setting that a command changes."""
    return command, values.get("light")


def _picture(data: bytes, size: Size) -> Images:
    try:
        picture = decode_rgb(data, "view")
    except ObjectError as error:
        raise ProtocolError(f"A view of {len(data)} bytes is not an image ({error.__cause__ or error}).") from error
    if picture.shape[:2] != size:
        raise ProtocolError(f"A view has {picture.shape[:2]} pixels, expected {size} (height, width).")
    return picture
