"""SAILenv's wire protocol as a table of commands, and the codec that server and client share. No sockets here.

A connection starts with ``REGISTER``. Then the client sends one command at a time (a code byte and the fields of its
row in ``COMMANDS``) and waits for that row's reply. Messages have no frame: after one misread field the stream is lost.
So every length is checked, and after a ``ProtocolError`` the connection must be closed.

Both directions are little-endian. Strings differ: a client counts code points, a server counts bytes. Readers are
callables: ``read(n)`` returns exactly n bytes, or raises ``EOFError`` or ``OSError`` at the end of the stream.
"""

import codecs
import contextlib
import gzip
import json
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from trompe_shared.errors import ProtocolError, RendererError, RendererLostError
from trompe_shared.object3d import MAX_TEXTURE_SIDE

MAX_TEXT: Final = 64 * 2**10
MAX_JSON: Final = 2**20
MAX_FILE: Final = 256 * 2**20
MAX_VIEW: Final = 256 * 2**20
_MAX_TEXTURES: Final = 256
MAX_LIST: Final = 4096
MAX_SIDE: Final = 4096
"""Largest width or height of an image, pixels."""
MAX_VIEWS: Final = 256
"""Most views in one RENDER_VIEWS."""
_MAX_CHANGES: Final = 64

EXTENSIONS: Final = "trompe extensions 2"
"""The name of a light. To GET_LIGHT_TYPE for it a Trompe worker with the commands from 0xE1 on answers its engine's
identity (``EngineInfo.to_text``); any other SAILenv answers that the light does not exist."""
MAIN_LIGHT: Final = "Main Light"
RIM_LIGHT: Final = "Rim Light"
LIGHT_NOT_FOUND: Final = "light_not_found"
LOST: Final = "lost: "
"""Begins the status of a renderer that ends after it: another one may succeed."""

VIEW_FLAGS: Final[Mapping[str, int]] = {"main": 1, "category": 4, "object": 8, "optical": 16, "depth": 32}
"""Bit of each view in FRAME's flags, in the order of the reply."""

Reader = Callable[[int], bytes]


class FieldCodec(Protocol):
    """Encoding of one field."""

    def pack(self, value: Any) -> bytes:
        """Encode ``value``. Raises ``ProtocolError`` for a value outside the protocol."""
        ...

    def take(self, read: Reader) -> Any:
        """Read and decode a value. Raises ``ProtocolError`` for malformed bytes."""
        ...


@dataclass(frozen=True)
class _Numbers:
    """``count`` numbers of one struct format. The value is a scalar for one, else a tuple."""

    format: str
    count: int = 1

    def pack(self, value: Any) -> bytes:
        values = (value,) if self.count == 1 else tuple(value)
        try:
            return struct.pack(f"<{self.count}{self.format}", *values)
        except (struct.error, OverflowError, TypeError) as error:
            raise ProtocolError(f"{value!r} cannot be sent as {self.count} x '{self.format}': {error}.") from error

    def take(self, read: Reader) -> Any:
        pattern = f"<{self.count}{self.format}"
        values = struct.unpack(pattern, read(struct.calcsize(pattern)))
        return values[0] if self.count == 1 else values


@dataclass(frozen=True)
class _ClientText:
    """Text from a client: an int with the number of CODE POINTS, then UTF-8."""

    limit: int = MAX_TEXT

    def pack(self, value: str) -> bytes:
        return _INT.pack(_within(len(value), self.limit, "text")) + _utf8(value)

    def take(self, read: Reader) -> str:
        count = _within(_INT.take(read), self.limit, "text")
        decoder = codecs.getincrementaldecoder("utf-8")()
        text = ""
        try:
            while len(text) < count:
                # A missing code point takes at least one byte, so this never reads past the text.
                text += decoder.decode(read(count - len(text)))
        except UnicodeDecodeError as error:
            raise ProtocolError(f"A text of {count} code points is not UTF-8 ({error}).") from error
        return text


