"""Cost (time, images, visibility) against drop of each configuration, and the Pareto front."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, Literal

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter

from trompe_experiments.markdown import figure_words, markdown_table
from trompe_experiments.style import GREY, INK, Drawing, drawing, look
from trompe_experiments.table import ResultRow
from trompe_shared.comparison import PROBED, Job, Mean, charged, grouped, means_of, pareto_front

Cost = Literal["seconds", "evaluations", "delta_e", "dissimilarity"]
Place = tuple[str, str]
"""Series and configuration."""
UNITS: Final[dict[Cost, tuple[str, str]]] = {
    "seconds": ("wall time of a job, s", "{:.3g} s"),
    "evaluations": ("images shown to the classifier", "{:.0f} images"),
    "delta_e": ("CIEDE2000 of the views", "{:.2f}"),
    "dissimilarity": ("1 - SSIM of the views", "{:.3f}"),
}
"""Name of each cost, and its form in a text."""
PRESET: Final = "preset"
"""Series of the presets."""
LINE, CHARACTER = 0.055, 0.0078
"""Height of a line of text, and width of a character, as shares of the axes."""
ARROW: Final[dict[str, Any]] = {"arrowstyle": "-", "color": GREY, "lw": 0.6, "shrinkB": 4}


def configurations(
    rows: Sequence[ResultRow], *, cost: Cost = "seconds", drop: str = "judged_drop"
) -> list[Mean[Place]]:
    """Means of the configurations (series, name), in the order of the rows; see ``trompe_shared.comparison``.

    Names leave out options that are the same in all configurations of a series, such as "held_out 100".
    """
    known = [row for row in rows if getattr(row, drop) is not None and getattr(row, cost) is not None]
    names = _short_names(list(dict.fromkeys(map(_place, rows))))
    jobs = [_job(row, getattr(row, cost), getattr(row, drop)) for row in known]
    means, _ = means_of(charged(jobs) if cost == "seconds" else jobs)
    return [replace(mean, configuration=names[mean.configuration]) for mean in means]


def _place(row: ResultRow) -> Place:
    return row.series, row.configuration or "base"


def _job(row: ResultRow, cost: float, drop: float) -> Job[Place]:
    calibration = (row.probe_renders or 0, row.calibrate_s or 0.0)
    same_probes = (row.object, row.image_size, row.views, row.seed, *(getattr(row, name) for name in PROBED))
    return Job(row.object, _place(row), row.seed, cost, drop, calibration, same_probes)


def _short_names(places: Sequence[Place]) -> dict[Place, Place]:
    """Series and configurations without the options that are the same in all configurations of a series, unless two
    series had one title then."""
    shortened = [_shortened(series, group) for series, group in grouped(places, lambda place: place[0]).items()]
    titles = Counter(title for names in shortened for title in {title for title, _ in names.values()})
    return {place: name if titles[name[0]] == 1 else place for names in shortened for place, name in names.items()}


def _shortened(series: str, group: Sequence[Place]) -> dict[Place, Place]:
    """Short titles and names of the configurations of a series."""
    parts = [name.split(", ") for _, name in group]
    constant = set.intersection(*map(set, parts)) if len(parts) > 1 else set()
    fixed = {part.rpartition(" ")[0] for part in constant}
    title = " x ".join(word for word in series.split(" x ") if word not in fixed)
    names = (", ".join(part for part in split if part not in constant) for split in parts)
    return {place: (title, name) for place, name in zip(group, names, strict=True)}


def speed_accuracy_chart(rows: Sequence[ResultRow], *, cost: Cost = "seconds") -> Drawing:
    """A point for each configuration; the front as a line with named points."""
    points = configurations(rows, cost=cost)
    front = pareto_front(points)
    series = list(dict.fromkeys(point.configuration[0] for point in points))
    styles = {name: look(k) | {"mec": INK, "mew": 0.5} for k, name in enumerate(series)}
    with drawing(size=(10.5, 5.8)) as made:
        (axes,) = made.panels
        for point in points:
            axes.errorbar(point.cost, point.drop, yerr=point.spread, ms=7, lw=1, **styles[point.configuration[0]])
        axes.step([p.cost for p in front], [p.drop for p in front], where="post", color=INK, lw=1, ls="--", zorder=1)
        axes.set_xscale("log")
        for ticks in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            ticks(LogFormatter(labelOnlyBase=False, minor_thresholds=(2, 0.5)))
        axes.set_xlabel(f"{UNITS[cost][0]} (mean, log scale)")
        axes.set_ylabel("A_drop on held-out views (mean; bars: deviation over seeds)")
        axes.set_title("Up and to the left is better")
        _name_points(axes, front, points, cost)
        handles = [Line2D([], [], ls="", label=name or "configurations", **styles[name]) for name in series]
        handles.append(Line2D([], [], color=INK, ls="--", lw=1, label="Pareto front"))
        made.figure.legend(handles=handles, loc="outside right upper", title="varied", alignment="left")
    return made


def _name_points(axes: Axes, front: Sequence[Mean[Place]], points: Sequence[Mean[Place]], cost: Cost) -> None:
    """Name the points of the front at their upper left, where no other point can be, and presets at their lower right;
    make room for all names."""
    costs, drops = [p.cost for p in points], [p.drop for p in points]
    low, high = min(drops) - max(p.spread for p in points), max(drops)
    line = max(high - low, 0.05) * LINE
    top = bottom = low
    names = [f"{p.configuration[1]}: {UNITS[cost][1].format(p.cost)}, {p.drop:.2f}" for p in front]
    for point, words in zip(front, names, strict=True):
        top = max(point.drop + line / 2, top + line)
        _name_point(axes, point, words, top, "right")
    presets = [point for point in points if point.configuration[0] == PRESET and point not in front]
    for number, point in enumerate(sorted(presets, key=lambda p: -p.drop)):
        bottom = min(point.drop - line, bottom - line if number else high)
        _name_point(axes, point, point.configuration[1], bottom, "left")
    low, high = min(low, bottom) - line, max(top, high) + 2 * line
    right = max(costs) * 1.3
    axes.set_xlim(min(min(costs) / 1.3, *map(partial(_left_edge, right), front, names)), right)
    axes.set_ylim(low, high)
    axes.set_yticks([tick for tick in axes.get_yticks() if low <= tick <= 1.001])


def _left_edge(right: float, point: Mean[Place], words: str) -> float:
    """Left end of a logarithmic axis up to ``right`` with room for ``words`` that end at the point."""
    share = min(CHARACTER * len(words), 0.8)
    return float(point.cost ** (1 / (1 - share)) / right ** (share / (1 - share)))


def _name_point(axes: Axes, point: Mean[Place], words: str, height: float, side: Literal["left", "right"]) -> None:
    """Write ``words`` that end (right) above, or begin (left) below a point, with a line to it."""
    axes.annotate(
        words,
        (point.cost, point.drop),
        xytext=(point.cost, height),
        textcoords="data",
        ha=side,
        va="bottom" if side == "right" else "top",
        fontsize=8,
        weight="bold" if point.configuration[0] == PRESET else "normal",
        arrowprops=ARROW | {"relpos": (1, 0) if side == "right" else (0, 1)},
    )


def pareto_markdown(rows: Sequence[ResultRow]) -> str:
    """A table of all configurations with both costs, those on a front in bold; one of the presets first, if any."""
    by_time, by_images = configurations(rows), configurations(rows, cost="evaluations")
    images = {mean.configuration: mean.cost for mean in by_images}
    target = {mean.configuration: mean.drop for mean in configurations(rows, drop="target_a_drop")}
    fronts = {"time": pareto_front(by_time), "images": pareto_front(by_images)}
    head = ["configuration", "s", "images", "held-out A_drop", "target A_drop", "on front"]
    lines = []
    for mean in sorted(by_time, key=lambda mean: mean.cost):
        place = mean.configuration
        front = [words for words, means in fronts.items() if place in {each.configuration for each in means}]
        name = f"**{place[1]}**" if front else place[1]
        costs = [f"{mean.cost:.3g}", figure_words(images.get(place), ".0f")]
        lines.append([name, *costs, _drop(mean), figure_words(target.get(place)), ", ".join(front)])
    return _presets_markdown(by_time) + markdown_table(head, lines, align="lrrrrl") + "\n"


def _presets_markdown(means: Sequence[Mean[Place]]) -> str:
    """A table of the presets, each compared with the front."""
    presets, front = [mean for mean in means if mean.configuration[0] == PRESET], pareto_front(means)
    if not presets:
        return ""
    head = ["preset", "s", "held-out A_drop", "beside the Pareto front"]
    lines = [[mean.configuration[1], f"{mean.cost:.3g}", _drop(mean), _beside(mean, front)] for mean in presets]
    return markdown_table(head, lines, align="lrrl") + "\n\n"


def _beside(mean: Mean[Place], front: Sequence[Mean[Place]]) -> str:
    """The next better configuration, or the one that beats it."""
    if mean not in front:
        better = [each for each in front if each.cost <= mean.cost and each.drop >= mean.drop][-1]
        return f"beaten by {_against(better, mean)}"
    dearer = [each for each in front if each.cost > mean.cost]
    return f"on it; next: {_against(dearer[0], mean)}" if dearer else "on it; nothing drops more"


def _against(other: Mean[Place], mean: Mean[Place]) -> str:
    more = other.drop - mean.drop
    small = ", less than the deviation over seeds" if more < max(other.spread, mean.spread) else ""
    return f"{other.configuration[1]}, {other.cost / mean.cost:.2g} times the time, A_drop {more:+.3f}{small}"


def _drop(mean: Mean[Place]) -> str:
    return f"{mean.drop:.2f} ± {mean.spread:.2f}" if mean.spread else f"{mean.drop:.2f}"
