"""The code of docs/library.md and of the notebook runs on a real renderer and does what they say."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.documentation import DOCS, blocks
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects

pytestmark = pytest.mark.thorough


def test_the_page_runs_from_its_beginning_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for heading, code in blocks("library.md", "python"):
        exec(compile(code, f"library.md, {heading}", "exec"), names)
    said = capsys.readouterr().out

    recognised = re.findall(r"recognised in (\d+)% before, in (\d+)% after", said)
    assert recognised, said
    for before, after in recognised:
        assert int(before) >= 50
        assert int(after) <= int(before) / 3
    clean, painted = load_object(shipped_objects()["mug"].path), load_object(tmp_path / "mug-adversarial.zip")
    change = max(np.abs(painted.textures[name].astype(int) - texture).max() for name, texture in clean.textures.items())
    assert 0 < change <= 0.1 * 255

    texels = re.search(r"(\d+) texels may move", said)
    assert texels is not None, said
    assert 0 < int(texels[1]) <= 0.05 * sum(texture[..., 0].size for texture in clean.textures.values()) + 1
    assert "calibrated good enough with two probes a view" in said
    assert said.endswith("2 steps\n5 classes\n")


def test_the_notebook_runs_from_top_to_bottom() -> None:
    names: dict[str, Any] = {}
    cells = json.loads((DOCS / "first_attack.ipynb").read_text())["cells"]
    for number, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"first_attack.ipynb, cell {number}", "exec"), names)
    held_out = names["attacked"].held_out
    assert held_out.a_after <= held_out.a_before / 2
    (_, fooled), (clean, hardened) = names["recognised"].values()
    assert hardened > fooled
    assert clean >= 0.5
