"""The pictures of a result."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from trompe_server.reports import (
    TransferMatrix,
    Verdict,
    contact_sheet,
    difference_strip,
    heat_colours,
    heat_textures,
    prediction_histogram,
    representative,
    saliency_object_sheet,
    saliency_sheet,
    saliency_texture_sheet,
    texture_sheet,
    transfer_matrix,
    transfer_picture,
)
from trompe_server.reports.contact_sheet import FRAME, TILE
from trompe_server.reports.difference import amplified_difference
from trompe_server.reports.heat import BAR, GREY, OUTLINE, TICKS, heat_legend, heat_over
from trompe_server.reports.histogram import AFTER, BARS, BEFORE
from trompe_server.reports.layout import (
    CAPTION,
    GREEN,
    INK,
    MARGIN,
    PAPER,
    RED,
    Align,
    captioned,
    line,
    printable,
    shortened,
    stacked,
    text_width,
)
from trompe_server.reports.saliency_sheet import TILE as SALIENCY_TILE
from trompe_shared.api import Accuracy, Judgement, Result, SaliencyScope

BLUE = (40, 80, 160)
BELOW_LEGEND = 120
"""Row of a saliency sheet from which on there are views."""


def images(count: int, size: tuple[int, int] = (32, 32)) -> np.ndarray:
    return np.full((count, *size, 3), BLUE, np.uint8)


def verdicts(correct: list[bool], label: str = "mug") -> list[Verdict]:
    return [Verdict(label, 0.5, right) for right in correct]


def sheet_of(
    correct: list[tuple[bool, bool]], *, columns: int = 3, label: str = "mug", title: str = "t"
) -> Image.Image:
    before, after = zip(*correct, strict=True)
    count = len(correct)
    return contact_sheet(
        images(count),
        images(count),
        verdicts(list(before), label),
        verdicts(list(after), label),
        title=title,
        columns=columns,
    )


def frames(sheet: Image.Image) -> list[tuple[int, int, int]]:
    """Frame colours in reading order: of each top left corner whose other corners have its colour too."""
    pixels, side = np.array(sheet), TILE + 2 * FRAME - 1
    found: dict[tuple[int, int], tuple[int, int, int]] = {}
    for colour in (GREEN, RED):
        mask = np.pad((pixels == colour).all(axis=2), ((1, side), (1, side)))
        here, up, left = mask[1:-side, 1:-side], mask[: -side - 1, 1:-side], mask[1:-side, : -side - 1]
        others = mask[1 + side :, 1:-side] & mask[1:-side, 1 + side :] & mask[1 + side :, 1 + side :]
        found |= {(int(y), int(x)): colour for y, x in np.argwhere(here & ~up & ~left & others)}
    return [found[corner] for corner in sorted(found)]


def test_frames_are_green_where_the_class_is_the_objects_and_red_where_not() -> None:
    sheet = sheet_of([(True, False), (True, True), (False, False)], columns=2)
    assert frames(sheet) == [GREEN, RED, GREEN, GREEN, RED, RED]


@pytest.mark.parametrize(("count", "columns", "rows"), [(1, 3, 1), (3, 3, 1), (5, 2, 3), (7, 3, 3)])
def test_a_sheet_has_as_many_pairs_as_views_in_rows_of_columns(count: int, columns: int, rows: int) -> None:
    sheet = sheet_of([(True, False)] * count, columns=columns)
    assert len(frames(sheet)) == 2 * count
    one_row, two_rows = (sheet_of([(True, False)] * columns * n, columns=columns).height for n in (1, 2))
    assert sheet.height == one_row + (rows - 1) * (two_rows - one_row)


def test_nothing_is_drawn_in_the_margin() -> None:
    pixels = np.array(sheet_of([(True, False)] * 4, title="a very long title " * 20))
    inner = np.zeros(pixels.shape[:2], bool)
    inner[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    assert (pixels[~inner] == 255).all()


def test_the_same_arguments_give_the_same_bytes() -> None:
    assert sheet_of([(True, False)] * 2).tobytes() == sheet_of([(True, False)] * 2).tobytes()


@pytest.mark.parametrize("label", ["", "x" * 300, "tasse à café", "茶碗", "🫖", "line\nbreak"])
def test_any_class_name_leaves_the_sheet_as_it_is(label: str) -> None:
    assert sheet_of([(True, False)], label=label).size == sheet_of([(True, False)]).size


def test_only_the_first_name_of_a_class_is_shown() -> None:
    both, first = (sheet_of([(True, True)], label=label) for label in ("mug, coffee cup", "mug"))
    assert both.tobytes() == first.tobytes()


def test_a_contact_sheet_needs_a_verdict_for_each_image() -> None:
    with pytest.raises(ValueError, match="zip"):
        contact_sheet(images(2), images(2), verdicts([True]), verdicts([True, True]), title="t")


def test_a_sheet_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet(images(0), images(0), [], [], title="t")


@given(st.integers(1, 200), st.integers(1, 40))
def test_representative_views_are_few_distinct_and_spread_evenly(n: int, k: int) -> None:
    chosen = representative(n, k)
    assert len(chosen) == min(n, k)
    assert chosen == sorted(set(chosen))
    assert all(0 <= index < n for index in chosen)
    if len(chosen) > 1:
        gaps = np.diff(chosen)
        assert (chosen[0], chosen[-1]) == (0, n - 1)
        assert gaps.max() - gaps.min() <= 1


@given(st.text(), st.integers(30, 300))
def test_shortened_text_fits(text: str, width: int) -> None:
    picture = Image.new("RGB", (width, 10), (255, 255, 255))
    card = np.array(captioned(picture, text))
    assert card.shape[1] == width
    short = shortened(text, width, size=CAPTION)
    assert short == printable(text) or short.endswith("...")


def test_accents_are_dropped_and_other_letters_become_question_marks() -> None:
    assert printable("Café 茶 — naïve") == "Cafe ? ? naive"


def test_a_difference_is_amplified_without_sign_and_cut_at_white() -> None:
    before, after = np.array([[[10, 100, 200]]], np.uint8), np.array([[[13, 90, 100]]], np.uint8)
    assert amplified_difference(before, after).tolist() == [[[30, 100, 255]]]
    assert amplified_difference(after, before).tolist() == [[[30, 100, 255]]]


@pytest.mark.parametrize("count", [1, 3])
def test_a_difference_strip_has_a_row_for_each_view(count: int) -> None:
    one, strip = (difference_strip(images(n), images(n), title="t") for n in (1, count))
    assert strip.width == one.width
    rows = (np.array(strip) == BLUE).all(axis=2).any(axis=1)
    assert np.count_nonzero(np.diff(rows.astype(int)) == 1) == count


def test_a_texture_sheet_shows_every_texture_whatever_its_form() -> None:
    before = {"b.png": images(1, (8, 64))[0], "a.png": images(1, (64, 32))[0]}
    sheet = texture_sheet(before, before, title="t")
    assert sheet.tobytes() == texture_sheet(dict(reversed(before.items())), before, title="t").tobytes()
    rows = (np.array(sheet) == BLUE).all(axis=2).any(axis=1)
    assert np.count_nonzero(np.diff(rows.astype(int)) == 1) == 2


@given(st.floats(0, 1), st.floats(0, 1))
def test_heat_grows_lighter_with_the_value(a: float, b: float) -> None:
    low, high = heat_colours(np.array(sorted((a, b)))) @ (0.2126, 0.7152, 0.0722)
    assert low <= high + 1e-3


def test_heat_outside_0_1_is_the_nearest_end() -> None:
    np.testing.assert_array_equal(heat_colours(np.array([-1.0, 2.0])), heat_colours(np.array([0.0, 1.0])))


def test_saliency_is_outlined_where_it_reaches_tau_and_only_there() -> None:
    maps = np.zeros((2, 32, 32), np.float32)
    maps[0, 8:24, 8:24] = 0.5
    with_mask, without = (saliency_sheet(images(1), maps[i : i + 1], tau=0.5, title="t") for i in (0, 1))
    outlined, none = ((np.array(sheet)[BELOW_LEGEND:] == OUTLINE).all(axis=2) for sheet in (with_mask, without))
    assert not none.any()
    ys, xs = np.nonzero(outlined)
    side = SALIENCY_TILE // 2
    assert ys.max() - ys.min() + 1 == xs.max() - xs.min() + 1 == side
    assert outlined.sum() == 4 * (side - 1)


def test_the_legend_says_which_views_saliency_is_compared_over() -> None:
    maps = np.zeros((3, 32, 32), np.float32)
    together, alone = (
        np.array(saliency_sheet(images(3), maps, tau=0.5, scope=scope, title="t")) for scope in get_args(SaliencyScope)
    )
    assert (together[:BELOW_LEGEND] != alone[:BELOW_LEGEND]).any()
    np.testing.assert_array_equal(alone[BELOW_LEGEND:], together[BELOW_LEGEND:])
    np.testing.assert_array_equal(together, saliency_sheet(images(3), maps, tau=0.5, title="t"))


def test_saliency_without_tau_has_no_outline() -> None:
    maps = np.ones((3, 32, 32), np.float32)
    sheet = saliency_sheet(images(3), maps, tau=None, title="t", columns=2)
    assert not (np.array(sheet) == OUTLINE).all(axis=2).any()


def test_saliency_is_painted_over_the_image_only_where_there_is_some() -> None:
    maps = np.zeros((1, 32, 32), np.float32)
    maps[0, :, 16:] = 1
    pixels = {
        tuple(int(c) for c in p) for p in np.array(saliency_sheet(images(1), maps, tau=None, title="")).reshape(-1, 3)
    }
    assert tuple(round(c * 0.6) for c in BLUE) in pixels
    assert tuple(int(c) for c in heat_colours(np.array(1.0))) in pixels


def test_the_outline_is_explained_where_there_is_one() -> None:
    maps = np.zeros((1, 32, 32), np.float32)
    with_tau, without = (np.array(saliency_sheet(images(1), maps, tau=tau, title="t")) for tau in (0.5, None))
    assert (with_tau[:BELOW_LEGEND] == OUTLINE).all(axis=2).any()
    assert not (without == OUTLINE).all(axis=2).any()


@pytest.mark.parametrize("value", TICKS)
def test_the_legend_shows_a_value_in_the_colour_that_a_picture_has_there(value: float) -> None:
    grey, bar = np.full((1, 1, 3), GREY, np.uint8), np.array(heat_legend(""))[: BAR[1]]
    shown = heat_over(grey, np.full((1, 1), value))[0, 0]
    places = np.flatnonzero((np.abs(bar[0].astype(int) - shown) <= 3).all(axis=1))
    start = bar.shape[1] - BAR[0]
    assert places.min() - 3 <= start + value**0.5 * (BAR[0] - 1) <= places.max() + 3


@given(st.sampled_from(["left", "centre", "right"]), st.integers(20, 200))
def test_a_line_stays_within_its_width_on_its_ground(align: Align, width: int) -> None:
    picture = np.array(line("some words", width, align=align, ground=BLUE, colour=PAPER))
    assert picture.shape[1] == width
    letters = np.flatnonzero((picture != BLUE).any(axis=(0, 2)))
    room = width - text_width("some words", size=CAPTION)
    if room > 4:
        expected = {"left": 0, "centre": room // 2, "right": room}[align]
        assert abs(letters.min() - expected) <= 2


def test_stacked_pictures_keep_their_left_sides_and_their_order() -> None:
    column = np.array(stacked([Image.new("RGB", (5, 2), RED), Image.new("RGB", (3, 4), GREEN)], gap=1))
    assert column.shape == (7, 5, 3)
    assert (column[:2] == RED).all()
    assert (column[2] == PAPER).all()
    assert (column[3:, :3] == GREEN).all()
    assert (column[3:, 3:] == PAPER).all()


# Saliency on the textures


def scores() -> dict[str, np.ndarray]:
    found = {"a.png": np.zeros((40, 40), np.float32), "b.png": np.zeros((10, 20), np.float32)}
    found["a.png"][:20] = 4.0
    found["b.png"][:5] = 1.0
    return found


def textures() -> dict[str, np.ndarray]:
    return {name: images(1, score.shape)[0] for name, score in scores().items()}


def test_scores_are_painted_on_one_scale_for_all_textures() -> None:
    heat = heat_textures(textures(), scores())
    assert {name: texture.shape for name, texture in heat.items()} == {"a.png": (40, 40, 3), "b.png": (10, 20, 3)}
    for name, value in (("a.png", 1.0), ("b.png", 0.25)):
        hot = heat_over(images(1, (1, 1))[0], np.full((1, 1), value))[0, 0]
        cold = heat_over(images(1, (1, 1))[0], np.zeros((1, 1)))[0, 0]
        rows = len(heat[name]) // 2
        assert (heat[name][:rows] == hot).all()
        assert (heat[name][rows:] == cold).all()


@given(st.floats(1e-6, 1e6))
def test_the_unit_of_the_scores_does_not_matter(unit: float) -> None:
    scaled = {name: score * unit for name, score in scores().items()}
    for name, texture in heat_textures(textures(), scaled).items():
        np.testing.assert_array_equal(texture, heat_textures(textures(), scores())[name])


def test_a_few_extreme_texels_do_not_darken_the_others() -> None:
    extreme = scores()
    extreme["a.png"][0, 0] = 1e9
    for name, texture in heat_textures(textures(), extreme).items():
        np.testing.assert_array_equal(texture, heat_textures(textures(), scores())[name])


def test_textures_that_nothing_depends_on_are_only_dimmed() -> None:
    nothing = {name: score * 0 for name, score in scores().items()}
    for texture in heat_textures(textures(), nothing).values():
        assert (texture == [round(0.6 * c) for c in BLUE]).all()
    assert saliency_texture_sheet(textures(), nothing, title="t").size == (
        saliency_texture_sheet(textures(), scores(), title="t").size
    )


def test_a_texture_and_its_heat_stand_side_by_side_in_the_order_of_names() -> None:
    sheet = saliency_texture_sheet(textures(), scores(), title="t")
    assert sheet.tobytes() == saliency_texture_sheet(dict(reversed(textures().items())), scores(), title="t").tobytes()
    rows = (np.array(sheet) == BLUE).all(axis=2).any(axis=1)
    assert np.count_nonzero(np.diff(rows.astype(int)) == 1) == 2


def test_the_object_is_shown_as_it_is_with_its_views_saliency_and_in_its_heat() -> None:
    maps = np.zeros((2, 32, 32), np.float32)
    maps[:, :16] = 1e-3
    worn = np.full((2, 32, 32, 3), RED, np.uint8)
    sheet = np.array(saliency_object_sheet(images(2), maps, worn, title="t", columns=1))
    hottest = heat_colours(np.array(1.0)).astype(np.uint8)
    order = [np.flatnonzero((sheet == colour).all(axis=2).any(axis=0)).min() for colour in (BLUE, hottest, RED)]
    assert order[0] < order[2]
    assert (sheet[BELOW_LEGEND:] == hottest).all(axis=2).any()
    with pytest.raises(ValueError, match="zip"):
        saliency_object_sheet(images(2), maps, worn[:1], title="t")


# Predictions


def bars(sheet: Image.Image, colour: tuple[int, int, int]) -> list[int]:
    """Lengths of the bars of a colour from the top, without the legend's square."""
    found = (np.array(sheet) == colour).all(axis=2).sum(axis=1)
    starts = np.flatnonzero(np.diff((found > 0).astype(int), prepend=0) == 1)
    return [int(found[start]) for start in starts][1:]


