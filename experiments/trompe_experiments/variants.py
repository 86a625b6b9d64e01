"""Adversarial variants of shipped objects, as archives and as labelled pictures, to train on or to test with."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_experiments.design import Experiment
from trompe_experiments.plan import plan_experiment
from trompe_experiments.run import Show, run_experiment
from trompe_experiments.service import Service
from trompe_experiments.table import ResultRow
from trompe_server.attack import ViewDistribution
from trompe_server.renderers import TargetRenderer
from trompe_shared.api import ADVERSARIAL
from trompe_shared.errors import SpecError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import ShippedObject, shipped_objects

CLEAN: Final = "clean"
TEST_SHARE: Final = 0.2
VIEW_STREAM: Final = 11
"""Random stream of the pictures, separate from those of the attacks."""
ATTACK: Final[dict[str, Any]] = {"steps": 25, "pool": 80, "held_out": 30, "background": ["white", "black"]}
"""Options of the attacks."""
ARCHIVE: Final = f"{ADVERSARIAL}.zip"
"""End of the name of an attack's archive."""
LABELS: Final = "labels.csv"
COLUMNS: Final = (
    *("file", "split", "label", "object", "variant", "epsilon"),
    *("distance", "azimuth", "elevation", "light_azimuth", "light_elevation"),
)

Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Variant:
    """A repainted object, or an unpainted one (name ``clean``, ``epsilon`` 0)."""

    object: ShippedObject
    name: str
    epsilon: float
    obj: Object3D


def clean(name: str) -> Variant:
    """An unpainted shipped object."""
    shipped = shipped_objects()[name]
    return Variant(shipped, CLEAN, 0.0, load_object(shipped.read()))


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
    service: Service,
    target: TargetRenderer,
    *,
    names: Sequence[str] = (),
    per_object: int = 2,
    epsilon: float = 0.05,
    views: int = 40,
    seed: int = 0,
    size: tuple[int, int] = (224, 224),
    show: Show,
) -> tuple[ResultRow, ...]:
    """Attack shipped objects (default: all) and write variants into ``out``; returns the rows of the attacks.

    ``objects/NAME-SEED.zip`` are SAILenv archives; ``train/LABEL/`` and ``test/LABEL/`` hold pictures of the variants
    and of the unpainted objects, rendered by ``target`` from different random cameras and lights; ``labels.csv`` lists
    the pictures; those that it listed before, and their archives, are deleted. An object that the network does not
    recognise has no variants. Raises ``SpecError``.
    """
    unknown = sorted(set(names) - set(shipped_objects()))
    if unknown:
        raise SpecError(f"No shipped object {', '.join(unknown)}; objects: {', '.join(shipped_objects())}.")
    chosen = list(dict.fromkeys(names or shipped_objects()))
    experiment = Experiment(
        name="variants",
        base=ATTACK | {"epsilon": epsilon},
        objects={name: {} for name in chosen},
        seeds=list(range(seed, seed + per_object)),
        artifacts=[f"*{ARCHIVE}"],
    )
    rows = run_experiment(plan_experiment(experiment), service, out, show=show)
    (out / "objects").mkdir(exist_ok=True)
    _delete_listed(out)
    with (out / LABELS).open("w", newline="", encoding="utf-8") as file:
        labels = csv.writer(file, lineterminator="\n")
        labels.writerow(COLUMNS)
        for name in chosen:
            for variant in (clean(name), *_variants(name, out, rows)):
                labels.writerows(_write_pictures(variant, target, out, views=views, size=size, seed=seed))
    return rows


def _delete_listed(out: Path) -> None:
    """Delete the pictures and archives of an earlier export into ``out``, whose splits and budget may differ."""
    if not (out / LABELS).exists():
        return
    with (out / LABELS).open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            for name in (row.get("file", ""), f"objects/{row.get('variant')}.zip"):
                listed = (out / name).resolve()
                if listed.is_file() and listed.is_relative_to(out.resolve()):
                    listed.unlink()


def _variants(name: str, out: Path, rows: Sequence[ResultRow]) -> Iterator[Variant]:
    """The repainted variants of an object; writes their archives."""
    for row in rows:
        archive = out / "jobs" / row.key / f"{name}{ARCHIVE}"
        if row.object == name and archive.exists():
            data = archive.read_bytes()
            (out / "objects" / f"{name}-{row.seed}.zip").write_bytes(data)
            yield Variant(shipped_objects()[name], f"{name}-{row.seed}", row.epsilon, load_object(data))


def _write_pictures(
    variant: Variant, target: TargetRenderer, out: Path, *, views: int, size: tuple[int, int], seed: int
) -> Iterator[tuple[object, ...]]:
    """Write a variant's pictures; yields their lines of ``labels.csv``. The first views are for the test."""
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
