"""Objects as people bring them, uploaded and attacked end to end: shipped network, real renderer."""

import io
import json
from typing import Any

import numpy as np
import pytest

from tests.job_runs import run_job
from tests.made_objects import copy_of, lantern
from trompe_server.formats.gltf_container import split_glb
from trompe_server.library import Library
from trompe_server.renderers import SailenvTarget
from trompe_shared.api import JobSpec
from trompe_shared.object3d import load_object


def test_glass_is_painted_but_stays_clear_and_is_said_to_show_little(library: Library, target: SailenvTarget) -> None:
    upload = lantern(opacity=0.2)
    stored = library.add_object(io.BytesIO(upload), "lantern.glb")
    spec = JobSpec.of(stored.id, label="chair", distance=0.8, steps=6, epsilon=0.1, pool=8, held_out=4)
    run = run_job(spec, library, target=target)
    result = run.result
    assert result.target.a_before > 0.5
    assert result.fidelity["explained"] > 0.9
    assert [each for each in result.warnings if "'glass' is nearly transparent (opacity 0.20)" in each]
    before, after = load_object(library.object_bytes(stored.id)), run.artifacts.painted()
    assert {name for name, data in before.files.items() if after.files[name] != data} <= set(before.textures)
    glass = before.materials["glass"]
    assert after.materials["glass"] == glass
    changed = np.abs(after.textures[glass.albedo].astype(int) - before.textures[glass.albedo])
    assert 0 < changed.max() <= 0.1 * 255
    documents = [json.loads(split_glb(data)[0][1]) for name, data in run.artifacts.files.items() if name[-4:] == ".glb"]
    (returned,) = (each for each in documents if each["asset"].get("generator") != "trompe")
    assert returned["materials"] == json.loads(split_glb(upload)[0][1])["materials"]


@pytest.mark.parametrize(
    "made",
    [
        pytest.param({"offset": (0.3, 0.5, -0.2)}, id="off centre", marks=pytest.mark.thorough),
        pytest.param({"scale": 0.0005 / 0.127}, id="1 mm"),
        pytest.param(
            {"scale": 50 / 0.127, "offset": (0, 50, 0)}, id="100 m, its origin at the foot", marks=pytest.mark.thorough
        ),
        pytest.param({"pieces": 40, "side": 32}, id="40 materials", marks=pytest.mark.thorough),
        pytest.param({"side": 0}, id="without textures", marks=pytest.mark.thorough),
        pytest.param({"side": 1}, id="one texel"),
    ],
)
def test_an_awkward_object_is_recognised_and_attacked(
    made: dict[str, Any], library: Library, target: SailenvTarget
) -> None:
    stored = library.add_object(io.BytesIO(copy_of("teapot", **made)), "awkward.glb")
    spec = JobSpec.of(stored.id, label="teapot", steps=4, epsilon=0.1, pool=8, held_out=4)
    result = run_job(spec, library, target=target).result
    assert result.target.a_before >= 0.75
    assert result.target.a_drop is not None
    assert result.texels_altered
    assert any("paint is a few flat colours" in each for each in result.warnings) == (made.get("side") == 1)
    assert result.fidelity["explained"] > 0.9
    largest = max(abs(each.before_true_confidence - (each.after_true_confidence or 0)) for each in result.views)
    assert largest > 0.001
