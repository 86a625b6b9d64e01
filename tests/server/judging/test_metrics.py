"""The figures of a result."""

import re
from collections import Counter
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from trompe_server.judging.metrics import (
    accuracy,
    agreement,
    drop_interval,
    drop_warning,
    fooled_as,
    max_view_change,
    mean_texel_change,
    reach_warning,
    share_beyond,
    texels_altered,
    transfer_gap,
    view_predictions,
    wilson_interval,
)
from trompe_shared.api import Accuracy
from trompe_shared.geometry import Camera, Light, View

LABEL = 1
hits = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=30)


def logits(right: list[bool]) -> np.ndarray:
    """Logits (views, 3) that are right where ``right`` says so."""
    return np.array([[0.0, 2.0, 1.0] if r else [3.0, 2.0, 1.0] for r in right], np.float32)


def judged(pairs: list[tuple[bool, bool]]) -> Accuracy:
    before, after = zip(*pairs, strict=True)
    return accuracy(logits(list(before)), logits(list(after)), LABEL)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_interval_is_wilsons_inside_0_1_and_holds_the_share(case: tuple[int, int]) -> None:
    low, high = wilson_interval(case[0] / case[1], case[1])
    assert 0 <= low <= case[0] / case[1] <= high <= 1
    assert (low, high) == pytest.approx(tuple(binomtest(*case).proportion_ci(method="wilson")), abs=1e-4)


@given(hits, st.randoms())
def test_the_order_of_the_views_does_not_matter(pairs: list[tuple[bool, bool]], random: Random) -> None:
    shuffled = random.sample(pairs, len(pairs))
    assert judged(pairs) == judged(shuffled)


@given(st.lists(st.tuples(*[st.integers(0, 3)] * 2), min_size=1, max_size=20), st.permutations(range(4)))
def test_each_class_of_several_counts_as_the_object(pairs: list[tuple[int, int]], order: list[int]) -> None:
    before, after = (np.eye(4, dtype=np.float32)[list(said)] for said in zip(*pairs, strict=True))
    for count in (1, 2, 3):
        labels, found = order[:count], accuracy(before, after, order[:count])
        assert found.views == len(pairs)
        assert found.a_before == np.mean([b in labels for b, _ in pairs])
        still = np.mean([a in labels for _, a in pairs])
        assert found.a_after == still
        if found.a_before:
            assert found.a_drop == pytest.approx((found.a_before - still) / found.a_before)
        assert fooled_as(before, after, labels) == Counter(a for b, a in pairs if b in labels and a not in labels)
    assert accuracy(before, after, order[:1]) == accuracy(before, after, order[0])


def test_the_drop_is_na_if_nothing_was_recognised_and_negative_if_the_attack_helps() -> None:
    assert judged([(False, True), (False, False)]).a_drop is None
    assert judged([(True, True), (False, True)]).a_drop == -1.0


def test_nothing_stands_after_an_attack_that_was_not_made() -> None:
    found = accuracy(logits([True, False]), None, LABEL)
    assert (found.a_before, found.a_after, found.a_drop, found.a_after_interval) == (0.5, None, None, None)


def test_accuracy_needs_the_same_views_and_at_least_one() -> None:
    with pytest.raises(ValueError, match="of the same views"):
        accuracy(logits([True, True]), logits([True]), LABEL)
    with pytest.raises(ValueError, match="of the same views"):
        drop_interval(logits([True, True]), logits([True]), LABEL)
    with pytest.raises(ValueError, match="at least one view"):
        accuracy(logits([True])[:0], None, LABEL)


def interval(pairs: list[tuple[bool, bool]]) -> Any:
    before, after = zip(*pairs, strict=True)
    return drop_interval(logits(list(before)), logits(list(after)), LABEL)


BOTH, FOOLED, HELPED, NEVER = (True, True), (True, False), (False, True), (False, False)


@given(hits)
def test_the_interval_of_the_drop_ends_by_1_and_is_na_where_the_drop_is(pairs: list[tuple[bool, bool]]) -> None:
    found = interval(pairs)
    assert (found is None) == (judged(pairs).a_drop is None)
    if found is not None:
        assert found[0] <= found[1] <= 1
        assert found == interval(pairs)


@pytest.mark.parametrize("drop", [0.2, 0.5, 0.75])
def test_the_interval_of_the_drop_is_the_binomial_one_where_every_view_was_recognised(drop: float) -> None:
    fooled = round(400 * drop)
    found = interval([FOOLED] * fooled + [BOTH] * (400 - fooled))
    assert found == pytest.approx(wilson_interval(drop, 400), abs=0.015)


