"""Figures, tables and reports of experiments."""

import html
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
from click.testing import CliRunner
from matplotlib.patches import Rectangle
from PIL import Image

from trompe_client.cli import main
from trompe_experiments.between import between_chart, between_markdown
from trompe_experiments.documents import fill, outdated
from trompe_experiments.engines import engines_chart, engines_markdown
from trompe_experiments.figures import FIGURES, Data, figures_of, histogram_rows, plain_rows, read_data
from trompe_experiments.histograms import prediction_histograms
from trompe_experiments.paper import (
    paper_means_markdown,
    paper_numbers,
    table_one,
    table_one_chart,
    table_one_markdown,
    texels_scatter,
)
from trompe_experiments.pareto import configurations, pareto_markdown
from trompe_experiments.report import write_report
from trompe_experiments.stability.chart import behaviours, stability_markdown
from trompe_experiments.style import Drawing, stamp_of
from trompe_experiments.surrogates import surrogates_chart, surrogates_markdown
from trompe_experiments.table import PREDICTIONS, RESULTS, PredictionRow, ResultRow, write_table
from trompe_shared.errors import SpecError

ROW: dict[str, Any] = {
    "experiment": "some",
    "key": "k",
    "state": "succeeded",
    "object": "candle",
    "classifier": "mobilenet_v2",
    "epsilon": 0.05,
    "surrogate": "auto",
    "seed": 0,
    "target_a_before": 0.8,
    "surrogate_a_drop": 1.0,
    "target_a_drop": 0.9,
    "held_out_a_drop": 0.6,
    "transfer_gap": 0.1,
    "texels_altered": 0.4,
    "seconds": 30.0,
    "evaluations": 800,
}


def row(**columns: Any) -> ResultRow:
    made: ResultRow = ResultRow.model_validate(ROW | columns)
    return made


def prediction(key: str, moment: str, count: int, *, true: bool) -> PredictionRow:
    k, name = (0, "candle") if true else (1, "pot, flowerpot")
    return PredictionRow(key=key, views="target", moment=moment, class_index=k, name=name, true_class=true, count=count)


def test_drops_through_changes_of_the_images_are_compared_with_the_undisturbed_ones(tmp_path: Path) -> None:
    rows = [
        row(image_pipeline="robust", held_out_a_drop=0.8, pipeline_drops="half size 0.600 | grain 0.800"),
        row(image_pipeline="robust", object="pot", held_out_a_drop=0.4, pipeline_drops="half size 0.100 | grain n.a."),
        row(image_pipeline="none", held_out_a_drop=1.0, pipeline_drops="half size 0.200 | grain 0.500"),
        row(image_pipeline="none", object="pot", held_out_a_drop=-0.02, pipeline_drops="half size 0.200 | grain 0.500"),
        row(image_pipeline="none", steps=5, held_out_a_drop=0.1, pipeline_drops="half size 0.000 | grain 0.000"),
    ]
    rows.append(rows[0].model_copy(update={"series": "a second one with the same job"}))
    lines = [[*map(str.strip, line.split("|")[1:-1])] for line in between_markdown(rows).splitlines()]
    assert lines[0] == ["in between", "robust: A_drop", "robust: kept", "none: A_drop", "none: kept"]
    assert lines[2:] == [
        ["nothing", "0.60", "**1.00**", "0.49", "**1.00**"],
        ["half size", "0.35", "**0.50**", "0.20", "**0.20**"],
        ["grain", "0.80", "**1.00**", "0.50", "**0.50**"],
    ]
    data = Data(tmp_path, tuple(rows), ())
    assert "between" in figures_of(data)
    assert all(path.stat().st_size > 5000 for path in data.draw("between"))
    assert "between" not in figures_of(Data(tmp_path, tuple(rows[:2]), ()))


