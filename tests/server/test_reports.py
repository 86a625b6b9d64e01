"""The pictures of a result."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from trompe_server.reports import (
    Verdict,
    contact_sheet,
    difference_strip,
    heat_colours,
    representative,
    saliency_sheet,
    texture_sheet,
)
from trompe_server.reports.contact_sheet import FRAME, TILE
from trompe_server.reports.difference import amplified_difference
from trompe_server.reports.layout import CAPTION, GREEN, MARGIN, RED, captioned, printable, shortened
from trompe_server.reports.saliency_sheet import OUTLINE
from trompe_server.reports.saliency_sheet import TILE as SALIENCY_TILE

BLUE = (40, 80, 160)


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
    outlined = (np.array(with_mask) == OUTLINE).all(axis=2)
    assert not (np.array(without) == OUTLINE).all(axis=2).any()
    ys, xs = np.nonzero(outlined)
    side = SALIENCY_TILE // 2
    assert ys.max() - ys.min() + 1 == xs.max() - xs.min() + 1 == side
    assert outlined.sum() == 4 * (side - 1)


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
