"""Classifiers that only answer: the estimate of their gradient is right, repeatable, and paid for by the query."""

import importlib
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from tests.fakes import fake_classifier
from tests.server.classifiers.test_contract import write_onnx
from trompe_server.classifiers import (
    NetworkClassifier,
    ScoringClassifier,
    WhiteBoxClassifier,
    load_classifier,
    resized,
    score_based,
)
from trompe_server.classifiers.protocol import AT_ONCE, Wrapper
from trompe_shared.errors import ClassifierError, SpecError

MODULE = importlib.import_module("trompe_server.classifiers.score_based")
SIDE = 8


@dataclass
class Asked(Wrapper):
    """The scores of a network, and the images they were asked for."""

    inner: NetworkClassifier
    seen: list[Tensor] = field(default_factory=list)

    @property
    def image_size(self) -> tuple[int, int]:
        return self.inner.image_size

    def scores(self, images: Tensor) -> Tensor:
        assert not images.requires_grad
        self.seen.append(images)
        return self.inner.scores(images)


class Mean(torch.nn.Module):
    """Two logits that are linear in every pixel."""

    def forward(self, images: Tensor) -> Tensor:
        weights = torch.randn((3 * SIDE * SIDE, 2), generator=torch.Generator().manual_seed(3))
        return images.flatten(1) @ weights


def linear() -> NetworkClassifier:
    return NetworkClassifier("linear", Mean(), (SIDE, SIDE), 2)


def greyish(count: int, side: int = SIDE, seed: int = 0) -> Tensor:
    """Images away from black and white, so that no step is cut off."""
    return 0.3 + 0.4 * torch.rand((count, 3, side, side), generator=torch.Generator().manual_seed(seed))


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def gradient(classifier: WhiteBoxClassifier, images: Tensor, weights: Tensor) -> Tensor:
    leaf = images.clone().requires_grad_()
    (found,) = torch.autograd.grad((classifier.logits(leaf) * weights).sum(), leaf)
    return found


def cosine(one: Tensor, other: Tensor) -> float:
    return float(F.cosine_similarity(one.flatten(), other.flatten(), dim=0))


def test_the_logits_are_the_true_ones() -> None:
    network, images = fake_classifier(), greyish(3, 32)
    asked = score_based(Asked(network), seed=0)
    torch.testing.assert_close(asked.logits(images), network.logits(images))
    assert isinstance(asked, WhiteBoxClassifier)
    assert (asked.name, asked.image_size, asked.n_classes) == ("fake", (32, 32), 10)
    eight_bit = np.zeros((2, 5, 5, 3), np.uint8)
    assert (asked.predict(eight_bit) == network.predict(eight_bit)).all()


def test_the_estimate_of_a_linear_function_is_exact_on_average() -> None:
    network, images, weights = linear(), greyish(1), torch.tensor([[1.0, -0.5]])
    true = gradient(network, images, weights)
    estimates = [gradient(score_based(network, queries=400, seed=k, sigma=0.01), images, weights) for k in range(40)]
    spread = true.norm() * ((true.numel() + 1) / (200 * 40)) ** 0.5  # of a mean of 40 x 200 Gaussian patterns
    assert float((torch.stack(estimates).mean(0) - true).norm()) < 1.3 * float(spread)


def test_the_estimate_comes_nearer_to_the_true_gradient_with_every_query() -> None:
    """For d unknowns and n pairs, the squared cosine is about n / (n + d)."""
    network, images, weights = fake_classifier(image_size=(SIDE, SIDE)), greyish(6), drawn(6, 10)
    true = gradient(network, images, weights)
    unknowns = 3 * SIDE * SIDE
    for pairs in (8, 32, 128):
        found = gradient(score_based(network, queries=2 * pairs, seed=0, sigma=1e-3), images, weights)
        assert cosine(found, true) > 0.65 * (pairs / (pairs + unknowns)) ** 0.5


@settings(max_examples=20)
@given(seed=st.integers(-(2**40), 2**40), order=st.permutations(range(4)))
def test_an_estimate_depends_on_the_image_and_the_seed_alone(seed: int, order: list[int]) -> None:
    network, images, weights = linear(), greyish(4), torch.tensor([[1.0, 2.0]]).repeat(4, 1)

    def estimate(chosen: list[int], seed: int) -> Tensor:
        return gradient(score_based(network, queries=4, seed=seed), images[chosen], weights[chosen])

    together = estimate(list(range(4)), seed)
    assert torch.equal(estimate(order, seed), together[order])
    assert torch.equal(estimate([2], seed)[0], together[2])
    assert not torch.equal(estimate([2], seed + 1)[0], together[2])
    assert not torch.equal(together[0], together[1])


def test_every_image_that_is_asked_about_is_counted_and_only_those_with_a_gradient_are() -> None:
    inner = Asked(linear())
    classifier = score_based(inner, queries=6, seed=0)
    images = greyish(4).requires_grad_()
    logits = classifier.logits(images)
    assert classifier.queries == 4
    (found,) = torch.autograd.grad((logits[:3, 0] * torch.tensor([1.0, 0.0, 2.0])).sum(), images)
    assert classifier.queries == 4 + 2 * 6 == sum(len(images) for images in inner.seen)
    assert found.abs().amax((1, 2, 3)).gt(0).tolist() == [True, False, True, False]