def test_configurations_are_means_over_the_objects_that_all_of_them_have() -> None:
    rows = [
        row(series="steps", configuration="steps 5", object="mug", held_out_a_drop=0.4, seconds=10, seed=0),
        row(series="steps", configuration="steps 5", object="mug", held_out_a_drop=0.6, seconds=20, seed=1),
        row(series="steps", configuration="steps 5", object="lamp", held_out_a_drop=0.0, seconds=99),
        row(series="steps", configuration="steps 9", object="mug", held_out_a_drop=0.8, seconds=30),
    ]
    short, long = configurations(rows)
    assert (short.drop, short.cost) == pytest.approx((0.5, 15))
    assert short.spread == pytest.approx(0.1414, abs=1e-3)
    assert (long.drop, long.cost) == (0.8, 30)
    assert "**steps 5**" in pareto_markdown(rows)


def test_what_all_configurations_of_a_series_share_is_left_out_of_their_names() -> None:
    rows = [
        row(series="preset x held_out", configuration=f"preset {name}, held_out 100") for name in ("fast", "best")
    ] + [row(series="optimiser x steps", configuration="optimiser fgsm, steps 1")]
    named = [each.configuration for each in configurations(rows)]
    presets = [("preset", f"preset {name}") for name in ("fast", "best")]
    assert named == [*presets, ("optimiser x steps", "optimiser fgsm, steps 1")]


def test_series_that_would_have_one_title_keep_what_tells_them_apart() -> None:
    rows = [
        row(series="epsilon", configuration="epsilon 0.02"),
        row(series="epsilon", configuration="epsilon 0.05"),
        row(series="perceptual x epsilon", configuration="perceptual True, epsilon 0.03"),
        row(series="perceptual x epsilon", configuration="perceptual True, epsilon 0.05"),
    ]
    named = [each.configuration for each in configurations(rows)]
    assert named == [(each.series, each.configuration) for each in rows]


def test_the_table_has_both_costs_and_says_on_which_front_a_configuration_is() -> None:
    rows = [
        row(series="steps", configuration="steps 5", seconds=10, evaluations=500, held_out_a_drop=0.4),
        row(series="steps", configuration="steps 9", seconds=30, evaluations=400, held_out_a_drop=0.6),
        row(series="steps", configuration="steps 90", seconds=90, evaluations=900, held_out_a_drop=0.5),
    ]
    text = pareto_markdown(rows)
    assert "| **steps 5** | 10 | 500 | 0.40 | 0.90 | time |" in text
    assert "| **steps 9** | 30 | 400 | 0.60 | 0.90 | time, images |" in text
    assert "| steps 90 | 90 | 900 |" in text


def test_each_preset_is_held_against_the_front() -> None:
    rows = [
        row(series="preset", configuration="preset fast", seconds=10, held_out_a_drop=0.5),
        row(series="preset", configuration="preset balanced", seconds=40, held_out_a_drop=0.8),
        row(series="preset", configuration="preset best", seconds=90, held_out_a_drop=0.9),
        row(series="steps", configuration="steps 9", seconds=20, held_out_a_drop=0.85),
    ]
    text = pareto_markdown(rows)
    assert "| preset fast | 10 | 0.50 | on it; next: steps 9, 2 times the time, A_drop +0.350 |" in text
    assert "| preset balanced | 40 | 0.80 | beaten by steps 9, 0.5 times the time, A_drop +0.050 |" in text
    assert "| preset best | 90 | 0.90 | on it; nothing drops more |" in text


def test_the_papers_numbers_have_the_means_that_the_paper_tells() -> None:
    def mean(classifier: str, epsilon: float) -> float:
        cells = [p for p in paper_numbers() if (p.classifier, p.epsilon, p.tau) == (classifier, epsilon, None)]
        return fmean(p.target_a_drop for p in cells if p.target_a_drop is not None)

    assert mean("mobilenet_v2", 0.05) == pytest.approx(0.59, abs=0.005)
    assert mean("inception_v3", 0.05) == pytest.approx(0.31, abs=0.005)
    assert len({p.object for p in paper_numbers()}) == 10


