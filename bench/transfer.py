"""Does a repaint made through some networks fool one that was never asked? Each network attacked alone, and ensembles.

TROMPE_ASSETS=... python -m bench.transfer --objects toilet_paper remote_controller --csv docs/bench/transfer.csv
"""

import argparse
import itertools
import tempfile
from pathlib import Path

from bench._common import running_renderer
from bench._jobs import Paper
from trompe_server.reports import transfer_matrix
from trompe_server.target import SailenvTarget
from trompe_shared.api import Result

WHITE = ("mobilenet_v2", "mobilenet_edgetpu_075", "squeezenet1_1")
BLACK = ("mobilenet_v1", "mobilenet_v3_large_min")
"""Those that give gradients, and those that only judge."""


def main() -> None:
    """Attack through one, two and all of the networks with gradients; everything judges."""
    options = _options()
    results = []
    with tempfile.TemporaryDirectory() as folder, running_renderer() as target:
        paper = Paper(Path(folder), [*(f"{name}.pt2" for name in WHITE), *(f"{name}.onnx" for name in BLACK)])
        for name in paper.named(options.objects):
            for count in (1, 2, 3):
                for attacked in itertools.combinations(WHITE, count):
                    results.append(_run(paper, name, attacked, target, options))
                    print(name, " + ".join(attacked), _said(results[-1]), flush=True)
    for views in ("target", "held_out"):
        print(f"\nA_drop, {views} views\n\n{transfer_matrix(results, views=views).markdown()}")
    if options.csv:
        options.csv.write_text(transfer_matrix(results, views="held_out").csv())


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=["toilet_paper", "remote_controller"], help="names, or all")
    parser.add_argument("--epsilon", type=float, default=0.05)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--pool", type=int, default=120)
    parser.add_argument("--held-out", type=int, default=60)
    parser.add_argument("--csv", type=Path, help="the matrix of held-out views")
    return parser.parse_args()


def _run(
    paper: Paper, name: str, attacked: tuple[str, ...], target: SailenvTarget, options: argparse.Namespace
) -> Result:
    """An attack through ``attacked``, judged by all the others."""
    spec = paper.spec(
        name,
        classifier=attacked[0],
        ensemble=list(attacked[1:]),
        judges=[judge for judge in (*WHITE, *BLACK) if judge != attacked[0]],
        epsilon=options.epsilon,
        steps=options.steps,
        pool=options.pool,
        held_out=options.held_out,
    )
    return paper.run(spec, target)


def _said(result: Result) -> str:
    views = {result.classifier: result.held_out} | {judge.classifier: judge.held_out for judge in result.judges}
    drops = {name: accuracy.a_drop if accuracy else None for name, accuracy in views.items()}
    return ", ".join(f"{name} {'n.a.' if drop is None else f'{drop:.2f}'}" for name, drop in drops.items())


if __name__ == "__main__":
    main()
