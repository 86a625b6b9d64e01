"""What people may call a class."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_server.labels import resolve_label
from trompe_shared.errors import LabelError

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
    assert resolve_label(label, CLASSES, len(CLASSES)) == index


@pytest.mark.parametrize(
    ("label", "words"),
    [
        pytest.param(6, r"indices are 0\.\.5", id="index too large"),
        pytest.param(-1, r"indices are 0\.\.5", id="index negative"),
        pytest.param("toilet", "did you mean 'toilet", id="unknown with close matches"),
        pytest.param("zzz", "for example, 'crane'", id="unknown without"),
        pytest.param("", "no class ''", id="empty"),
    ],
)
def test_a_label_that_fits_nothing_is_refused_with_help(label: str | int, words: str) -> None:
    with pytest.raises(LabelError, match=words):
        resolve_label(label, CLASSES, len(CLASSES))


def test_a_label_that_fits_two_classes_is_refused_with_both() -> None:
    with pytest.raises(LabelError, match=r"0 \(jug, cup\); 1 \(mug, cup\)"):
        resolve_label("cup", ["jug, cup", "mug, cup"], 2)


def test_a_name_means_nothing_to_a_classifier_without_names() -> None:
    assert resolve_label("7", None, 10) == 7
    with pytest.raises(LabelError, match=r"give an index in 0\.\.9"):
        resolve_label("mug", None, 10)


@given(st.lists(st.text("abc", min_size=1, max_size=3), unique=True, min_size=1))
def test_every_unique_name_resolves_to_its_place(classes: list[str]) -> None:
    assert [resolve_label(name, classes, len(classes)) for name in classes] == list(range(len(classes)))
