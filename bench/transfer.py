"""Does a repaint made through some networks fool one that was never asked? Each network attacked alone, and ensembles.

TROMPE_ASSETS=... python -m bench.transfer --objects toilet_paper remote_controller --csv docs/bench/transfer.csv

Prints the matrix of all, and for each victim how much an ensemble without it drops beside each single network without
it. What the CSV file has already is not run again.
"""

import argparse
import itertools
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Final

from pydantic import BaseModel, ConfigDict

from bench._common import running_renderer
from bench._jobs import Paper, Rows
from trompe_server.experiments.groups import figure_words
from trompe_server.markdown import markdown_table
from trompe_server.reports import TransferMatrix
from trompe_server.target import SailenvTarget
from trompe_shared.api import FEW_RECOGNISED, Accuracy, Result

WHITE: Final = ("mobilenet_v2", "mobilenet_edgetpu_075", "squeezenet1_1")
BLACK: Final = ("mobilenet_v1", "mobilenet_v3_large_min")
"""Those that give gradients, and those that only judge."""

TOGETHER: Final = " + "
SETTINGS: Final = ("epsilon", "steps", "pool", "held_out", "diverse")


class Row(BaseModel):
    """What ``judge`` says of one job, in the target, on the attack's own views and on held-out ones."""

    model_config = ConfigDict(frozen=True)

    object: str
    attacked: str
    epsilon: float
    steps: int
    pool: int
    held_out: int
    diverse: bool
    seed: int
    judge: str
    a_before: float
    a_after: float | None
    a_drop: float | None
    held_out_a_before: float | None
    held_out_a_after: float | None
    held_out_a_drop: float | None
    seconds: float

    def drop(self, views: str) -> float | None:
        """``a_drop`` on the ``target``'s own or the ``held_out`` views, where the judge knew the object on enough."""
        before, drop = self.a_before, self.a_drop
        if views == "held_out":
            before, drop = self.held_out_a_before or 0.0, self.held_out_a_drop
        return drop if before >= FEW_RECOGNISED else None


