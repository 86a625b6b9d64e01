"""Saliency of images against its formula, and the masks by tau."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.fakes import fake_classifier
from trompe_server.attack import Goal, image_gradients, saliency, saliency_masks
from trompe_server.classifiers import NetworkClassifier
from trompe_shared.errors import SpecError


def test_saliency_is_scaled_over_all_views_to_end_at_zero_and_one() -> None:
    images = np.random.default_rng(0).integers(0, 256, (13, 32, 32, 3), dtype=np.uint8)
    classifier = fake_classifier()
    maps = saliency(images, classifier, goal=Goal(3))
    assert maps.shape == (13, 32, 32)
    assert (float(maps.min()), float(maps.max())) == (0.0, 1.0)
    gradients = []
    for image in images:
        leaf = (torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255).requires_grad_()
        (gradient,) = torch.autograd.grad(Goal(3).margins(classifier.logits(leaf)).sum(), leaf)
        gradients.append(gradient[0].abs().mean(0))
    expected = torch.stack(gradients)
    torch.testing.assert_close(maps, (expected - expected.min()) / (expected.max() - expected.min()), atol=1e-4, rtol=0)


def test_image_gradients_are_those_of_the_loss_with_their_sign() -> None:
    images = np.random.default_rng(1).integers(0, 256, (11, 32, 32, 3), dtype=np.uint8)
    classifier, goal = fake_classifier(), Goal(3, loss="cross_entropy")
    found = image_gradients(images, classifier, goal=goal)
    leaf = (torch.from_numpy(images).float() / 255).requires_grad_()
    (expected,) = torch.autograd.grad(goal.losses(classifier.logits(leaf.permute(0, 3, 1, 2))).sum(), leaf)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-4)
    maps = saliency(images, classifier, goal=goal)
    torch.testing.assert_close((maps == 1).nonzero(), (found.abs().mean(3) == found.abs().mean(3).max()).nonzero())


def test_saliency_of_a_classifier_that_does_not_care_is_zero() -> None:
    last = torch.nn.Linear(12, 2)
    torch.nn.init.zeros_(last.weight)
    deaf = torch.nn.Sequential(torch.nn.Flatten(), last)
    maps = saliency(np.zeros((2, 2, 2, 3), np.uint8), NetworkClassifier("deaf", deaf, (2, 2), 2), goal=Goal(0))
    assert (maps == 0).all()


def test_masks_are_the_pixels_of_at_least_tau() -> None:
    maps = torch.tensor([[[0.0, 0.05, 0.2, 1.0]]])
    assert saliency_masks(maps, 0.05).tolist() == [[[False, True, True, True]]]
    assert saliency_masks(maps, 0.0).all()


class Steep(torch.nn.Module):
    """Logits whose gradient is a high power of the image: dark views are hardly sensitive."""

    def forward(self, images: Tensor) -> Tensor:
        steep = (images**9).sum((1, 2, 3))
        return torch.stack([-steep, 0 * steep], 1)


STEEP = NetworkClassifier("steep", Steep(), (4, 4), 2)


def test_saliency_compares_views_so_that_a_dark_one_has_no_pixels() -> None:
    images = np.zeros((3, 4, 4, 3), np.uint8)
    images[0, :2], images[1, 1:3] = 255, 2  # the second view is 255 / 2 to the eighth, 7e16, times less sensitive
    maps = saliency(images, STEEP, goal=Goal(0)).half().float()
    assert saliency_masks(maps, 0.2).any(2).tolist() == [[True, True, False, False], [False] * 4, [False] * 4]


def test_insensitive_views_leave_no_pixels() -> None:
    maps = saliency(np.zeros((2, 4, 4, 3), np.uint8), STEEP, goal=Goal(0))
    assert (maps == 0).all()
    with pytest.raises(SpecError, match=r"`tau: 0\.01` or more; lower it"):
        saliency_masks(maps, 0.01)
