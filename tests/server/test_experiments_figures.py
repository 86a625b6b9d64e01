"""Figures and tables of experiments: what they count, that they say what they were made from, and that nothing is
missing from a report."""

import html
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from trompe_server.experiments.commands import main
from trompe_server.experiments.documents import fill, out_of_step
from trompe_server.experiments.figures import FIGURES, Data, figures_of, histogram_rows, plain_rows, read_data
from trompe_server.experiments.histograms import prediction_histograms
from trompe_server.experiments.paper_means import paper_means_markdown
from trompe_server.experiments.pareto import Configuration, configurations, pareto_front, pareto_markdown
from trompe_server.experiments.parquet import write_parquet
from trompe_server.experiments.report import write_report
from trompe_server.experiments.stability_chart import behaviours, stability_markdown
from trompe_server.experiments.style import stamp_of
from trompe_server.experiments.surrogates import surrogates_markdown
from trompe_server.experiments.table_one import paper_numbers, table_one, table_one_chart, table_one_markdown
from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import PREDICTIONS, RESULTS, PredictionRow, ResultRow, write_table

ROW: dict[str, Any] = {
    "experiment": "some",
    "key": "k",
    "state": "succeeded",
    "object": "candle",
    "label": "candle",
    "classifier": "mobilenet_v2",
    "epsilon": 0.05,
    "alpha": 0.01,
    "loss": "margin",
    "optimiser": "nesterov",
    "surrogate": "auto",
    "steps": 20,
    "restarts": 0,
    "seed": 0,
    "pool": 0,
    "background": "white",
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
    return ResultRow.model_validate(ROW | columns)


def prediction(key: str, moment: str, count: int, *, true: bool) -> PredictionRow:
    name = "candle" if true else "pot, flowerpot"
    index = 0 if true else 1
    return PredictionRow(
        key=key, views="target", moment=moment, class_index=index, name=name, true_class=true, count=count
    )


def point(cost: float, gain: float) -> Configuration:
    return Configuration("", f"{cost} {gain}", cost, gain, 0.0, None, None, 1)


def beats(one: Configuration, other: Configuration) -> bool:
    """Whether ``one`` is no worse in both, and better in one."""
    no_worse = one.cost <= other.cost and one.gain >= other.gain
    return no_worse and (one.cost < other.cost or one.gain > other.gain)


POINTS = st.lists(st.builds(point, st.floats(0.1, 100), st.floats(-1, 1)), max_size=30)


@given(POINTS)
def test_nothing_beats_a_point_of_the_front_and_something_beats_or_equals_every_other(
    points: list[Configuration],
) -> None:
    front = pareto_front(points)
    for each in points:
        if each in front:
            assert not any(beats(other, each) for other in points)
        else:
            assert any(beats(other, each) or (other.cost, other.gain) == (each.cost, each.gain) for other in front)


@given(POINTS)
def test_along_the_front_more_cost_gives_more(points: list[Configuration]) -> None:
    for cheap, dear in pairwise(pareto_front(points)):
        assert cheap.cost < dear.cost
        assert cheap.gain < dear.gain


@given(POINTS, st.randoms(use_true_random=False))
def test_the_front_does_not_depend_on_the_order(points: list[Configuration], random: Any) -> None:
    shuffled = random.sample(points, len(points))
    values = [[(each.cost, each.gain) for each in pareto_front(order)] for order in (points, shuffled)]
    assert values[0] == values[1]


def test_configurations_are_means_over_the_objects_that_all_of_them_have() -> None:
    rows = [
        row(series="steps", configuration="steps 5", object="mug", held_out_a_drop=0.4, seconds=10, seed=0),
        row(series="steps", configuration="steps 5", object="mug", held_out_a_drop=0.6, seconds=20, seed=1),
        row(series="steps", configuration="steps 5", object="lamp", held_out_a_drop=0.0, seconds=99),
        row(series="steps", configuration="steps 9", object="mug", held_out_a_drop=0.8, seconds=30),
    ]
    short, long = configurations(rows)
    assert (short.gain, short.cost, short.jobs) == pytest.approx((0.5, 15, 2))
    assert short.spread == pytest.approx(0.1414, abs=1e-3)
    assert (long.gain, long.cost) == (0.8, 30)
    assert "**steps 5**" in pareto_markdown(rows)


def test_what_all_configurations_of_a_series_share_is_left_out_of_their_names() -> None:
    rows = [
        row(series="preset x held_out", configuration=f"preset {name}, held_out 100") for name in ("fast", "best")
    ] + [row(series="optimiser x steps", configuration="optimiser fgsm, steps 1")]
    named = [(each.series, each.name) for each in configurations(rows)]
    assert named == [
        ("preset", "preset fast"),
        ("preset", "preset best"),
        ("optimiser x steps", "optimiser fgsm, steps 1"),
    ]


def test_the_table_has_both_costs_and_says_on_which_front_a_configuration_is() -> None:
    rows = [
        row(series="steps", configuration="steps 5", seconds=10, evaluations=500, held_out_a_drop=0.4),
        row(series="steps", configuration="steps 9", seconds=30, evaluations=400, held_out_a_drop=0.6),
        row(series="steps", configuration="steps 90", seconds=90, evaluations=900, held_out_a_drop=0.5),
    ]
    text = pareto_markdown(rows)
    assert "| steps | **steps 5** | 10 | 500 | 0.40 | 0.90 | 0.10 | time | 1 |" in text
    assert "| steps | **steps 9** | 30 | 400 | 0.60 | 0.90 | 0.10 | time, images | 1 |" in text
    assert "| steps | steps 90 | 90 | 900 |" in text


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
    assert "| preset best | 90 | 0.90 | on it; nothing does more |" in text


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
    assert "| candle | 0.80 | 1.00 | **0.90** | 1.00 | 0.76 |" in text
    assert "| **mean** of those with A_before ≥ 0.3 |  | **1.00** | **0.90** | **1.00** | **0.76** |" in text


def test_each_classifier_fills_a_row_of_its_own_however_many_budgets_it_was_given() -> None:
    asked = {"squeezenet1_1": [0.5, 0.05], "mobilenet_v2": [0.01, 0.02, 0.05, 0.1, 0.5]}
    made = table_one_chart([row(classifier=name, epsilon=epsilon) for name, some in asked.items() for epsilon in some])
    titles = [panel.get_title(loc="left") for panel in made.panels]
    assert titles == [f"{name}, ε = {epsilon:g}" for name, some in asked.items() for epsilon in sorted(some)]
    assert all(panel.lines for panel in made.panels)
    made.figure.draw_without_rendering()
    ends = [panel.get_position().x1 for panel in made.panels]
    assert ends[1] == pytest.approx(ends[-1], abs=0.01)


def test_another_network_stands_beside_inceptions_means() -> None:
    text = table_one_markdown([row(classifier="squeezenet1_1")])
    assert "its InceptionV3" in text
    assert "0.31 at ε 0.05" in text
    assert "paper: target" not in text


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
        r"\| silent .*breaks, UNNOTICED",
        r"\| told .*breaks, said so \| The surrogate is off",
        r"\| unforeseen: jpeg .*could not know",
        r"\| not seen .*n\.a\., said so",
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
    assert "| candle | 0.80 | 1.00 | **0.30** | 40.0% | 1.00 | **0.90** | 40.0% |" in everything
    mean = next(line for line in salient.splitlines() if line.startswith("| **mean**"))
    assert mean.endswith("| 1.00 | **0.30** | 20.0% | 1.00 | **0.90** | 20.0% |")
    hardly = [each for each in surrogate_rows() if each.object == "toilet"]
    assert surrogates_markdown(hardly).count("| n.a. | **n.a.** | n.a. | n.a. | **n.a.** | n.a. |") == 2


def test_the_grid_at_a_glance_averages_what_was_recognised_and_sets_the_papers_means_beside_it() -> None:
    rows = [
        row(key="a", target_a_drop=1.0, texels_altered=0.5, transfer_gap=-0.02),
        row(key="b", object="plunger", target_a_drop=0.5, texels_altered=0.3, transfer_gap=0.04),
        row(key="c", object="toilet", target_a_before=0.1, target_a_drop=0.0, texels_altered=0.9, transfer_gap=0.9),
        row(key="d", tau=0.2, target_a_drop=0.4, texels_altered=0.1, transfer_gap=0.0),
        row(key="e", epsilon=0.02, target_a_drop=0.25, texels_altered=0.5, transfer_gap=None),
        row(key="f", classifier="squeezenet1_1", target_a_drop=0.75, texels_altered=0.2, transfer_gap=0.0),
    ]
    head, _, *lines = paper_means_markdown(rows).splitlines()
    assert head.endswith("| ε 0.02 | ε 0.05 | paper's |")
    assert lines == [
        "| mobilenet_v2 | all texels | 2 | 0.030 | **0.25** (50%) | **0.75** (40%) | 0.59 (27%) |",
        "| mobilenet_v2 | saliency, τ 0.2 | 1 | 0.000 |  | **0.40** (10%) | 0.27 (5%) |",
        "| squeezenet1_1 | all texels | 1 | 0.000 |  | **0.75** (20%) |  |",
        "| inception_v3 | all texels |  |  |  |  | 0.31 (30%) |",
        "| inception_v3 | saliency, τ 0.2 |  |  |  |  | 0.13 (5%) |",
    ]


def test_jobs_that_not_every_surrogate_has_are_in_no_comparison_and_one_surrogate_alone_is_in_the_other_figures(
    tmp_path: Path,
) -> None:
    alone = row(key="alone", object="pot", surrogate="diffuse", epsilon=0.1)
    assert surrogates_markdown([*surrogate_rows(), alone]) == surrogates_markdown(surrogate_rows())
    data = read_data(written(tmp_path / "some", [*surrogate_rows(), alone]))
    assert {each.surrogate for each in data.rows} == {"diffuse", "calibrated"}
    assert {each.surrogate for each in (*data.grid, *plain_rows(data))} == {"diffuse"}


def test_a_budget_that_the_paper_has_not_got_has_no_columns_of_the_paper() -> None:
    head, *_ = table_one_markdown([row(), row(epsilon=0.01)]).splitlines()[2:]
    columns = ["object", "A_before", "surrogate, ε 0.01", "target", "surrogate, ε 0.05", "target", "paper: surrogate"]
    assert head == "| " + " | ".join([*columns, "paper: target"]) + " |"


def test_a_job_that_found_a_calibration_costs_what_it_would_have_cost_without() -> None:
    asked = row(key="a", series="loss", configuration="loss margin", probe_renders=124, calibrate_s=8.0, seconds=20.0)
    found = row(key="b", series="loss", configuration="loss dlr", probe_renders=0, calibrate_s=0.5, seconds=12.0)
    other = row(key="c", series="pool", configuration="pool 20", pool=20, probe_renders=0, calibrate_s=0.5, seconds=9.0)
    assert [each.cost for each in configurations([asked, found, other])] == [20.0, 19.5, 9.0]


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


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        pytest.param(grid_rows(), ["table_one", "scatter", "histograms"], id="grid"),
        pytest.param(series_rows(), ["speed_accuracy", "evaluations_accuracy"], id="series"),
        pytest.param(stability_rows(), ["stability"], id="cases"),
        pytest.param(surrogate_rows(), ["table_one", "scatter", "surrogates", "histograms"], id="surrogates"),
        pytest.param(
            [*grid_rows(), row(key="small", series="small", epsilon=0.01, alpha=0.004, configuration="epsilon 0.01")],
            ["table_one", "scatter", "histograms"],
            id="grid in two series",
        ),
    ],
)
def test_a_report_holds_what_fits_its_rows_and_needs_nothing_else(
    rows: list[ResultRow], names: list[str], tmp_path: Path
) -> None:
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


