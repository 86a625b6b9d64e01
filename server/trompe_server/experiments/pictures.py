"""Pictures of experiments: the objects in both renderers, and what jobs left behind, put together."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_server.reports.layout import beside, captioned, sheet, stacked, tile
from trompe_server.surrogate import Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_server.surrogate.calibration import build_surrogate, calibrate
from trompe_server.target import TargetRenderer
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["Shown", "job_pictures", "objects_grid"]

Image8 = NDArray[np.uint8]
TILE, WIDTH = 168, 1200
SIZE = (224, 224)
COLUMNS = ("target", "the paper's surrogate", "repainted: target", "repainted: our surrogate")


@dataclass(frozen=True)
class Shown:
    """An object to be shown from one view."""

    name: str
    obj: Object3D
    view: View


def objects_grid(shown: Sequence[Shown], target: TargetRenderer) -> Image.Image:
    """A row for each object: the target, the paper's (diffuse) surrogate; then, in the colours' negative, which the
    measured surrogate has not seen, the target and what that surrogate predicts.
    """
    cards = []
    for k in range(0, len(shown), 2):
        cards.append(beside([_row(each, target) for each in shown[k : k + 2]], gap=24))
    return sheet(cards, columns=1, title=f"Objects in both renderers: {', '.join(COLUMNS)}")


def _row(shown: Shown, target: TargetRenderer) -> Image.Image:
    obj, views = shown.obj, [shown.view]
    negative = obj.with_textures({name: 255 - image for name, image in obj.textures.items()})
    ask = partial(target.render, size=SIZE)
    clean, repainted = ask(obj, views), ask(negative, views)
    found = calibrate(obj, views, clean, ask, wanted="auto", generator=np.random.default_rng(0))
    geometry = prepare_geometry(obj, views, size=SIZE, sampling=found.sampling)
    plain = _seen(diffuse_surrogate(geometry, views), obj)
    predicted = _seen(build_surrogate(found, obj, views, clean, geometry=geometry), negative)
    images = (clean[0], plain, repainted[0], predicted)
    tiles = [captioned(tile(image, TILE), caption) for image, caption in zip(images, COLUMNS, strict=True)]
    return captioned(beside(tiles, gap=4), shown.name)


def _seen(surrogate: Surrogate, obj: Object3D) -> Image8:
    """The surrogate's image (H, W, 3) of its only view."""
    image = surrogate.render_all(surrogate.texels(textures_of(obj)))[0]
    return np.asarray(image.mul(255).round().byte().permute(1, 2, 0).numpy())


def job_pictures(folder: Path, keys: Sequence[str], artifact: str) -> Image.Image | None:
    """A file of some jobs, one under the other, scaled to one width; ``None`` where no job has it."""
    files = [file for key in dict.fromkeys(keys) if (file := folder / "jobs" / key / artifact).is_file()]
    if not files:
        return None
    return stacked([_fitted(file) for file in files], gap=12)


def _fitted(file: Path) -> Image.Image:
    with Image.open(file) as opened:
        picture = opened.convert("RGB")
    return picture.resize((WIDTH, round(WIDTH * picture.height / picture.width)), Image.Resampling.LANCZOS)
