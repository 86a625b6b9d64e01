"""Networks as Trompe runs them beside the same ones as they were exported: milliseconds an image.

python -m bench.classifiers [FILE.pt2 ...] [--images 5] [--rounds 20]

Without files: the shipped network, and those of TROMPE_ASSETS.
"""

import argparse
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from bench._common import assets, in_rounds, machine
from trompe_experiments.markdown import markdown_table
from trompe_server.classifiers import load_classifier
from trompe_server.classifiers.archive import read_program
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.tiny import load_tiny
from trompe_server.system.memory import keep_freed_memory
from trompe_server.system.threads import prepare_threads


def scores(network: nn.Module, images: Tensor) -> None:
    """What judging asks."""
    with torch.no_grad():
        network(images)


def gradient(network: nn.Module, images: Tensor) -> None:
    """What a step of an attack asks."""
    leaf = images.clone().requires_grad_()
    torch.autograd.grad(network(leaf).sum(), leaf)


def as_exported(reference: str) -> nn.Module:
    """The network unchanged."""
    network = load_tiny() if reference == "tiny" else read_program(Path(reference)).module(check_guards=False)
    return network.requires_grad_(False)


def row(reference: str, *, count: int, rounds: int) -> list[str]:
    """Cells of one network: its name, then the medians of both and their ratio, for scores and for gradients."""
    ours = load_classifier(reference)
    assert isinstance(ours, NetworkClassifier)
    contenders = {"exported": as_exported(reference), "ours": ours.network}
    images, cells = torch.rand(count, 3, *ours.image_size), [ours.name]
    for ask in (scores, gradient):
        times = in_rounds({name: partial(ask, network, images) for name, network in contenders.items()}, rounds)
        before, after = (1000 * times[name].median / count for name in contenders)
        cells += [f"{before:.1f}", f"{after:.1f}", f"{after / before:.2f}"]
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", metavar="FILE.pt2")
    parser.add_argument("--images", type=int, default=5, help="images of one call, as a step's batches have them")
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    keep_freed_memory()
    prepare_threads()
    folder = assets()
    found = sorted(map(str, (folder / "classifiers").glob("*.pt2"))) if folder else []
    rows = [row(each, count=options.images, rounds=options.rounds) for each in options.files or ["tiny", *found]]
    header = ["network", "scores: exported", "ours", "ratio", "gradient: exported", "ours", "ratio"]
    print(f"{machine()}\n\n{markdown_table(header, rows)}")


if __name__ == "__main__":
    main()
