"""Malformed bytes close their agent and change nothing for others.

The slow run sends TROMPE_FUZZ_INPUTS (200,000) inputs; ``--log-cli-level=INFO`` shows the figures.
"""

import logging
import os
import random
import socket
import struct
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.served import repeating, wait_until
from tests.wire import Wire, boxes
from tests.worker_process import Worker
from trompe_renderer.world.model import content_key
from trompe_shared.geometry import Camera
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import encode_png
from trompe_shared.sailenv import COMMANDS, REGISTER

log = logging.getLogger(__name__)

SEED = 5
FUZZERS = 3
EXTREMES = [struct.pack("<i", value) for value in (-1, -(2**31), 2**31 - 1, 65536, 65537, 2**20, 2**28, 0, 1, 255)]
EXTREMES += [struct.pack("<f", value) for value in (float("nan"), float("inf"), -0.0, 1e38, 1e-45)]


class Fuzzer:
    """Makes inputs: a handshake and a few messages, most of them damaged. The same seed makes the same ones."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        mesh = b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
        table = b'{"m": {"albedo": "a.png", "normal": "n.png", "metallic": "a.png"}}'
        picture = encode_png(np.full((4, 4, 3), 90, np.uint8))
        self._files = {"t.obj": mesh, "t_mat_def.json": table, "a.png": picture, "n.png": picture}
        self._calls: list[Callable[[], bytes]] = [self._simple, self._light, self._object, self._frame, self._batch]

    def input(self) -> bytes:
        if self._random.random() < 0.03:
            return self._damaged(self._hello())
        messages = b"".join(self._random.choice(self._calls)() for _ in range(self._random.randint(1, 3)))
        return self._hello() + (messages if self._random.random() < 0.2 else self._damaged(messages))

    def _hello(self) -> bytes:
        side = self._random.randint(1, 24)
        return REGISTER.encode_request(width=side, height=side, gzip=self._random.random() < 0.3)

    def _vector(self) -> tuple[float, float, float]:
        values = [0.0, 0.3, -1.0, 180.0, 1e30, float("nan"), self._random.uniform(-2, 2)]
        x, y, z = self._random.choices(values, k=3)
        return x, y, z

    def _place(self) -> dict[str, Any]:
        return {"position": self._vector(), "rotation": self._vector()}

    def _simple(self) -> bytes:
        code = self._random.choice(
            [command.code for command in COMMANDS.values() if command.code and not command.request]
        )
        color = tuple(self._random.choices([-1, 0, 7, 255, 256, 2**31 - 1], k=3))
        messages = [
            bytes([code]),
            COMMANDS["set_position"].encode_request(position=self._vector()),
            COMMANDS["set_rotation"].encode_request(rotation=self._vector()),
            COMMANDS["set_clear_color"].encode_request(color=color),
            COMMANDS["set_ambient_light_color"].encode_request(color=color),
            COMMANDS["change_scene"].encode_request(scene=self._random.choice(["object_view/scene", "", "càndle€"])),
            COMMANDS["move_object"].encode_request(instance=self._random.randint(-1, 3), **self._place()),
            COMMANDS["load_scenario"].encode_request(scenario='{"frustum": 3, "objects": [{"id": 1}]}'),
        ]
        return self._random.choice(messages)

    def _light(self) -> bytes:
        light = self._random.choice(["Main Light", "Rim Light", "Sun", "Main"])
        return self._random.choice(
            [
                COMMANDS["get_light_type"].encode_request(light=light),
                COMMANDS["set_light_intensity"].encode_request(light=light, intensity=self._vector()[0]),
                COMMANDS["set_light_direction"].encode_request(light=light, direction=self._vector()),
                COMMANDS["set_light_position"].encode_request(light=light, position=self._vector()),
            ]
        )

    def _object(self) -> bytes:
        """An upload, sound or with a damaged file or as a damaged archive, and the spawning of it."""
        files = dict(self._files)
        if self._random.random() < 0.5:
            name = self._random.choice(sorted(files))
            files[name] = self._damaged(files[name])
        archive = pack_zip(files)
        if self._random.random() < 0.3:
            archive = self._damaged(archive)
        name = self._random.choice([f"file:{content_key(archive)}", "file:../../etc/passwd", "file:", "mug"])
        placed = {"remove_dynamics": True, "scale": (1, 1, 1), "use_parent": True, **self._place()}
        dynamic = self._random.choice([None, ("linear_waypoints", '{"waypoints": [], "total_time": -1}'), ("x", "[")])
        return (
            COMMANDS["send_obj_zip"].encode_request(file=("../t.zip", archive))
            + COMMANDS["spawn_object"].encode_request(name=name, frustum_limited=True, dynamic=dynamic, **placed)
            + self._repaint()
        )

    def _repaint(self) -> bytes:
        side = self._random.randint(0, 9)
        names = self._random.choices(["a.png", "n.png", ""], k=self._random.randint(0, 2))
        textures = [(name, (side, side, bytes(side * side * 3))) for name in names]
        instance = self._random.randint(0, 2)
        return COMMANDS["repaint_object"].encode_request(instance=instance, textures=textures)

    def _frame(self) -> bytes:
        return COMMANDS["frame"].encode_request(flags=self._random.choice([0, 1, 1, 4, 8, 16, 32, 61, 255]))

    def _batch(self) -> bytes:
        views = [[("set_position", {"position": self._vector()})] for _ in range(self._random.randint(0, 3))]
        return COMMANDS["render_views"].encode_request(views=views)

    def _damaged(self, data: bytes) -> bytes:
        for _ in range(self._random.randint(1, 3)):
            data = self._damaged_at(self._random.randrange(len(data) + 1), data)
        return data

    def _damaged_at(self, where: int, data: bytes) -> bytes:
        noise = self._random.randbytes(self._random.randint(1, 20))
        return self._random.choice(
            [
                data[:where],
                data[:where] + noise + data[where:],
                data[:where] + self._random.choice(EXTREMES) + data[where + 4 :],
                data[:where] + noise[:1] + data[where + 1 :],
                data[:where] + data[where // 2 :],
                noise,
            ]
        )


def send(address: tuple[str, int], data: bytes) -> None:
    """Send an input and nothing more, and wait until the worker has hung up."""
    with socket.create_connection(address, timeout=240) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # no port waits
        try:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(2**16):
                pass
        except TimeoutError:
            raise
        except OSError:  # it has hung up while we were sending
            pass


def fuzz(address: tuple[str, int], first: int, last: int) -> None:
    """Send the inputs with these numbers. An input that hangs raises ``TimeoutError``."""
    fuzzer = Fuzzer(SEED + first)
    for _ in range(first, last):
        send(address, fuzzer.input())


class Witness:
    """An agent whose every ``look`` is a picture compared with its first."""

    def __init__(self, agent: Wire) -> None:
        self._agent = agent
        agent.spawn(boxes())
        agent.look(Camera(0.3, 0, 0))
        self._first = agent.picture()
        self.frames, self.wrong, self.slowest = 0, 0, 0.0

    def look(self) -> None:
        started = time.monotonic()
        self.wrong += not (self._agent.picture() == self._first).all()
        self.slowest = max(self.slowest, time.monotonic() - started)
        self.frames += 1


@pytest.mark.parametrize(
    "inputs",
    [
        pytest.param(500, id="some"),
        pytest.param(
            int(os.environ.get("TROMPE_FUZZ_INPUTS", "200000")),
            id="many",
            marks=[pytest.mark.slow, pytest.mark.timeout(7200)],
        ),
    ],
)
def test_no_input_crashes_hangs_or_fills_a_worker_or_disturbs_another_agent(inputs: int, own_worker: Worker) -> None:
    worker = own_worker
    fuzz(worker.address, 0, 100)  # warms caches up
    memory, before = worker.memory, worker.open
    bounds = [100 + inputs * k // FUZZERS for k in range(FUZZERS + 1)]
    with closing(Wire(worker.address)) as agent:
        witness = Witness(agent)
        with repeating(witness.look, pause=0.005), ThreadPoolExecutor(FUZZERS) as threads:
            list(threads.map(partial(fuzz, worker.address), bounds[:-1], bounds[1:]))
    assert witness.frames > 10
    assert witness.wrong == 0
    assert worker.process.poll() is None, "the worker crashed"
    wait_until(lambda: worker.open <= before)
    log.info(
        "%d inputs: another agent took %d frames, the slowest %.2f s; memory %.1f to %.1f MiB",
        *(inputs, witness.frames, witness.slowest, memory / 2**20, worker.memory / 2**20),
    )
    assert worker.memory < memory + 128 * 2**20  # the largest picture of any input, and caches