def test_bars_are_as_long_as_the_share_of_the_views() -> None:
    sheet = prediction_histogram({"mug": 30, "cup": 10}, {"cup": 15, "vase": 5}, label="mug", title="t")
    assert bars(sheet, BEFORE) == [round(0.75 * BARS), round(0.25 * BARS)]
    assert bars(sheet, AFTER) == [round(0.75 * BARS), round(0.25 * BARS)]


def test_the_objects_own_class_comes_first_even_if_it_was_never_given() -> None:
    sheet = prediction_histogram({"cup": 4}, {"cup": 4}, label="mug", title="t")
    assert bars(sheet, BEFORE) == [BARS]
    one_class = prediction_histogram({"mug": 4}, {"mug": 4}, label="mug", title="t")
    assert sheet.height > one_class.height


def test_rare_classes_are_counted_together() -> None:
    many = {f"class {k}": 1 for k in range(20)}
    sheet = prediction_histogram({"mug": 20}, many, label="mug", title="t", top=4)
    assert bars(sheet, AFTER) == [round(BARS / 20)] * 4 + [round(BARS * 16 / 20)]


def test_the_sum_of_all_bars_is_all_views() -> None:
    before, after = {"mug": 7, "a": 2, "b": 1}, {"a": 3, "c": 5, "d": 2}
    sheet = prediction_histogram(before, after, label="mug", title="t", top=2)
    assert sum(bars(sheet, BEFORE)) == pytest.approx(BARS, abs=3)
    assert sum(bars(sheet, AFTER)) == pytest.approx(BARS, abs=3)