def test_table_one_puts_ours_beside_the_papers_and_leaves_saliency_and_the_unrecognised_out_of_the_mean() -> None:
    rows = [
        row(target_a_drop=1.0),
        row(target_a_drop=0.8, seed=1),
        row(target_a_drop=0.1, tau=0.2),
        row(object="toilet", target_a_before=0.1, target_a_drop=0.0),
    ]
    cells = {cell.object: cell for cell in table_one(rows)}
    assert cells["candle"].target == pytest.approx(0.9)
    assert cells["candle"].paper is not None
    assert cells["candle"].paper.target_a_drop == pytest.approx(0.7586)
    assert not cells["toilet"].counts
    text = table_one_markdown(rows)
    assert "| candle | 0.05 | 0.80 | 1.00 | **0.90** | 0.76 |" in text
    assert "| **mean** where A_before ≥ 0.3 | 0.05 | 0.80 | 1.00 | **0.90** | 0.76 |" in text


def test_each_classifier_fills_a_row_of_its_own_however_many_budgets_it_was_given() -> None:
    asked = {"squeezenet1_1": [0.5, 0.05], "mobilenet_v2": [0.01, 0.02, 0.05, 0.1, 0.5]}
    made = table_one_chart([row(classifier=name, epsilon=epsilon) for name, some in asked.items() for epsilon in some])
    titles = [panel.get_title(loc="left") for panel in made.panels]
    assert titles == [f"{name}, ε = {epsilon:g}" for name, some in asked.items() for epsilon in sorted(some)]
    assert all(panel.lines for panel in made.panels)
    made.figure.draw_without_rendering()
    ends = [panel.get_position().x1 for panel in made.panels]
    assert ends[1] == pytest.approx(ends[-1], abs=0.01)


def test_a_budget_or_a_network_that_the_paper_lacks_has_no_paper_column() -> None:
    lines = table_one_markdown([row(), row(epsilon=0.01)]).splitlines()
    assert "| candle | 0.01 | 0.80 | 1.00 | **0.90** |  |" in lines
    assert "| candle | 0.05 | 0.80 | 1.00 | **0.90** | 0.76 |" in lines
    text = table_one_markdown([row(classifier="squeezenet1_1")])
    assert "its InceptionV3" in text
    assert "0.31 at ε 0.05" in text
    assert text.splitlines()[-1].endswith("| **0.90** |  |")


def stability_rows() -> list[ResultRow]:
    return [
        row(case="as it should be", held_out_a_drop=0.9, target_a_drop=1.0),
        row(case="told", held_out_a_drop=0.2, target_a_drop=0.9, warnings="The surrogate is off."),
        row(case="silent", held_out_a_drop=0.2, target_a_drop=0.9),
        row(case="promised more", held_out_a_drop=0.9, target_a_drop=0.5),
        row(case="unforeseen: jpeg", held_out_a_drop=0.1, target_a_drop=0.9),
        row(case="warned for nothing", held_out_a_drop=0.9, target_a_drop=1.0, warnings="Careful."),
        row(case="not seen", target_a_before=0.0, target_a_drop=None, held_out_a_drop=None, warnings="n.a.: none"),
        row(case="crashed", state="failed", target_a_before=None, target_a_drop=None, held_out_a_drop=None, error="no"),
    ]


def test_a_case_that_breaks_without_a_word_is_told_apart() -> None:
    cases = {case.case: case for case in behaviours(stability_rows())}
    reference = cases["as it should be"]
    assert [name for name, case in cases.items() if case.unnoticed(reference)] == ["silent", "promised more"]
    broken = [name for name, case in cases.items() if case.broken(reference)]
    assert broken == ["told", "silent", "promised more", "unforeseen: jpeg", "crashed"]
    text = stability_markdown(stability_rows())
    for line in (
        r"\| silent .*breaks, NO WARNING",
        r"\| told .*breaks, warned \| The surrogate is off",
        r"\| unforeseen: jpeg .*no warning possible",
        r"\| not seen .*n\.a\., warned",
        r"\| warned for nothing .*holds, warned",
    ):
        assert re.search(line, text)


