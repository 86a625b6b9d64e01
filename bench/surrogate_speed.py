"""What does the surrogate cost, beside the classifier and PyTorch3D on the same work? Rounds in turn, medians.

python -m bench.surrogate_speed [--objects candle toilet] [--rounds 7] [--pytorch3d]

Only time counts here, so random pictures stand in for the target's, and no renderer is needed. The classifier is
MobileNetV2 from TROMPE_ASSETS/classifiers, or the shipped one; PyTorch3D is compared with where it can be imported.
"""

import argparse
import importlib.util
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench._common import (
    GREYS,
    BenchObject,
    Times,
    assets,
    bench_objects,
    forward_backward,
    in_rounds,
    machine,
    measured_at_random,
    rescaled,
)
from trompe_experiments.markdown import markdown_table
from trompe_server.attack import Budget, Goal, attack, movable, start
from trompe_server.classifiers import WhiteBoxClassifier, load_classifier
from trompe_server.job.texture_attack import CHUNK
from trompe_server.surrogate import SamplingModel, Surrogate, prepare_geometry, textures_of
from trompe_server.surrogate.calibration import build_surrogate
from trompe_server.surrogate.sampling import Gather
from trompe_server.surrogate.surrogate import BATCH
from trompe_server.system.memory import keep_freed_memory
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

SMALL = 0.33
"""The paper's factor on the textures' sides."""

FULL = "full texture"

WANTED_RATIO = {"candle": 150, "toilet": 400}
WANTED_SHARE, WANTED_SECONDS = 0.08, 4.0


@dataclass(frozen=True)
class Work:
    """One object with one size of texture, ready to render: all its views in a step."""

    name: str
    obj: Object3D
    views: Sequence[View]
    surrogate: Surrogate
    textures: Mapping[str, Float[Tensor, "H W 3"]]
    gradient: Float[Tensor, "batch 3 H W"]
    """Arrives at every batch of images in the backward pass; channels last, as classifiers give it."""

    def forward_backward(self) -> None:
        """One step's work of the surrogate: textures to images of all views, and back."""
        forward_backward(self.surrogate, self.textures, lambda images: self.gradient[: len(images)])


def work_of(entry: BenchObject, obj: Object3D, name: str, size: tuple[int, int], n_views: int, model: str) -> Work:
    """Prepare ``obj`` with pictures at random for probes."""
    views = entry.views()[:n_views]
    calibration, clean = measured_at_random(len(views), size, model)
    surrogate = build_surrogate(calibration, obj, views, clean)
    gradient = torch.randn(BATCH, 3, *size, generator=torch.Generator().manual_seed(0))
    gradient = gradient.contiguous(memory_format=torch.channels_last)
    return Work(name, obj, views, surrogate, textures_of(obj), gradient)


