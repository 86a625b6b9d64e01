"""Wrappers: other image sizes, and ensembles of members with the same classes."""

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from tests.fakes import fake_classifier
from trompe_server.classifiers import WhiteBoxClassifier, as_ensemble, resized
from trompe_shared.errors import ClassifierError

NAMES = tuple("abcdefghij")
FAKE = fake_classifier(classes=NAMES)


@pytest.mark.parametrize("size", [(20, 40), (64, 64), (31, 32)])
def test_a_resized_classifier_looks_at_the_images_as_its_predictions_do(size: tuple[int, int]) -> None:
    assert resized(FAKE, FAKE.image_size) is FAKE
    classifier = resized(FAKE, size)
    assert isinstance(classifier, WhiteBoxClassifier)
    assert (classifier.name, classifier.image_size, classifier.n_classes) == ("fake", size, 10)
    assert classifier.classes == NAMES
    images = np.random.default_rng(0).integers(0, 256, (3, *size, 3), np.uint8)
    inputs = torch.from_numpy(images).permute(0, 3, 1, 2).float().div(255).requires_grad_()
    logits = classifier.logits(inputs)
    np.testing.assert_allclose(logits.detach().numpy(), classifier.predict(images), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(classifier.predict(images), FAKE.predict(images))


def test_the_gradient_goes_through_the_change_of_size() -> None:
    inner = fake_classifier(image_size=(16, 16))
    images = torch.rand((2, 3, 24, 20), generator=torch.Generator().manual_seed(0)).requires_grad_()
    by_hand = inner.logits(F.interpolate(images, (16, 16), mode="bilinear", antialias=True))
    expected = torch.autograd.grad(by_hand[:, 1].sum(), images)[0]
    found = torch.autograd.grad(resized(inner, (24, 20)).logits(images)[:, 1].sum(), images)[0]
    assert found.shape == images.shape
    torch.testing.assert_close(found, expected)
    assert found.abs().amax((1, 2, 3)).min() > 0


def test_an_ensemble_takes_images_of_its_first_members_size() -> None:
    first, second = fake_classifier(image_size=(16, 24)), fake_classifier(image_size=(32, 32), seed=1)
    members = as_ensemble([first, second])
    assert members[0] is first
    assert [member.image_size for member in members] == [(16, 24), (16, 24)]
    assert as_ensemble([second]) == (second,)


@pytest.mark.parametrize("order", [1, -1])
def test_members_of_other_classes_are_refused(order: int) -> None:
    swapped = ("b", "a", *NAMES[2:])
    unnamed = fake_classifier()
    assert len(as_ensemble([unnamed, fake_classifier(classes=NAMES)][::order])) == 2
    with pytest.raises(ClassifierError, match=r"class 0 is '[ab]' for one and '[ab]' for the other"):
        as_ensemble([fake_classifier(classes=NAMES), unnamed, fake_classifier(classes=swapped)][::order])
    with pytest.raises(ClassifierError, match=r"they have (10 and 9|9 and 10) classes"):
        as_ensemble([unnamed, fake_classifier(n_classes=9)][::order])
    with pytest.raises(ClassifierError, match="at least one classifier"):
        as_ensemble([])


def test_longer_and_shorter_names_of_the_same_classes_agree() -> None:
    short = fake_classifier(n_classes=2, classes=("tench", "crane bird"))
    assert len(as_ensemble([short, fake_classifier(n_classes=2, classes=("tench, Tinca tinca", "crane"))])) == 2
    assert len(as_ensemble([short, fake_classifier(n_classes=2, classes=("tench", "crane_bird"))])) == 2
    with pytest.raises(ClassifierError, match="class 1 is 'crane bird' for one and 'heron' for the other"):
        as_ensemble([short, fake_classifier(n_classes=2, classes=("tench", "heron"))])
