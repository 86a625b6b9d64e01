"""How few texels fool a classifier? The smallest share of texels altered with which the target's A_drop is 0.9 or more.

TROMPE_ASSETS=... python -m bench.few_texels --csv docs/bench/few_texels.csv --chart docs/bench/few_texels.svg
                  python -m bench.few_texels --classifier squeezenet1_1 --csv docs/bench/few_texels.csv

Two ways to choose texels, each a curve of A_drop against the share altered, on the paper's views: those that ``keep``
finds by trying (ranked by the gradient of the target's images, to which two short attacks on the best few add that of
the views they do not win), and the paper's masks of pixels (``tau``). A curve begins where most texels may change, ends
once A_drop is below 0.3, and is then refined between its last point that drops enough and the next. What the CSV file
has already is not run again.
"""

import argparse
import hashlib
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict

from bench._common import running_renderer
from bench._jobs import Paper, Rows
from trompe_server.experiments.groups import average, figure_words
from trompe_server.markdown import markdown_table
from trompe_server.target import SailenvTarget
from trompe_shared.errors import SpecError

Way = Literal["keep", "tau"]

ENOUGH: Final = 0.9
"""The A_drop that is asked for."""

HOPELESS: Final = 0.3
"""A curve is not followed further once its A_drop is below this."""

COLUMNS: Final = 5
"""Panels of the chart side by side."""


class Row(BaseModel):
    """One job: by ``way`` (the job's option) and its ``setting``. ``n`` is the share of texels altered.

    Where a setting leaves no texel to change, nothing is altered and nothing drops. ``a_drop`` is n.a. (``None``) where
    the object was not recognised before.
    """

    model_config = ConfigDict(frozen=True)

    object: str
    classifier: str
    epsilon: float
    steps: int
    seed: int
    way: Way
    setting: float
    n: float
    a_before: float | None = None
    a_after: float | None = None
    a_drop: float | None = None
    evaluations: int = 0
    seconds: float = 0.0

    @property
    def enough(self) -> bool:
        """Whether it drops what is asked for."""
        return self.a_drop is not None and self.a_drop >= ENOUGH


@dataclass(frozen=True)
class Curve:
    """How settings of a way are ordered: ``sign`` times the setting grows with the texels that may change."""

    way: Way
    sign: int
    label: str

    def follow(self, grid: Sequence[float], measure: Callable[[float], Row], *, refine: int) -> list[Row]:
        """The points of the grid from the mildest setting on, and up to ``refine`` more where A_drop falls too low."""
        rows: list[Row] = []
        for setting in sorted(grid, key=lambda setting: -self.sign * setting):
            rows.append(measure(setting))
            if rows[-1].a_drop is None:
                return rows
            if rows[-1].a_drop < HOPELESS:
                break
        for _ in range(refine):
            wanted = self.next(rows)
            if wanted is None:
                break
            rows.append(measure(wanted))
        return rows

    def next(self, rows: Sequence[Row]) -> float | None:
        """The setting to try next: between the strictest that is enough and the next one, or beyond the ends."""
        strictest_last = sorted(rows, key=lambda row: -self.sign * row.setting)
        good = [place for place, row in enumerate(strictest_last) if row.enough]
        if not good:
            return self._times(strictest_last[0].setting, 2**self.sign)
        if good[-1] + 1 == len(rows):
            return self._times(strictest_last[-1].setting, 2**-self.sign)
        low, high = (strictest_last[good[-1] + step].setting for step in (0, 1))
        return _rounded(math.sqrt(low * high)) if abs(math.log(low / high)) > 0.1 else None

    def _times(self, setting: float, factor: float) -> float | None:
        """Within what the options allow."""
        most = 1.0 if self.way == "keep" else 0.95
        wanted = min(_rounded(setting * factor), most)
        return None if wanted == setting else wanted


CURVES: Final = (
    Curve("keep", 1, "best texels, found by trying (keep)"),
    Curve("tau", -1, "the paper's masks (tau)"),
)


