"""Does training on adversarial objects make a classifier more robust? The shipped one, tuned in two ways.

python -m bench.augmentation [--csv docs/experiments/augmentation/results.csv] [--epsilon 0.05] [--steps 250]

*Variants*: every shipped object is attacked once through the network as it is, and the network is tuned on pictures of
the variants and of the objects as they are, as one would with `trompe experiment export-variants`. *On the fly*: the
paint is never finished. Each object has several, and every step of the training, on the surrogate's images, is a step
of the attack on each of them too.

Judged in the target on views that no training picture was taken from: clean objects; variants that were made against
the shipped network (kept apart from training); and variants that are made anew against the network itself, which is
what counts.
"""

import argparse
import csv
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.optim.lr_scheduler import OneCycleLR

from bench._common import machine
from trompe_experiments.in_process import Change, run_job
from trompe_experiments.markdown import markdown_table
from trompe_experiments.variants import ATTACK, Variant, clean, photographs
from trompe_server.classifiers import NetworkClassifier, WhiteBoxClassifier
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE, TinyNet, load_tiny
from trompe_server.renderers import TargetRenderer, local_renderer
from trompe_server.surrogate import Surrogate, textures_of
from trompe_server.surrogate.calibration import build_surrogate, calibrate
from trompe_shared.api import JobSpec
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects

TRAIN_VIEWS, TEST_VIEWS, SURROGATE_VIEWS = 96, 40, 80
TRAIN_SEED, SURROGATE_SEED, TEST_SEED, JUDGES = 100, 150, 200, 900
"""Seeds of pictures, of the surrogate's views, and of the variants that only judge."""
BATCH = 64
LEARNING_RATE = 2e-3
PAINTS = 4
"""Paints of each object that are followed side by side."""
LIFE = 15
"""Steps that a paint lasts on average before another is begun at random."""
PLAIN = 40
"""Pictures of clean objects in each step on the fly."""
COLUMNS = ("network", "object", "clean", "variants of the shipped network", "attacked anew")

Paint = dict[str, Tensor]


@dataclass(frozen=True)
class Pictures:
    """Images (N, 3, H, W) in [0, 1] and their classes (N,)."""

    images: Tensor
    labels: Tensor


@dataclass(frozen=True)
class Sitter:
    """An object in training: its surrogate, its textures, its class, and the paints that follow the network."""

    surrogate: Surrogate
    textures: Mapping[str, Tensor]
    label: int
    epsilon: float
    paints: list[Paint] = field(default_factory=list)

    def begin(self, number: int) -> None:
        """Another paint at random in the place of paint ``number``."""
        self.paints[number] = {
            name: self._within(name, torch.empty_like(texture).uniform_(-self.epsilon, self.epsilon))
            for name, texture in self.textures.items()
        }

    def shown(self, paint: Paint, batch: int) -> Tensor:
        """Images of a batch of views with a paint; differentiable in it."""
        painted = {name: texture + paint[name] for name, texture in self.textures.items()}
        return self.surrogate.render(self.surrogate.texels(painted), batch)

    def follow(self, number: int, gradients: Sequence[Tensor]) -> None:
        """A step of paint ``number`` up the loss."""
        paint = self.paints[number]
        for (name, change), gradient in zip(paint.items(), gradients, strict=True):
            paint[name] = self._within(name, change.detach() + self.epsilon / 4 * gradient.sign())

    def _within(self, name: str, change: Tensor) -> Tensor:
        """The change kept in the budget and in range."""
        texture = self.textures[name]
        return (texture + change.clamp(-self.epsilon, self.epsilon)).clamp(0, 1) - texture


def as_change(network: TinyNet) -> Change:
    """The network in the place of the shipped classifier."""

    def changed(_: WhiteBoxClassifier) -> WhiteBoxClassifier:
        return NetworkClassifier("tiny, tuned", copied(network), IMAGE_SIZE, len(CLASSES), CLASSES)

    return changed


def copied(network: TinyNet) -> TinyNet:
    """A copy whose normalisation stays as it is."""
    copy = TinyNet()
    copy.load_state_dict(network.state_dict())
    return copy.eval()


