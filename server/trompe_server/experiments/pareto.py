"""Speed against accuracy: what each configuration costs and achieves, and which of them nothing beats in both."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Final, Literal

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter

from trompe_server.experiments.front import front_of
from trompe_server.experiments.groups import average, deviation, grouped, known
from trompe_server.experiments.style import INK, MARKERS, PALETTE, Drawing, drawing
from trompe_shared.experiment_table import ResultRow

__all__ = ["Configuration", "configurations", "pareto_front", "pareto_markdown", "speed_accuracy_chart"]

Cost = Literal["seconds", "evaluations"]
UNITS: Final[dict[Cost, str]] = {"seconds": "wall time of a job, s", "evaluations": "images shown to the classifier"}


@dataclass(frozen=True)
class Configuration:
    """The mean of some jobs that differ by object and seed alone.

    cost: what is to be small. gain: mean held-out ``A_drop``, what is to be large; spread: its standard deviation over
    seeds (of the mean over objects). target, gap: mean ``A_drop`` of the attack's own views in the target, and what the
    surrogate promised beyond it.
    """

    series: str
    name: str
    cost: float
    gain: float
    spread: float
    target: float | None
    gap: float | None
    jobs: int


def configurations(rows: Sequence[ResultRow], *, cost: Cost = "seconds") -> list[Configuration]:
    """The configurations of an experiment, in its order; those without a figure to show are left out.

    Only objects on which every configuration has a held-out ``A_drop`` count, so that all are means over the same ones.
    """
    groups = grouped(rows, lambda row: (row.series, row.configuration or "base"))
    known_objects = [{row.object for row in group if row.held_out_a_drop is not None} for group in groups.values()]
    common = set.intersection(*known_objects) if known_objects else set()
    found = []
    for (series, name), group in groups.items():
        same = [row for row in group if row.object in common and row.held_out_a_drop is not None]
        costs = known(same, cost)
        if not costs:
            continue
        per_seed = [fmean(known(part, "held_out_a_drop")) for part in grouped(same, lambda row: row.seed).values()]
        found.append(
            Configuration(
                series,
                name,
                fmean(costs),
                fmean(known(same, "held_out_a_drop")),
                deviation(per_seed),
                average(row.target_a_drop for row in same),
                average(row.transfer_gap for row in same),
                len(same),
            )
        )
    return found


def pareto_front(points: Sequence[Configuration]) -> list[Configuration]:
    """The configurations that no other one beats in cost and gain; see ``front_of``."""
    return front_of(points, cost=lambda point: point.cost, gain=lambda point: point.gain)


def speed_accuracy_chart(rows: Sequence[ResultRow], *, cost: Cost = "seconds") -> Drawing:
    """A point for each configuration, the front as a line, its points named."""
    points = configurations(rows, cost=cost)
    front = pareto_front(points)
    series = list(dict.fromkeys(point.series for point in points))
    look = {name: (PALETTE[k % len(PALETTE)], MARKERS[k % len(MARKERS)]) for k, name in enumerate(series)}
    with drawing(size=(10.5, 5.2)) as made:
        (axes,) = made.panels
        for point in points:
            colour, marker = look[point.series]
            axes.errorbar(
                point.cost, point.gain, yerr=point.spread, color=colour, marker=marker, ms=7, lw=1, mec="white", mew=0.7
            )
        axes.step([p.cost for p in front], [p.gain for p in front], where="post", color=INK, lw=1, ls="--", zorder=1)
        axes.set_xscale("log")
        for ticks in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            ticks(LogFormatter(labelOnlyBase=False, minor_thresholds=(2, 0.5)))
        axes.set_xlabel(f"{UNITS[cost]} (mean, log scale)")
        axes.set_ylabel("A_drop on held-out views (mean; bars: deviation over seeds)")
        axes.set_title("Speed against accuracy: up and to the left is better")
        _name_front(made, axes, front)
        handles = [
            Line2D([], [], color=look[name][0], marker=look[name][1], ls="", label=name or "configurations")
            for name in series
        ]
        handles.append(Line2D([], [], color=INK, ls="--", lw=1, label="Pareto front"))
        axes.legend(handles=handles, loc="lower right", title="varied", alignment="left")
    return made


def _name_front(made: Drawing, axes: Axes, front: Sequence[Configuration]) -> None:
    """A number at each point of the front; what the numbers stand for is listed at the right."""
    for number, point in enumerate(front, 1):
        axes.annotate(
            str(number), (point.cost, point.gain), xytext=(-5, 5), textcoords="offset points", ha="right", weight="bold"
        )
    listed = [f"{number}  {p.name}: {p.cost:.3g}, {p.gain:.2f}" for number, p in enumerate(front, 1)]
    blank = [Line2D([], [], ls="", label=words) for words in listed]
    title = "Pareto front (cost, A_drop)"
    made.figure.legend(
        handles=blank, title=title, alignment="left", loc="outside right upper", handlelength=0, handletextpad=0
    )


def pareto_markdown(rows: Sequence[ResultRow], *, cost: Cost = "seconds") -> str:
    """A table of all configurations, those on the front in bold."""
    points = configurations(rows, cost=cost)
    front = pareto_front(points)
    unit = "s" if cost == "seconds" else "images"
    lines = [f"| varied | configuration | {unit} | held-out A_drop | target A_drop | transfer gap | jobs |"]
    lines.append("|---|---|---:|---:|---:|---:|---:|")
    for point in sorted(points, key=lambda p: p.cost):
        name = f"**{point.name}**" if point in front else point.name
        cells = [f"{point.cost:.3g}", f"{point.gain:.2f} ± {point.spread:.2f}", _cell(point.target), _cell(point.gap)]
        lines.append(f"| {point.series} | {name} | {' | '.join(cells)} | {point.jobs} |")
    return "\n".join(lines) + "\n"


def _cell(value: float | None) -> str:
    return "n.a." if value is None else f"{value:.2f}"
