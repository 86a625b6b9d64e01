"""Tables in Markdown: their form, and that no cell breaks out of its column."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trompe_experiments.markdown import cells_of, markdown_row, markdown_table

CELLS = st.text(st.characters(exclude_categories=["C", "Z"], include_characters="|\\ ")).map(str.strip)


def test_a_table_has_a_header_a_line_of_alignments_and_its_rows() -> None:
    text = markdown_table(["name", "share", "said"], [["mug", 0.5, ""], ["a|b", "", "yes"]], align="lrl")
    assert text.splitlines() == [
        "| name | share | said |",
        "|---|---:|---|",
        "| mug | 0.5 |  |",
        r"| a\|b |  | yes |",
    ]


def test_columns_are_aligned_left_unless_told_otherwise_and_a_table_may_have_no_rows_yet() -> None:
    assert markdown_table(["a", "b"], []) == "| a | b |\n|---|---|"


@pytest.mark.parametrize("align", ["l", "lrr"])
def test_an_alignment_is_needed_for_each_column(align: str) -> None:
    with pytest.raises(ValueError, match="zip"):
        markdown_table(["a", "b"], [], align=align)


@given(st.lists(CELLS, min_size=1, max_size=5))
def test_cells_are_read_from_a_row_as_they_were_written(cells: list[str]) -> None:
    assert cells_of(markdown_row(cells)) == cells