def test_views_seen_twice_count_once_in_the_intervals() -> None:
    before, after = [True] * 45 + [False] * 5, [True] * 10 + [False] * 40
    once, twice = (judged(list(zip(before, after, strict=True)) * times) for times in (1, 2))
    repeated = accuracy(logits(before * 2), logits(after * 2), LABEL, distinct=50)
    assert (repeated.views, repeated.distinct, repeated.counted) == (100, 50, "100 (50 distinct)")
    assert repeated == once.model_copy(update={"views": 100})
    assert (twice.counted, twice.a_drop) == ("100", once.a_drop)
    for name in ("a_drop_interval", "a_before_interval", "a_after_interval"):
        (low, high), (low_twice, high_twice) = getattr(repeated, name), getattr(twice, name)
        assert high - low > high_twice - low_twice


@pytest.mark.parametrize("views", [10, 60, 200])
def test_an_attack_that_fooled_every_view_seen_is_not_certain_to_fool_all(views: int) -> None:
    found = interval([FOOLED] * views)
    assert found[1] == 1.0
    assert 1 - found[0] == pytest.approx(wilson_interval(0, views)[1], rel=0.5)


def test_few_recognised_views_give_a_wide_interval() -> None:
    few, many = (interval([FOOLED] * n + [BOTH] * n + [NEVER] * (100 - 2 * n)) for n in (3, 50))
    assert few[0] < 0 < many[0] < 0.5 < many[1] < few[1]


def test_the_interval_holds_the_true_drop_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    before = generator.random((200, 60)) < 0.9
    after = before & (generator.random((200, 60)) < 0.01)
    held = [interval(list(zip(b, a, strict=True))) for b, a in zip(before, after, strict=True)]
    assert np.mean([low <= 0.99 <= high for low, high in filter(None, held)]) > 0.93


def test_the_interval_respects_that_a_view_is_the_same_before_and_after() -> None:
    paired = interval([BOTH] * 50 + [NEVER] * 50)
    shuffled = interval([BOTH] * 25 + [FOOLED] * 25 + [HELPED] * 25 + [NEVER] * 25)
    assert paired[1] - paired[0] < (shuffled[1] - shuffled[0]) / 3


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        pytest.param([FOOLED] * 3 + [NEVER] * 7, None, id="three tenths are enough"),
        pytest.param([FOOLED] * 7 + [NEVER] * 53, "12% of the views .* rests on 7 of 60 views", id="few"),
        pytest.param([HELPED] * 60, "None of the 60 views .* n.a.", id="none"),
    ],
)
def test_a_drop_that_rests_on_few_views_comes_with_a_warning(pairs: list[tuple[bool, bool]], words: str | None) -> None:
    found = drop_warning(judged(pairs))
    assert found is words is None or (words and re.search(words, found or ""))


def test_agreement_compares_verdicts_and_margins_of_surrogate_and_target() -> None:
    before = np.array([[4.0, 1, 0], [5, 0, 3]], np.float32)  # margins 3, 2
    after = np.array([[0.0, 1, 0], [5, 0, 4]], np.float32)  # -1, 1
    predicted = np.array([[0.5, 1, 0], [4, 0, 4.5]], np.float32)  # -0.5, -0.5
    assert agreement(before, after, predicted, 0) == {"disagreement": 0.5, "margin_error": (0.5 + 1.5) / 2 / 2.5}
    assert agreement(before, after, after, 0) == {"disagreement": 0.0, "margin_error": 0.0}
    assert agreement(after, before, after, 0)["margin_error"] is None
    assert agreement(before, after, predicted, (0, 2))["disagreement"] == 0.0  # either class counts as the object


def test_the_transfer_gap_is_surrogate_minus_target() -> None:
    all_fooled, half = judged([(True, False), (True, False)]), judged([(True, False), (True, True)])
    never = judged([(False, False)])
    assert transfer_gap(all_fooled, half) == 0.5
    assert transfer_gap(None, half) is None
    assert transfer_gap(never, half) is None
    assert transfer_gap(half, never) is None


def test_view_predictions_name_camera_light_and_both_verdicts() -> None:
    view = View(Camera(0.5, 30.0, 40.0), Light(azimuth=5.0, elevation=60.0))
    (found,) = view_predictions([view], logits([True]), logits([False]), LABEL)
    assert (found.distance, found.azimuth, found.elevation) == (0.5, 30.0, 40.0)
    assert (found.light_azimuth, found.light_elevation) == (5.0, 60.0)
    assert (found.before, found.after) == (1, 0)
    assert found.before_confidence == found.before_true_confidence == pytest.approx(np.exp(2) / np.exp([0, 2, 1]).sum())
    assert found.after_confidence == pytest.approx(np.exp(3) / np.exp([3, 2, 1]).sum())
    assert found.after_true_confidence == pytest.approx(np.exp(2) / np.exp([3, 2, 1]).sum())