def test_a_histogram_needs_a_view() -> None:
    with pytest.raises(ValueError, match="at least one view"):
        prediction_histogram({}, {}, label="mug", title="t")


# Transfer


def judged(before: float, drop: float | None) -> Accuracy:
    after = None if drop is None else before * (1 - drop)
    return Accuracy.model_construct(views=100, a_before=before, a_after=after, a_drop=drop)


def result(classifier: str, own: Accuracy, **others: Accuracy) -> Result:
    judges = [Judgement(classifier=name, target=one, held_out=None) for name, one in others.items()]
    return Result.model_construct(classifier=classifier, target=own, held_out=None, judges=judges)


RESULTS = [
    result("a", judged(0.9, 1.0), b=judged(0.8, 0.2), c=judged(0.0, None)),
    result("a", judged(0.9, 0.8), b=judged(0.4, 0.6), c=judged(0.1, 0.9)),
    result("b", judged(0.9, 0.9), a=judged(0.9, -0.1)),
]


def test_the_transfer_matrix_has_the_mean_drop_of_each_attacked_and_judging_classifier() -> None:
    matrix = transfer_matrix(RESULTS, views="target")
    assert (matrix.attacked, matrix.judging) == (("a", "b"), ("a", "b", "c"))
    assert matrix.drops[0] == (pytest.approx(0.9), pytest.approx(0.4), None)
    assert matrix.drops[1] == (-0.1, 0.9, None)
    assert matrix.counts == ((2, 2, 0), (1, 1, 0))


