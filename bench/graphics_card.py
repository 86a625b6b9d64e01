"""What does the surrogate cost on a graphics card, beside nvdiffrast and PyTorch3D on the same work and card?

python -m bench.graphics_card [--objects candle lamp_floor] [--sides 224 512] [--rounds 7]

One pass: textures to images of 64 views, and back. Random pictures stand in for the target's. A peer that is not
installed is left out. Beside them: the classifier on as many images, and whole attack steps.
"""

import argparse
import importlib.util
import sys
from collections.abc import Callable
from functools import partial

import torch

from bench._common import BenchObject, bench_objects, forward_backward, in_rounds, machine, measured_at_random
from bench.surrogate_speed import classifier_alone, fastest_classifier, same_silhouette
from trompe_experiments.markdown import markdown_table
from trompe_server.attack import Budget, Goal, attack, movable, start
from trompe_server.classifiers import WhiteBoxClassifier
from trompe_server.surrogate import Surrogate, textures_of
from trompe_server.surrogate.calibration import build_surrogate

VIEWS = 64
STEPS = 5

Contender = Callable[[], object]


def surrogate_of(entry: BenchObject, size: tuple[int, int]) -> Surrogate:
    """The surrogate of the bench's views on the card."""
    views = entry.views(azimuths=8, elevations=8)
    calibration, clean = measured_at_random(len(views), size, "calibrated")
    return build_surrogate(calibration, entry.obj, views, clean, device="cuda")


def contenders_of(entry: BenchObject, size: tuple[int, int]) -> tuple[dict[str, Contender], list[str]]:
    """The surrogate and its peers, and how far their silhouettes agree."""
    surrogate, views = surrogate_of(entry, size), entry.views(azimuths=8, elevations=8)
    textures, gradient = textures_of(entry.obj, device="cuda"), torch.randn(VIEWS, 3, *size, device="cuda")
    found: dict[str, Contender] = {
        "surrogate": partial(forward_backward, surrogate, textures, lambda images: gradient[: len(images)])
    }
    agreement: list[str] = []
    if importlib.util.find_spec("nvdiffrast") is not None:
        from bench._nvdiffrast import NvdiffrastPeer

        for name, cached in (("nvdiffrast", False), ("nvdiffrast, rasterised once", True)):
            peer = NvdiffrastPeer(entry.obj, views, size, cached=cached)
            found[name] = peer.forward_backward
        agreement.append(f"nvdiffrast {same_silhouette(surrogate, peer.forward_backward()[..., 0]):.1%}")
    if importlib.util.find_spec("pytorch3d") is not None:
        from bench._pytorch3d import PyTorch3DPeer

        other = PyTorch3DPeer(entry.obj, views, size, device="cuda")
        found["PyTorch3D"] = other.forward_backward
        agreement.append(f"PyTorch3D {same_silhouette(surrogate, other.forward_backward()[..., 3]):.1%}")
    return found, agreement


def steps_of(entry: BenchObject, classifier: WhiteBoxClassifier) -> Contender:
    """``STEPS`` steps of an attack over all views."""
    surrogate, textures = surrogate_of(entry, classifier.image_size), textures_of(entry.obj, device="cuda")
    budget, goal = Budget(0.05, 0.01), Goal(0, loss="cross_entropy")  # no view ever rests
    texels, state = movable(surrogate, budget), start(textures)
    return lambda: attack(state, textures, surrogate, classifier, goal=goal, budget=budget, steps=STEPS, texels=texels)


def synchronised(contender: Contender) -> Contender:
    """The contender up to the end of its work on the card."""

    def run() -> None:
        contender()
        torch.cuda.synchronize()

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=["candle", "lamp_floor"], metavar="NAME", help="of one part")
    parser.add_argument("--sides", nargs="+", type=int, default=[224, 512], help="sides of the images, pixels")
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    if not torch.cuda.is_available():
        sys.exit("torch sees no CUDA device.")
    classifier = fastest_classifier("cuda")
    print(f"{torch.cuda.get_device_name()}; {machine()}; {VIEWS} views, {options.rounds} rounds\n", flush=True)
    rows = []
    for entry in bench_objects(options.objects):
        for side in options.sides:
            contenders, agreement = contenders_of(entry, (side, side))
            times = in_rounds({name: synchronised(each) for name, each in contenders.items()}, options.rounds)
            own = times["surrogate"].median
            rows += [
                [f"{entry.name}, {side}", name, each.per(VIEWS), f"{each.median / own:.1f}", ", ".join(agreement)]
                for name, each in times.items()
            ]
    header = ["object, side", "renderer", "ms per view (median / least)", "ratio", "silhouettes agree"]
    print(markdown_table(header, rows) + "\n", flush=True)
    network = {f"{classifier.name}, forward and gradient": classifier_alone(classifier, VIEWS, "cuda")}
    steps = {f"attack steps, {entry.name}": steps_of(entry, classifier) for entry in bench_objects(options.objects)}
    times = in_rounds({name: synchronised(each) for name, each in (network | steps).items()}, options.rounds)
    print(
        markdown_table(
            ["at the classifier's size", "ms per image (median / least)"],
            [[name, each.per(VIEWS * (STEPS if name in steps else 1))] for name, each in times.items()],
        )
    )


if __name__ == "__main__":
    main()
