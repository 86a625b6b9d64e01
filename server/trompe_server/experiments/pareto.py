"""Speed against accuracy: what each configuration costs and achieves, and which of them nothing beats in both."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean
from typing import Final, Literal

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter

from trompe_server.experiments.front import front_of
from trompe_server.experiments.groups import average, deviation, figure_words, grouped, known
from trompe_server.experiments.style import GREY, INK, MARKERS, PALETTE, Drawing, drawing
from trompe_server.markdown import markdown_table
from trompe_shared.experiment_table import ResultRow

__all__ = ["Configuration", "configurations", "pareto_front", "pareto_markdown", "speed_accuracy_chart"]

Cost = Literal["seconds", "evaluations"]
Place = tuple[str, str]
"""Series and configuration."""
UNITS: Final[dict[Cost, str]] = {"seconds": "wall time of a job, s", "evaluations": "images shown to the classifier"}
PRESET: Final = "preset"
"""The series of the presets."""
LINE, CHARACTER = 0.055, 0.0078
"""Height of a line of text, and width of a character, as shares of the axes."""


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
    Seconds are those of an object that the target has never been asked about.
    """
    groups = grouped(_as_if_new(rows), lambda row: (row.series, row.configuration or "base"))
    known_objects = [{row.object for row in group if row.held_out_a_drop is not None} for group in groups.values()]
    common = set.intersection(*known_objects) if known_objects else set()
    said, found = _said_once(list(groups)), []
    for place, group in groups.items():
        same = [row for row in group if row.object in common and row.held_out_a_drop is not None]
        costs = known(same, cost)
        if not costs:
            continue
        per_seed = [fmean(known(part, "held_out_a_drop")) for part in grouped(same, lambda row: row.seed).values()]
        found.append(
            Configuration(
                *said[place],
                fmean(costs),
                fmean(known(same, "held_out_a_drop")),
                deviation(per_seed),
                average(row.target_a_drop for row in same),
                average(row.transfer_gap for row in same),
                len(same),
            )
        )
    return found


