"""What the pages read of a job's files: outcomes for lists, and single target images. Thread-safe."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Final, Literal

import numpy as np
from fastapi import Path
from numpy.typing import NDArray

from trompe_server.api.jobs import RESULT
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
KEPT: Final = 2000
"""Outcomes in memory."""

Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Outcome:
    """``drop``: A_drop in the target, of held-out views if there are any (``unseen``); ``None`` without an attack."""

    drop: float | None
    unseen: bool


@lru_cache(maxsize=KEPT)
def outcome_of(artifacts: JobArtifacts) -> Outcome | None:
    """A few figures of the result, which never changes; ``None`` without a readable one."""
    try:
        result = json.loads(artifacts.read(RESULT))
    except (FileNotFoundError, ValueError):
        return None
    judged = result.get("held_out") or result.get("target") or {}
    return Outcome(judged.get("a_drop"), bool(result.get("held_out")))


def picture_png(artifacts: JobArtifacts, view_set: ViewSet, index: int, kind: Kind) -> bytes:
    """One target image of an ended job as PNG. Raises ``FileNotFoundError`` or ``IndexError``."""
    if kind != "difference":
        return encode_png(target_image(artifacts, view_set, index, kind))
    before = target_image(artifacts, view_set, index, "before").astype(np.int16)
    change = target_image(artifacts, view_set, index, "after") - before
    return encode_png((128 + AMPLIFIED * change).clip(0, 255).astype(np.uint8))


def target_image(artifacts: JobArtifacts, view_set: ViewSet, index: int, kind: Kind) -> Image8:
    """One image (H, W, 3) uint8, not the difference. Raises as ``picture_png``."""
    name, _, renderer = view_set.partition("-")
    image: Image8 = _load(artifacts, f"{numbered(FILES[kind], int(renderer or 0))}.npz")[name][index]
    return image


@lru_cache(maxsize=JOBS)
def _load(artifacts: JobArtifacts, name: str) -> dict[str, Image8]:
    return unpack_arrays(artifacts.read(name))