class _ServerText:
    """Text from a server: an int with the number of BYTES, then UTF-8."""

    def pack(self, value: str) -> bytes:
        data = _utf8(value)
        return _INT.pack(_within(len(data), MAX_TEXT, "text")) + data

    def take(self, read: Reader) -> str:
        count = _within(_INT.take(read), MAX_TEXT, "text")
        try:
            return read(count).decode("utf-8")
        except UnicodeDecodeError as error:
            raise ProtocolError(f"A text of {count} bytes is not UTF-8 ({error}).") from error


class _File:
    """A file from a client: its name, an int with its size, its bytes. The value is ``(name, bytes)``."""

    def pack(self, value: tuple[str, bytes]) -> bytes:
        name, data = value
        return _CLIENT_TEXT.pack(name) + _INT.pack(_within(len(data), MAX_FILE, "file")) + data

    def take(self, read: Reader) -> tuple[str, bytes]:
        name = _CLIENT_TEXT.take(read)
        return name, read(_within(_INT.take(read), MAX_FILE, "file"))


@dataclass(frozen=True)
class _List:
    """An int with the number of items, then the items. An item of several kinds is a tuple."""

    kinds: tuple[FieldCodec, ...]
    limit: int = MAX_LIST

    def pack(self, value: Sequence[Any]) -> bytes:
        rows = [(item,) if len(self.kinds) == 1 else item for item in value]
        body = b"".join(kind.pack(cell) for row in rows for kind, cell in zip(self.kinds, row, strict=True))
        return _INT.pack(_within(len(rows), self.limit, "list")) + body

    def take(self, read: Reader) -> list[Any]:
        count = _within(_INT.take(read), self.limit, "list")
        rows = [tuple(kind.take(read) for kind in self.kinds) for _ in range(count)]
        return [row[0] for row in rows] if len(self.kinds) == 1 else rows


class _Dynamic:
    """An optional movement: a bool, then its type and its description as JSON text. The value is ``None`` or a pair."""

    def pack(self, value: tuple[str, str] | None) -> bytes:
        if value is None:
            return _BOOL.pack(False)
        return _BOOL.pack(True) + _CLIENT_TEXT.pack(value[0]) + _JSON.pack(value[1])

    def take(self, read: Reader) -> tuple[str, str] | None:
        return (_CLIENT_TEXT.take(read), _JSON.take(read)) if _BOOL.take(read) else None


class _Scenario:
    """JSON text of an object with a list "objects", as long as the reply. The value is the object."""

    def pack(self, value: Mapping[str, Any]) -> bytes:
        return _JSON.pack(json.dumps(value))

    def take(self, read: Reader) -> dict[str, Any]:
        text = _JSON.take(read)
        try:
            value = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ProtocolError(f"A scenario of {len(text)} characters is not JSON ({error}).") from error
        if not isinstance(value, dict) or not isinstance(value.get("objects"), list):
            raise ProtocolError('A scenario must be a JSON object with a list "objects"; its reply depends on it.')
        _within(len(value["objects"]), MAX_LIST, "list of objects")
        return value


class _Pixels:
    """An 8-bit RGB picture. The value is (height, width, rows), top row first."""

    def pack(self, value: tuple[int, int, bytes]) -> bytes:
        height, width, data = value
        if len(data) != height * width * 3:
            raise ProtocolError(f"{height} x {width} RGB pixels are {height * width * 3} bytes, not {len(data)}.")
        return b"".join([_INT.pack(height), _INT.pack(width), data])

    def take(self, read: Reader) -> tuple[int, int, bytes]:
        height, width = (_within(_INT.take(read), MAX_TEXTURE_SIDE, "side of a texture") for _ in range(2))
        return height, width, read(height * width * 3)


