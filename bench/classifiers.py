"""Networks as Trompe runs them, two batches at once, beside the same ones as they were exported: milliseconds an image.

python -m bench.classifiers [FILE.pt2 ...] [--images 5] [--rounds 5]

Without files: the shipped network, and those of TROMPE_ASSETS.
"""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import torch
from torch import Tensor, nn

from bench._common import assets, in_rounds, machine
from trompe_experiments.markdown import markdown_table
from trompe_server.classifiers import load_classifier
from trompe_server.classifiers.archive import read_program
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.tiny import load_tiny
from trompe_server.system.memory import keep_freed_memory
from trompe_server.system.threads import prepare_threads, side_by_side

BATCHES: Final = 8
"""Batches of one call: those of a step."""


def scores(network: nn.Module, images: Tensor) -> None:
    """What judging asks."""
    with torch.no_grad():
        network(images)


def gradient(network: nn.Module, images: Tensor) -> None:
    """What a step of an attack asks."""
    leaf = images.clone().requires_grad_()
    torch.autograd.grad(network(leaf).sum(), leaf)


def one_by_one(ask: Callable[[Tensor], None], batches: Sequence[Tensor]) -> None:
    for batch in batches:
        ask(batch)


def as_exported(reference: str) -> nn.Module:
    """The network unchanged."""
    network = load_tiny() if reference == "tiny" else read_program(Path(reference)).module(check_guards=False)
    return network.requires_grad_(False)


def row(reference: str, *, count: int, rounds: int) -> list[str]:
    """Cells of one network: its name, then the medians of both and their ratio, for scores and for gradients."""
    ours = load_classifier(reference)
    assert isinstance(ours, NetworkClassifier)
    exported, cells = as_exported(reference), [ours.name]
    batches = [torch.rand(count, 3, *ours.image_size) for _ in range(BATCHES)]
    for ask in (scores, gradient):
        in_turn = partial(one_by_one, partial(ask, exported), batches)
        at_once = partial(side_by_side, partial(ask, ours.network), batches)
        times = in_rounds({"exported": in_turn, "ours": at_once}, rounds)
        before, after = (1000 * times[name].median / count / BATCHES for name in ("exported", "ours"))
        cells += [f"{before:.1f}", f"{after:.1f}", f"{after / before:.2f}"]
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", metavar="FILE.pt2")
    parser.add_argument("--images", type=int, default=5, help="images of one batch, as a step's have")
    parser.add_argument("--rounds", type=int, default=5)
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