def test_view_predictions_need_one_row_of_logits_for_each_view_and_may_lack_an_attack() -> None:
    view = View(Camera(1, 0, 0))
    (found,) = view_predictions([view], logits([True]), None, LABEL)
    assert (found.after, found.after_confidence, found.after_true_confidence) == (None, None, None)
    (found,) = view_predictions([view], logits([True]), None, [0, LABEL])
    assert found.before_true_confidence == pytest.approx(np.exp([0, 2]).sum() / np.exp([0, 2, 1]).sum())
    with pytest.raises(ValueError, match="zip"):
        view_predictions([view], logits([True, True]), None, LABEL)


def textures() -> dict[str, np.ndarray]:
    return {"a.png": np.full((2, 4, 3), 100, np.uint8), "b.png": np.full((2, 1, 3), 250, np.uint8)}


def test_texels_count_when_any_channel_changed_and_whatever_their_texture() -> None:
    after = textures()
    assert texels_altered(textures(), after) == mean_texel_change(textures(), after) == 0
    after["a.png"][0, 0, 1] = 85
    after["b.png"][1, 0] = (255, 250, 240)
    assert texels_altered(textures(), after) == 2 / 10
    assert mean_texel_change(textures(), after) == pytest.approx((15 + 5 + 10) / 6 / 255)
    assert mean_texel_change(after, textures()) == mean_texel_change(textures(), after)


def test_textures_of_other_names_or_sizes_cannot_be_compared() -> None:
    for other in ({"a.png": textures()["a.png"]}, textures() | {"b.png": np.zeros((3, 1, 3), np.uint8)}):
        with pytest.raises(ValueError, match="same names and sizes"):
            texels_altered(textures(), other)


def test_the_largest_change_of_a_view_has_no_sign_and_does_not_wrap() -> None:
    before = np.zeros((2, 4, 4, 3), np.uint8)
    after = before.copy()
    after[1, 2, 3, 0] = 255
    assert max_view_change(before, after) == max_view_change(after, before) == 1.0
    assert max_view_change(before, before) == 0.0


def test_pixels_and_views_beyond_epsilon_are_counted_on_the_object_alone() -> None:
    before, pixels = np.full((4, 2, 5, 3), 100, np.uint8), np.zeros((4, 2, 5), bool)
    pixels[:, :, :4] = True
    after = before.copy()
    after[0, 0, 0, 1] = 114
    after[0, 1, 1] = (86, 114, 100)
    after[1, 0, 0] = 113
    after[2, :, 4] = 255
    assert share_beyond(before, after, pixels, epsilon=13 / 255) == (2 / 32, 1 / 4)
    assert share_beyond(before, after, pixels, epsilon=0.05) == (3 / 32, 2 / 4)
    assert share_beyond(before, after, pixels & False, epsilon=0.05) == (0.0, 0.0)


def test_a_change_of_epsilon_itself_is_not_beyond_it() -> None:
    before, pixels = np.zeros((1, 1, 1, 3), np.uint8), np.ones((1, 1, 1), bool)
    for level in range(1, 256):
        after = np.full((1, 1, 1, 3), level, np.uint8)
        assert share_beyond(before, after, pixels, epsilon=level / 255) == (0.0, 0.0)
        assert share_beyond(before, after, pixels, epsilon=(level - 0.01) / 255) == (1.0, 1.0)


def share(before: int, after: int) -> Accuracy:
    """Of ten views."""
    return judged([(k < before, k < after) for k in range(10)])


@pytest.mark.parametrize(
    ("own", "held_out", "words"),
    [
        pytest.param((10, 8), (10, 10), "little effect: A_drop 0.20 on its own views. stronger", id="little"),
        pytest.param((10, 0), (10, 3), "A_drop 1.00 on the attack's own, 0.70 on held-out ones. wider", id="own alone"),
        pytest.param((10, 6), (10, 8), "A_drop 0.40 on the attack's own, 0.20 on held-out ones. wider", id="by share"),
        *[
            ((10, 6), (10, 7), None),
            ((10, 0), (10, 2), None),
            ((10, 7), (10, 6), None),
            ((0, 0), (10, 10), None),
            ((9, 0), None, None),
        ],
    ],
)
def test_an_attack_that_reaches_few_views_or_only_its_own_is_warned_of(
    own: tuple[int, int], held_out: tuple[int, int] | None, words: str | None
) -> None:
    others = share(*held_out) if held_out else None
    found = reach_warning(share(*own), others, stronger="stronger", wider="wider")
    assert found is None if words is None else words in (found or "")