def test_a_report_shows_pictures_warnings_and_failures_and_takes_words_literally(tmp_path: Path) -> None:
    rows = [row(key="a", warnings="<b>thin</b> | far"), row(key="b", object="pot", state="failed", error="a < b")]
    page = write_report(written(tmp_path / "some", rows)).read_text("utf-8")
    assert "Before and after, view by view" in page
    assert "&lt;b&gt;thin&lt;/b&gt;" in page
    assert "pot, seed 0: failed: a &lt; b" in page


def test_a_bar_in_a_name_stays_in_its_cell_in_the_report(tmp_path: Path) -> None:
    page = write_report(written(tmp_path / "some", [row(object="cup|saucer")])).read_text("utf-8")
    assert "<td>cup|saucer</td><td>0.80</td>" in page


def test_a_figure_is_the_same_for_the_same_rows_and_says_which_they_were(tmp_path: Path) -> None:
    data = read_data(written(tmp_path / "some", grid_rows()))
    first, again = (Data(tmp_path / name, data.rows, data.predictions).draw("table_one") for name in ("1", "2"))
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in again]
    assert data.stamp in first[0].read_text("utf-8")
    assert Data(data.folder, (*data.rows, row(object="pot")), data.predictions).stamp != data.stamp


def test_the_stamp_does_not_depend_on_the_id_of_a_job() -> None:
    assert stamp_of([row(job="1")]) == stamp_of([row(job="2")])
    assert stamp_of([row(seconds=1)]) != stamp_of([row(seconds=2)])


