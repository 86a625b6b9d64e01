"""The figures of a result."""

from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_server.attack.metrics import (
    accuracy,
    max_view_change,
    mean_texel_change,
    softmax,
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
def test_the_interval_lies_in_0_1_and_holds_the_share(case: tuple[int, int]) -> None:
    low, high = wilson_interval(*case)
    assert 0 <= low <= case[0] / case[1] <= high <= 1
    assert high - low < 2 / case[1] ** 0.5


def test_the_interval_is_the_published_one() -> None:
    assert wilson_interval(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


@given(st.integers(0, 40))
def test_more_views_of_the_same_share_make_the_interval_narrower(k: int) -> None:
    (low, high), (low_10, high_10) = wilson_interval(k, 40), wilson_interval(10 * k, 400)
    assert high_10 - low_10 < high - low


@given(hits, st.randoms())
def test_the_order_of_the_views_does_not_matter(pairs: list[tuple[bool, bool]], random: Random) -> None:
    shuffled = random.sample(pairs, len(pairs))
    assert judged(pairs) == judged(shuffled)


@given(hits)
def test_accuracy_counts_the_views_of_the_objects_class(pairs: list[tuple[bool, bool]]) -> None:
    found = judged(pairs)
    assert found.views == len(pairs)
    assert found.a_before * len(pairs) == pytest.approx(sum(before for before, _ in pairs))
    assert found.a_after is not None
    assert found.a_after * len(pairs) == pytest.approx(sum(after for _, after in pairs))
    if found.a_before:
        assert found.a_drop == pytest.approx((found.a_before - found.a_after) / found.a_before)


def test_the_drop_is_not_applicable_when_nothing_was_recognised() -> None:
    assert judged([(False, True), (False, False)]).a_drop is None


def test_an_attack_that_helps_has_a_negative_drop() -> None:
    assert judged([(True, True), (False, True)]).a_drop == -1.0


def test_nothing_stands_after_an_attack_that_was_not_made() -> None:
    found = accuracy(logits([True, False]), None, LABEL)
    assert (found.a_before, found.a_after, found.a_drop, found.a_after_interval) == (0.5, None, None, None)


def test_accuracy_needs_the_same_views_and_at_least_one() -> None:
    with pytest.raises(ValueError, match="of the same views"):
        accuracy(logits([True, True]), logits([True]), LABEL)
    with pytest.raises(ValueError, match="at least one view"):
        accuracy(logits([True])[:0], None, LABEL)


def test_the_transfer_gap_is_surrogate_minus_target() -> None:
    all_fooled, half = judged([(True, False), (True, False)]), judged([(True, False), (True, True)])
    never = judged([(False, False)])
    assert transfer_gap(all_fooled, half) == 0.5
    assert transfer_gap(None, half) is None
    assert transfer_gap(never, half) is None
    assert transfer_gap(half, never) is None


@given(st.lists(st.floats(-1e4, 1e4), min_size=2, max_size=6), st.floats(-1e4, 1e4))
def test_softmax_gives_probabilities_that_do_not_depend_on_a_shift(row: list[float], shift: float) -> None:
    values = np.array([row], np.float32)
    probabilities = softmax(values)
    assert probabilities.sum() == pytest.approx(1)
    assert (probabilities >= 0).all()
    np.testing.assert_allclose(softmax(values + np.float32(shift)), probabilities, atol=1e-2)
    assert softmax(np.zeros((1, 4), np.float32)) == pytest.approx(np.full((1, 4), 0.25))


def test_view_predictions_name_camera_light_and_both_verdicts() -> None:
    view = View(Camera(0.5, 30.0, 40.0), Light(azimuth=5.0, elevation=60.0))
    (found,) = view_predictions([view], logits([True]), logits([False]), LABEL)
    assert (found.distance, found.azimuth, found.elevation) == (0.5, 30.0, 40.0)
    assert (found.light_azimuth, found.light_elevation) == (5.0, 60.0)
    assert (found.before, found.after) == (1, 0)
    assert (
        found.before_confidence == found.before_true_confidence == pytest.approx(np.exp(2) / (np.exp([0, 2, 1]).sum()))
    )
    assert found.after_confidence == pytest.approx(np.exp(3) / np.exp([3, 2, 1]).sum())
    assert found.after_true_confidence == pytest.approx(np.exp(2) / np.exp([3, 2, 1]).sum())


def test_view_predictions_without_an_attack_have_nothing_after() -> None:
    (found,) = view_predictions([View(Camera(1, 0, 0))], logits([True]), None, LABEL)
    assert (found.after, found.after_confidence, found.after_true_confidence) == (None, None, None)


def test_view_predictions_need_one_row_of_logits_for_each_view() -> None:
    with pytest.raises(ValueError, match="zip"):
        view_predictions([View(Camera(1, 0, 0))], logits([True, True]), None, LABEL)


def textures() -> dict[str, np.ndarray]:
    return {"a.png": np.full((2, 4, 3), 100, np.uint8), "b.png": np.full((2, 1, 3), 250, np.uint8)}


def test_untouched_textures_have_no_altered_texel_and_no_change() -> None:
    assert texels_altered(textures(), textures()) == 0
    assert mean_texel_change(textures(), textures()) == 0


def test_texels_count_when_any_channel_changed_and_whatever_their_texture() -> None:
    after = textures()
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