def test_judges_that_hardly_recognised_the_object_do_not_count() -> None:
    assert transfer_matrix(RESULTS, views="target", least_before=0.05).drops[0][2] == 0.9
    assert transfer_matrix(RESULTS, views="target", least_before=0.5).counts == ((2, 1, 0), (1, 1, 0))


def test_results_that_were_not_judged_on_held_out_views_say_nothing_of_them() -> None:
    matrix = transfer_matrix(RESULTS, views="held_out")
    assert set(sum(matrix.drops, ())) == {None}
    assert transfer_matrix([], views="target") == TransferMatrix((), (), (), ())


def test_the_matrix_is_written_for_people_and_for_programs() -> None:
    matrix = TransferMatrix(("a", "x|y"), ("a", "b"), ((1.0, None), (-0.126, 0.5)), ((3, 0), (2, 1)))
    assert matrix.markdown().splitlines() == [
        r"| attacked \ judged by | a | b |",
        "|---|---:|---:|",
        "| a | 1.00 (3) | n.a. |",
        r"| x\|y | -0.13 (2) | 0.50 (1) |",
    ]
    assert matrix.csv().splitlines() == [
        "attacked,judge,a_drop,results",
        "a,a,1,3",
        "a,b,,0",
        "x|y,a,-0.126,2",
        "x|y,b,0.5,1",
    ]


def test_the_matrix_is_drawn_in_colours_of_its_drops_and_grey_where_there_are_none() -> None:
    matrix = TransferMatrix(("a", "b"), ("a", "b"), ((1.0, None), (0.0, 2.0)), ((3, 0), (2, 1)))
    pixels = np.array(transfer_picture(matrix, title="t"))
    hot, cold = (heat_colours(np.array(value)).round() for value in (1.0, 0.0))
    counts = [int((pixels == colour).all(axis=2).sum()) for colour in (hot, cold, (225, 225, 225))]
    assert counts[0] > 1.8 * counts[1]
    assert min(counts) > 5000
    assert (pixels == INK).all(axis=2).any()