def main() -> None:
    """Attack through one, two and all of the networks with gradients; everything judges."""
    options = _options()
    table = Rows(Row, options.csv)
    with tempfile.TemporaryDirectory() as folder, running_renderer() as target:
        paper = Paper(Path(folder), [*(f"{name}.pt2" for name in WHITE), *(f"{name}.onnx" for name in BLACK)])
        rows = [
            row
            for name, seed in itertools.product(paper.named(options.objects), options.seeds)
            for attacked in attacks()
            for row in _judged(paper, target, table, _key(options, name, seed, attacked))
        ]
    for views in ("target", "held_out"):
        print(f"\nA_drop, {views} views\n\n{matrix(rows, views).markdown()}")
        print(f"The victim left out, {views} views\n\n{left_out(rows, views)}")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=["toilet_paper", "remote_controller"], help="names, or all")
    parser.add_argument("--epsilon", type=float, default=0.05)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--pool", type=int, default=120)
    parser.add_argument("--held-out", type=int, default=60)
    parser.add_argument(
        "--diverse",
        action=argparse.BooleanOptionalAction,
        help="show images at random places, win by all one can (as everywhere the default for ensembles alone)",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--csv", type=Path, metavar="FILE", help="read if it is there, and written job by job")
    return parser.parse_args()


def attacks() -> Iterator[str]:
    """What is attacked: each network, each pair, all."""
    for count in (1, 2, 3):
        yield from map(TOGETHER.join, itertools.combinations(WHITE, count))


def _key(options: argparse.Namespace, name: str, seed: int, attacked: str) -> dict[str, Any]:
    """What the rows of a job are found again by."""
    key = {"object": name, "attacked": attacked, "seed": seed} | {one: getattr(options, one) for one in SETTINGS}
    return key | ({"diverse": TOGETHER in attacked} if options.diverse is None else {})


def _judged(paper: Paper, target: SailenvTarget, table: Rows[Row], key: dict[str, Any]) -> list[Row]:
    """The rows of a job, from the table or by running it. One that was cut off while they were written runs again."""
    found = table.find(key)
    if len(found) == len(WHITE + BLACK):
        return found
    started = time.perf_counter()
    result = _run(paper, target, key)
    fresh = [
        Row(**key, judge=judge, seconds=round(time.perf_counter() - started, 1), **_figures(*views))
        for judge, views in _views(result).items()
    ]
    known = {row.judge for row in found}
    rows = [table.add(row) for row in fresh if row.judge not in known] + found
    said = ", ".join(f"{row.judge} {figure_words(row.held_out_a_drop)}" for row in rows)
    print(f"{key['object']}, seed {key['seed']}, {key['attacked']}: {said}", flush=True)
    return rows


def _run(paper: Paper, target: SailenvTarget, key: dict[str, Any]) -> Result:
    """An attack, judged by all the others."""
    first, *others = key["attacked"].split(TOGETHER)
    spec = paper.spec(
        key["object"],
        classifier=first,
        ensemble=others,
        judges=[judge for judge in (*WHITE, *BLACK) if judge != first],
        seed=key["seed"],
        **{name: key[name] for name in SETTINGS},
    )
    return paper.run(spec, target, known=True)


def _views(result: Result) -> dict[str, tuple[Accuracy, Accuracy | None]]:
    """By judge, its accuracies on the attack's own and the held-out views."""
    others = {judge.classifier: (judge.target, judge.held_out) for judge in result.judges}
    return {result.classifier: (result.target, result.held_out), **others}


def _figures(own: Accuracy, held_out: Accuracy | None) -> dict[str, Any]:
    names = ("a_before", "a_after", "a_drop")
    figures = {name: getattr(own, name) for name in names}
    return figures | {f"held_out_{name}": getattr(held_out, name, None) for name in names}


def matrix(rows: Sequence[Row], views: str) -> TransferMatrix:
    """Mean drops over objects and seeds: a row for what is attacked, a column for who judges."""
    drops = [[_drops(rows, views, attacked, judge) for judge in (*WHITE, *BLACK)] for attacked in attacks()]
    return TransferMatrix(
        tuple(attacks()),
        (*WHITE, *BLACK),
        tuple(tuple(fmean(cell) if cell else None for cell in line) for line in drops),
        tuple(tuple(len(cell) for cell in line) for line in drops),
    )


def left_out(rows: Sequence[Row], views: str) -> str:
    """A table: for each victim the mean drop by a single network that is not it, by the best of those, and by the
    ensemble of all those."""
    figures = {victim: found for victim in (*WHITE, *BLACK) if (found := _without(rows, views, victim))}
    if figures:
        figures["mean"] = [fmean(column) for column in zip(*figures.values(), strict=True)]
    head = ["victim", "singles without it, mean", "best single", "ensemble without it", "ensemble / singles"]
    lines = [[victim, *map(figure_words, found), _ratio(found[2], found[0])] for victim, found in figures.items()]
    return markdown_table(head, lines)


def _without(rows: Sequence[Row], views: str, victim: str) -> list[float]:
    """What singles drop on average, the best single, and the ensemble; empty where one of them is n.a."""
    others = [name for name in WHITE if name != victim]
    singles = [fmean(drops) for name in others if (drops := _drops(rows, views, name, victim))]
    together = _drops(rows, views, TOGETHER.join(others), victim)
    return [fmean(singles), max(singles), fmean(together)] if singles and together else []


def _drops(rows: Sequence[Row], views: str, attacked: str, judge: str) -> list[float]:
    found = (row.drop(views) for row in rows if row.attacked == attacked and row.judge == judge)
    return [drop for drop in found if drop is not None]


def _ratio(value: float, by: float) -> str:
    return f"{value / by:.1f}" if by > 0 else "-"


if __name__ == "__main__":
    main()
