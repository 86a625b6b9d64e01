"""Single target images of a job, as PNG."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Final, Literal

import numpy as np
from fastapi import Path
from numpy.typing import NDArray

from trompe_server.job.protocol import VIEWS_AFTER, VIEWS_BEFORE, numbered
from trompe_server.storage.arrays import unpack_arrays
from trompe_server.storage.folders import JobArtifacts
from trompe_shared.object3d import encode_png

ViewSet = Annotated[str, Path(pattern=r"^(own|held_out)(-[1-9]\d?)?$")]
"""``own`` or ``held_out``, with the number of the renderer if it is not the job's first."""
Kind = Literal["before", "after", "difference"]

FILES: Final[Mapping[Kind, str]] = {"before": VIEWS_BEFORE, "after": VIEWS_AFTER}
AMPLIFIED: Final = 10
JOBS: Final = 4
"""Image files in memory, each of some tens of MiB."""

Image8 = NDArray[np.uint8]


class Pictures:
    """Target images of ended jobs. Thread-safe."""

    def __init__(self) -> None:
        self._load = lru_cache(maxsize=JOBS)(_load)

    def one(self, artifacts: JobArtifacts, view_set: ViewSet, index: int, kind: Kind) -> bytes:
        """One image as PNG. Raises ``FileNotFoundError`` or ``IndexError``."""
        if kind != "difference":
            return encode_png(self.image(artifacts, view_set, index, kind))
        before = self.image(artifacts, view_set, index, "before").astype(np.int16)
        change = self.image(artifacts, view_set, index, "after") - before
        return encode_png((128 + AMPLIFIED * change).clip(0, 255).astype(np.uint8))

    def image(self, artifacts: JobArtifacts, view_set: ViewSet, index: int, kind: Kind) -> Image8:
        """One image (H, W, 3) uint8, not the difference. Raises as ``one``."""
        name, _, renderer = view_set.partition("-")
        image: Image8 = self._load(artifacts, f"{numbered(FILES[kind], int(renderer or 0))}.npz")[name][index]
        return image


def _load(artifacts: JobArtifacts, name: str) -> dict[str, Image8]:
    return unpack_arrays(artifacts.read(name))