def grid_rows() -> list[ResultRow]:
    return [
        row(key=f"{name}{epsilon}{tau}", object=name, epsilon=epsilon, tau=tau, configuration=f"epsilon {epsilon:g}")
        for name in ("candle", "ewer")
        for epsilon in (0.05, 0.1)
        for tau in (None, 0.05)
    ]


def series_rows() -> list[ResultRow]:
    return [
        row(key=f"{n}", series=series, configuration=f"{series} {n}", seconds=n, held_out_a_drop=n / 40)
        for series, values in (("steps", (5, 10, 20)), ("pool", (8, 16)))
        for n in values
    ]


def surrogate_rows() -> list[ResultRow]:
    """Two objects attacked in two surrogates, with and without saliency; one of them is hardly recognised."""
    return [
        row(
            key=f"{name}-{surrogate}-{tau}",
            object=name,
            target_a_before=before,
            surrogate=surrogate,
            tau=tau,
            target_a_drop=kept,
            texels_altered=0.4 if tau is None else 0.2,
            configuration=f"surrogate {surrogate}, tau {tau}",
        )
        for name, before in (("candle", 0.8), ("toilet", 0.1))
        for surrogate, kept in (("diffuse", 0.3), ("calibrated", 0.9))
        for tau in (0.05, None)
    ]


def test_a_table_sets_surrogates_beside_each_other_by_tau_and_means_count_what_was_recognised() -> None:
    everything, salient = surrogates_markdown(surrogate_rows()).split("**saliency, τ 0.05**")
    assert everything.startswith("**all texels**")
    for name, kept in (("diffuse", "0.30"), ("calibrated", "0.90")):
        assert f"| candle | {name} | 0.80 | 1.00 | **{kept}** | 40.0% |" in everything
        assert f"| **mean** where A_before ≥ 0.3 | {name} | 0.80 | 1.00 | **{kept}** | 20.0% |" in salient
    hardly = [each for each in surrogate_rows() if each.object == "toilet"]
    assert surrogates_markdown(hardly).count("| n.a. | n.a. | **n.a.** | n.a. |") == 4


def engine_rows() -> list[ResultRow]:
    return [
        row(key=f"{engine}-{name}", renderers=engine, object=name, series="renderers", configuration=engine, **figures)
        for engine, error in (("three", 0.02), ("mitsuba | three", 0.05))
        for name, figures in (
            ("candle", {"disagreement": 0.0, "margin_error": error, "held_out_a_drop": 0.6}),
            ("pot", {"disagreement": 0.04, "margin_error": error / 2, "held_out_a_drop": 0.8}),
            ("toilet", {"disagreement": None, "margin_error": None, "held_out_a_drop": None, "target_a_before": 0.0}),
        )
    ]


def test_renderers_are_set_beside_each_other_with_the_worst_margin_error_of_their_jobs() -> None:
    _, _, *lines = engines_markdown(engine_rows()).splitlines()
    assert lines == [
        "| three | 0.05 | 3 | 2.0% | 0.020 | **0.70** |",
        "| mitsuba \\| three | 0.05 | 3 | 2.0% | 0.050 | **0.70** |",
    ]


