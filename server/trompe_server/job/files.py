"""Files that the phases of a job leave for later phases: arrays, checkpoints, counts. All in the job's artifacts."""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from numpy.typing import NDArray

from trompe_server.attack import AttackState, load_state, save_state
from trompe_server.job.protocol import Artifacts, DamagedFileError, numbered
from trompe_server.storage.arrays import pack_arrays, unpack_arrays
from trompe_server.surrogate.calibration import Calibration
from trompe_server.surrogate.calibration_file import unpack_calibration

T = TypeVar("T")

OPEN: Final = "open"
"""Kind of the time before and between phases."""
_HASH: Final = hashlib.sha256().digest_size


@dataclass(frozen=True)
class Spent:
    """Steps of an attack, images shown to each classifier (before its first step too), scores asked.

    added, renders: views added to the first ones, and images rendered to find and to probe them.
    """

    steps: int
    evaluations: int | None
    queries: int | None
    added: int = 0
    renders: int = 0


@dataclass(frozen=True)
class JobFiles:
    """The files of one job whose attack takes ``chunks`` phases."""

    artifacts: Artifacts
    chunks: int

    @property
    def phases(self) -> list[str]:
        return ["prepare", "calibrate", *(f"attack-{chunk:03d}" for chunk in range(self.chunks)), "judge"]

    def save(self, name: str, **arrays: NDArray[Any]) -> None:
        self._seal(name, pack_arrays(arrays))

    def load(self, name: str) -> dict[str, NDArray[Any]]:
        """The arrays saved under ``name``. Raises ``DamagedFileError``."""
        return self._unseal(name, unpack_arrays)

    def save_state(self, chunk: int, state: AttackState) -> None:
        """Save the state after ``chunk`` chunks. Two files alternate: the state at a chunk's start outlives it."""
        self._seal(f"state-{chunk % 2}", save_state(state))

    def load_state(self, chunk: int, *, step: int) -> AttackState:
        """The state after ``chunk`` chunks, at ``step``.

        Raises ``DamagedFileError`` for a damaged file or one of another step.
        """

        def of_step(data: bytes) -> AttackState:
            if (state := load_state(data)).step != step:
                raise ValueError(f"it is of step {state.step} instead of {step}")
            return state

        return self._unseal(f"state-{chunk % 2}", of_step)

    def save_end(self, state: AttackState) -> None:
        """Save the state after the last step that was taken."""
        self._seal("state-end", save_state(state))

    def load_end(self) -> AttackState:
        """The state of ``save_end``. Raises ``DamagedFileError``."""
        return self._unseal("state-end", load_state)

    def save_calibration(self, renderer: int, packed: bytes) -> None:
        """Save the packed calibration of a renderer, by its number."""
        self._seal(numbered("calibration", renderer), packed)

    def load_calibration(self, renderer: int) -> Calibration:
        """The saved calibration of a renderer. Raises ``DamagedFileError``."""
        return self._unseal(numbered("calibration", renderer), unpack_calibration)

    def has_calibration(self, renderer: int) -> bool:
        """Whether a usable calibration is saved."""
        try:
            self.load_calibration(renderer)
        except DamagedFileError:
            return False
        return True

    def save_look(self, chunk: int, arrays: Mapping[str, NDArray[Any]], *, views: int, renders: int) -> None:
        """Save what a look at further views found before a chunk, and its number of added ``views`` and images."""
        self._write(_look(chunk), {"views": views, "renders": renders})
        self.save(_look(chunk), **arrays)

    def load_looks(self, chunk: int) -> dict[int, dict[str, NDArray[Any]]]:
        """The arrays of the looks before earlier chunks than ``chunk``, by theirs. Raises ``DamagedFileError``."""
        taken = [earlier for earlier in range(chunk) if self.artifacts.exists(f"{_look(earlier)}.npz")]
        return {earlier: self.load(_look(earlier)) for earlier in taken}

    def note_seconds(self, phase: str, seconds: float) -> None:
        """Record the duration of a phase, or of what came before it since the phase before (``open-<phase>``)."""
        self._write(f"seconds-{phase}", seconds)

    def seconds(self) -> dict[str, float]:
        """Seconds by kind of phase, all attack phases together, and of opening the job and between phases."""
        seconds: dict[str, float] = {}
        for name in (each for phase in self.phases for each in (f"{OPEN}-{phase}", phase)):
            if (took := self._read(f"seconds-{name}")) is not None:
                kind = name.partition("-")[0]
                seconds[kind] = seconds.get(kind, 0.0) + took
        return seconds

    def note_shown_before(self, evaluations: int) -> None:
        """Record the number of images shown before the first step."""
        self._write("shown-before", evaluations)

    def note_spent(self, chunk: int, *, steps: int, evaluations: int, queries: int) -> None:
        """Record the steps of a chunk, its scores, and the images shown by all steps so far."""
        self._write(f"spent-{chunk:03d}", {"steps": steps, "evaluations": evaluations, "queries": queries})

    def spent(self) -> Spent:
        """Counts of the whole attack."""
        found = (self._read(f"spent-{chunk:03d}") for chunk in range(self.chunks))
        spent = [each for each in found if each is not None]
        queries = sum(each["queries"] for each in spent)
        evaluations = spent[-1]["evaluations"] + (self._read("shown-before") or 0) if spent else None
        looks = [look for chunk in range(self.chunks) if (look := self._read(_look(chunk))) is not None]
        added, renders = (sum(look[name] for look in looks) for name in ("views", "renders"))
        return Spent(sum(each["steps"] for each in spent), evaluations, queries or None, added, renders)

    def _seal(self, name: str, data: bytes) -> None:
        """Write an .npz file with its hash at the end, which readers of such files ignore."""
        self.artifacts.write(f"{name}.npz", data + hashlib.sha256(data).digest())

    def _unseal(self, name: str, unpack: Callable[[bytes], T]) -> T:
        """What ``unpack`` makes of the bytes that ``_seal`` wrote. Raises ``DamagedFileError`` for a missing or damaged
        file, so that its phase is run again."""
        try:
            sealed = self.artifacts.read(f"{name}.npz")
            data, digest = sealed[:-_HASH], sealed[-_HASH:]
            if hashlib.sha256(data).digest() != digest:
                raise ValueError("its checksum is wrong")
            return unpack(data)
        except (FileNotFoundError, ValueError) as error:
            raise DamagedFileError(f"The file {name!r} of an earlier phase cannot be used: {error}") from error

    def _write(self, name: str, value: Any) -> None:
        self.artifacts.write(f"{name}.json", json.dumps(value).encode())

    def _read(self, name: str) -> Any:
        """The recorded value; ``None`` if missing or damaged, since it is only a count."""
        try:
            return json.loads(self.artifacts.read(f"{name}.json"))
        except (FileNotFoundError, ValueError):
            return None


def _look(chunk: int) -> str:
    return f"look-{chunk:03d}"
