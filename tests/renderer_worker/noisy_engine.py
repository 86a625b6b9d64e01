"""An engine of one's own for tests: each picture is one grey, drawn from the noise."""

import os
import subprocess

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engines.engine import noise_seed
from trompe_renderer.world.snapshot import Snapshot
from trompe_shared.engine import EngineInfo


class Noisy:
    def __init__(self, level: int = 100, *, spread: float = 50.0, wrong: bool | None = None) -> None:
        self.info = EngineInfo("pyrender", "7", deterministic=False)
        self._level, self._spread, self._kind = level, spread, np.float32 if wrong else np.uint8

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        grey = self._level + self._spread * np.random.default_rng(noise_seed(world)).random()
        return np.full((height, width, 3), grey, self._kind)


class Talkative(Noisy):
    """Prints in Latin-1, without an end of line, and starts a process that outlives it."""

    def __init__(self) -> None:
        super().__init__()
        os.write(1, "Grün ".encode("latin-1"))
        subprocess.Popen(["sleep", "600"])


class Failing(Noisy):
    """Draws nothing."""

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        raise ValueError("no shader")