def test_the_grid_at_a_glance_averages_what_was_recognised_and_sets_the_papers_means_beside_it() -> None:
    rows = [
        row(key="a", target_a_drop=1.0, texels_altered=0.5, transfer_gap=-0.02),
        row(key="b", object="plunger", target_a_drop=0.5, texels_altered=0.3, transfer_gap=0.04),
        row(key="c", object="toilet", target_a_before=0.1, target_a_drop=0.0, texels_altered=0.9, transfer_gap=0.9),
        row(key="d", tau=0.2, target_a_drop=0.4, texels_altered=0.1, transfer_gap=0.0),
        row(key="e", epsilon=0.02, target_a_drop=0.25, texels_altered=0.5, transfer_gap=None),
        row(key="f", classifier="squeezenet1_1", target_a_drop=0.75, texels_altered=0.2, transfer_gap=0.0),
    ]
    _, _, *lines = paper_means_markdown(rows).splitlines()
    assert lines == [
        "| mobilenet_v2 | all texels | 0.02 | n.a. | **0.25 (50%)** |  |",
        "| mobilenet_v2 | all texels | 0.05 | 0.030 | **0.75 (40%)** | 0.59 (27%) |",
        "| mobilenet_v2 | saliency, τ 0.2 | 0.05 | 0.000 | **0.40 (10%)** | 0.27 (5%) |",
        "| squeezenet1_1 | all texels | 0.05 | 0.000 | **0.75 (20%)** |  |",
        "| inception_v3 | all texels | 0.05 |  |  | 0.31 (30%) |",
        "| inception_v3 | saliency, τ 0.2 | 0.05 |  |  | 0.13 (5%) |",
    ]


def test_jobs_that_some_surrogate_lacks_are_not_compared_and_other_figures_show_one_surrogate(tmp_path: Path) -> None:
    alone = row(key="alone", object="pot", surrogate="diffuse", epsilon=0.1)
    assert surrogates_markdown([*surrogate_rows(), alone]) == surrogates_markdown(surrogate_rows())
    data = read_data(written(tmp_path / "some", [*surrogate_rows(), alone]))
    assert {each.surrogate for each in data.rows} == {"diffuse", "calibrated"}
    assert {each.surrogate for each in (*data.grid, *plain_rows(data))} == {"diffuse"}


def test_a_job_that_found_a_calibration_costs_what_it_would_have_cost_without() -> None:
    asked = row(key="a", series="loss", configuration="loss margin", probe_renders=124, calibrate_s=8.0, seconds=20.0)
    found = row(key="b", series="loss", configuration="loss dlr", probe_renders=0, calibrate_s=0.5, seconds=12.0)
    differing: list[dict[str, Any]] = [{"views": 20}, {"image_size": "299x299"}, {"renderers": "three"}, {"grid": True}]
    others = [
        row(key=str(k), configuration=str(k), probe_renders=0, calibrate_s=0.5, seconds=9.0, **options)
        for k, options in enumerate(differing)
    ]
    assert [each.cost for each in configurations([asked, found, *others])] == [20.0, 19.5, *[9.0] * len(others)]


