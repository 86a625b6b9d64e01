"""Whole attacks on the paper's objects: surrogate and target before and after, by epsilon, colour model, tau and seed.

TROMPE_ASSETS=... python -m bench.attacks [--csv FILE]
                  python -m bench.attacks --plain --objects all --epsilon 0.05 0.02
                  python -m bench.attacks --plain --objects all --pool 480 --held-out 200 --mixed
"""

import argparse
import csv
import itertools
import tempfile
import time
from pathlib import Path

from bench._common import running_renderer
from bench._jobs import Paper
from trompe_server.experiments.groups import figure_words
from trompe_server.markdown import markdown_row, markdown_table
from trompe_shared.api import Accuracy, Result

OBJECTS = ("toilet_paper", "lamp_floor", "remote_controller", "plunger")
SETTINGS: tuple[tuple[str, float | None], ...] = (
    ("auto", None),
    ("curve", None),
    ("diffuse", None),
    ("auto", 0.05),
    ("auto", 0.2),
)
COLUMNS = (
    *("object", "surrogate", "tau", "epsilon", "steps", "seed", "probes"),
    *("surrogate before", "surrogate after", "target before", "target after", "A_drop"),
    *("held-out before", "held-out after", "held-out A_drop", "N%", "SSIM", "CIEDE2000"),
    *("evaluations", "prepare s", "calibrate s", "attack s", "judge s", "seconds"),
)


def main() -> None:
    """Run every object under every setting and print a row for each."""
    options = _options()
    rows = []
    print(markdown_table(COLUMNS, []))
    with tempfile.TemporaryDirectory() as folder, running_renderer() as target:
        paper = Paper(Path(folder), [f"{options.classifier}.pt2"])
        settings = SETTINGS[:1] if options.plain else SETTINGS
        for name, epsilon, (surrogate, tau), seed in itertools.product(
            paper.named(options.objects), options.epsilon, settings, options.seeds
        ):
            spec = paper.spec(
                name,
                mixed=options.mixed,
                classifier=options.classifier,
                epsilon=epsilon,
                surrogate=surrogate,
                tau=tau,
                seed=seed,
                steps=options.steps,
                pool=options.pool,
                held_out=options.held_out,
            )
            started = time.perf_counter()
            result = paper.run(spec, target)
            rows.append(_row(name, result, time.perf_counter() - started))
            print(markdown_row(rows[-1]), flush=True)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", nargs="+", default=OBJECTS, help="names, or all")
    parser.add_argument("--plain", action="store_true", help="only the automatic surrogate without saliency")
    parser.add_argument("--classifier", default="mobilenet_v2")
    parser.add_argument("--epsilon", type=float, nargs="+", default=[0.05])
    parser.add_argument("--steps", type=int, default=90)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--pool", type=int, default=0, help="attack so many random views, not the paper's grid")
    parser.add_argument("--held-out", type=int, default=60)
    parser.add_argument("--mixed", action="store_true", help="black, white and the photographs as backgrounds")
    parser.add_argument("--csv", type=Path)
    return parser.parse_args()


def _row(name: str, result: Result, seconds: float) -> list[str]:
    own, held_out = result.target, result.held_out
    pairs = [figure_words(value) for views in (result.surrogate, own, held_out) for value in _pair(views)]
    head = [name, result.surrogate_model, str(result.tau or "-"), f"{result.epsilon:g}", str(result.steps)]
    phases = [f"{result.seconds.get(phase, 0.0):.1f}" for phase in ("prepare", "calibrate", "attack", "judge")]
    return [
        *head,
        *(str(result.seed), str(result.probe_renders)),
        *(*pairs[:4], figure_words(own.a_drop)),
        *(*pairs[4:], figure_words(held_out.a_drop if held_out else None)),
        *(figure_words(value, 3) for value in (result.texels_altered, result.ssim, result.delta_e)),
        *(str(result.evaluations or 0), *phases, f"{seconds:.1f}"),
    ]


def _pair(accuracy: Accuracy | None) -> tuple[float | None, float | None]:
    return (None, None) if accuracy is None else (accuracy.a_before, accuracy.a_after)


if __name__ == "__main__":
    main()
