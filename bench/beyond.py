"""Beyond texture: what a light, and a surface that moves a little, do to a classifier in the target.

TROMPE_ASSETS=... python -m bench.beyond --csv docs/bench/beyond.csv

The light is searched by asking the target (what the service does) and, to compare, by gradients through a Lambert model
with the target's own albedo; whatever is found is judged in the target, on the attack's views and on held-out ones.
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bench._common import BenchObject, assets, bench_objects, machine, running_renderer
from trompe_server.attack import Goal, ViewDistribution
from trompe_server.attack.beyond import (
    LightPlace,
    LightRanges,
    Relief,
    VertexBudget,
    VertexState,
    chances,
    find_light,
    light_map,
    move_vertices,
    probe_light,
    shape_of,
)
from trompe_server.classifiers import NetworkClassifier, load_classifier
from trompe_server.markdown import markdown_row, markdown_table
from trompe_server.surrogate.calibration import calibrate
from trompe_server.surrogate.shading import ENCODERS, Encoding, decode_as
from trompe_server.target import SailenvTarget
from trompe_shared.asset_objects import asset_objects
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, encode_png

Image8 = NDArray[np.uint8]
COLUMNS = (
    *("object", "attack", "own before", "own after", "own views not asked: after", "held-out before", "held-out after"),
    *("extra renders", "seconds", "found"),
)
STARTS = 8
"""Lights from which gradients are followed."""


@dataclass(frozen=True)
class Stage:
    """One object with its views before the target and the classifier, and the target's images at rest."""

    entry: BenchObject
    target: SailenvTarget
    network: NetworkClassifier
    goal: Goal
    own: list[View]
    held_out: list[View]

    def ask(self, obj: Object3D, views: Sequence[View]) -> Image8:
        """Images (views, H, W, 3)."""
        return self.target.render(obj, views, size=self.network.image_size)

    def right(self, obj: Object3D, views: Sequence[View]) -> NDArray[np.bool_]:
        """The views (views,) on which the object is recognised."""
        return np.asarray(self.network.predict(self.ask(obj, views)).argmax(1) == self.goal.label)

    def row(
        self,
        attack: str,
        obj: Object3D,
        lit: Callable[[Sequence[View]], list[View]],
        *,
        asked: Sequence[int] = (),
        renders: int,
        seconds: float,
        found: str,
    ) -> list[str]:
        """Judge what was found."""
        own, after = self.right(self.entry.obj, self.own), self.right(obj, lit(self.own))
        held = [self.right(self.entry.obj, self.held_out).mean(), self.right(obj, lit(self.held_out)).mean()]
        fresh = np.delete(after, list(asked))
        shares = [own.mean(), after.mean(), fresh.mean(), *held]
        cells = [f"{share:.2f}" for share in shares]
        return [self.entry.name, attack, *cells, str(renders), f"{seconds:.0f}", found]


def by_asking(stage: Stage, ranges: LightRanges, *, n_views: int, folder: Path | None) -> list[str]:
    """The service's search."""
    started, obj = time.perf_counter(), stage.entry.obj
    found = find_light(
        partial(stage.ask, obj), stage.own, stage.network, goal=stage.goal, ranges=ranges, n_views=n_views
    )
    seconds = time.perf_counter() - started
    if folder is not None:
        (folder / f"light_{stage.entry.name}.png").write_bytes(encode_png(light_map(found)))
    return stage.row(
        f"light's {', '.join(ranges.given)}: asked on {len(found.asked)} views",
        obj,
        found.place.light_up,
        asked=found.asked,
        renders=found.renders,
        seconds=seconds,
        found=described(found.place),
    )


@dataclass(frozen=True)
class Matt:
    """A view as Lambert's law has it.

    pixel: row * W + column of the object's. albedo: the target's own, linear (pixels, 3). normals: unit (pixels, 3).
    """

    view: View
    background: torch.Tensor
    pixel: torch.Tensor
    albedo: torch.Tensor
    normals: torch.Tensor
    encoding: Encoding

    @classmethod
    def of(cls, relief: Relief, number: int) -> "Matt":
        """A view of ``relief`` at rest."""
        shape, seen = relief.shape, relief.at(relief.shape.positions, number)
        weights = relief.weights(seen, number, shape.positions).clamp(0, 1) * seen.share[:, None]
        corners = (weights[..., None] * shape.normals[shape.normal[seen.face]]).sum(1)
        normals = torch.zeros(len(seen.pixel), 3, dtype=corners.dtype).index_add_(0, seen.entry, corners)
        encoding = relief.sampling.encoding
        shown = torch.from_numpy(relief.probes.ambient[number]).view(-1, 3)[seen.pixel] / 255
        background = torch.from_numpy(relief.backgrounds[number]) / 255
        unit = torch.nn.functional.normalize(normals, dim=1).float()
        return cls(relief.views[number], background, seen.pixel, decode_as(shown, encoding), unit, encoding)

    def image(self, towards: torch.Tensor) -> torch.Tensor:
        """(3, H, W) with the main light shining from the unit vector ``towards``. Differentiable."""
        light = self.view.light
        shade = light.ambient + light.intensity * (self.normals @ towards).clamp(min=0)
        colours = ENCODERS[self.encoding]((self.albedo * shade[:, None]).clamp(0, 1))
        flat = self.background.view(-1, 3).index_copy(0, self.pixel, colours)
        return flat.view(self.background.shape).permute(2, 0, 1)