class _Changes:
    """Commands whose reply is a status alone, each a code byte and its fields. The value is (name, fields) pairs."""

    def pack(self, value: Sequence[tuple[str, Mapping[str, Any]]]) -> bytes:
        body = b"".join(COMMANDS[name].encode_request(**fields) for name, fields in value)
        return _INT.pack(_within(len(value), _MAX_CHANGES, "list of changes")) + body

    def take(self, read: Reader) -> list[tuple[str, dict[str, Any]]]:
        count = _within(_INT.take(read), _MAX_CHANGES, "list of changes")
        return [self._take_one(read) for _ in range(count)]

    def _take_one(self, read: Reader) -> tuple[str, dict[str, Any]]:
        code = _BYTE.take(read)
        command = _BY_CODE.get(code)
        if command is None or not command.status or command.reply or command.name == "repaint_object":
            raise ProtocolError("Before a view only commands are allowed whose reply is a status alone.")
        return command.name, command.decode_fields(read)


def _within(length: int, limit: int, what: str) -> int:
    if not 0 <= length <= limit:
        raise ProtocolError(f"A {what} of length {length}; allowed are 0 to {limit}.")
    return length


def _utf8(text: str) -> bytes:
    try:
        return text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise ProtocolError(f"{text!r} cannot be sent as UTF-8 ({error}).") from error


_BYTE: Final = _Numbers("B")
_BOOL: Final = _Numbers("?")
_INT: Final = _Numbers("i")
_UNSIGNED: Final = _Numbers("I")  # ints of a reply: the client reads them without sign
_FLOAT: Final = _Numbers("f")
_VEC3: Final = _Numbers("f", 3)
_COLOR: Final = _Numbers("i", 3)
_REPLY_COLOR: Final = _Numbers("I", 3)
_CLIENT_TEXT: Final = _ClientText()
_JSON: Final = _ClientText(MAX_JSON)
_SERVER_TEXT: Final = _ServerText()


@dataclass(frozen=True)
class Command:
    """One row of the protocol.

    request: fields after the code byte.
    tail: further fields of the longer dialect (v0.6).
    reply: kinds of the answer's values.
    status: a text precedes the reply, "ok" or the reason of a refusal; nothing follows a refusal.
    refused: values of a refusal without status.
    repeated: the reply repeats its one kind; the request determines the number.
    """

    code: int | None
    name: str
    request: Mapping[str, FieldCodec] = field(default_factory=dict)
    reply: tuple[FieldCodec, ...] = ()
    status: bool = False
    refused: tuple[Any, ...] | None = None
    tail: Mapping[str, FieldCodec] = field(default_factory=dict)
    repeated: bool = False

    def encode_request(self, **values: Any) -> bytes:
        """Bytes from a client. ``values`` holds all fields of ``tail`` or none."""
        head = b"" if self.code is None else _BYTE.pack(self.code)
        kinds = dict(self.request) | (dict(self.tail) if set(values) & set(self.tail) else {})
        if set(values) != set(kinds):
            raise ProtocolError(f"{self.name} takes {sorted(kinds)}, got {sorted(values)}.")
        return head + b"".join(kind.pack(values[name]) for name, kind in kinds.items())

    def decode_fields(self, read: Reader) -> dict[str, Any]:
        """The fields of ``request`` by name."""
        return {name: kind.take(read) for name, kind in self.request.items()}

    def encode_reply(self, *values: Any) -> bytes:
        """Bytes from a server after success."""
        status = encode_status() if self.status else b""
        kinds = self.reply * len(values) if self.repeated else self.reply
        return status + b"".join(kind.pack(value) for kind, value in zip(kinds, values, strict=True))

    def encode_refusal(self, reason: str) -> bytes:
        """Bytes from a server that refuses; ``reason`` is sent if the protocol has room for it."""
        if self.status:
            return encode_status(reason)
        return b"".join(kind.pack(value) for kind, value in zip(self.reply, self.refused or (), strict=True))

    def decode_reply(self, read: Reader) -> tuple[Any, ...]:
        """The values of an answer; one value of a ``repeated`` answer.

        Raises ``RendererError`` with the server's reason for a refusal by status.
        """
        if self.status:
            take_status(read, self.name)
        return tuple(kind.take(read) for kind in self.reply)


def _status(code: int, name: str, request: Mapping[str, FieldCodec], *reply: FieldCodec) -> Command:
    return Command(code, name, request, reply, status=True)