def pictures(variants: Sequence[Variant], target: TargetRenderer, *, count: int, seed: int) -> Pictures:
    """Random views of the variants."""
    images, labels = [], []
    for variant in variants:
        _, shown = photographs(variant, target, count=count, size=IMAGE_SIZE, seed=seed)
        images.append(torch.from_numpy(shown).permute(0, 3, 1, 2).float() / 255)
        labels.append(torch.full((count,), CLASSES.index(variant.object.label)))
    return Pictures(torch.cat(images), torch.cat(labels))


def varied(images: Tensor) -> Tensor:
    """Mirrored and brightened at random; differentiable."""
    images = torch.where(torch.rand(len(images), 1, 1, 1) < 0.5, images, images.flip(3))
    return (images * torch.empty(len(images), 1, 1, 1).uniform_(0.8, 1.15)).clamp(0, 1)


class Tuning:
    """A network that is being tuned, for so many steps."""

    def __init__(self, network: TinyNet, *, steps: int) -> None:
        self.network = copied(network)
        self._parameters = list(self.network.parameters())
        self._optimizer = torch.optim.AdamW(self._parameters, lr=LEARNING_RATE, weight_decay=0.01)
        self._schedule = OneCycleLR(self._optimizer, max_lr=LEARNING_RATE, total_steps=steps, pct_start=0.2)

    def step(self, images: Tensor, labels: Tensor, leaves: Sequence[Tensor] = ()) -> tuple[Tensor, ...]:
        """One step; gives the gradient of the loss before it by the ``leaves`` that the images depend on."""
        loss = F.cross_entropy(self.network(varied(images)), labels, label_smoothing=0.05)
        gradients = torch.autograd.grad(loss, [*self._parameters, *leaves])
        for parameter, gradient in zip(self._parameters, gradients, strict=False):
            parameter.grad = gradient
        self._optimizer.step()
        self._schedule.step()
        return gradients[len(self._parameters) :]


def tuned_on(network: TinyNet, found: Pictures, *, steps: int) -> TinyNet:
    """``network``, tuned on pictures."""
    tuning = Tuning(network, steps=steps)
    for _ in range(steps):
        chosen = torch.randint(len(found.labels), (BATCH,))
        tuning.step(found.images[chosen], found.labels[chosen])
    return tuning.network


def tuned_on_the_fly(network: TinyNet, sitters: Sequence[Sitter], plain: Pictures, *, steps: int) -> TinyNet:
    """``network``, tuned on paints that follow it, and on pictures of clean objects."""
    tuning, generator = Tuning(network, steps=steps), np.random.default_rng(0)
    for _ in range(steps):
        chosen = torch.randint(len(plain.labels), (PLAIN,))
        images, labels, leaves = [plain.images[chosen]], [plain.labels[chosen]], []
        numbers = [int(number) for number in generator.integers(PAINTS, size=len(sitters))]
        for sitter, number in zip(sitters, numbers, strict=True):
            if generator.random() < 1 / LIFE:
                sitter.begin(number)
            paint = {name: change.requires_grad_() for name, change in sitter.paints[number].items()}
            images.append(sitter.shown(paint, int(generator.integers(len(sitter.surrogate.batches)))))
            labels.append(torch.full((len(images[-1]),), sitter.label))
            leaves.append(list(paint.values()))
        gradients = iter(tuning.step(torch.cat(images), torch.cat(labels), [leaf for some in leaves for leaf in some]))
        for sitter, number, some in zip(sitters, numbers, leaves, strict=True):
            sitter.follow(number, [next(gradients) for _ in some])
    return tuning.network


@torch.no_grad()
def shares_right(network: TinyNet, found: Pictures) -> dict[str, float]:
    """Share of each class's pictures that is classified right; not a number where there is none."""
    right = network(found.images).argmax(1) == found.labels
    return {name: float(right[found.labels == k].float().mean()) for k, name in enumerate(CLASSES)}


