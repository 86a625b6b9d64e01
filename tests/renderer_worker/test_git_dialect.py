"""SAILenv's client as it stands in its repository: a session of it as bytes, and how the worker knows its dialect."""

import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from trompe_shared.sailenv import COMMANDS

TRANSCRIPT = Path(__file__).parent / "git_dialect.txt"
SPAWN = {"name": "mug", "position": (0, 0, 0), "rotation": (0, 0, 0), "scale": (1, 1, 1), "use_parent": True}
SHORT = SPAWN | {"remove_dynamics": True}
LONG = SHORT | {"frustum_limited": True, "dynamic": None}


def exchanges() -> Iterator[tuple[int, str, list[str]]]:
    """Line number, ``>`` or ``<``, and the tokens of each line of the transcript that is not a comment."""
    for number, line in enumerate(TRANSCRIPT.read_text().splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line[0], line[1:].split()


class Replay:
    """Says a client's lines and compares the answers."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.socket = socket.create_connection(address, timeout=60)
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
                self._read(4)
            else:
                assert self._read(len(token) // 2).hex() == token

    def _counted(self) -> bytes:
        return self._read(struct.unpack("<i", self._read(4))[0])

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.socket.recv(count - len(data))
            assert part, "the worker hung up"
            data += part
        return data


def test_a_recorded_session_of_the_git_client_is_answered_byte_for_byte(ticking_worker: tuple[str, int]) -> None:
    replay = Replay(ticking_worker)
    for number, direction, tokens in exchanges():
        try:
            (replay.say if direction == ">" else replay.hear)(tokens)
        except AssertionError as error:
            raise AssertionError(f"{TRANSCRIPT.name}:{number}: {error}") from error
    assert replay.socket.recv(1) == b""  # nothing more was sent, and DELETE ended it
    replay.socket.close()


def test_the_recorded_session_holds_every_command_of_the_git_client() -> None:
    requests = [bytes.fromhex(tokens[0]) for _, direction, tokens in exchanges() if direction == ">"]
    codes = {command.code for command in COMMANDS.values() if command.code is not None and command.code < 0xE0}
    assert {request[0] for request in requests[1:]} == codes == set(range(0x1F))
    assert sum(request[:2] == b"\x00\x3d" for request in requests) >= 60


def test_a_short_spawn_is_waited_on_once_and_then_no_more(wire: Callable[..., Any]) -> None:
    agent, seconds = wire(), []
    for _ in range(3):
        start = time.monotonic()
        assert agent.ask("spawn_object", **SHORT)
        seconds.append(time.monotonic() - start)
    assert seconds[0] > 0.25
    assert max(seconds[1:]) < 0.2


@pytest.mark.parametrize("pause", [0.0, 0.1], ids=["at once", "after a moment"])
def test_a_long_spawn_is_known_by_its_tail(wire: Callable[..., Any], pause: float) -> None:
    agent, spawn = wire(), COMMANDS["spawn_object"]
    short = spawn.encode_request(**SHORT)
    agent.socket.sendall(short)
    time.sleep(pause)
    agent.socket.sendall(spawn.encode_request(**LONG)[len(short) :])
    assert spawn.decode_reply(agent.read) == ("1",)
    assert agent.ask("spawn_object", **LONG) == "2"
    assert agent.ask("get_position") == (0, 0, 0)


@pytest.mark.parametrize("proof", ["spawn_view_frustum", "load_scenario", "move_object"])
def test_commands_that_only_the_git_client_has_prove_its_dialect(wire: Callable[..., Any], proof: str) -> None:
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
    time.sleep(0.5)  # longer than a client of unknown dialect would be given
    agent.socket.sendall(spawn.encode_request(**LONG)[len(short) :])
    assert spawn.decode_reply(agent.read) == ("1",)
    assert agent.ask("get_position") == (0, 0, 0)  # nothing of the tail was taken for a command
