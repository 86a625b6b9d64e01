"""The SAILenv target when the other end is not there, is silent, or is something else: always an error that helps."""

import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from tests.served import answering_once, reserved_port, saying, wait_until
from tests.small_models import triangle_zip
from trompe_server.renderers import SailenvTarget, local_renderer
from trompe_shared.errors import RendererError, RendererLostError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, encode_png, load_object
from trompe_shared.sailenv import COMMANDS, REGISTER, decode_request, encode_frame
from trompe_shared.sailenv_client import engine_at

VIEW = View(Camera(1.0, 0.0, 0.0))


def triangle() -> Object3D:
    return load_object(triangle_zip())


def render(address: tuple[str, int], *, timeout: float = 240.0) -> str:
    """The message of the error that rendering raises."""
    with closing(SailenvTarget(*address, timeout=timeout)) as target, pytest.raises(RendererError) as raised:
        target.render(triangle(), [VIEW], size=(8, 8))
    assert f"{address[0]}:{address[1]}" in str(raised.value)
    return str(raised.value)


def pretend(frame: list[bytes], *, path: str = "path", instance: str = "1") -> Callable[[socket.socket], None]:
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
                name = decode_request(read, is_long=lambda: True)[0].name
                values = {"send_obj_zip": (path,), "spawn_object": (instance,), "last_error": ("lamp is broken",)}
                values["get_light_type"] = ("light_not_found",)
                reply = b"".join(frame) if name == "frame" else COMMANDS[name].encode_reply(*values.get(name, ()))
                connection.sendall(reply)

    return answer


def test_where_nothing_listens_the_error_says_how_to_start_a_renderer() -> None:
    with reserved_port() as port:
        assert f"trompe render --host 127.0.0.1 --port {port}" in render(("127.0.0.1", port))


def test_an_address_that_is_none_is_an_error_like_any_other() -> None:
    assert "There is no renderer at a..b:80" in render(("a..b", 80))
    assert engine_at("a..b", 80, timeout=1.0) is None


def test_an_aborted_target_renders_no_more_even_if_it_connects_just_then(monkeypatch: pytest.MonkeyPatch) -> None:
    connect = socket.create_connection

    def connect_late(address: tuple[str, int], timeout: float) -> socket.socket:
        target.abort()
        return connect(address, timeout)

    monkeypatch.setattr(socket, "create_connection", connect_late)
    with answering_once(pretend(frame(encode_png(np.zeros((8, 8, 3), np.uint8))))) as address:
        target = SailenvTarget(*address)
        with closing(target), pytest.raises(RendererLostError, match="given up: it did not answer"):
            target.render(triangle(), [VIEW], size=(8, 8))


def test_a_renderer_that_stays_silent_is_given_up() -> None:
    done = threading.Event()

    def answer(connection: socket.socket) -> None:
        done.wait(240)

    with answering_once(answer) as address:
        assert "did not answer within" in render(address, timeout=0.2)
        done.set()


def frame(picture: bytes, *, delta_time: float = 0.0) -> list[bytes]:
    return encode_frame([picture], delta_time=delta_time, compress=False)


BLACK = encode_png(np.zeros((8, 8, 3), np.uint8))
OTHER = "not a SAILenv renderer"


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        pytest.param(lambda connection: None, "trompe render", id="hangs up"),
        pytest.param(saying(b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9), OTHER, id="another protocol"),
        pytest.param(saying(struct.pack("<ii", 0, -1)), OTHER, id="a negative length"),
        pytest.param(pretend(frame(encode_png(np.zeros((4, 8, 3), np.uint8)))), OTHER, id="wrong size"),
        pytest.param(pretend(frame(b"no picture")), OTHER, id="not an image"),
        pytest.param(pretend(frame(BLACK, delta_time=float("nan"))), "lamp is broken", id="a frame marked as failed"),
        pytest.param(pretend([], instance=""), "lamp is broken", id="an object that is not spawned"),
        pytest.param(pretend([], path=""), "refused the file of", id="an object that is not stored"),
    ],
)
def test_a_renderer_that_fails_is_an_error_with_the_reason(answer: Callable[[socket.socket], None], words: str) -> None:
    with answering_once(answer) as address:
        assert words in render(address)


# A worker of one's own


def test_a_local_renderer_renders_and_ends_with_its_block() -> None:
    with local_renderer() as target:
        assert (target.render(triangle(), [VIEW], size=(8, 8)) < 255).any()
        address = target.address
    assert engine_at(*address, timeout=5) is None


def test_a_local_renderer_may_say_other_things_before_its_address_and_after(tmp_path: Path) -> None:
    with answering_once(pretend(frame(BLACK))) as (host, port):
        lines = (
            "import os, pathlib, sys",
            "os.write(1, b'Gr\\xfcn, ')",
            f"print('listening on {host}:{port}', flush=True)",
            "print('x' * 2**20, flush=True)",
            "pathlib.Path(sys.argv[1]).touch()",
            "input()",
        )
        with local_renderer([sys.executable, "-c", "\n".join(lines), str(tmp_path / "said")]) as target:
            assert target.address == (host, port)
            assert (target.render(triangle(), [VIEW], size=(8, 8)) == 0).all()
            wait_until((tmp_path / "said").exists)


def test_a_local_renderer_ends_when_its_parent_is_killed() -> None:
    lines = (
        "import os, signal",
        "from trompe_server.renderers import local_renderer",
        "with local_renderer() as target:",
        "    print(*target.address, flush=True)",
        "    os.kill(os.getpid(), signal.SIGKILL)",
    )
    killed = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False)
    host, port = killed.stdout.split()
    wait_until(lambda: engine_at(host, int(port), timeout=5) is None, story=lambda: "it outlives its parent")


def test_a_local_renderer_that_does_not_start_is_an_error() -> None:
    with pytest.raises(RendererError, match="did not start"), local_renderer([sys.executable, "-c", ""]):
        pass