def by_gradients(stage: Stage, relief: Relief, ranges: LightRanges, *, steps: int) -> list[str]:
    """Adam on azimuth and elevation through Lambert's law, from several lights; the best prediction wins."""
    started, some = time.perf_counter(), [Matt.of(relief, number) for number in range(0, len(stage.own), 5)]
    best, place = -np.inf, LightPlace(0, 75)
    for start in range(STARTS):
        shares = torch.tensor([start / STARTS, 0.25 + 0.5 * (start % 2)], requires_grad=True)
        optimiser = torch.optim.Adam([shares], lr=0.05)
        for _ in range(steps):
            optimiser.zero_grad()
            images = torch.stack([matt.image(direction(shares, ranges)) for matt in some])
            chance = chances(stage.goal, stage.network.logits(images)).mean()
            if float(chance.detach()) > best:
                best, place = float(chance.detach()), ranges.place(shares.detach().double().numpy())
            (-chance).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
    return stage.row(
        "light's azimuth, elevation: by gradients",
        stage.entry.obj,
        place.light_up,
        renders=len(some),
        seconds=time.perf_counter() - started,
        found=f"{described(place)}, predicted chance {best:.2f}",
    )


def direction(shares: torch.Tensor, ranges: LightRanges) -> torch.Tensor:
    """The unit vector towards the light at ``shares`` (2,) of the ranges of azimuth and elevation."""
    (low, high), elevations = ranges.azimuth, torch.tensor(ranges.elevation)
    azimuth = torch.deg2rad(low + shares[0] * (high - low))
    bottom, top = torch.deg2rad(elevations).sin()
    height = bottom + shares[1].clamp(0, 1) * (top - bottom)
    flat = (1 - height.square()).sqrt()
    return torch.stack([flat * azimuth.sin(), height, flat * azimuth.cos()])


def described(place: LightPlace) -> str:
    """Where the light stands, and how strong it is where that was searched."""
    return ", ".join(f"{name} {value:.3g}" for name, value in vars(place).items() if value is not None)


def by_vertices(stage: Stage, relief: Relief, budget: VertexBudget, *, steps: int) -> list[str]:
    """The surface, within ``budget``."""
    obj, shape, started = stage.entry.obj, relief.shape, time.perf_counter()
    state = move_vertices(VertexState.of(shape), relief, stage.network, goal=stage.goal, budget=budget, steps=steps)
    seconds = time.perf_counter() - started
    moved = budget.heights(obj, shape, state.shares).abs()
    return stage.row(
        f"vertices, {budget.epsilon:.0%} of the radius, smoothed {budget.smoothing}x",
        budget.reshape(obj, shape, state),
        list,
        renders=2 * len(stage.own),
        seconds=seconds,
        found=f"moved {1000 * float(moved.mean()):.2f} mm on average, {1000 * float(moved.max()):.2f} at most",
    )


def attacks(stage: Stage, options: argparse.Namespace) -> Iterator[list[str]]:
    """Rows of the table, one for each attack."""
    obj, ranges = stage.entry.obj, LightRanges()
    for n_views in options.asked:
        yield by_asking(stage, ranges, n_views=n_views, folder=options.maps)
    yield by_asking(stage, replace(ranges, intensity=(0.3, 3.0), ambient=(0.0, 0.6)), n_views=12, folder=None)
    clean = stage.ask(obj, stage.own)
    behind = np.broadcast_to(np.array(stage.entry.background, np.uint8), clean.shape).copy()
    probes = probe_light(partial(stage.ask, obj), stage.own)
    few = slice(None, None, 15)
    trial = calibrate(
        obj, stage.own[few], clean[few], stage.ask, wanted="calibrated", generator=np.random.default_rng(0)
    )
    relief = Relief(obj, shape_of(obj), tuple(stage.own), clean, probes, behind, trial.sampling)
    yield by_gradients(stage, relief, ranges, steps=options.steps)
    for epsilon in options.epsilons:
        for smoothing in options.smoothings:
            yield by_vertices(stage, relief, VertexBudget(epsilon, smoothing=smoothing), steps=options.steps)


def staged(entry: BenchObject, target: SailenvTarget, network: NetworkClassifier, label: int) -> Stage:
    """The paper's 60 views of an object, and 60 held-out ones."""
    unseen = ViewDistribution(entry.distance, entry.elevation, backgrounds=(entry.background,))
    held_out = unseen.sample(60, generator=np.random.default_rng([0, 1]))
    return Stage(entry, target, network, Goal(label), entry.views(), held_out)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=["toilet_paper", "remote_controller"], metavar="NAME")
    parser.add_argument("--asked", type=int, nargs="*", default=[12], help="views that the search for a light asks")
    parser.add_argument("--epsilons", type=float, nargs="*", default=[0.01, 0.02], help="shares of the radius")
    parser.add_argument("--smoothings", type=int, nargs="*", default=[1])
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--maps", type=Path, metavar="FOLDER", help="where pictures of the loss over lights go")
    parser.add_argument("--csv", type=Path, metavar="FILE")
    options, folder = parser.parse_args(), assets()
    if folder is None:
        sys.exit("TROMPE_ASSETS must name the folder with the paper's objects and the classifiers.")
    network = load_classifier(folder / "classifiers" / "mobilenet_v2.pt2", name="mobilenet_v2", classes=None)
    paper = asset_objects(folder)
    rows = []
    print(f"{machine()}\n\n{markdown_table(COLUMNS, [])}", flush=True)
    with running_renderer() as target:
        for entry in bench_objects(options.objects):
            stage = staged(entry, target, network, paper[entry.name].label)  # type: ignore[arg-type]
            for row in attacks(stage, options):
                rows.append(row)
                print(markdown_row(row), flush=True)
    if options.csv is not None:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


if __name__ == "__main__":
    main()
