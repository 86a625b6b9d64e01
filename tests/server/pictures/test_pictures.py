"""The pictures of a result."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from trompe_server.pictures import (
    Verdict,
    difference_strip,
    heat_textures,
    prediction_histogram,
    representative,
    saliency_object_sheet,
    saliency_sheet,
    saliency_texture_sheet,
    texture_sheet,
    views_sheet,
)
from trompe_server.pictures.contact_sheet import FRAME, TILE, contact_sheet, extremes
from trompe_server.pictures.difference import amplified_difference
from trompe_server.pictures.histogram import AFTER, BARS, BEFORE, TOP
from trompe_server.pictures.layout import (
    CAPTION,
    GREEN,
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
    tile,
)
from trompe_server.pictures.saliency import BAR, GREY, OUTLINE, TICKS, heat_colours, heat_legend, heat_over
from trompe_server.pictures.saliency import TILE as SALIENCY_TILE
from trompe_shared.geometry import Camera

BLUE = (40, 80, 160)
BELOW_LEGEND = 120
"""Row of a saliency sheet from which on there are views."""


def images(count: int, size: tuple[int, int] = (32, 32)) -> np.ndarray:
    return np.full((count, *size, 3), BLUE, np.uint8)


def sheet_of(correct: list[tuple[bool, bool]], *, label: str = "mug", title: str = "t") -> Image.Image:
    (image,) = images(1)
    views = [(image, image, *(Verdict(label, 0.5, right) for right in both)) for both in correct]
    return contact_sheet(views, title=title, facts="facts")


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
    sheet = sheet_of([(True, False), (True, True), (False, False), (False, True)])
    assert frames(sheet) == [GREEN, RED, GREEN, GREEN, RED, RED, RED, GREEN]


@pytest.mark.parametrize(("count", "rows"), [(1, 1), (3, 1), (7, 3)])
def test_a_sheet_has_as_many_pairs_as_views_in_rows_of_three(count: int, rows: int) -> None:
    sheet = sheet_of([(True, False)] * count)
    assert len(frames(sheet)) == 2 * count
    one_row, two_rows = (sheet_of([(True, False)] * 3 * n).height for n in (1, 2))
    assert sheet.height == one_row + (rows - 1) * (two_rows - one_row)


def test_nothing_is_drawn_in_the_margin() -> None:
    pixels = np.array(sheet_of([(True, False)] * 4, title="a very long title " * 20))
    inner = np.zeros(pixels.shape[:2], bool)
    inner[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    assert (pixels[~inner] == 255).all()


@pytest.mark.parametrize("label", ["", "x" * 300, "tasse à café", "茶碗", "🫖", "line\nbreak"])
def test_any_class_name_leaves_the_sheet_as_it_is(label: str) -> None:
    assert sheet_of([(True, False)], label=label).size == sheet_of([(True, False)]).size


def test_the_same_arguments_give_the_same_bytes_and_only_the_first_name_of_a_class_counts() -> None:
    both, first, again = (sheet_of([(True, True)], label=label) for label in ("mug, coffee cup", "mug", "mug"))
    assert both.tobytes() == first.tobytes() == again.tobytes()


def test_a_sheet_of_views_of_which_none_was_recognised_shows_representative_ones() -> None:
    verdicts = [Verdict("mug", 0.5, False)] * 30
    sheet = views_sheet((images(30), images(30)), (verdicts, verdicts), [Camera(1, 0, 0)] * 30, title="t")
    assert frames(sheet) == [RED] * 24


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


def sphere(n: int, seed: int) -> np.ndarray:
    """Random unit vectors (n, 3)."""
    points = np.random.default_rng(seed).normal(size=(n, 3))
    unit: np.ndarray = points / np.linalg.norm(points, axis=1, keepdims=True)
    return unit


@given(st.integers(0, 80), st.integers(1, 12), st.integers(0, 99))
def test_extreme_views_are_distinct_from_the_hardest_to_the_easiest(n: int, k: int, seed: int) -> None:
    hardness = np.random.default_rng(seed).normal(size=n)
    chosen = extremes(hardness, sphere(n, seed), k)
    assert len(set(chosen)) == len(chosen) == min(n, k)
    assert [hardness[index] for index in chosen] == sorted(hardness[chosen], reverse=True)
    if chosen:
        assert hardness[chosen[0]] == hardness.max()
    if len(chosen) > 1:
        assert hardness[chosen[-1]] == hardness.min()
    if n > 3 * k:
        ranks = sorted(int((hardness > hardness[index]).sum()) for index in chosen)
        assert all(rank < n / 3 or rank >= n - n / 3 for rank in ranks)


def test_extreme_views_are_spread_over_the_sphere() -> None:
    """The six hardest look from the same side; those after them, from all around."""
    away = sphere(60, 3)
    same = np.array([0.0, 0.0, 1.0]) + 0.01 * sphere(6, 1)
    directions = np.concatenate([same / np.linalg.norm(same, axis=1, keepdims=True), away])
    chosen = extremes(np.arange(66.0)[::-1], directions, 12)
    assert chosen[0] == 0
    assert sum(index < 6 for index in chosen) == 1
    hard, easy = directions[chosen[:6]], directions[chosen[6:]]
    for half in (hard, easy):
        nearness = half @ half.T - 2 * np.eye(6)
        assert nearness.max() < np.cos(np.radians(25))


def test_views_from_one_place_are_chosen_once_each() -> None:
    assert extremes(np.arange(20.0), np.tile([0.0, 1.0, 0.0], (20, 1)), 6) == [19, 18, 17, 2, 1, 0]


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


def rows_of(sheet: Image.Image) -> int:
    """How many rows of blue pictures there are."""
    rows = (np.array(sheet) == BLUE).all(axis=2).any(axis=1)
    return int(np.count_nonzero(np.diff(rows.astype(int)) == 1))


def test_a_difference_strip_has_a_row_for_each_of_a_few_views() -> None:
    strips = [difference_strip(images(n), images(n), title="t") for n in (1, 3, 9)]
    assert len({strip.width for strip in strips}) == 1
    assert [rows_of(strip) for strip in strips] == [1, 3, 4]


@pytest.mark.parametrize("size", [(1024, 1), (1, 1024), (300, 200), (2, 3)])
def test_a_tile_fits_its_square_whatever_the_form_of_the_image(size: tuple[int, int]) -> None:
    (image,) = images(1, size)
    assert max(tile(image, 224).size) == 224
    sheet, square = (texture_sheet({"a.png": each}, {"a.png": each}, title="t") for each in (image, images(1)[0]))
    assert sheet.width == square.width
    assert sheet.height <= square.height


def test_a_texture_sheet_shows_every_texture_whatever_its_form() -> None:
    before = {"b.png": images(1, (8, 64))[0], "a.png": images(1, (64, 32))[0]}
    sheet = texture_sheet(before, before, title="t")
    assert sheet.tobytes() == texture_sheet(dict(reversed(before.items())), before, title="t").tobytes()
    assert rows_of(sheet) == 2


@given(st.floats(-1, 2), st.floats(-1, 2))
def test_heat_grows_lighter_with_the_value_up_to_the_ends_of_the_scale(a: float, b: float) -> None:
    values = np.array(sorted((a, b)))
    low, high = heat_colours(values) @ (0.2126, 0.7152, 0.0722)
    assert low <= high + 1e-3
    np.testing.assert_array_equal(heat_colours(values), heat_colours(values.clip(0, 1)))


def test_saliency_is_outlined_where_it_reaches_tau_and_only_there() -> None:
    maps = np.zeros((2, 32, 32), np.float32)
    maps[0, 8:24, 8:24] = 0.5
    reached, missed, without = (
        (np.array(saliency_sheet(images(1), maps[k : k + 1], tau=tau, title="t")) == OUTLINE).all(axis=2)
        for k, tau in ((0, 0.5), (1, 0.5), (0, None))
    )
    assert not missed[BELOW_LEGEND:].any()
    assert not without.any()
    assert reached[:BELOW_LEGEND].any(), "the legend does not explain it"
    ys, xs = np.nonzero(reached[BELOW_LEGEND:])
    side = SALIENCY_TILE // 2
    assert ys.max() - ys.min() + 1 == xs.max() - xs.min() + 1 == side
    assert len(ys) == 4 * (side - 1)


def test_saliency_is_painted_over_the_image_only_where_there_is_some() -> None:
    maps = np.zeros((1, 32, 32), np.float32)
    maps[0, :, 16:] = 1
    sheet = np.array(saliency_sheet(images(1), maps, tau=None, title=""))
    pixels = set(map(tuple, sheet.reshape(-1, 3).tolist()))
    assert tuple(round(c * 0.6) for c in BLUE) in pixels
    assert tuple(int(c) for c in heat_colours(np.array(1.0))) in pixels


@pytest.mark.parametrize("value", TICKS)
def test_the_legend_shows_a_value_in_the_colour_that_a_picture_has_there(value: float) -> None:
    grey, bar = np.full((1, 1, 3), GREY, np.uint8), np.array(heat_legend(""))[: BAR[1]]
    shown = heat_over(grey, np.full((1, 1), value))[0, 0]
    places = np.flatnonzero((np.abs(bar[0].astype(int) - shown) <= 3).all(axis=1))
    start = bar.shape[1] - BAR[0]
    assert places.min() - 3 <= start + value**0.5 * (BAR[0] - 1) <= places.max() + 3


@given(st.sampled_from(["left", "centre", "right"]), st.integers(20, 200))
def test_a_line_stays_within_its_width_on_its_side(align: Align, width: int) -> None:
    picture = np.array(line("some words", width, align=align))
    assert picture.shape[1] == width
    letters = np.flatnonzero((picture != PAPER).any(axis=(0, 2)))
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
def test_neither_the_unit_of_the_scores_nor_a_few_extreme_texels_matter(unit: float) -> None:
    scaled = {name: score * unit for name, score in scores().items()}
    scaled["a.png"][0, 0] *= 1e9
    for name, texture in heat_textures(textures(), scaled).items():
        np.testing.assert_array_equal(texture, heat_textures(textures(), scores())[name])


def test_textures_that_nothing_depends_on_are_only_dimmed() -> None:
    nothing = {name: score * 0 for name, score in scores().items()}
    for texture in heat_textures(textures(), nothing).values():
        assert (texture == [round(0.6 * c) for c in BLUE]).all()
    dimmed, hot = (saliency_texture_sheet(textures(), each, title="t") for each in (nothing, scores()))
    assert dimmed.size == hot.size


def test_a_texture_and_its_heat_stand_side_by_side_in_the_order_of_names() -> None:
    sheet = saliency_texture_sheet(textures(), scores(), title="t")
    assert sheet.tobytes() == saliency_texture_sheet(dict(reversed(textures().items())), scores(), title="t").tobytes()
    assert rows_of(sheet) == 2


def test_the_object_is_shown_as_it_is_with_its_views_saliency_and_in_its_heat() -> None:
    maps = np.zeros((2, 32, 32), np.float32)
    maps[:, :16] = 1e-3
    worn = np.full((2, 32, 32, 3), RED, np.uint8)
    sheet = np.array(saliency_object_sheet(images(2), maps, worn, title="t"))
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
    sheet = prediction_histogram({"mug": 30, "cup": 10}, {"cup": 15, "vase": 5}, labels=["mug"], title="t")
    assert bars(sheet, BEFORE) == [round(0.75 * BARS), round(0.25 * BARS)]
    assert bars(sheet, AFTER) == [round(0.75 * BARS), round(0.25 * BARS)]


def test_the_objects_own_class_comes_first_even_if_it_was_never_given() -> None:
    sheet = prediction_histogram({"cup": 4}, {"cup": 4}, labels=["mug"], title="t")
    assert bars(sheet, BEFORE) == [BARS]
    one_class = prediction_histogram({"mug": 4}, {"mug": 4}, labels=["mug"], title="t")
    assert sheet.height > one_class.height
    both = prediction_histogram({"mug": 1, "cup": 2, "vase": 1}, {"vase": 4}, labels=["mug", "cup"], title="t")
    assert bars(both, BEFORE) == [BARS // 4, BARS // 2, BARS // 4]


def test_rare_classes_are_counted_together() -> None:
    many = {f"class {k}": 1 for k in range(20)}
    sheet = prediction_histogram({"mug": 20}, many, labels=["mug"], title="t")
    assert bars(sheet, AFTER) == [round(BARS / 20)] * TOP + [round(BARS * (20 - TOP) / 20)]


def test_pictures_of_views_need_a_view() -> None:
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet([], title="t", facts="")
    with pytest.raises(ValueError, match="at least one view"):
        prediction_histogram({}, {}, labels=["mug"], title="t")