def _as_if_new(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """``rows``, each with the time of calibrating: one that found what an earlier job had asked takes that job's.

    Such are those that asked fewer probes than another of the same object, views and colour model.
    """

    def asked(row: ResultRow) -> tuple[int, float]:
        return row.probe_renders or 0, row.calibrate_s or 0.0

    found = []
    for group in grouped(rows, lambda row: (row.object, row.surrogate_model, row.pool, row.seed)).values():
        probes, seconds = max(map(asked, group))
        for row in group:
            missing = max(0.0, seconds - asked(row)[1]) if asked(row)[0] < probes else 0.0
            found.append(row.model_copy(update={"seconds": None if row.seconds is None else row.seconds + missing}))
    return found


def _said_once(places: Sequence[Place]) -> dict[Place, Place]:
    """(series, configuration) without what is the same in all configurations of a series, such as "held_out 100"."""
    short: dict[Place, Place] = {}
    for series, group in grouped(places, lambda place: place[0]).items():
        parts = [name.split(", ") for _, name in group]
        constant = set.intersection(*map(set, parts)) if len(parts) > 1 else set()
        fixed = {part.rpartition(" ")[0] for part in constant}
        title = " x ".join(word for word in series.split(" x ") if word not in fixed)
        short |= {
            place: (title, ", ".join(part for part in split if part not in constant))
            for place, split in zip(group, parts, strict=True)
        }
    return short


def pareto_front(points: Sequence[Configuration]) -> list[Configuration]:
    """The configurations that no other one beats in cost and gain; see ``front_of``."""
    return front_of(points, cost=lambda point: point.cost, gain=lambda point: point.gain)


def speed_accuracy_chart(rows: Sequence[ResultRow], *, cost: Cost = "seconds") -> Drawing:
    """A point for each configuration, the front as a line, its points named where they stand."""
    points = configurations(rows, cost=cost)
    front = pareto_front(points)
    series = list(dict.fromkeys(point.series for point in points))
    look = {name: (PALETTE[k % len(PALETTE)], MARKERS[k % len(MARKERS)]) for k, name in enumerate(series)}
    with drawing(size=(10.5, 5.8)) as made:
        (axes,) = made.panels
        for point in points:
            colour, marker = look[point.series]
            axes.errorbar(
                point.cost, point.gain, yerr=point.spread, color=colour, marker=marker, ms=7, lw=1, mec=INK, mew=0.5
            )
        axes.step([p.cost for p in front], [p.gain for p in front], where="post", color=INK, lw=1, ls="--", zorder=1)
        axes.set_xscale("log")
        for ticks in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            ticks(LogFormatter(labelOnlyBase=False, minor_thresholds=(2, 0.5)))
        axes.set_xlabel(f"{UNITS[cost]} (mean, log scale)")
        axes.set_ylabel("A_drop on held-out views (mean; bars: deviation over seeds)")
        axes.set_title("Speed against accuracy: up and to the left is better")
        _name_points(axes, front, points, cost)
        handles = [
            Line2D([], [], color=look[n][0], marker=look[n][1], mec=INK, mew=0.5, ls="", label=n or "configurations")
            for n in series
        ]
        handles.append(Line2D([], [], color=INK, ls="--", lw=1, label="Pareto front"))
        made.figure.legend(handles=handles, loc="outside right upper", title="varied", alignment="left")
    return made


def _name_points(axes: Axes, front: Sequence[Configuration], points: Sequence[Configuration], cost: Cost) -> None:
    """What each point of the front is, to its upper left, where no point can be, and presets below it, to the lower
    right; room is made for all."""
    costs, gains = [p.cost for p in points], [p.gain for p in points]
    low, high = min(gains) - max(p.spread for p in points), max(gains)
    line = max(high - low, 0.05) * LINE
    top = bottom = low
    names = [f"{point.name}: {_told_cost(point.cost, cost)}, {point.gain:.2f}" for point in front]
    for point, words in zip(front, names, strict=True):
        top = max(point.gain + line / 2, top + line)
        _name_point(axes, point, words, top, "right")
    presets = [point for point in points if point.series == PRESET and point not in front]
    for number, point in enumerate(sorted(presets, key=lambda p: -p.gain)):
        bottom = min(point.gain - line, bottom - line if number else high)
        _name_point(axes, point, point.name, bottom, "left")
    low, high = min(low, bottom) - line, max(top, high) + 2 * line
    right = max(costs) * 1.3
    axes.set_xlim(min(min(costs) / 1.3, *map(partial(_left_edge, right), front, names)), right)
    axes.set_ylim(low, high)
    axes.set_yticks([tick for tick in axes.get_yticks() if low <= tick <= 1.001])


def _left_edge(right: float, point: Configuration, words: str) -> float:
    """Where a logarithmic axis up to ``right`` must begin so that ``words`` that end at the point fit."""
    share = min(CHARACTER * len(words), 0.8)
    return float(point.cost ** (1 / (1 - share)) / right ** (share / (1 - share)))


def _name_point(axes: Axes, point: Configuration, words: str, height: float, side: Literal["left", "right"]) -> None:
    """Write ``words`` that end (right) or begin (left) above or below a point, with a line to it."""
    axes.annotate(
        words,
        (point.cost, point.gain),
        xytext=(point.cost, height),
        textcoords="data",
        ha=side,
        va="bottom" if side == "right" else "top",
        fontsize=8,
        weight="bold" if point.series == PRESET else "normal",
        arrowprops={
            "arrowstyle": "-",
            "color": GREY,
            "lw": 0.6,
            "shrinkB": 4,
            "relpos": (1, 0) if side == "right" else (0, 1),
        },
    )


def _told_cost(value: float, cost: Cost) -> str:
    return f"{value:.3g} s" if cost == "seconds" else f"{value:.0f} images"


def pareto_markdown(rows: Sequence[ResultRow]) -> str:
    """A table of all configurations with both costs, those on a front in bold; before it one of the presets, if any."""
    by_time, by_images = configurations(rows), configurations(rows, cost="evaluations")
    images = {(point.series, point.name): point.cost for point in by_images}
    fronts = {"time": _names(pareto_front(by_time)), "images": _names(pareto_front(by_images))}
    head = ["varied", "configuration", "s", "images", "held-out A_drop", "target A_drop", "transfer gap", "on front"]
    lines = []
    for point in sorted(by_time, key=lambda p: p.cost):
        place = point.series, point.name
        front = [words for words, names in fronts.items() if place in names]
        name = f"**{point.name}**" if front else point.name
        cells = [f"{point.cost:.3g}", f"{images[place]:.0f}" if place in images else "n.a."]
        cells += [_gain(point), figure_words(point.target), figure_words(point.gap), ", ".join(front)]
        lines.append([point.series, name, *cells, point.jobs])
    return _presets_markdown(by_time) + markdown_table([*head, "jobs"], lines, align="llrrrrrlr") + "\n"


def _names(points: Sequence[Configuration]) -> set[tuple[str, str]]:
    return {(point.series, point.name) for point in points}


def _presets_markdown(points: Sequence[Configuration]) -> str:
    """A table of the presets: what each costs and gives, and what on the front it must be held against."""
    presets, front = [point for point in points if point.series == PRESET], pareto_front(points)
    if not presets:
        return ""
    head = ["preset", "s", "held-out A_drop", "beside the Pareto front"]
    lines = [[point.name, f"{point.cost:.3g}", _gain(point), _beside(point, front)] for point in presets]
    return markdown_table(head, lines, align="lrrl") + "\n\n"


def _beside(point: Configuration, front: Sequence[Configuration]) -> str:
    """What speaks for a configuration, or against it: what is better for as much, or what more would bring."""
    if point not in front:
        better = [p for p in front if p.cost <= point.cost and p.gain >= point.gain][-1]
        return f"beaten by {_against(better, point)}"
    dearer = [p for p in front if p.cost > point.cost]
    return f"on it; next: {_against(dearer[0], point)}" if dearer else "on it; nothing does more"


def _against(other: Configuration, point: Configuration) -> str:
    more = other.gain - point.gain
    small = ", less than the deviation over seeds" if more < max(other.spread, point.spread) else ""
    return f"{other.name}, {other.cost / point.cost:.2g} times the time, A_drop {more:+.3f}{small}"


def _gain(point: Configuration) -> str:
    return f"{point.gain:.2f} ± {point.spread:.2f}" if point.spread else f"{point.gain:.2f}"