def written(folder: Path, rows: Sequence[ResultRow]) -> Path:
    """The folder of an experiment with these rows, predictions of each, and one picture."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / RESULTS, rows)
    said = [
        prediction(each.key, moment, count, true=true)
        for each in rows
        for moment, count, true in (("before", 60, True), ("after", 6, True), ("after", 54, False))
    ]
    write_table(folder / PREDICTIONS, said, PredictionRow)
    (folder / "jobs" / rows[0].key).mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (30, 20), "white").save(folder / "jobs" / rows[0].key / "contact_sheet.png")
    return folder


REPORTS: dict[str, tuple[list[ResultRow], list[str]]] = {
    "grid": (grid_rows(), ["table_one", "scatter", "histograms"]),
    "series": (series_rows(), ["speed_accuracy", "evaluations_accuracy"]),
    "cases": (stability_rows(), ["stability"]),
    "engines": (engine_rows(), ["engines"]),
    "surrogates": (surrogate_rows(), ["table_one", "scatter", "surrogates", "histograms"]),
    "surrogates on different objects": (
        [row(object="mug", surrogate="diffuse"), row(object="lamp", surrogate="curve")],
        ["table_one", "histograms"],
    ),
    "no result of the first surrogate": (
        [row(surrogate="diffuse", state="failed", target_a_drop=None)]
        + [row(surrogate="curve", tau=tau) for tau in (None, 0.1, 0.2)],
        [],
    ),
    "series on different objects": (
        [row(series=str(n > 1), configuration=f"steps {n}", object=f"object {n}", alpha=n / 9) for n in range(4)]
        + [row(series="True", configuration="steps 3", object="object 3", alpha=0.5)],
        [],
    ),
    "grid in two series": (
        [*grid_rows(), row(key="small", series="small", epsilon=0.01, alpha=0.004, configuration="epsilon 0.01")],
        ["table_one", "scatter", "histograms"],
    ),
}


@pytest.mark.parametrize(("rows", "names"), REPORTS.values(), ids=REPORTS)
def test_a_report_fits_its_rows_and_needs_nothing_else(rows: list[ResultRow], names: list[str], tmp_path: Path) -> None:
    folder = written(tmp_path / "some", rows)
    assert list(figures_of(read_data(folder))) == names
    page = write_report(folder).read_text("utf-8")
    for name in names:
        assert html.escape(FIGURES[name].title) in page
        for ending in ("svg", "png"):
            assert (folder / "figures" / f"{name}.{ending}").stat().st_size > 2000
    links = re.findall(r'(?:src|href)="([^"]{0,30})', page)
    assert len(links) >= len(names) + 1
    assert all(link.startswith("data:") for link in links)
    assert "<script" not in page


@pytest.mark.parametrize(
    ("chart", "column"),
    [
        (texels_scatter, "tau"),
        (texels_scatter, "epsilon"),
        (engines_chart, "renderers"),
        (surrogates_chart, "surrogate"),
        (between_chart, "image_pipeline"),
    ],
)
def test_charts_with_too_few_colours_begin_again(chart: Callable[[Sequence[ResultRow]], Drawing], column: str) -> None:
    assert chart([row(**{column: str(k / 10)}) for k in range(1, 10)]).panels


def test_a_report_shows_pictures_warnings_and_failures_and_takes_words_literally(tmp_path: Path) -> None:
    failed = row(key="b", object="pot", state="failed", error="a < b")
    rows = [row(key="a", warnings="<b>thin</b> | far"), failed, row(key="c", object="cup|saucer")]
    page = write_report(written(tmp_path / "some", rows)).read_text("utf-8")
    assert "Before and after, view by view" in page
    assert "&lt;b&gt;thin&lt;/b&gt;" in page
    assert "pot, seed 0: failed: a &lt; b" in page
    assert "<td>cup|saucer</td><td>0.05</td>" in page


def test_a_figure_is_the_same_for_the_same_rows_and_says_which_they_were(tmp_path: Path) -> None:
    data = read_data(written(tmp_path / "some", grid_rows()))
    first, again = (Data(tmp_path / name, data.rows, data.predictions).draw("table_one") for name in ("1", "2"))
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in again]
    assert data.stamp in first[0].read_text("utf-8")
    assert Data(data.folder, (*data.rows, row(object="pot")), data.predictions).stamp != data.stamp


def test_the_stamp_depends_neither_on_the_id_of_a_job_nor_on_columns_that_came_after_a_file_was_written() -> None:
    class Later(ResultRow):
        gloss: float | None = None

    assert stamp_of([row(job="1")]) == stamp_of([row(job="2")])
    assert stamp_of([row(seconds=1)]) != stamp_of([row(seconds=2)])
    assert stamp_of([Later.model_validate(ROW)]) == stamp_of([row()])
    assert stamp_of([Later.model_validate(ROW | {"gloss": 0.5})]) != stamp_of([row()])


def test_histograms_show_one_row_of_each_object_and_need_predictions() -> None:
    assert [each.object for each in histogram_rows(grid_rows())] == ["candle", "ewer"]
    with pytest.raises(SpecError, match="No predictions of the target views"):
        prediction_histograms([row()], [])


def test_classes_of_one_name_have_bars_of_their_own() -> None:
    said = [
        PredictionRow(key="k", views="target", moment=when, class_index=k, name="crane", true_class=k == 9, count=count)
        for when, k, count in (("before", 9, 60), ("after", 9, 6), ("after", 134, 54))
    ]
    (panel,) = prediction_histograms([row()], said).panels
    assert [label.get_text() for label in panel.get_yticklabels()] == ["crane (true class)", "crane"]
    assert [bar.get_bbox().width for bar in panel.patches if isinstance(bar, Rectangle)] == [60, 6, 0, 54]


DOCUMENT = "# Results\n\n<!-- trompe: table_one of experiments/some -->\n<!-- end -->\n\nWords.\n"


def test_a_document_is_filled_from_its_data_and_falls_outdated_with_them(tmp_path: Path) -> None:
    folder = written(tmp_path / "experiments" / "some", [row(tau=None)])
    document = tmp_path / "results.md"
    document.write_text(DOCUMENT)
    assert len(outdated(document)) == 2
    fill(document)
    text = document.read_text()
    assert "![A_drop per object, classifier and epsilon (the paper's Table I)](experiments/some/figures/" in text
    assert "Rows: [results.csv](experiments/some/results.csv)\n" in text
    assert "| candle |" not in text
    assert text.endswith("<!-- end -->\n\nWords.\n")
    assert outdated(document) == []
    fill(document)
    assert document.read_text() == text
    write_table(folder / RESULTS, [row(tau=None), row(object="pot")])
    assert len(outdated(document)) == 2
    told = CliRunner().invoke(main, ["experiment", "fill", str(document), "--check"])
    assert told.exit_code == 1
    assert "experiments/some/figures/table_one.svg is not made from" in told.output
    assert CliRunner().invoke(main, ["experiment", "fill", str(document)]).exit_code == 0
    assert CliRunner().invoke(main, ["experiment", "fill", str(document), "--check"]).exit_code == 0


def test_a_document_says_what_is_not_measured_yet_and_refuses_figures_that_do_not_exist_or_fit(tmp_path: Path) -> None:
    document = tmp_path / "results.md"
    document.write_text(DOCUMENT)
    fill(document)
    assert "*Not measured yet: experiments/some/results.csv is missing.*" in document.read_text()
    document.write_text(DOCUMENT.replace("table_one", "table_two"))
    with pytest.raises(SpecError, match="unknown figure 'table_two'; figures: table_one, scatter"):
        fill(document)
    written(tmp_path / "experiments" / "some", [row(target_a_drop=None)])
    document.write_text(DOCUMENT.replace("table_one", "scatter"))
    with pytest.raises(SpecError, match=r"'scatter' does not suit the rows of .*some'\. Suitable: none"):
        fill(document)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(DOCUMENT.replace("<!-- end -->", "Words.") + DOCUMENT, id="no end before the next block"),
        pytest.param(DOCUMENT.replace("<!-- end -->", ""), id="no end"),
        pytest.param(DOCUMENT.replace(" of ", " "), id="no folder"),
    ],
)
def test_a_block_that_is_none_is_told_and_the_words_after_it_stay(text: str, tmp_path: Path) -> None:
    document = tmp_path / "results.md"
    document.write_text(text)
    for work in (outdated, fill):
        with pytest.raises(SpecError, match=r"'<!-- trompe: table_one .* begins no block"):
            work(document)
    assert document.read_text() == text


def test_the_folder_of_a_figure_may_have_spaces(tmp_path: Path) -> None:
    written(tmp_path / "my results", [row(tau=None)])
    document = tmp_path / "results.md"
    document.write_text(DOCUMENT.replace("experiments/some", "my results"))
    assert fill(document)
    assert "Rows: [results.csv](my%20results/results.csv)\n" in document.read_text()
    assert outdated(document) == []


def test_the_projects_own_results_are_in_step_with_their_data() -> None:
    assert outdated(Path(__file__).parents[2] / "docs" / "experiments.md") == []


def test_an_experiment_without_rows_is_told(tmp_path: Path) -> None:
    write_table(tmp_path / RESULTS, [])
    for command in (["report"], ["show"], ["compare", str(tmp_path)]):
        told = CliRunner().invoke(main, ["experiment", *command, str(tmp_path)])
        assert told.exit_code == 2
        assert "has no rows yet" in told.output