def _getter(code: int, name: str, request: Mapping[str, FieldCodec], reply: FieldCodec, *refused: Any) -> Command:
    return Command(code, name, request, (reply,), refused=refused)


_LIGHT: Final[Mapping[str, FieldCodec]] = {"light": _CLIENT_TEXT}
_COLOR_FIELD: Final[Mapping[str, FieldCodec]] = {"color": _COLOR}
_SPAWN: Final[Mapping[str, FieldCodec]] = {
    "name": _CLIENT_TEXT,
    "position": _VEC3,
    "rotation": _VEC3,
    "remove_dynamics": _BOOL,
    "scale": _VEC3,
    "use_parent": _BOOL,
}
_SPAWN_TAIL: Final[Mapping[str, FieldCodec]] = {"frustum_limited": _BOOL, "dynamic": _Dynamic()}
_NAMES: Final = _List((_SERVER_TEXT,))

REGISTER: Final = Command(None, "register", {"width": _INT, "height": _INT, "gzip": _BOOL}, (_UNSIGNED, _NAMES))
"""The handshake. The answer is (agent id, scene names)."""

_ROWS: Final = (
    Command(0x00, "frame", {"flags": _BYTE}),  # its reply depends on the flags: encode_frame, decode_frame
    Command(0x01, "delete"),
    _status(0x02, "change_scene", {"scene": _CLIENT_TEXT}),
    _getter(0x03, "get_categories", {}, _List((_UNSIGNED, _SERVER_TEXT)), []),
    _getter(0x04, "get_position", {}, _VEC3, (0.0, 0.0, 0.0)),
    _status(0x05, "set_position", {"position": _VEC3}),
    _getter(0x06, "get_rotation", {}, _VEC3, (0.0, 0.0, 0.0)),
    _status(0x07, "set_rotation", {"rotation": _VEC3}),
    _status(0x08, "toggle_follow", {}),
    Command(0x09, "spawn_object", _SPAWN, (_SERVER_TEXT,), refused=("",), tail=_SPAWN_TAIL),
    _status(0x0A, "despawn_object", {"instance": _INT}),
    _getter(0x0B, "get_spawnable_objects_names", {}, _NAMES, []),
    _getter(0x0C, "send_obj_zip", {"file": _File()}, _SERVER_TEXT, ""),
    _status(0x0D, "set_clear_color", _COLOR_FIELD),
    _status(0x0E, "get_light_color", _LIGHT, _REPLY_COLOR),
    _status(0x0F, "set_light_color", {**_LIGHT, **_COLOR_FIELD}),
    _status(0x10, "get_light_intensity", _LIGHT, _FLOAT),
    _status(0x11, "set_light_intensity", {**_LIGHT, "intensity": _FLOAT}),
    _status(0x12, "get_light_indirect_multiplier", _LIGHT, _FLOAT),
    _status(0x13, "set_light_indirect_multiplier", {**_LIGHT, "multiplier": _FLOAT}),
    _status(0x14, "get_light_position", _LIGHT, _VEC3),
    _status(0x15, "set_light_position", {**_LIGHT, "position": _VEC3}),
    _status(0x16, "get_light_direction", _LIGHT, _VEC3),
    _status(0x17, "set_light_direction", {**_LIGHT, "direction": _VEC3}),
    _getter(0x18, "get_light_type", _LIGHT, _SERVER_TEXT, LIGHT_NOT_FOUND),
    _getter(0x19, "get_lights_names", {}, _NAMES, []),
    _status(0x1A, "get_ambient_light_color", {}, _REPLY_COLOR),
    _status(0x1B, "set_ambient_light_color", _COLOR_FIELD),
    Command(0x1C, "spawn_view_frustum"),
    Command(0x1D, "load_scenario", {"scenario": _Scenario()}, (_SERVER_TEXT,), refused=("",), repeated=True),
    _status(0x1E, "move_object", {"instance": _INT, "position": _VEC3, "rotation": _VEC3}),
    # Extensions of Trompe. The reason of the agent's last refusal; "" if there was none since the last query.
    _getter(0xE0, "last_error", {}, _SERVER_TEXT, ""),
    # New albedo textures for a spawned object, by file name.
    _status(0xE1, "repaint_object", {"instance": _INT, "textures": _List((_CLIENT_TEXT, _Pixels()), _MAX_TEXTURES)}),
    # Changes of state for each view, then its picture. The reply is a status for each view (encode_status), and after
    # "ok" height x width RGB bytes, top row first, not mirrored. Nothing follows any other status.
    Command(0xE2, "render_views", {"views": _List((_Changes(),), MAX_VIEWS)}),
    # Number of the noise in the next pictures of an engine that is not deterministic; others ignore it.
    _status(0xE3, "set_noise", {"number": _UNSIGNED}),
)

