"""SAILenv's client from its git repository: a recorded session in bytes, and the detection of its dialect."""

import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.wire import ORIGIN, Wire, received
from tests.worker_process import shared_worker
from trompe_shared.sailenv import COMMANDS

TRANSCRIPT = Path(__file__).parent / "git_dialect.txt"
SHORT = ORIGIN | {"name": "mug", "remove_dynamics": True, "use_parent": True}
LONG = SHORT | {"frustum_limited": True, "dynamic": None}


def exchanges() -> Iterator[tuple[int, str, list[str]]]:
    """Line number, ``>`` or ``<``, and tokens of each message of the transcript, without comments."""
    for number, line in enumerate(TRANSCRIPT.read_text().splitlines(), start=1):
        for direction, words in re.findall("([<>])([^<>]*)", line.partition("#")[0]):
            yield number, direction, words.split()


class Replay:
    """Sends a client's messages and compares the answers."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.socket = socket.create_connection(address, timeout=240)
        self.remembered: dict[str, str] = {}

    def say(self, tokens: list[str]) -> None:
        for token in tokens:
            if token.startswith("file:"):
                text = "file:" + self.remembered[token.removeprefix("file:")]
                self.socket.sendall(struct.pack("<i", len(text)) + text.encode())
            else:
                self.socket.sendall(bytes.fromhex(token))

    def hear(self, tokens: list[str]) -> None:
        for token in tokens:
            if token.startswith("text="):
                self.remembered[token.removeprefix("text=")] = self._counted().decode()
            elif token == "view":
                assert self._counted()
            elif token == "*4":
                received(self.socket, 4)
            else:
                assert received(self.socket, len(token) // 2).hex() == token

    def _counted(self) -> bytes:
        return received(self.socket, struct.unpack("<i", received(self.socket, 4))[0])


def test_a_recorded_session_of_the_git_client_is_answered_byte_for_byte(ticking_worker: tuple[str, int]) -> None:
    replay = Replay(ticking_worker)
    for number, direction, tokens in exchanges():
        try:
            (replay.say if direction == ">" else replay.hear)(tokens)
        except (AssertionError, EOFError) as error:
            raise AssertionError(f"{TRANSCRIPT.name}:{number}: {error}") from error
    assert replay.socket.recv(1) == b""  # nothing more was sent, and DELETE ended it
    replay.socket.close()


def test_the_recorded_session_holds_every_command_of_the_git_client() -> None:
    requests = [bytes.fromhex(tokens[0]) for _, direction, tokens in exchanges() if direction == ">"]
    codes = {command.code for command in COMMANDS.values() if command.code is not None and command.code < 0xE0}
    assert {request[0] for request in requests[1:]} == codes == set(range(0x1F))
    assert sum(request[:2] == b"\x00\x3d" for request in requests) >= 60


def test_a_short_spawn_is_waited_on_once_and_then_no_more(wire: Callable[..., Wire]) -> None:
    later = []
    for _ in range(5):  # on a busy machine some of them last longer for another reason
        agent, seconds = wire(), []
        for _ in range(3):
            start = time.monotonic()
            assert agent.ask("spawn_object", **SHORT)
            seconds.append(time.monotonic() - start)
        assert seconds[0] > 0.25
        later.append(max(seconds[1:]))
        if later[-1] < 0.2:
            break
    assert min(later) < 0.2


_PATIENT = """
from trompe_renderer.command import render
from trompe_renderer.protocol import agent

agent.DIALECT_WAIT = 120.0
render(["--port", "0"])
"""
patient_worker = shared_worker(code=_PATIENT, scope="module")
"""A worker that waits for the tail of a spawn for longer than a busy machine keeps it back."""


@pytest.mark.parametrize("pause", [0.0, 0.1], ids=["at once", "after a moment"])
def test_a_long_spawn_is_known_by_its_tail(
    wire: Callable[..., Wire], patient_worker: tuple[str, int], pause: float
) -> None:
    agent, spawn = wire(patient_worker), COMMANDS["spawn_object"]
    short = spawn.encode_request(**SHORT)
    agent.socket.sendall(short)
    time.sleep(pause)
    agent.socket.sendall(spawn.encode_request(**LONG)[len(short) :])
    assert spawn.decode_reply(agent.read) == ("1",)
    assert agent.ask("spawn_object", **LONG) == "2"
    assert agent.ask("get_position") == (0, 0, 0)


@pytest.mark.parametrize("proof", ["spawn_view_frustum", "load_scenario", "move_object"])
def test_commands_that_only_the_git_client_has_prove_its_dialect(wire: Callable[..., Wire], proof: str) -> None:
    agent, spawn = wire(), COMMANDS["spawn_object"]
    if proof == "load_scenario":
        agent.load({"scene_name": "object_view/scene", "objects": []})
    elif proof == "move_object":
        agent.socket.sendall(COMMANDS[proof].encode_request(instance=1, position=(0, 0, 0), rotation=(0, 0, 0)))
        agent.read(int.from_bytes(agent.read(4), "little"))
    else:
        agent.ask(proof)
    short = spawn.encode_request(**SHORT)
    agent.socket.sendall(short)
    time.sleep(0.4)  # longer than a client of unknown dialect would be given
    agent.socket.sendall(spawn.encode_request(**LONG)[len(short) :])
    assert spawn.decode_reply(agent.read) == ("1",)
    assert agent.ask("get_position") == (0, 0, 0)  # nothing of the tail was taken for a command