@dataclass
class Inside:
    """A classifier that notes how many seconds are spent in its forward and backward pass."""

    classifier: WhiteBoxClassifier
    seconds: float = field(default=0.0, init=False)

    def __getattr__(self, name: str) -> object:
        return getattr(self.classifier, name)

    def logits(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Its logits. The clock runs here, and in the backward pass from their gradient to the images' gradient."""
        before = time.perf_counter()
        logits = self.classifier.logits(images)
        self.seconds += time.perf_counter() - before
        logits.register_hook(lambda _: self._add(-time.perf_counter()))  # type: ignore[no-untyped-call]
        images.register_hook(lambda _: self._add(time.perf_counter()))  # type: ignore[no-untyped-call]
        return logits

    def _add(self, seconds: float) -> None:
        self.seconds += seconds


def outside_share(work: Work, classifier: WhiteBoxClassifier, shares: list[float]) -> Callable[[], None]:
    """A contender that takes as many attack steps as a job does in one go, and appends the share of them that was not
    the classifier's."""
    textures, budget, inside = work.textures, Budget(0.05, 0.01), Inside(classifier)
    texels, state = movable(work.surrogate, budget), start(textures)
    goal = Goal(0, loss="cross_entropy")  # no view ever rests

    def step() -> None:
        inside.seconds, started = 0.0, time.perf_counter()
        attack(state, textures, work.surrogate, inside, goal=goal, budget=budget, steps=CHUNK, texels=texels)  # type: ignore[arg-type]
        shares.append(1 - inside.seconds / (time.perf_counter() - started))

    return step


def classifier_alone(classifier: WhiteBoxClassifier, count: int = BATCH, device: str = "cpu") -> Callable[[], None]:
    """A contender: forward and gradient of one batch of images."""
    images = torch.rand(count, *classifier.image_size, 3, generator=torch.Generator().manual_seed(0))
    images = images.to(device).permute(0, 3, 1, 2).requires_grad_()

    def step() -> None:
        torch.autograd.grad(Goal(0).losses(classifier.logits(images)).sum(), images)

    return step


def fastest_classifier(device: str = "cpu") -> WhiteBoxClassifier:
    """MobileNetV2 where the real classifiers are, else the shipped one."""
    folder = assets()
    file = folder / "classifiers" / "mobilenet_v2.pt2" if folder is not None else "tiny"
    classifier = load_classifier(file, device=device)
    assert isinstance(classifier, WhiteBoxClassifier)
    return classifier


def speed(works: Sequence[Work], times: dict[str, Times]) -> str:
    """Table of forward + backward."""
    rows = []
    for work in works:
        own, peer = times[work.name], times.get(peer_name(work))
        row = [work.name, own.per(work.surrogate.n_views), "-", "-", "-"]
        if peer is not None:
            ratio = (peer.median / PEER_VIEWS) / (own.median / work.surrogate.n_views)
            wanted = WANTED_RATIO.get(work.name.partition(" ")[0])
            row[2:] = [peer.per(PEER_VIEWS), f"{ratio:.0f} x", f">= {wanted} x" if wanted else "-"]
        rows.append(row)
    header = ["forward + backward, ms per view (median / least)", "surrogate", "PyTorch3D", "ratio", "wanted"]
    return markdown_table(header, rows)


PEER_VIEWS = 3
"""PyTorch3D takes seconds a view, so it is given only some."""


def peer_name(work: Work) -> str:
    """What PyTorch3D on the same work is called among the contenders."""
    return f"PyTorch3D {work.name}"


def preparation(entries: Sequence[BenchObject], size: tuple[int, int], n_views: int, rounds: int) -> str:
    """Table of what preparing takes."""
    rows = []
    for entry in entries:
        prepare = partial(prepare_geometry, entry.obj, entry.views()[:n_views], size=size, sampling=SamplingModel())
        times, made = in_rounds({"prepare": prepare}, rounds)["prepare"], prepare()
        wanted = f"<= {WANTED_SECONDS:g}" if entry.name == "toilet" else "-"
        taps = sum(len(batch.gather.index) for batch in made.batches if isinstance(batch.gather, Gather))
        pixels = sum(len(batch.pixel) for batch in made.batches)
        rows.append(
            [
                entry.name,
                f"{times.median:.2f} / {times.best:.2f}",
                wanted,
                f"{made.nbytes / 2**20:.0f}",
                f"{taps / max(pixels, 1):.1f}",
            ]
        )
    header = [
        f"preparing {n_views} views",
        "seconds (median / least)",
        "wanted",
        "operators, MiB",
        "texels read per pixel",
    ]
    return markdown_table(header, rows)


def compare(entries: Sequence[BenchObject], size: tuple[int, int], n_views: int, rounds: int, peer: bool) -> None:
    """Everything in the same rounds: surrogate, classifier, attack step, and PyTorch3D if wanted."""
    works = [
        work_of(entry, obj, f"{entry.name} {name}, {model}", size, n_views, model)
        for entry in entries
        for name, obj in ((f"{SMALL} texture", rescaled(entry.obj, SMALL)), (FULL, entry.obj))
        for model in GREYS
    ]
    classifier = fastest_classifier()
    contenders: dict[str, Callable[[], object]] = {work.name: work.forward_backward for work in works}
    contenders["classifier"] = classifier_alone(classifier)
    shares: dict[str, list[float]] = {work.name: [] for work in works if FULL in work.name}
    for work in works:
        if work.name in shares:
            contenders[f"step {work.name}"] = outside_share(work, classifier, shares[work.name])
    contenders |= peers(works, size) if peer else {}
    times = in_rounds(contenders, rounds)
    print(speed(works, times) + "\n")
    print(f"{classifier.name}, forward + input gradient, ms per image: {times['classifier'].per(BATCH)}\n")
    rows = [
        [name, times[f"step {name}"].per(CHUNK * n_views), f"{np.median(share[1:]):.1%}", f"<= {WANTED_SHARE:.0%}"]
        for name, share in shares.items()
    ]
    header = ["attack step", "ms per view (median / least)", "share outside the classifier, median", "wanted"]
    print(markdown_table(header, rows))


def peers(works: Sequence[Work], size: tuple[int, int]) -> dict[str, Callable[[], object]]:
    """PyTorch3D on the small textures."""
    if importlib.util.find_spec("pytorch3d") is None:
        print("PyTorch3D is not installed, so it is not compared with.\n")
        return {}
    from bench._pytorch3d import PyTorch3DPeer

    found: dict[str, Callable[[], object]] = {}
    for work in works:
        if str(SMALL) in work.name and work.surrogate.model == "calibrated":
            chosen = [int(k) for k in np.linspace(0, len(work.views) - 1, PEER_VIEWS + 2)[1:-1]]
            peer = PyTorch3DPeer(work.obj, [work.views[k] for k in chosen], size)
            overlap = same_silhouette(work.surrogate, peer.forward_backward()[..., 3], chosen)
            print(f"{work.name}: the silhouettes of both overlap to {overlap:.1%}.\n")
            found[peer_name(work)] = peer.forward_backward
    return found


def same_silhouette(surrogate: Surrogate, alpha: Float[Tensor, "views H W"], views: Sequence[int] = ()) -> float:
    """Intersection over union of the object's pixels in some ``views`` (default: all), so that the work is known to be
    the same."""
    own = torch.zeros(surrogate.base.shape[:3], dtype=torch.bool, device=surrogate.device)
    for batch in surrogate.geometry.batches:
        own[batch.views.start : batch.views.stop].view(-1)[batch.pixel] = True
    own, theirs = own[list(views)] if views else own, alpha > 0
    return float((own & theirs).sum() / (own | theirs).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=[], metavar="NAME", help="default: candle toilet")
    parser.add_argument("--size", type=int, default=224 if assets() else 128, help="side of the images, pixels")
    parser.add_argument("--views", type=int, default=60, help="how many of the 60 views")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--pytorch3d", action="store_true", help="compare with PyTorch3D (slow), where installed")
    options = parser.parse_args()
    keep_freed_memory()  # as attack workers do
    size = (options.size, options.size)
    entries = bench_objects(options.objects or (["candle", "toilet"] if assets() else ["mug", "chair"]))
    print(f"{machine()}; {options.views} views at {options.size}x{options.size}, {options.rounds} rounds\n")
    print(preparation(entries, size, options.views, min(options.rounds, 3)) + "\n", flush=True)
    compare(entries, size, options.views, options.rounds, options.pytorch3d)


if __name__ == "__main__":
    main()
