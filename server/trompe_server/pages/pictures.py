"""Single target images of a job, as PNG: the report has them on sheets, a turntable wants them one by one."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from trompe_server.array_files import unpack_arrays
from trompe_server.artifacts import JobArtifacts
from trompe_server.pipeline import VIEWS_AFTER, VIEWS_BEFORE
from trompe_shared.object3d import encode_png

__all__ = ["Kind", "Pictures", "ViewSet"]

ViewSet = Literal["own", "held_out"]
Kind = Literal["before", "after", "difference"]

FILES: Final[Mapping[Kind, str]] = {"before": f"{VIEWS_BEFORE}.npz", "after": f"{VIEWS_AFTER}.npz"}
AMPLIFIED: Final = 10
JOBS: Final = 4
"""Files of images that are kept in memory, each of some tens of MiB."""

Images = NDArray[np.uint8]


class Pictures:
    """Target images of finished jobs. Safe to use from several threads."""

    def __init__(self) -> None:
        self._load = lru_cache(maxsize=JOBS)(_load)

    def one(self, artifacts: JobArtifacts, view_set: ViewSet, index: int, kind: Kind) -> bytes:
        """One image as PNG. Raises ``FileNotFoundError`` or ``IndexError`` where there is none."""
        if kind != "difference":
            return encode_png(self._images(artifacts, kind, view_set)[index])
        before = self._images(artifacts, "before", view_set)[index].astype(np.int16)
        change = self._images(artifacts, "after", view_set)[index] - before
        return encode_png((128 + AMPLIFIED * change).clip(0, 255).astype(np.uint8))

    def _images(self, artifacts: JobArtifacts, kind: Kind, view_set: ViewSet) -> Images:
        return self._load(artifacts, FILES[kind])[view_set]


def _load(artifacts: JobArtifacts, name: str) -> dict[str, Images]:
    return unpack_arrays(artifacts.read(name))