def main() -> None:
    """Follow both curves of each object and seed, then say how few texels were enough."""
    options = _options()
    table = Rows(Row, options.csv)
    asked: list[Row] = []
    with tempfile.TemporaryDirectory() as folder, running_renderer() as target:
        paper = Paper(Path(folder), [f"{options.classifier}.pt2"])
        for name in paper.named(options.objects):
            for seed in options.seeds:
                for curve in CURVES:

                    def measure(setting: float, name: str = name, seed: int = seed, way: Way = curve.way) -> Row:
                        key = _key(options, name, seed, way, setting)
                        return table.get(key, lambda: _run(paper, target, key))

                    asked += curve.follow(getattr(options, curve.way), measure, refine=options.refine)
    print(f"\nSmallest N% with A_drop >= {ENOUGH:g}, {options.classifier}, epsilon {options.epsilon:g}\n")
    print(summary(asked))
    if options.chart:
        draw(asked, options.chart)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=["all"], help="names, or all")
    parser.add_argument("--classifier", default="mobilenet_v2", help="a .pt2 file of TROMPE_ASSETS")
    parser.add_argument("--epsilon", type=float, default=0.1)
    parser.add_argument("--steps", type=int, default=90)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--keep", type=float, nargs="+", default=[0.01, 0.02, 0.05, 0.1, 0.2], help="shares of texels")
    parser.add_argument("--tau", type=float, nargs="+", default=[0.05, 0.1, 0.2, 0.3], help="saliency thresholds, > 0")
    parser.add_argument("--refine", type=int, default=2, help="further points of each curve")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="read if it is there, and written row by row")
    parser.add_argument("--chart", type=Path, metavar="FILE", help="written as .svg and .png")
    options = parser.parse_args()
    if min(options.keep + options.tau) <= 0:
        parser.error("--keep and --tau must be greater than 0; all texels are --keep 1")
    return options


def _key(options: argparse.Namespace, name: str, seed: int, way: Way, setting: float) -> dict[str, Any]:
    """What a row is found again by."""
    fixed = {"object": name, "classifier": options.classifier, "epsilon": options.epsilon, "steps": options.steps}
    return {**fixed, "seed": seed, "way": way, "setting": setting}


def _run(paper: Paper, target: SailenvTarget, key: dict[str, Any]) -> Row:
    started = time.perf_counter()
    asked = {name: key[name] for name in ("classifier", "epsilon", "steps", "seed")}
    spec = paper.spec(key["object"], **asked, **{key["way"]: key["setting"]}, pool=0, held_out=0)
    try:
        result = paper.run(spec, target, known=True)
    except SpecError as error:
        print(f"{key['object']}, {key['way']} {key['setting']:g}: {error}", file=sys.stderr)
        return Row(**key, n=0.0, a_drop=0.0)
    own = result.target
    row = Row(
        **key,
        n=result.texels_altered or 0.0,
        **{name: getattr(own, name) for name in ("a_before", "a_after", "a_drop")},
        evaluations=result.evaluations or 0,
        seconds=round(time.perf_counter() - started, 1),
    )
    print(
        f"{row.object}, {row.way} {row.setting:g}, seed {row.seed}: N {row.n:.2%}, A_drop {figure_words(row.a_drop)}",
        flush=True,
    )
    return row


def summary(rows: Sequence[Row]) -> str:
    """A table: for each object and way the smallest share that is enough, mean over seeds, and the ratio of the two."""
    lines = []
    for name in dict.fromkeys(row.object for row in rows):
        mine = [row for row in rows if row.object == name]
        fewest = {curve.way: _fewest([row for row in mine if row.way == curve.way]) for curve in CURVES}
        ours, theirs = fewest["keep"], fewest["tau"]
        before = [row.a_before for row in mine if row.a_before is not None]
        lines.append(
            [
                name,
                figure_words(average(before)),
                *(f"{share:.2%}" if share is not None else _best(mine, way) for way, share in fewest.items()),
                f"{theirs / ours:.1f}" if ours and theirs else "-",
            ]
        )
    return markdown_table(["object", "A_before", *(curve.label for curve in CURVES), "ratio"], lines)


