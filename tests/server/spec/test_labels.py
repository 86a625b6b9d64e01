"""What people may call a class, and which class names make two classes neighbours."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from trompe_server.spec.labels import resolve_label, resolve_labels
from trompe_server.spec.neighbours import neighbours
from trompe_shared.errors import LabelError, SpecError

CLASSES = ["crane", "toilet tissue, toilet paper, bathroom tissue", "Crane, bird", "wall clock", "2", "toilet seat"]


@pytest.mark.parametrize(
    ("label", "index"),
    [
        pytest.param(1, 1, id="index"),
        pytest.param("3", 3, id="digits are an index"),
        pytest.param("2", 2, id="digits are an index even where a class is called so"),
        pytest.param("toilet tissue, toilet paper, bathroom tissue", 1, id="full name"),
        pytest.param("Toilet Paper", 1, id="synonym, whatever its case"),
        pytest.param(" wall clock ", 3, id="spaces around"),
        pytest.param("crane", 0, id="a full name goes before a synonym"),
    ],
)
def test_a_label_is_an_index_a_name_or_a_synonym(label: str | int, index: int) -> None:
    assert resolve_label(label, CLASSES, len(CLASSES), classifier="net") == index


@pytest.mark.parametrize(
    ("label", "words"),
    [
        pytest.param(6, r"6 is not a class of 'net'; its indices are 0\.\.5", id="index too large"),
        pytest.param(-1, r"indices are 0\.\.5", id="index negative"),
        pytest.param("9" * 5000, r"^9{18} is not a class of 'net'", id="thousands of digits"),
        pytest.param("toilet", "did you mean 'toilet", id="unknown with close matches"),
        pytest.param("zzz", "example of a class is 'crane'", id="unknown without"),
        pytest.param("zzz", r"^'net' has no class 'zzz'.* or another network\.$", id="network"),
        pytest.param("", "no class ''", id="empty"),
    ],
)
def test_a_label_that_fits_nothing_is_refused_with_help(label: str | int, words: str) -> None:
    with pytest.raises(LabelError, match=words):
        resolve_label(label, CLASSES, len(CLASSES), classifier="net")


def test_accents_may_be_composed_in_either_way_and_a_hint_keeps_the_spelling() -> None:
    classes = ["T\u00e4\u00dfle", "mug"]
    assert resolve_label("Ta\u0308\u00dfle", classes, 2, classifier="net") == 0
    with pytest.raises(LabelError, match="did you mean 'T\u00e4\u00dfle'"):
        resolve_label("T\u00e4\u00dfl", classes, 2, classifier="net")


def test_a_label_that_fits_two_classes_is_refused_with_both() -> None:
    with pytest.raises(LabelError, match=r"0 \(jug, cup\); 1 \(mug, cup\)"):
        resolve_label("cup", ["jug, cup", "mug, cup"], 2, classifier="net")


def test_one_label_or_several_are_distinct_classes_in_their_order() -> None:
    assert resolve_labels("toilet paper", CLASSES, len(CLASSES), "net") == (1,)
    assert resolve_labels(["wall clock", 0], CLASSES, len(CLASSES), "net") == (3, 0)
    assert resolve_labels(np.int64(2), CLASSES, len(CLASSES), "net") == (2,)
    assert resolve_labels(torch.tensor(2), CLASSES, len(CLASSES), "net") == (2,)
    twice = "'toilet paper' and 'toilet tissue' are the same class, 1: name each `label` once"
    with pytest.raises(SpecError, match=twice):
        resolve_labels(["toilet paper", 3, "toilet tissue"], CLASSES, len(CLASSES), "net")
    with pytest.raises(SpecError, match="6 of the classifier's 6 classes count as the object"):
        resolve_labels(range(6), CLASSES, len(CLASSES), "net")
    with pytest.raises(LabelError, match="no class 'wall'"):
        resolve_labels([1, "wall"], CLASSES, len(CLASSES), "net")


def test_a_name_means_nothing_to_a_classifier_without_names() -> None:
    assert resolve_label("7", None, 10, classifier="net") == 7
    with pytest.raises(LabelError, match=r"give an index in 0\.\.9"):
        resolve_label("mug", None, 10, classifier="net")


@given(st.lists(st.text("abA", min_size=1, max_size=3), unique=True, min_size=1))
def test_every_unique_name_resolves_to_its_place(classes: list[str]) -> None:
    found = [resolve_label(name, classes, len(classes), classifier="net") for name in classes]
    assert found == list(range(len(classes)))


# Neighbours. The names are ImageNet's

LAMPSHADE = "lampshade, lamp shade"
TOILET_PAPER = "toilet tissue, toilet paper, bathroom tissue"
LAPTOP = "laptop, laptop computer"


@pytest.mark.parametrize(
    ("one", "other", "near"),
    [
        pytest.param(LAMPSHADE, "table lamp", True, id="noun of one, first word of the other"),
        pytest.param("notebook, notebook computer", LAPTOP, True, id="same noun in one of the synonyms"),
        pytest.param(LAPTOP, "computer keyboard, keypad", True, id="part of the same thing"),
        pytest.param(TOILET_PAPER, "paper towel", True, id="noun of a second synonym"),
        pytest.param("basketball", "shopping basket", True, id="compound, its first word"),
        pytest.param("basketball", "tennis ball", True, id="compound, its noun"),
        pytest.param("sunglass", "sunglasses, dark glasses, shades", True, id="plural"),
        pytest.param("crane (bird)", "crane_(machine)", True, id="remarks and underscores"),
        pytest.param("cup of tea", "measuring cup", True, id="noun before a preposition"),
        pytest.param("tennis ball", "tennis racket", False, id="noun of neither"),
        pytest.param(TOILET_PAPER, "toilet seat", False, id="first word of both"),
        pytest.param("cup of tea", "tea bag", False, id="word after a preposition"),
        pytest.param("balloon", "tennis ball", False, id="no compound: oon is no word"),
        pytest.param("dining table, board", "desk", False, id="another word for it: names cannot tell"),
        pytest.param("n01 2", "n01 3", False, id="digits"),
        pytest.param("", "", False, id="no names"),
    ],
)
def test_names_with_a_common_noun_are_neighbours(one: str, other: str, near: bool) -> None:
    classes = [one, other, "shopping basket", "golf ball", "sea lion"]
    assert (1 in neighbours([0], classes)) is near
    assert (0 in neighbours([1], classes)) is near
    assert 4 not in neighbours([0, 1], classes)


@given(st.lists(st.text("ab ,", max_size=8), min_size=2, max_size=6), st.data())
def test_neighbours_of_a_set_are_those_of_its_classes_without_the_set(classes: list[str], data: st.DataObject) -> None:
    labels = data.draw(st.sets(st.sampled_from(range(len(classes))), min_size=1))
    of_each = [neighbours([label], classes) for label in labels]
    assert neighbours(labels, classes) == frozenset().union(*of_each) - labels
