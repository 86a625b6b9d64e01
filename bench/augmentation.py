"""Does training on adversarial objects make a classifier more robust? The shipped one, before and after.

python -m bench.augmentation [--csv docs/experiments/augmentation/results.csv] [--rounds 2] [--epsilon 0.05]

In each round every shipped object is attacked through the network as it stands, and the network is tuned further on
pictures of the objects as they are and of all variants so far. Judged on views that no training picture was taken from:
clean objects; variants that were made against the network before (kept apart from training); and variants that are made
anew against the network after, which is what counts.
"""

import argparse
import csv
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from bench._common import machine, markdown_table
from trompe_server.classifiers import NetworkClassifier, WhiteBoxClassifier
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE, TinyNet, load_tiny
from trompe_server.experiments.disturbed import renderer
from trompe_server.experiments.in_process import Change
from trompe_server.experiments.variants import Variant, clean, make_variants, photographs
from trompe_server.target import TargetRenderer
from trompe_shared.shipped import shipped_objects

TRAIN_VIEWS, TEST_VIEWS = 48, 40
TRAIN_SEED, TEST_SEED, JUDGES = 100, 200, 900
"""Seeds of pictures and of the variants that only judge."""
COLUMNS = (
    "object",
    "clean before",
    "clean after",
    "old variants before",
    "old variants after",
    "attacked anew before",
    "attacked anew after",
)


@dataclass(frozen=True)
class Pictures:
    """Images (N, 3, H, W) in [0, 1] and their classes (N,)."""

    images: Tensor
    labels: Tensor


def as_change(network: TinyNet) -> Change:
    """The network in the place of the shipped classifier."""

    def changed(_: WhiteBoxClassifier) -> WhiteBoxClassifier:
        frozen = TinyNet()
        frozen.load_state_dict(network.state_dict())
        return NetworkClassifier("tiny, tuned", frozen.eval(), IMAGE_SIZE, len(CLASSES), CLASSES)

    return changed


def pictures(variants: Sequence[Variant], target: TargetRenderer, *, count: int, seed: int) -> Pictures:
    """Random views of the variants."""
    images, labels = [], []
    for variant in variants:
        _, shown = photographs(variant, target, count=count, size=IMAGE_SIZE, seed=seed)
        images.append(torch.from_numpy(shown).permute(0, 3, 1, 2).float() / 255)
        labels.append(torch.full((count,), CLASSES.index(variant.object.label)))
    return Pictures(torch.cat(images), torch.cat(labels))


def tune(network: TinyNet, found: Pictures, *, epochs: int, seed: int) -> TinyNet:
    """A copy of ``network`` tuned on pictures, mirrored and brightened at random; its normalisation stays as it was."""
    tuned = TinyNet()
    tuned.load_state_dict(network.state_dict())
    tuned.eval()
    torch.manual_seed(seed)
    steps = epochs * -(-len(found.labels) // 64)
    optimizer = torch.optim.AdamW(tuned.parameters(), lr=1e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=1e-3, total_steps=steps, pct_start=0.2)
    for _ in range(epochs):
        for chosen in torch.split(torch.randperm(len(found.labels)), 64):
            images = found.images[chosen]
            images = torch.where(torch.rand(len(chosen), 1, 1, 1) < 0.5, images, images.flip(3))
            images = (images * torch.empty(len(chosen), 1, 1, 1).uniform_(0.8, 1.15)).clamp(0, 1)
            loss = F.cross_entropy(tuned(images), found.labels[chosen], label_smoothing=0.05)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
    return tuned


@torch.no_grad()
def shares_right(network: TinyNet, found: Pictures) -> dict[str, float]:
    """Share of each class's pictures that is classified right."""
    right = network(found.images).argmax(1) == found.labels
    return {name: float(right[found.labels == k].float().mean()) for k, name in enumerate(CLASSES)}


@dataclass(frozen=True)
class Bench:
    """Where variants are made and pictures are taken."""

    target: TargetRenderer
    folder: Path
    epsilon: float

    def attacked(self, network: TinyNet, *, seed: int) -> list[Variant]:
        """A variant of each object, made against ``network``."""
        options = {"per_object": 1, "epsilon": self.epsilon, "seed": seed}
        names, change = list(shipped_objects()), as_change(network)
        return list(make_variants(names, self.target, self.folder, change=change, **options))  # type: ignore[arg-type]

    def tuned(self, network: TinyNet, *, rounds: int, epochs: int) -> TinyNet:
        """``network``, tuned on pictures of clean objects and of variants made against what it had become so far."""
        training, now = [clean(name) for name in shipped_objects()], network
        for number in range(rounds):
            started = time.perf_counter()
            training += self.attacked(now, seed=number)
            found = pictures(training, self.target, count=TRAIN_VIEWS, seed=TRAIN_SEED + number)
            now = tune(network, found, epochs=epochs, seed=number)
            seconds = time.perf_counter() - started
            print(f"round {number + 1}: {len(found.labels)} pictures, {seconds:.0f} s", flush=True)
        return now

    def judged(self, variants: Sequence[Variant], *networks: TinyNet) -> list[dict[str, float]]:
        """Share of each class's fresh views that each network gets right."""
        shown = pictures(variants, self.target, count=TEST_VIEWS, seed=TEST_SEED)
        return [shares_right(network, shown) for network in networks]


def main() -> None:
    """Tune, judge, print, write."""
    options, started = _options(), time.perf_counter()
    torch.set_num_threads(2)
    print(machine() + "\n")
    with renderer() as target, tempfile.TemporaryDirectory(prefix="trompe-") as scratch:
        bench, before = Bench(target, Path(scratch), options.epsilon), load_tiny()
        after = bench.tuned(before, rounds=options.rounds, epochs=options.epochs)
        old = bench.judged(bench.attacked(before, seed=JUDGES), before, after)
        anew = bench.judged(bench.attacked(after, seed=JUDGES), after)
        shares = [*bench.judged([clean(name) for name in CLASSES], before, after), *old, old[0], *anew]
    rows = [[name, *(f"{share[name]:.3f}" for share in shares)] for name in CLASSES]
    rows.append(["mean", *(f"{np.nanmean(list(share.values())):.3f}" for share in shares)])
    print("\n" + markdown_table(COLUMNS, rows))
    print(f"\nepsilon {options.epsilon:g}, {options.rounds} rounds, {time.perf_counter() - started:.0f} s")
    if options.csv:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--epsilon", type=float, default=0.1)
    parser.add_argument("--csv", type=Path, metavar="FILE")
    return parser.parse_args()


if __name__ == "__main__":
    main()