def _fewest(rows: Sequence[Row]) -> float | None:
    """The smallest share that is enough, mean over seeds; ``None`` unless each seed has one."""
    by_seed = [[row.n for row in rows if row.seed == seed and row.enough] for seed in {row.seed for row in rows}]
    return fmean(min(shares) for shares in by_seed) if by_seed and all(by_seed) else None


def _best(rows: Sequence[Row], way: Way) -> str:
    """What is said where no setting was enough."""
    drops = [row.a_drop for row in rows if row.way == way and row.a_drop is not None]
    return f"not reached (at most {max(drops):.2f})" if drops else "n.a."


def _rounded(setting: float) -> float:
    return float(f"{setting:.3g}")


def draw(rows: Sequence[Row], file: Path) -> None:
    """A chart: a panel for each object, A_drop against the share of texels altered, a line for each way and seed."""
    try:
        from trompe_server.experiments.style import BLUE, GREY, ORANGE, drawing
    except ImportError:
        sys.exit("A chart needs matplotlib: pip install matplotlib, or leave --chart out.")
    names = list(dict.fromkeys(row.object for row in rows))
    across = min(COLUMNS, len(names))
    down = -(-len(names) // across)
    drops = [row.a_drop or 0.0 for row in rows]
    looks: list[Any] = [{"color": BLUE, "marker": "o"}, {"color": ORANGE, "marker": "s", "ls": "--"}]
    size = (1.1 + 2.1 * max(across, 2), 1.2 + 1.9 * down)
    with drawing(size=size, panels=(down, across), sharex=True, sharey=True) as made:
        for axes, name in zip(made.panels, names, strict=False):
            axes.axhline(ENOUGH, color=GREY, lw=1, ls=":")
            _draw_object(axes, [row for row in rows if row.object == name], looks)
            axes.set(title=name.replace("_", " "), xscale="log", ylim=(min(0.0, *drops), 1.02))
            axes.xaxis.set_major_formatter("{x:g}")
        for axes in made.panels[len(names) :]:
            axes.set_visible(False)
        for axes in made.panels[-across:]:
            axes.tick_params(labelbottom=True)
        made.figure.supxlabel(f"texels altered, N (% of all, log scale); {rows[0].classifier}, ε {rows[0].epsilon:g}")
        made.figure.supylabel("A_drop in the target (share)")
        lines = {str(line.get_label()): line for axes in made.panels for line in axes.lines[1:]}
        made.figure.legend(handles=list(lines.values()), loc="outside upper left", ncols=2)
    data = "".join(row.model_dump_json(exclude={"seconds"}) for row in rows)
    made.save(file.parent, file.stem, stamp=f"data {hashlib.sha256(data.encode()).hexdigest()[:16]}")


def _draw_object(axes: Any, rows: Sequence[Row], looks: Sequence[Any]) -> None:
    """The lines of one object, each way as its look says; or that it was not recognised."""
    for curve, look in zip(CURVES, looks, strict=True):
        for shares, dropped in _lines(rows, curve.way):
            axes.plot(shares, dropped, ms=4, lw=1.2, clip_on=False, label=curve.label, **look)
    if all(row.a_drop is None for row in rows):
        axes.text(0.5, 0.5, "n.a.: not recognised", transform=axes.transAxes, ha="center", fontsize=8)


def _lines(rows: Sequence[Row], way: Way) -> list[tuple[list[float], list[float]]]:
    """For each seed, shares altered (%) in rising order and what drops."""
    known = [row for row in rows if row.way == way and row.n and row.a_drop is not None]
    mine = sorted(known, key=lambda row: row.n)
    by_seed = [[row for row in mine if row.seed == seed] for seed in dict.fromkeys(row.seed for row in mine)]
    return [([100 * row.n for row in some], [row.a_drop or 0.0 for row in some]) for some in by_seed]


if __name__ == "__main__":
    main()
