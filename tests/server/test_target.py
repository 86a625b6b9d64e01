"""The SAILenv target when the other end is not there, is silent, or is something else: always an error that helps."""

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress

import numpy as np
import pytest

from trompe_server.target import SailenvTarget
from trompe_shared.errors import RendererError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, encode_png, object_from_files
from trompe_shared.sailenv import COMMANDS, REGISTER, decode_request, encode_frame

VIEW = View(Camera(1.0, 0.0, 0.0))


def triangle() -> Object3D:
    mesh = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    table = b'{"m": {"albedo": "a.png"}}'
    return object_from_files(
        {"t.obj": mesh, "t_mat_def.json": table, "a.png": encode_png(np.zeros((2, 2, 3), np.uint8))}
    )


@contextmanager
def listening(answer: Callable[[socket.socket], None]) -> Iterator[tuple[str, int]]:
    """A server whose one connection is handled by ``answer`` in a thread."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                answer(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[:2]
        thread.join(timeout=30)


def render(address: tuple[str, int], *, timeout: float = 30.0) -> str:
    """The message of the error that rendering raises."""
    with closing(SailenvTarget(*address, timeout=timeout)) as target, pytest.raises(RendererError) as raised:
        target.render(triangle(), [VIEW], size=(8, 8))
    assert f"{address[0]}:{address[1]}" in str(raised.value)
    return str(raised.value)


def pretend(frame: list[bytes], *, instance: str = "1") -> Callable[[socket.socket], None]:
    """A renderer that agrees to everything and answers each FRAME with ``frame``, until the client hangs up."""

    def answer(connection: socket.socket) -> None:
        stream = connection.makefile("rb")

        def read(count: int) -> bytes:
            data = stream.read(count)
            if len(data) < count:
                raise EOFError
            return data

        with stream, suppress(EOFError):
            REGISTER.decode_fields(read)
            connection.sendall(REGISTER.encode_reply(0, []))
            while True:
                name = decode_request(read, is_long=lambda: True).command.name
                values = {"send_obj_zip": ("path",), "spawn_object": (instance,), "last_error": ("lamp is broken",)}
                values["get_light_type"] = ("light_not_found",)
                reply = b"".join(frame) if name == "frame" else COMMANDS[name].encode_reply(*values.get(name, ()))
                connection.sendall(reply)

    return answer


def picture(height: int, width: int) -> list[bytes]:
    return encode_frame([encode_png(np.zeros((height, width, 3), np.uint8))], delta_time=0.0, compress=False)


def test_where_nothing_listens_the_error_says_how_to_start_a_renderer() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = listener.getsockname()[:2]
    message = render(address)
    assert f"trompe render --host 127.0.0.1 --port {address[1]}" in message


def test_a_renderer_that_hangs_up_is_reported() -> None:
    with listening(lambda connection: None) as address:
        assert "trompe render" in render(address)


def test_a_renderer_that_stays_silent_is_given_up() -> None:
    done = threading.Event()

    def answer(connection: socket.socket) -> None:
        done.wait(20)

    with listening(answer) as address:
        assert "in time" in render(address, timeout=0.2)
        done.set()


@pytest.mark.parametrize(
    "garbage",
    [
        pytest.param(b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9, id="another protocol"),
        pytest.param(struct.pack("<ii", 0, -1), id="a negative length"),
    ],
)
def test_what_is_no_renderer_is_called_so(garbage: bytes) -> None:
    def answer(connection: socket.socket) -> None:
        connection.recv(9)
        connection.sendall(garbage)

    with listening(answer) as address:
        assert "no SAILenv renderer" in render(address)


@pytest.mark.parametrize(
    "frame",
    [
        pytest.param(picture(4, 8), id="wrong size"),
        pytest.param(encode_frame([b"no picture"], delta_time=0.0, compress=False), id="not an image"),
    ],
)
def test_a_frame_that_is_not_what_was_asked_for_is_an_error(frame: list[bytes]) -> None:
    with listening(pretend(frame)) as address:
        assert "no SAILenv renderer" in render(address)


def test_a_frame_that_the_renderer_marks_as_failed_is_an_error_with_its_reason() -> None:
    payload = encode_png(np.zeros((8, 8, 3), np.uint8))
    frame = encode_frame([payload], delta_time=float("nan"), compress=False)
    with listening(pretend(frame)) as address:
        assert "lamp is broken" in render(address)


def test_an_object_that_is_not_spawned_is_an_error_with_the_reason() -> None:
    with listening(pretend([], instance="")) as address:
        assert "lamp is broken" in render(address)


def test_images_come_back_unmirrored() -> None:
    sent = np.zeros((8, 8, 3), np.uint8)
    sent[:, 0] = 200
    frame = encode_frame([encode_png(sent)], delta_time=0.0, compress=False)
    with listening(pretend(frame)) as address, closing(SailenvTarget(*address)) as target:
        images = target.render(triangle(), [VIEW, VIEW], size=(8, 8))
        target.close()
    assert (images == sent[:, ::-1]).all()