def test_only_images_that_exist_are_asked_about() -> None:
    inner, images = Asked(linear()), drawn(2, 3, SIDE, SIDE).sign().clamp(0, 1)
    gradient(score_based(inner, seed=0, sigma=0.5), images, torch.ones(2, 2))
    assert all(float(asked.min()) >= 0 and float(asked.max()) <= 1 for asked in inner.seen)


def test_only_what_differs_from_the_background_is_asked_about() -> None:
    background, inner = greyish(1, seed=1)[0], Asked(linear())
    images = background.repeat(2, 1, 1, 1)
    images[0, :, 2:5, 3:7] = 0.5
    images[1, 1, 0, 0] += 0.01
    found = gradient(score_based(inner, seed=0, background=background), images, torch.ones(2, 2))
    shown = (images != background).any(1, keepdim=True).expand_as(found)
    assert torch.equal(found != 0, shown)
    for asked, image in zip(inner.seen[1:], images, strict=True):
        assert torch.equal((asked != image).any(0), (image != background).any(0).expand_as(image))
    colour = torch.tensor([0.5, 0.5, 0.5]).reshape(3, 1, 1)
    on_grey = gradient(score_based(linear(), seed=0, background=colour), images, torch.ones(2, 2))
    assert torch.equal((on_grey[0] == 0).all(0).nonzero(), (images[0] == 0.5).all(0).nonzero())


def test_many_queries_are_asked_in_batches_with_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    inner, images, weights = Asked(linear()), greyish(1), torch.tensor([[1.0, -0.5]])
    found = gradient(score_based(inner, queries=202, seed=0), images, weights)
    assert [len(asked) for asked in inner.seen] == [1, *[AT_ONCE] * 5, 2]
    monkeypatch.setattr(MODULE, "AT_ONCE", 202)
    torch.testing.assert_close(gradient(score_based(inner, queries=202, seed=0), images, weights), found)
    assert len(inner.seen[-1]) == 202


def test_the_coarser_the_patterns_the_smoother_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    images, weights = greyish(1, 32), drawn(1, 10)

    def roughness(cells: int) -> float:
        monkeypatch.setattr(MODULE, "CELLS", cells)
        found = gradient(score_based(fake_classifier(), queries=20, seed=0), images, weights)
        return float(found.diff(dim=3).square().sum() / found.square().sum())

    assert roughness(4) < 0.3 * roughness(16) < 0.3 * roughness(64)


def test_an_onnx_file_can_be_attacked_by_its_scores(tmp_path: Path) -> None:
    """Without rounding to 8 bits: the steps here are a tenth of an 8-bit level."""
    inner = load_classifier(write_onnx(tmp_path / "net.onnx", size=(SIDE, SIDE), n_classes=2))
    assert isinstance(inner, ScoringClassifier)
    assert not isinstance(inner, WhiteBoxClassifier)
    classifier = score_based(inner, queries=2000, seed=0, sigma=0.0004)
    found = gradient(classifier, greyish(1), torch.tensor([[0.0, 1.0]]))
    of_channels = inner.scores(torch.eye(3)[..., None, None].expand(-1, -1, SIDE, SIDE))[:, 1]  # it is linear
    assert cosine(found, of_channels[:, None, None].expand(-1, SIDE, SIDE)) > 0.85


def test_an_estimate_comes_back_through_a_change_of_size() -> None:
    images, weights = greyish(1, 12), torch.tensor([[1.0, 0.0]])
    true = gradient(resized(linear(), (12, 12)), images, weights)
    found = gradient(resized(score_based(linear(), queries=2000, seed=0), (12, 12)), images, weights)
    assert cosine(found, true) > 0.85


@pytest.mark.assets
def test_the_scores_of_a_real_network_tell_the_coarse_part_of_its_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MODULE, "CELLS", 7)
    folder = Path(os.environ["TROMPE_ASSETS"]) / "classifiers"
    white, black = (load_classifier(folder / f"mobilenet_v2{end}") for end in (".pt2", ".onnx"))
    assert isinstance(white, WhiteBoxClassifier)
    images = F.interpolate(greyish(1, 8), (224, 224), mode="bilinear")
    weights = F.one_hot(white.logits(images).argmax(1), 1000).float()
    classifier = score_based(black, seed=0, queries=300, sigma=1e-3)
    coarse = torch.zeros((1, 3, 7, 7), requires_grad=True)
    smooth = F.interpolate(coarse, (224, 224), mode="bilinear")
    by_grid = [
        torch.autograd.grad(smooth, coarse, gradient(one, images, weights), retain_graph=True)[0]
        for one in (classifier, white)
    ]
    assert cosine(*by_grid) > 0.3
    assert classifier.queries == 301


@pytest.mark.parametrize("options", [{"queries": 0}, {"queries": 5}, {"sigma": 0.0}, {"sigma": 1.5}])
def test_options_out_of_range_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(SpecError, match="an even number of queries, at least 2, with 0 < sigma <= 1"):
        score_based(fake_classifier(), seed=0, **options)  # type: ignore[arg-type]


def test_a_classifier_of_8_bit_images_is_refused() -> None:
    with pytest.raises(ClassifierError, match="'fake' takes 8-bit images only"):
        score_based(resized(fake_classifier(), (8, 8)), seed=0)