@dataclass(frozen=True)
class Bench:
    """Where variants are made and pictures are taken."""

    target: TargetRenderer
    epsilon: float

    def attacked(self, network: TinyNet, *, seed: int) -> list[Variant]:
        """A variant of each object that the network recognises, made against it."""
        variants = []
        for name, shipped in shipped_objects().items():
            spec = JobSpec.of(name, label=shipped.label, seed=seed, epsilon=self.epsilon, **ATTACK)
            with tempfile.TemporaryDirectory(prefix="trompe-") as folder:
                done = run_job(spec, self.target, Path(folder), change=as_change(network))
            if done.painted is not None:
                variants.append(Variant(shipped, f"{name}-{seed}", self.epsilon, load_object(done.painted)))
        return variants

    def sitter(self, name: str) -> Sitter:
        """A shipped object with a surrogate measured on the target."""
        variant = clean(name)
        views, shown = photographs(variant, self.target, count=SURROGATE_VIEWS, size=IMAGE_SIZE, seed=SURROGATE_SEED)
        found = calibrate(
            variant.obj,
            views,
            shown,
            lambda obj, some: self.target.render(obj, some, size=IMAGE_SIZE),
            wanted="calibrated",
            generator=np.random.default_rng(SURROGATE_SEED),
        )
        surrogate = build_surrogate(found, variant.obj, views, shown)
        label = CLASSES.index(variant.object.label)
        sitter = Sitter(surrogate, textures_of(variant.obj), label, self.epsilon, [{} for _ in range(PAINTS)])
        for number in range(PAINTS):
            sitter.begin(number)
        return sitter

    def networks(self, shipped: TinyNet, *, steps: int) -> dict[str, TinyNet]:
        """The shipped network, and what it becomes, by what it was tuned on."""
        plain = [clean(name) for name in shipped_objects()]
        taken = pictures(plain, self.target, count=TRAIN_VIEWS, seed=TRAIN_SEED)
        variants = [*plain, *self.attacked(shipped, seed=0)]
        found = pictures(variants, self.target, count=TRAIN_VIEWS, seed=TRAIN_SEED)
        sitters = [self.sitter(name) for name in shipped_objects()]
        return {
            "as shipped": shipped,
            "tuned on variants": tuned_on(shipped, found, steps=steps),
            "tuned on the fly": tuned_on_the_fly(shipped, sitters, taken, steps=steps),
        }

    def judged(self, network: TinyNet, variants: Sequence[Variant]) -> dict[str, float]:
        """Share of each class's fresh views that the network gets right."""
        return shares_right(network, pictures(variants, self.target, count=TEST_VIEWS, seed=TEST_SEED))


def main() -> None:
    """Tune, judge, print, write."""
    options, started = _options(), time.perf_counter()
    torch.manual_seed(0)
    print(machine() + "\n")
    rows: list[list[str]] = []
    with local_renderer() as target:
        bench, shipped = Bench(target, options.epsilon), load_tiny()
        plain, old = [clean(name) for name in shipped_objects()], bench.attacked(shipped, seed=JUDGES)
        for name, network in bench.networks(shipped, steps=options.steps).items():
            anew = old if network is shipped else bench.attacked(network, seed=JUDGES)
            rows += _rows(name, [bench.judged(network, variants) for variants in (plain, old, anew)])
    print(markdown_table(COLUMNS, [row for row in rows if row[1] == "mean"]))
    print(f"\nepsilon {options.epsilon:g}, {options.steps} steps, {time.perf_counter() - started:.0f} s")
    if options.csv:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


def _rows(network: str, shares: Sequence[Mapping[str, float]]) -> list[list[str]]:
    """A row for each object, and their mean."""
    found = [[network, name, *(f"{share[name]:.3f}" for share in shares)] for name in CLASSES]
    return [*found, [network, "mean", *(f"{np.nanmean(list(share.values())):.3f}" for share in shares)]]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--epsilon", type=float, default=0.05)
    parser.add_argument("--csv", type=Path, metavar="FILE")
    return parser.parse_args()


if __name__ == "__main__":
    main()
