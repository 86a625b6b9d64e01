"""Which class names make two classes neighbours. The names are ImageNet's."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_server.spec.neighbours import neighbours

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