def test_a_column_that_came_after_a_file_was_written_does_not_change_its_stamp() -> None:
    class Later(ResultRow):
        gloss: float | None = None

    assert stamp_of([Later.model_validate(ROW)]) == stamp_of([row()])
    assert stamp_of([Later.model_validate(ROW | {"gloss": 0.5})]) != stamp_of([row()])


def test_histograms_need_predictions() -> None:
    with pytest.raises(SpecError, match="no predictions of the target views"):
        prediction_histograms([row()], [])


def test_histograms_show_one_row_of_each_object() -> None:
    assert [each.object for each in histogram_rows(grid_rows())] == ["candle", "ewer"]


DOCUMENT = "# Results\n\n<!-- trompe: table_one of experiments/some -->\n<!-- end -->\n\nWords.\n"


def test_a_document_is_filled_from_its_data_and_falls_out_of_step_with_them(tmp_path: Path) -> None:
    folder = written(tmp_path / "experiments" / "some", grid_rows())
    document = tmp_path / "results.md"
    document.write_text(DOCUMENT)
    assert len(out_of_step(document)) == 2
    fill(document)
    text = document.read_text()
    assert "![A_drop per object, classifier and epsilon (the paper's Table I)](experiments/some/figures/" in text
    assert "| candle | 0.80 |" in text
    assert text.endswith("<!-- end -->\n\nWords.\n")
    assert out_of_step(document) == []
    fill(document)
    assert document.read_text() == text
    write_table(folder / RESULTS, [*grid_rows(), row(object="pot")])
    assert len(out_of_step(document)) == 2
    told = CliRunner().invoke(main, ["fill", str(document), "--check"])
    assert told.exit_code == 1
    assert "experiments/some/figures/table_one.svg is not made from" in told.output
    assert CliRunner().invoke(main, ["fill", str(document)]).exit_code == 0
    assert CliRunner().invoke(main, ["fill", str(document), "--check"]).exit_code == 0


