"""What the phases of a job leave for each other: arrays, checkpoints, what was spent. All in the job's artifacts."""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeVar

from numpy.typing import NDArray

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack import AttackState, load_state, save_state
from trompe_server.calibration_files import unpack_calibration
from trompe_server.pipeline import Artifacts, DamagedFileError
from trompe_server.surrogate.calibration import Calibration

__all__ = ["JobFiles", "Spent"]


class HasStep(Protocol):
    """The state of a search; it knows after how many steps."""

    @property
    def step(self) -> int: ...


State = TypeVar("State", bound=HasStep)


@dataclass(frozen=True)
class Spent:
    """Steps of an attack, images it showed to each classifier (those before its first step too), scores it asked for;
    ``None`` where there were none."""

    steps: int
    evaluations: int | None
    queries: int | None


@dataclass(frozen=True)
class JobFiles:
    """The files of one job whose attack takes ``chunks`` phases, after those named ``first``."""

    artifacts: Artifacts
    chunks: int
    first: tuple[str, ...] = ("prepare", "calibrate")

    @property
    def phases(self) -> list[str]:
        """Names of the job's phases."""
        return [*self.first, *(f"attack-{chunk:03d}" for chunk in range(self.chunks)), "judge"]

    def save(self, name: str, **arrays: NDArray[Any]) -> None:
        """Keep arrays under ``name``."""
        self._seal(f"{name}.npz", pack_arrays(arrays))

    def load(self, name: str) -> dict[str, NDArray[Any]]:
        """The arrays that were kept under ``name``. Raises ``DamagedFileError`` where they are not whole."""
        with _whole(name):
            return unpack_arrays(self._unseal(f"{name}.npz"))

    def has(self, name: str) -> bool:
        """Whether arrays were kept under ``name``."""
        return self.artifacts.exists(f"{name}.npz")

    def save_state(self, chunk: int, state: AttackState) -> None:
        """Keep the checkpoint of an attack on a texture; see ``save_checkpoint``."""
        self.save_checkpoint(chunk, save_state(state))

    def load_state(self, chunk: int, *, step: int) -> AttackState:
        """The checkpoint of an attack on a texture; see ``load_checkpoint``."""
        return self.load_checkpoint(chunk, load_state, step=step)

    def save_checkpoint(self, chunk: int, state: bytes) -> None:
        """Keep a state after ``chunk`` chunks. Two files take turns: the one a chunk starts from outlives it."""
        self._seal(f"state-{chunk % 2}.npz", state)

    def load_checkpoint(self, chunk: int, load: Callable[[bytes], State], *, step: int) -> State:
        """The state after ``chunk`` chunks, which are ``step`` steps; ``load`` reads its bytes.

        Raises ``DamagedFileError`` where it is not whole (the file holds checksums), or a later one is in its place.
        """
        name = f"state-{chunk % 2}"
        with _whole(name):
            state = load(self._unseal(f"{name}.npz"))
            if state.step != step:
                raise ValueError(f"it is of step {state.step} instead of {step}")
        return state

    def save_calibration(self, packed: bytes) -> None:
        """Keep a packed calibration."""
        self._seal(_CALIBRATION, packed)

    def load_calibration(self) -> Calibration:
        """The calibration that was kept. Raises ``DamagedFileError`` where it is not whole."""
        with _whole("calibration"):
            return unpack_calibration(self._unseal(_CALIBRATION))

    def has_calibration(self) -> bool:
        """Whether there is a calibration that can be used."""
        try:
            self.load_calibration()
        except DamagedFileError:
            return False
        return True

    def note_seconds(self, phase: str, seconds: float) -> None:
        """Keep how long a phase took."""
        self._write(f"seconds-{phase}", seconds)

    def seconds(self) -> dict[str, float]:
        """Seconds of the phases that are done, those of all attack phases together."""
        seconds: dict[str, float] = {}
        for phase in self.phases:
            if (took := self._read(f"seconds-{phase}")) is not None:
                kind = phase.partition("-")[0]
                seconds[kind] = seconds.get(kind, 0.0) + took
        return seconds

    def note_shown_before(self, evaluations: int) -> None:
        """Keep how many images were shown before the first step."""
        self._write("shown-before", evaluations)

    def note_spent(self, chunk: int, *, steps: int, evaluations: int, queries: int) -> None:
        """Keep how many steps a chunk took and scores it asked for, and all images its and earlier steps showed."""
        self._write(f"spent-{chunk:03d}", {"steps": steps, "evaluations": evaluations, "queries": queries})

    def spent(self) -> Spent:
        """What the whole attack spent."""
        found = (self._read(f"spent-{chunk:03d}") for chunk in range(self.chunks))
        spent = [each for each in found if each is not None]
        queries = sum(each["queries"] for each in spent)
        evaluations = spent[-1]["evaluations"] + (self._read("shown-before") or 0) if spent else None
        return Spent(sum(each["steps"] for each in spent), evaluations, queries or None)

    def _seal(self, name: str, data: bytes) -> None:
        """Keep bytes with their hash at the end, where a reader of .npz files does not mind it."""
        self.artifacts.write(name, data + hashlib.sha256(data).digest())

    def _unseal(self, name: str) -> bytes:
        """What ``_seal`` kept. Raises ``ValueError`` where it is not what was kept."""
        sealed = self.artifacts.read(name)
        data, digest = sealed[:-_HASH], sealed[-_HASH:]
        if hashlib.sha256(data).digest() != digest:
            raise ValueError("its checksum is wrong")
        return data

    def _write(self, name: str, value: Any) -> None:
        self.artifacts.write(f"{name}.json", json.dumps(value).encode())

    def _read(self, name: str) -> Any:
        """What was kept under ``name``; ``None`` where there is nothing whole: it only tells what was spent."""
        try:
            return json.loads(self.artifacts.read(f"{name}.json"))
        except (FileNotFoundError, ValueError):
            return None


@contextmanager
def _whole(name: str) -> Iterator[None]:
    """Say that a file is missing or damaged, so that the phase that made it is run again."""
    try:
        yield
    except (FileNotFoundError, ValueError) as error:
        raise DamagedFileError(f"The file {name!r} of an earlier phase cannot be used: {error}") from error


_CALIBRATION: Final = "calibration.npz"
_HASH: Final = hashlib.sha256().digest_size