COMMANDS: Final[Mapping[str, Command]] = {row.name: row for row in _ROWS}
"""All commands by name."""

_BY_CODE: Final = {row.code: row for row in _ROWS}


def decode_request(read: Reader, *, is_long: Callable[[], bool]) -> tuple[Command, dict[str, Any]]:
    """Read one command of a client.

    ``is_long`` says whether the client speaks the longer dialect. It is called after the short form of a command with
    two dialects: nothing on the wire tells them apart. Raises ``ProtocolError`` for an unknown code or a bad field.
    """
    code = _BYTE.take(read)
    command = _BY_CODE.get(code)
    if command is None:
        raise ProtocolError(f"There is no command {code:#04x}; its length is unknown, so the stream is lost.")
    try:
        values = command.decode_fields(read)
        if command.tail and is_long():
            values |= {name: kind.take(read) for name, kind in command.tail.items()}
    except ProtocolError as error:
        raise ProtocolError(f"{command.name}: {error}") from error
    return command, values


def encode_status(refusal: str | None = None) -> bytes:
    """A status: "ok", or the reason of a refusal."""
    if refusal is None:
        return _SERVER_TEXT.pack("ok")
    shortened = refusal.encode("utf-8", "replace")[: MAX_TEXT // 2].decode("utf-8", "ignore")
    return _SERVER_TEXT.pack("refused" if shortened in {"", "ok"} else shortened)


def take_status(read: Reader, asked: str) -> None:
    """Read the status of the command ``asked``. Raises ``RendererError`` with the server's reason for any but "ok", and
    ``RendererLostError`` after the end of a renderer that is lost."""
    if (status := _SERVER_TEXT.take(read)).startswith(LOST):
        with contextlib.suppress(EOFError, OSError):
            read(1)  # until its end nobody may connect again
        raise RendererLostError(status.removeprefix(LOST))
    if status != "ok":
        raise RendererError(f"The renderer refused {asked}: {status}")


def encode_frame(views: Sequence[bytes], *, delta_time: float, compress: bool) -> list[bytes]:
    """FRAME's reply in pieces; each starts with the length of its view.

    A client reads a length with one ``recv``, so each piece must be sent whole, in segments of its own. ``views`` are
    the payloads in the order of ``VIEW_FLAGS``; ``delta_time`` in seconds, NaN after a failed rendering.
    """
    payloads = [gzip.compress(view, 1) for view in views] if compress else views
    pieces = [_INT.pack(_within(len(payload), MAX_VIEW, "view")) + payload for payload in payloads]
    return [*pieces[:-1], b"".join(pieces[-1:]) + _FLOAT.pack(delta_time)]


def decode_frame(read: Reader, *, flags: int) -> tuple[dict[str, bytes], float]:
    """Read FRAME's reply: payloads by view name, as sent, and the delta time in seconds."""
    views = {name: read(_within(_INT.take(read), MAX_VIEW, "view")) for name in views_of(flags)}
    return views, _FLOAT.take(read)


def views_of(flags: int) -> Iterator[str]:
    """Names of the views in ``flags``, in the order of the reply."""
    return (name for name, bit in VIEW_FLAGS.items() if flags & bit)
