"""What the phases of a job leave for each other: arrays, checkpoints, what was spent. All in the job's artifacts."""

import json
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack import AttackState, load_state, save_state
from trompe_server.pipeline import Artifacts

__all__ = ["JobFiles"]


@dataclass(frozen=True)
class JobFiles:
    """The files of one job whose attack takes ``chunks`` phases."""

    artifacts: Artifacts
    chunks: int

    @property
    def phases(self) -> list[str]:
        """Names of the job's phases."""
        return ["prepare", "calibrate", *(f"attack-{chunk:03d}" for chunk in range(self.chunks)), "judge"]

    def save(self, name: str, **arrays: NDArray[Any]) -> None:
        """Keep arrays under ``name``."""
        self.artifacts.write(f"{name}.npz", pack_arrays(arrays))

    def load(self, name: str) -> dict[str, NDArray[Any]]:
        """The arrays that were kept under ``name``."""
        return unpack_arrays(self.artifacts.read(f"{name}.npz"))

    def has(self, name: str) -> bool:
        """Whether arrays were kept under ``name``."""
        return self.artifacts.exists(f"{name}.npz")

    def save_state(self, chunk: int, state: AttackState) -> None:
        """Keep the checkpoint after ``chunk`` chunks. Two files take turns: the one a chunk starts from outlives it."""
        self.artifacts.write(f"state-{chunk % 2}.npz", save_state(state))

    def load_state(self, chunk: int) -> AttackState:
        """The checkpoint after ``chunk`` chunks."""
        return load_state(self.artifacts.read(f"state-{chunk % 2}.npz"))

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

    def note_spent(self, chunk: int, *, evaluations: int, queries: int) -> None:
        """Keep how many images the classifiers had been shown when a chunk was over, and the scores it asked for."""
        self._write(f"spent-{chunk:03d}", {"evaluations": evaluations, "queries": queries})

    def spent(self) -> dict[str, int | None]:
        """``evaluations`` and ``queries`` of the whole attack; ``None`` where there were none."""
        found = (self._read(f"spent-{chunk:03d}") for chunk in range(self.chunks))
        spent = [each for each in found if each is not None]
        queries = sum(each["queries"] for each in spent)
        return {"evaluations": spent[-1]["evaluations"] if spent else None, "queries": queries or None}

    def _write(self, name: str, value: Any) -> None:
        self.artifacts.write(f"{name}.json", json.dumps(value).encode())

    def _read(self, name: str) -> Any:
        name = f"{name}.json"
        return json.loads(self.artifacts.read(name)) if self.artifacts.exists(name) else None
