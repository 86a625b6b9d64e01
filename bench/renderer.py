"""What does a picture cost in the renderer worker, stage by stage, and what does a new texture? Medians, in turn.

python -m bench.renderer [--objects candle toilet] [--rounds 5] [--views 12]

The stages are timed within one process, with a glFinish between them; what the protocol adds is timed against a worker
process over the loopback. "ours" is SailenvTarget with the extensions, "published" the plain commands of SAILenv's
client, a picture as PNG each.
"""

import argparse
import contextlib
import importlib.util
import io
import logging
import socket
import statistics
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bench._common import BenchObject, bench_objects, in_rounds, machine
from trompe_experiments.markdown import markdown_table
from trompe_renderer.engines.pyrender import PyrenderEngine, PyrenderOptions
from trompe_renderer.engines.pyrender.passes import ObjectRenderer
from trompe_renderer.engines.pyrender.platform import GL
from trompe_renderer.protocol.limits import Limits
from trompe_renderer.protocol.session import Session
from trompe_renderer.protocol.upload import ModelCache
from trompe_renderer.world.snapshot import Snapshot
from trompe_server.renderers import SailenvTarget, local_renderer
from trompe_shared import sailenv_client as client
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import View, sailenv_pose
from trompe_shared.object3d import Object3D

SIDES = (224, 512)
STAGES = ("scene", "draw", "read back", "encode", "send")
LEVELS = (0, 1, 3, 6, 9)
WANTED_RATIO, WANTED_POSE_MS = 1.5, 1.0

Picture = NDArray[np.uint8]


class Stopwatch:
    """Seconds of each lap by name."""

    def __init__(self) -> None:
        self.laps: dict[str, list[float]] = defaultdict(list)
        self._since = time.perf_counter()

    def start(self) -> None:
        """Forget what was before."""
        self._since = time.perf_counter()

    def lap(self, name: str) -> None:
        """Note the time since the last lap."""
        now = time.perf_counter()
        self.laps[name].append(now - self._since)
        self._since = now


class StagedRenderer(ObjectRenderer):
    """Splits drawing from reading back."""

    def __init__(self, options: PyrenderOptions, watch: Stopwatch) -> None:
        super().__init__(options)
        self._watch = watch

    def _read_main_framebuffer(self, scene: Any, flags: int) -> Picture:
        GL.glFinish()
        self._watch.lap("draw")
        image = super()._read_main_framebuffer(scene, flags)
        self._watch.lap("read back")
        return image


class StagedEngine(PyrenderEngine):
    """An engine that draws with and without shadows, stage by stage."""

    def __init__(self, watch: Stopwatch) -> None:
        super().__init__(PyrenderOptions())
        self.watch = watch
        self._staged = {shadows: StagedRenderer(PyrenderOptions(shadows=shadows), watch) for shadows in (True, False)}

    def staged(self, snapshot: Callable[[], Snapshot], *, side: int, shadows: bool) -> Picture:
        """A picture; the watch has its laps."""
        self.watch.start()
        seen = snapshot()
        scene = self._scene(seen)
        self.watch.lap("scene")
        image = self._staged[shadows].picture(scene, width=side, height=side, background=seen.background)
        self._cache.trim()
        return image


@dataclass(frozen=True)
class Case:
    """An object as one agent has it in front of it."""

    entry: BenchObject
    session: Session
    views: Sequence[View]

    def look(self, view: View) -> None:
        """Put the camera there."""
        position, rotation = (tuple(each.tolist()) for each in sailenv_pose(view.camera))
        self.session.set_position(position=position)
        self.session.set_rotation(rotation=rotation)


