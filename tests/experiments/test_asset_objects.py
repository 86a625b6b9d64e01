"""The table of the paper's objects, as one piece reads it for experiments, benches and figures."""

import json
from pathlib import Path
from typing import Any

import pytest

from trompe_experiments.asset_objects import AssetObject, asset_objects
from trompe_shared.errors import ObjectError

ROW = {"imagenet_class": 470, "distance": 0.2, "elevation_range": [-13, 52], "background": "black", "else": 0}


def written(assets: Path, table: Any) -> Path:
    (assets / "objects").mkdir()
    (assets / "objects" / "objects.json").write_text(json.dumps(table))
    return assets


def test_each_object_is_read_with_the_way_it_is_looked_at(tmp_path: Path) -> None:
    found = asset_objects(written(tmp_path, {"pot": ROW, "candle": ROW | {"distance": 0.3}}))
    assert list(found) == ["pot", "candle"]
    assert found["pot"] == AssetObject("pot", 470, 0.2, (-13, 52), "black", tmp_path / "objects" / "pot")


@pytest.mark.parametrize(
    ("table", "missing"),
    [
        pytest.param([1], "items", id="no table"),
        pytest.param({"pot": 1}, "subscriptable", id="no rows"),
        pytest.param({"pot": {"distance": 1}}, "elevation_range", id="no elevations"),
        pytest.param({"pot": ROW | {"elevation_range": [1]}}, "not enough values", id="half a range"),
    ],
)
def test_a_table_that_lacks_something_is_refused_and_says_what(tmp_path: Path, table: Any, missing: str) -> None:
    with pytest.raises(ObjectError, match=f"must hold an objects.json with .*{missing}"):
        asset_objects(written(tmp_path, table))
    with pytest.raises(ObjectError, match="No such file"):
        asset_objects(tmp_path / "nowhere")
