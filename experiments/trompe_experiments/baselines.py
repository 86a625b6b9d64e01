"""Methods of painting, judged alike: a table and a chart."""

from collections.abc import Sequence
from math import nan
from statistics import fmean

from trompe_experiments.judged import JudgedRow
from trompe_experiments.markdown import figure_words, markdown_table
from trompe_experiments.style import Drawing, drawing, look
from trompe_shared.comparison import average, grouped


def baselines_chart(rows: Sequence[JudgedRow]) -> Drawing:
    """A line for each method: a small dot with its interval for each object, a large one for their mean."""
    methods, objects = _by_method(rows), list(dict.fromkeys(row.object for row in rows))
    with drawing(size=(7.0, 1.4 + 0.55 * len(methods))) as made:
        (axes,) = made.panels
        for place, own in enumerate(methods.values()):
            for row in own:
                number = objects.index(row.object)
                style = look(number)
                at = place + 0.6 * ((number + 0.5) / len(objects) - 0.5)
                label = row.object if not place else None
                axes.plot(nan if row.a_drop is None else row.a_drop, at, ms=4, mew=0, ls="", label=label, **style)
                if row.a_drop_low is not None and row.a_drop_high is not None:
                    axes.plot([row.a_drop_low, row.a_drop_high], [at, at], lw=0.8, color=style["color"], alpha=0.6)
            mean = fmean([row.a_drop for row in own if row.a_drop is not None] or [nan])
            axes.plot([mean, mean], [place - 0.35, place + 0.35], lw=2, color="black")
        axes.set_yticks(range(len(methods)), list(methods))
        axes.invert_yaxis()
        axes.set_xlabel("A_drop on unseen views (share); bars: means")
        made.figure.legend(loc="outside lower center", ncols=4)
    return made


def baselines_markdown(rows: Sequence[JudgedRow]) -> str:
    """A line for each method: means over the objects that are recognised in some view."""
    head = ["method", "A_drop", "at half size", "JPEG 30", "CIEDE2000", "seconds"]
    lines = [[method, *_means(own)] for method, own in _by_method(rows).items()]
    return markdown_table(head, lines, align="lrrrrr") + "\n"


def _by_method(rows: Sequence[JudgedRow]) -> dict[str, list[JudgedRow]]:
    return grouped(rows, lambda row: row.configuration or "base")


def _means(rows: Sequence[JudgedRow]) -> list[str]:
    columns = {"a_drop": ".2f", "half_size_drop": ".2f", "jpeg_drop": ".2f", "delta_e": ".1f", "seconds": ".0f"}
    drop, *others = (figure_words(average(getattr(row, name) for row in rows), form) for name, form in columns.items())
    return [f"**{drop}**", *others]