def case_of(entry: BenchObject, n_views: int) -> Case:
    """The object, uploaded and spawned."""
    session = Session(ModelCache(Limits()), EngineInfo("pyrender", ""))
    (path,) = session.send_obj_zip(file=("object.zip", entry.obj.to_zip()))
    origin = (0.0, 0.0, 0.0)
    session.spawn_object(name=f"file:{path}", position=origin, rotation=origin, scale=(1.0, 1.0, 1.0))
    views = entry.views()
    return Case(entry, session, views[:: max(1, len(views) // n_views)][:n_views])


def stages(cases: Sequence[Case], rounds: int) -> list[list[object]]:
    """A row for each object, size and kind: first picture, stages, pictures a second."""
    watch = Stopwatch()
    engine = StagedEngine(watch)
    kinds = [(case, side, shadows) for case in cases for side in SIDES for shadows in (True, False)]
    first: dict[int, float] = {}
    laps = {number: Stopwatch() for number in range(len(kinds))}
    with echo() as sent:
        for turn in range(rounds + 1):
            for number, (case, side, shadows) in enumerate(kinds):
                started = time.perf_counter()
                engine.watch.laps = laps[number].laps if turn else defaultdict(list)
                for view in case.views[: None if turn else 1]:
                    case.look(view)
                    image = engine.staged(case.session.snapshot, side=side, shadows=shadows)
                    first.setdefault(number, time.perf_counter() - started)
                    engine.watch.start()
                    data = png(image, 1)
                    engine.watch.lap("encode")
                    sent(data)
                    engine.watch.lap("send")
    return [
        [case.entry.name, side, "yes" if shadows else "no", f"{1000 * first[number]:.0f}", *figures(laps[number].laps)]
        for number, (case, side, shadows) in enumerate(kinds)
    ]


def figures(laps: Mapping[str, Sequence[float]]) -> list[str]:
    """Median milliseconds of each stage, of all, and pictures a second."""
    medians = [1000 * statistics.median(laps[name]) for name in STAGES]
    return [*(f"{value:.2f}" for value in medians), f"{sum(medians):.2f}", f"{1000 / sum(medians):.0f}"]


@contextlib.contextmanager
def echo() -> Iterator[Callable[[bytes], None]]:
    """Sends bytes over the loopback to someone who takes them all, and returns once they have been taken."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours = socket.create_connection(listener.getsockname())
        theirs, _ = listener.accept()
    ours.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def take() -> None:
        while size := theirs.recv(4, socket.MSG_WAITALL):
            theirs.recv(int.from_bytes(size, "little"), socket.MSG_WAITALL)
            theirs.sendall(b"!")

    thread = threading.Thread(target=take)
    thread.start()

    def send(data: bytes) -> None:
        ours.sendall(len(data).to_bytes(4, "little") + data)
        ours.recv(1)

    try:
        yield send
    finally:
        ours.close()
        thread.join()
        theirs.close()


def png(image: Picture, level: int) -> bytes:
    """As the worker encodes it, with another level of compression."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image[:, ::-1])).save(buffer, "PNG", compress_level=level)
    return buffer.getvalue()


def encodings(target: SailenvTarget, entry: BenchObject, rounds: int) -> list[list[object]]:
    """A row for each level of PNG and one for raw pixels."""
    image = target.render(entry.obj, entry.views()[20:21], size=(224, 224))[0]
    coders: dict[str, tuple[Callable[[], bytes], Callable[[bytes], object]]] = {
        f"PNG {level}": (partial(png, image, level), lambda data: np.asarray(Image.open(io.BytesIO(data))))
        for level in LEVELS
    }
    coders["raw"] = lambda: np.ascontiguousarray(image).tobytes(), lambda data: np.frombuffer(data, np.uint8)
    rows: list[list[object]] = []
    with echo() as send:
        for name, (encode, decode) in coders.items():
            data = encode()
            parts: dict[str, Callable[[], object]] = {
                "encode": encode,
                "send": partial(send, data),
                "decode": partial(decode, data),
            }
            costs = [1000 * each.median for each in in_rounds(parts, 4 * rounds).values()]
            rows.append([name, len(data), *(f"{cost:.2f}" for cost in costs), f"{sum(costs):.2f}"])
    return rows


def repaints(obj: Object3D) -> Iterator[Object3D]:
    """``obj`` again and again, each time with other noise on all its textures."""
    random = np.random.default_rng(0)
    while True:
        yield obj.with_textures(
            {
                name: np.clip(texture + random.integers(-12, 13, texture.shape), 0, 255).astype(np.uint8)
                for name, texture in obj.textures.items()
            }
        )


class Published(SailenvTarget):
    """Uses the plain commands, as SAILenv's own client does: an upload for each texture, and PNGs one by one."""

    def _connection(self, size: tuple[int, int]) -> client._Connection:
        connection = super()._connection(size)
        connection._extended = False
        return connection


def exchanges(target: SailenvTarget, entry: BenchObject, rounds: int) -> list[list[object]]:
    """A row for each size: what a picture costs a client, and one with a new texture."""
    rows: list[list[object]] = []
    views = entry.views()
    for side in SIDES:
        size = (side, side)
        with contextlib.closing(Published(*target.address)) as published:
            ours, plain = (alternating(each, entry.obj, views, size, 8 * rounds) for each in (target, published))
        batch = in_rounds({"all": lambda: target.render(entry.obj, views, size=size)}, rounds)["all"]  # noqa: B023
        rows.append([entry.name, side, *ours, f"{1000 * batch.median / len(views):.2f}", *plain])
    return rows


def alternating(
    target: SailenvTarget, obj: Object3D, views: Sequence[View], size: tuple[int, int], rounds: int
) -> tuple[str, str, str]:
    """Milliseconds of a picture of what is there, of one with another texture, and the ratio; medians."""
    seconds: dict[str, list[float]] = {"plain": [], "change": []}
    shown, others = obj, repaints(obj)
    for number in range(rounds + 1):
        for what in seconds:
            shown = next(others) if what == "change" else shown
            started = time.perf_counter()
            target.render(shown, [views[7 * number % len(views)]], size=size)
            seconds[what].append(time.perf_counter() - started)
    plain, change = (statistics.median(values[1:]) for values in seconds.values())
    return f"{1000 * plain:.2f}", f"{1000 * change:.2f}", f"{change / plain:.2f}"


def pose_change(target: SailenvTarget, rounds: int) -> str:
    """Milliseconds for SET_POSITION and SET_ROTATION together with the published client."""
    if importlib.util.find_spec("sailenv") is None:
        return "The published client is not installed (`pip install sailenv`)."
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from sailenv.agent import Agent
    agent = Agent(width=224, height=224, host=target.address[0], port=target.address[1])
    with contextlib.redirect_stdout(io.StringIO()):
        agent.register()

    def move() -> None:
        for _ in range(20):
            agent.set_position((0.1, 0.2, 0.3))
            agent.set_rotation((170.0, 20.0, 180.0))

    times = in_rounds({"pose": move}, rounds)["pose"]
    agent.delete()
    return f"A pose change (two commands) with the published client: {times.per(20)} ms (wanted < {WANTED_POSE_MS:g})."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="*", default=[], help="default: the paper's, or those that are shipped")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--views", type=int, default=12, help="views a round, for the stages")
    options = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    entries = bench_objects(options.objects)
    print(f"# The renderer worker\n\n{machine()}; {options.rounds} rounds\n")
    print("Milliseconds a picture, medians. First: the first picture, with upload to the card, in milliseconds.\n")
    rows = stages([case_of(entry, options.views) for entry in entries], options.rounds)
    print(GL.glGetString(GL.GL_RENDERER).decode(), "\n")
    print(markdown_table(["object", "side", "shadows", "first", *STAGES, "all", "a second"], rows))
    with local_renderer() as target:
        print("\nOver the loopback, milliseconds a picture; the ratio is that of texture change + picture to a picture")
        print(f"(wanted on candle at 224: <= {WANTED_RATIO}).\n")
        titles = ["ours", "new texture", "ratio", "ours, 60 at once", "published", "new texture", "ratio"]
        exchanged = [row for entry in entries for row in exchanges(target, entry, options.rounds)]
        print(markdown_table(["object", "side", *titles], exchanged))
        print(f"\nEncodings of a picture of {entries[0].name} at 224, milliseconds:\n")
        encoded = encodings(target, entries[0], options.rounds)
        print(markdown_table(["", "bytes", "encode", "send", "decode", "all"], encoded))
        print("\n" + pose_change(target, options.rounds))


if __name__ == "__main__":
    main()
