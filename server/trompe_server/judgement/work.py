"""The work of a judgement, image by image: kept in files, so that a stopped one goes on, and timed."""

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from trompe_server.job.protocol import Artifacts, OnProgress
from trompe_server.storage.arrays import pack_arrays, unpack_arrays
from trompe_server.system.versions import versions
from trompe_shared.api import Progress

T = TypeVar("T", bound=np.generic)

GUESS: Final = 0.05
"""Seconds of an image of a kind that has not been seen."""


@dataclass
class Timed:
    """Counts the images of each kind of work, and tells ``on_progress`` before and after each step.

    left: images to come by kind, ``rendering in three`` or ``showing to tiny``.
    """

    left: Counter[str]
    on_progress: OnProgress
    clock: Callable[[], float] = time.monotonic
    _took: dict[str, tuple[int, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._total = self.left.total()

    @contextmanager
    def step(self, kind: str, images: int, *, kept: bool = False) -> Iterator[None]:
        """Some images of a kind. kept: found in the files, so that their time tells nothing."""
        self._tell(kind)
        began = self.clock()
        yield
        if not kept:
            count, seconds = self._took.get(kind, (0, 0.0))
            self._took[kind] = count + images, seconds + self.clock() - began
        self.left[kind] -= images
        self._tell(kind)

    def skip(self, *kinds: str) -> None:
        """No more images of these kinds."""
        self._total -= sum(self.left.pop(kind, 0) for kind in kinds)

    def _tell(self, kind: str) -> None:
        done = 1 - self.left.total() / self._total if self._total else 1.0
        paces = {each: seconds / count for each, (count, seconds) in self._took.items() if count}
        left = sum(count * paces.get(each, GUESS) for each, count in self.left.items())
        self.on_progress(Progress(phase=kind, fraction=done, eta_seconds=left))


@dataclass(frozen=True)
class Kept:
    """Arrays in files, each named by a hash of all that it depends on."""

    files: Artifacts

    def has(self, key: str) -> bool:
        """Whether the array is there."""
        return self.files.exists(key)

    def array(self, key: str, make: Callable[[], NDArray[T]]) -> NDArray[T]:
        """The kept array, or else the one that ``make`` gives, which is saved. The write is atomic."""
        with suppress(FileNotFoundError, ValueError, OSError, KeyError):
            return unpack_arrays(self.files.read(key))["kept"]
        made = make()
        self.files.write(key, pack_arrays({"kept": made}))
        return made


def key_of(*parts: Any) -> str:
    """Name of a file by a hash of ``parts`` and of the versions of the software."""
    text = json.dumps([parts, versions()], sort_keys=True, default=str)
    return f"{hashlib.sha256(text.encode()).hexdigest()}.npz"
