"""The constructive side: adversarial variants of an object library, as objects and as labelled pictures, to train on
or to test with."""

import csv
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_server.attack import ViewDistribution
from trompe_server.experiments.in_process import Change, run_job
from trompe_server.experiments.own_renderer import running_renderer
from trompe_server.target import TargetRenderer
from trompe_shared.api import JobSpec
from trompe_shared.errors import SpecError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import ShippedObject, shipped_objects

__all__ = ["Variant", "clean", "export_variants", "make_variants", "photographs"]

CLEAN: Final = "clean"
TEST_SHARE: Final = 0.2
VIEW_STREAM: Final = 11
"""Keeps the random numbers of the pictures apart from those of the attacks."""
ATTACK: Final[Mapping[str, Any]] = {"steps": 25, "pool": 80, "held_out": 30, "background": ["white", "black"]}
"""Options of the attacks that make variants."""
COLUMNS: Final = (
    *("file", "split", "label", "object", "variant", "epsilon"),
    *("distance", "azimuth", "elevation", "light_azimuth", "light_elevation"),
)

Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Variant:
    """An object as it is (``epsilon`` 0, name ``clean``) or repainted, with its class.

    ``fooled``: share of held-out views on which the network that it was made for is fooled.
    """

    object: ShippedObject
    name: str
    epsilon: float
    obj: Object3D
    fooled: float = 0.0


def clean(name: str) -> Variant:
    """A shipped object as it is."""
    shipped = shipped_objects()[name]
    return Variant(shipped, CLEAN, 0.0, load_object(shipped.read()))


def make_variants(
    names: Sequence[str],
    target: TargetRenderer,
    folder: Path,
    *,
    per_object: int,
    epsilon: float,
    seed: int = 0,
    change: Change | None = None,
) -> Iterator[Variant]:
    """Repainted variants of shipped objects, each attacked from other random views; the network may be ``change``d.

    ``folder`` keeps what is measured of the target, so that attacks from the same views on another network are
    cheaper. An object that the network does not recognise has none.
    """
    for name in names:
        shipped = shipped_objects()[name]
        for number in range(per_object):
            asked = {"object": name, "label": shipped.label, "seed": seed + number, "epsilon": epsilon}
            done = run_job(JobSpec.model_validate({**ATTACK, **asked}), target, folder, change=change)
            if done.painted is not None:
                held_out = done.result.held_out
                fooled = held_out.a_drop if held_out and held_out.a_drop is not None else 0.0
                yield Variant(shipped, f"{name}-{seed + number}", epsilon, load_object(done.painted), fooled)


def photographs(
    variant: Variant, target: TargetRenderer, *, count: int, size: tuple[int, int], seed: int
) -> tuple[list[View], Image8]:
    """``count`` random views of a variant and their images (views, H, W, 3), before white and black."""
    views = ViewDistribution(
        variant.object.distance, variant.object.elevation, backgrounds=((255, 255, 255), (0, 0, 0))
    ).sample(count, generator=np.random.default_rng([seed, VIEW_STREAM]))
    return views, target.render(variant.obj, views, size=size)


def export_variants(
    out: Path,
    *,
    names: Sequence[str] = (),
    per_object: int = 2,
    epsilon: float = 0.05,
    views: int = 40,
    seed: int = 0,
    size: tuple[int, int] = (224, 224),
    on_variant: Callable[[str], None] = lambda _: None,
) -> list[Variant]:
    """Write variants of shipped objects (all by default) into ``out``; gives the adversarial ones.

    ``objects/NAME-SEED.zip`` are SAILenv archives; ``train/LABEL/`` and ``test/LABEL/`` hold pictures of them and of
    the objects as they are, from different random cameras and lights; ``labels.csv`` says which is which.
    ``on_variant`` is told a line for each. Raises ``SpecError`` for an object that is not shipped.
    """
    unknown = sorted(set(names) - set(shipped_objects()))
    if unknown:
        raise SpecError(f"No shipped object is called {', '.join(unknown)}; there are {', '.join(shipped_objects())}.")
    (out / "objects").mkdir(parents=True, exist_ok=True)
    made: list[Variant] = []
    with (
        running_renderer() as target,
        tempfile.TemporaryDirectory(prefix="trompe-") as scratch,
        (out / "labels.csv").open("w", newline="", encoding="utf-8") as file,
    ):
        labels = csv.writer(file, lineterminator="\n")
        labels.writerow(COLUMNS)
        for name in names or shipped_objects():
            plain = clean(name)
            attacked = make_variants([name], target, Path(scratch), per_object=per_object, epsilon=epsilon, seed=seed)
            for variant in (plain, *attacked):
                labels.writerows(_write_pictures(variant, target, out, views=views, size=size, seed=seed))
                if variant is not plain:
                    (out / "objects" / f"{variant.name}.zip").write_bytes(variant.obj.to_zip())
                    on_variant(f"{variant.name}: fools on {variant.fooled:.0%} of the views that it was not made for")
                    made.append(variant)
    return made


def _write_pictures(
    variant: Variant, target: TargetRenderer, out: Path, *, views: int, size: tuple[int, int], seed: int
) -> Iterator[tuple[object, ...]]:
    """Write a variant's pictures; gives their lines of ``labels.csv``. The first views are the test's."""
    taken, images = photographs(variant, target, count=views, size=size, seed=seed)
    name, label = variant.object.name, variant.object.label
    for number, (view, image) in enumerate(zip(taken, images, strict=True)):
        split = "test" if number < TEST_SHARE * views else "train"
        file = Path(split, label, f"{name}-{variant.name.removeprefix(name + '-')}-{number:03d}.png")
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(out / file)
        camera, light = view.camera, view.light
        place = (camera.distance, camera.azimuth, camera.elevation, light.azimuth, light.elevation)
        yield file.as_posix(), split, label, name, variant.name, variant.epsilon, *(f"{value:.4f}" for value in place)
