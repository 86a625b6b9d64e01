"""Whole jobs on another device than the CPU: each kind of attack, in several chunks, to the same result."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.fakes import FakeTarget, Scores
from tests.job_runs import MemoryArtifacts, run_job, spec_of
from tests.pretend_device import pretend_device
from trompe_server.attack import (
    Budget,
    Goal,
    attack,
    best_texels,
    few_texels,
    image_gradients,
    movable,
    rank_texels,
    saliency,
    saliency_masks,
    start,
)
from trompe_server.classifiers import NetworkClassifier, load_classifier
from trompe_server.job import setup
from trompe_server.job.texture_attack import CHUNK
from trompe_server.library import Library
from trompe_server.surrogate import SamplingModel, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (128, 128)
MUG_VIEWS = [View(Camera(0.25, 60.0 * k, 20), Light(0, 60), (255, 255, 255)) for k in range(3)]

KINDS: dict[str, dict[str, Any]] = {
    "calibrated": {"surrogate": "calibrated"},
    "measured tone": {"surrogate": "calibrated"},
    "curve, saliency": {"surrogate": "curve", "tau": 0.05},
    "few texels": {"keep": 0.2},
    "view budget": {"epsilon_view": 0.05, "optimiser": "pgd", "loss": "cross_entropy"},
    "pool": {"pool": 12, "views_per_step": 6, "background": ["white", "black"]},
    "ensemble": {"ensemble": ["tiny"], "judges": ["tiny"]},
    "scores": {"queries": 20},
}


def done(kind: str, folder: Path, monkeypatch: pytest.MonkeyPatch, *, device: str) -> MemoryArtifacts:
    """The files of a finished job."""
    if "queries" in KINDS[kind]:
        hidden = "trompe_server.job.setup._stored_classifier"
        monkeypatch.setattr(hidden, lambda _, *, device, **__: Scores(load_classifier("tiny", device=device)))
    if kind == "measured tone":
        measured = SamplingModel(encoding="measured")
        monkeypatch.setattr("trompe_server.surrogate.calibration.find_physics", lambda *_: measured)
    spec = spec_of(steps=CHUNK + 1, **KINDS[kind])
    return run_job(spec, Library(folder), target=FakeTarget(2000), device=device).artifacts


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[] if kind == "calibrated" else pytest.mark.thorough) for kind in KINDS]
)
def test_a_job_on_another_device_is_the_same_job(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trompe_server.classifiers.convolution.ONEDNN", False)  # other devices have other operators
    monkeypatch.setattr("trompe_server.classifiers.registry.fastest_format", lambda _: torch.contiguous_format)
    monkeypatch.setattr(setup, "_loaded", setup._loaded.__wrapped__)  # other tests may have loaded it already
    expected = done(kind, tmp_path / "cpu", monkeypatch, device="cpu")
    found = done(kind, tmp_path / "other", monkeypatch, device=pretend_device(monkeypatch))
    files, others = found.lasting(), expected.lasting()
    (text, numbers), (same, close) = (words_and_numbers(each.pop("result.json")) for each in (files, others))
    assert files == others
    assert text == same
    assert numbers == pytest.approx(close, rel=1e-5)  # a batch that was filled up differs in the last bits


def words_and_numbers(data: bytes) -> tuple[list[str], list[float]]:
    parts = re.split(r"(-?\d+\.\d+(?:e-\d+)?)", data.decode())
    return parts[::2], [float(number) for number in parts[1::2]]


def test_an_attack_computes_on_its_surrogates_device(mug: Object3D, monkeypatch: pytest.MonkeyPatch) -> None:
    """Textures, masks and a loaded state come from the CPU all the same."""
    textures, generator = textures_of(mug), torch.Generator().manual_seed(0)
    masks = torch.rand(len(MUG_VIEWS), *SIZE, generator=generator) < 0.5
    texels = {name: torch.rand(each.shape[:2], generator=generator) < 0.5 for name, each in textures.items()}
    found = []
    for device in ("cpu", pretend_device(monkeypatch)):
        geometry = prepare_geometry(mug, MUG_VIEWS, size=SIZE, sampling=SamplingModel(), device=device)
        classifier = load_classifier("tiny", device=device)
        assert isinstance(classifier, NetworkClassifier)
        state = attack(
            *(start(textures), textures, diffuse_surrogate(geometry, MUG_VIEWS), classifier),
            goal=Goal((classifier.classes or ()).index("mug")),
            budget=Budget(0.1, 0.03),
            steps=2,
            masks=masks,
            texels=texels,
        )
        found.append({name: delta.cpu() for name, delta in state.deltas.items()})
    expected, other = found
    assert any(delta.any() for delta in expected.values())
    assert all(torch.equal(expected[name], other[name]) for name in expected)


def test_texels_are_chosen_for_a_surrogate_on_another_device(mug: Object3D, monkeypatch: pytest.MonkeyPatch) -> None:
    """As docs/library.md does it: textures, masks and gradients stay on the CPU."""
    textures, budget, found = textures_of(mug), Budget(0.1, 0.03), []
    for device in ("cpu", pretend_device(monkeypatch)):
        geometry = prepare_geometry(mug, MUG_VIEWS, size=SIZE, sampling=SamplingModel(), device=device)
        surrogate, classifier = diffuse_surrogate(geometry, MUG_VIEWS), load_classifier("tiny", device=device)
        assert isinstance(classifier, NetworkClassifier)
        clean, goal = surrogate.images(mug), Goal((classifier.classes or ()).index("mug"))
        masks, gradients = (each(clean, classifier, goal=goal) for each in (saliency, image_gradients))
        masks = saliency_masks(masks, 0.05)
        ranked = best_texels(rank_texels(surrogate, textures, gradients), 0.05)
        tried = few_texels(0.2, textures, surrogate, classifier, gradients, goal=goal, budget=budget, masks=masks)
        found.append([movable(surrogate, budget, masks, within=[each]) for each in (ranked, tried.masks)])
    for expected, other in zip(*found, strict=True):
        assert any(mask.any() for mask in expected.values())
        assert all(torch.equal(mask, other[name].cpu()) for name, mask in expected.items())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("kind", KINDS)
def test_a_job_on_a_graphics_card_comes_to_the_result_of_the_cpu(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To within rounding, which sign steps amplify: the classes of the views count."""
    expected = done(kind, tmp_path / "cpu", monkeypatch, device="cpu").result()
    found = done(kind, tmp_path / "cuda", monkeypatch, device="cuda").result()
    pairs = [(expected.surrogate, found.surrogate), (expected.target, found.target)]
    for one, other in pairs:
        if one is not None and other is not None:
            assert other.a_before == one.a_before
            assert one.a_after is not None
            assert other.a_after is not None
            assert np.isclose(other.a_after, one.a_after, atol=0.25)
