"""Whole jobs on another device than the CPU: every way to attack, in several chunks, to the same result."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from memory_files import MemoryArtifacts
from pretend_device import pretend_device
from scores_only import Scores

from trompe_server.attack import Budget, Goal, attack, start
from trompe_server.attack_job import open_pipeline
from trompe_server.classifiers import NetworkClassifier, load_classifier
from trompe_server.library import Library
from trompe_server.phased_job import CHUNK
from trompe_server.surrogate import SamplingModel, diffuse_surrogate, prepare_geometry, textures_of
from trompe_server.target import FakeTarget
from trompe_shared.api import JobSpec
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (128, 128)
MUG_VIEWS = [View(Camera(0.25, 60.0 * k, 20), Light(0, 60), (255, 255, 255)) for k in range(3)]

VIEWS = {"object": "chair", "label": "chair", "pool": 0, "azimuths": 2, "elevations": 2, "held_out": 3}
PAINT = VIEWS | {"epsilon": 0.1, "alpha": 0.03, "surrogate": "calibrated", "steps": CHUNK + 1}
WAYS = {
    "paint": PAINT,
    "curve, saliency": PAINT | {"surrogate": "curve", "tau": 0.05},
    "few texels": PAINT | {"keep": 0.2},
    "restarts": PAINT | {"restarts": 1, "optimiser": "auto", "loss": "dlr"},
    "view budget": PAINT | {"epsilon_view": 0.05, "optimiser": "adam", "loss": "cross_entropy"},
    "pool": PAINT | {"pool": 12, "views_per_step": 6, "background": ["white", "black"]},
    "ensemble": PAINT | {"ensemble": ["tiny"], "judges": ["tiny"]},
    "scores": PAINT | {"queries": 20},
    "light": VIEWS | {"attack_on": "light", "steps": CHUNK + 1, "views_per_step": 2},
    "vertices": VIEWS | {"attack_on": "vertices", "steps": CHUNK + 1, "vertex_budget": 0.03},
}


def done(spec: dict[str, Any], folder: Path, *, device: str) -> MemoryArtifacts:
    """The files of a job that has run to its end."""
    artifacts = MemoryArtifacts()
    job = open_pipeline(
        JobSpec.model_validate(spec),
        library=Library(folder),
        artifacts=artifacts,
        target=FakeTarget(2000),
        device=device,
    )
    for phase in job.phases():
        job.run(phase, lambda _: None)
    return artifacts


def _hide_gradients(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if "queries" in WAYS[way]:
        hidden = "trompe_server.scene._stored_classifier"
        monkeypatch.setattr(hidden, lambda _, *, device, **__: Scores(load_classifier("tiny", device=device)))


@pytest.mark.parametrize("way", WAYS)
def test_a_job_on_another_device_is_the_same_job(way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _hide_gradients(way, monkeypatch)
    expected = done(WAYS[way], tmp_path / "cpu", device="cpu")
    found = done(WAYS[way], tmp_path / "other", device=pretend_device(monkeypatch))
    assert "result.json" in expected.files
    assert found.lasting() == expected.lasting()


def test_an_attack_computes_where_its_surrogate_lies(mug: Object3D, monkeypatch: pytest.MonkeyPatch) -> None:
    """Textures, masks and a state from a file come from the CPU all the same."""
    textures, masks = textures_of(mug), torch.rand(len(MUG_VIEWS), *SIZE) < 0.5
    texels = {name: torch.rand(texture.shape[:2]) < 0.5 for name, texture in textures.items()}
    found = []
    for device in ("cpu", pretend_device(monkeypatch)):
        geometry = prepare_geometry(mug, MUG_VIEWS, size=SIZE, sampling=SamplingModel(), device=device)
        classifier = load_classifier("tiny", device=device)
        assert isinstance(classifier, NetworkClassifier)
        state = attack(
            start(textures),
            textures,
            diffuse_surrogate(geometry, MUG_VIEWS),
            classifier,
            goal=Goal(classifier.classes.index("mug")),
            budget=Budget(0.1, 0.03),
            steps=2,
            masks=masks,
            texels=texels,
        )
        found.append({name: delta.cpu() for name, delta in state.deltas.items()})
    expected, other = found
    assert any(delta.any() for delta in expected.values())
    assert all(torch.equal(expected[name], other[name]) for name in expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("way", WAYS)
def test_a_job_on_a_graphics_card_comes_to_the_result_of_the_cpu(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To within rounding, which sign steps amplify: what the views are taken for is what counts."""
    _hide_gradients(way, monkeypatch)
    expected = done(WAYS[way], tmp_path / "cpu", device="cpu").result()
    found = done(WAYS[way], tmp_path / "cuda", device="cuda").result()
    pairs = [(expected.surrogate, found.surrogate), (expected.target, found.target)]
    for one, other in pairs:
        if one is not None and other is not None:
            assert other.a_before == one.a_before
            assert np.isclose(other.a_after, one.a_after, atol=0.25)
