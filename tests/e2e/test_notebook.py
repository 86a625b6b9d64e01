"""The notebook runs from top to bottom and shows what it says."""

from typing import Any

import pytest

from tests.documentation import cells


@pytest.mark.thorough
def test_the_notebook_runs_from_top_to_bottom() -> None:
    names: dict[str, Any] = {}
    for number, code in enumerate(cells("first_attack.ipynb")):
        exec(compile(code, f"first_attack.ipynb, cell {number}", "exec"), names)
    held_out = names["attacked"].held_out
    assert held_out.a_after <= held_out.a_before / 2
    (_, fooled), (clean, hardened) = names["recognised"].values()
    assert hardened > fooled
    assert clean >= 0.5