def test_a_document_says_what_is_not_measured_yet_and_refuses_figures_that_do_not_exist(tmp_path: Path) -> None:
    document = tmp_path / "results.md"
    document.write_text(DOCUMENT)
    fill(document)
    assert "*Not measured yet: experiments/some/results.csv is missing.*" in document.read_text()
    document.write_text(DOCUMENT.replace("table_one", "table_two"))
    with pytest.raises(SpecError, match="a figure 'table_two'; there are table_one, scatter"):
        fill(document)


@pytest.mark.parametrize("document", ["README.md", "docs/experiments.md"])
def test_the_projects_own_documents_are_in_step_with_their_data(document: str) -> None:
    assert out_of_step(Path(__file__).parents[2] / document) == []


def test_an_experiment_without_rows_is_told(tmp_path: Path) -> None:
    write_table(tmp_path / RESULTS, [])
    told = CliRunner().invoke(main, ["report", str(tmp_path)])
    assert told.exit_code == 1
    assert "has no row yet" in told.output


def test_parquet_holds_the_same_numbers(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    folder = written(tmp_path / "some", grid_rows())
    table = parquet.read_table(write_parquet(folder))
    assert table.column("epsilon").to_pylist() == [each.epsilon for each in grid_rows()]
    assert table.column("tau").to_pylist() == [each.tau for each in grid_rows()]
    assert table.column("object").to_pylist()[0] == "candle"
    assert table.column("diverse").to_pylist() == [None] * len(grid_rows())
    write_table(folder / RESULTS, [row(diverse=True), row(diverse=False)])
    assert parquet.read_table(write_parquet(folder)).column("diverse").to_pylist() == [True, False]
