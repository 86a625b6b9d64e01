"""A classifier that looks at images at random places: which, and what comes back of it."""

import numpy as np
import pytest
import torch

from trompe_server.classifiers import DiverseClassifier, WhiteBoxClassifier, fake_classifier, resized
from trompe_server.classifiers.protocol import innermost

GENERATOR = torch.Generator().manual_seed(0)
IMAGES = torch.rand(3, 3, 32, 32, generator=GENERATOR)
FAKE = fake_classifier(classes=tuple("abcdefghij"))


class Seen:
    """Stands in for a classifier; remembers the images that it was shown."""

    name, image_size, n_classes, classes = "seen", (32, 32), 10, None

    def __init__(self) -> None:
        self.images = torch.zeros(0)

    def logits(self, images: torch.Tensor) -> torch.Tensor:
        self.images = images
        return images.mean((2, 3)).repeat(1, 4)[:, :10]

    def predict(self, images: np.ndarray) -> np.ndarray:
        raise NotImplementedError


def shown(images: torch.Tensor, seed: int = 0) -> torch.Tensor:
    seen = Seen()
    DiverseClassifier(seen, seed).logits(images)
    return seen.images


def test_it_says_of_itself_and_of_8_bit_images_what_the_inner_one_says() -> None:
    diverse = DiverseClassifier(FAKE, 3)
    assert isinstance(diverse, WhiteBoxClassifier)
    assert (diverse.name, diverse.image_size, diverse.n_classes) == (FAKE.name, (32, 32), 10)
    assert diverse.classes == FAKE.classes
    images = np.random.default_rng(0).integers(0, 256, (3, 40, 40, 3), np.uint8)
    np.testing.assert_array_equal(diverse.predict(images), FAKE.predict(images))


def test_the_same_images_are_shown_at_the_same_places_whatever_was_shown_before() -> None:
    diverse = DiverseClassifier(FAKE, 3)
    first = diverse.logits(IMAGES)
    diverse.logits(IMAGES / 2)
    assert torch.equal(diverse.logits(IMAGES.contiguous(memory_format=torch.channels_last)), first)
    assert torch.equal(DiverseClassifier(FAKE, 3).logits(IMAGES), first)


def test_other_seeds_and_other_images_have_other_places() -> None:
    assert not torch.equal(shown(IMAGES, 0), shown(IMAGES, 1))
    same = IMAGES[:1].expand(3, -1, -1, -1)
    places = shown(same)
    assert not torch.equal(places[0], places[1])
    brighter = IMAGES.clone()
    brighter[2] += 1e-6
    assert (shown(brighter)[0] - shown(IMAGES)[0]).abs().max() > 0.1


def test_places_are_shifts_scales_and_mirrors_within_their_bounds() -> None:
    rows = torch.linspace(-1, 1, 64).view(1, 1, 64, 1).expand(200, 1, 64, 64)
    ramps = torch.cat([rows, rows.transpose(2, 3), rows], 1)
    found = shown(ramps)
    scale = (found[:, 0, 33, 32] - found[:, 0, 31, 32]) * 31.5 / 2
    across = (found[:, 1, 32, 33] - found[:, 1, 32, 31]) * 31.5 / 2
    torch.testing.assert_close(across.abs(), scale, rtol=1e-3, atol=1e-3)
    assert 3 / 4 - 1e-3 < float(scale.min()) < 0.8 < 1.25 < float(scale.max()) < 4 / 3 + 1e-3
    assert 70 < int((across < 0).sum()) < 130
    middle = found[:, :2, 31:33, 31:33].mean((2, 3)).abs()
    assert 0.13 < float(middle.max()) < 0.155


def test_what_is_beyond_the_image_looks_like_its_border() -> None:
    white = torch.ones(20, 3, 32, 32)
    white[:, :, 8:24, 8:24] = 0
    assert float(shown(white)[:, :, [0, -1]].min()) == pytest.approx(1)


def test_the_gradient_comes_back_to_where_the_image_was_looked_at() -> None:
    leaf = IMAGES.clone().requires_grad_()
    places = shown(leaf)
    weights = torch.rand(places.shape, generator=torch.Generator().manual_seed(1))
    (gradient,) = torch.autograd.grad((places * weights).sum(), leaf)
    assert float((gradient * IMAGES).sum()) == pytest.approx(float((places * weights).sum().detach()), rel=1e-4)
    assert gradient.abs().amax((1, 2, 3)).min() > 0


def test_wrappers_can_be_taken_off() -> None:
    assert innermost(DiverseClassifier(resized(FAKE, (48, 48)), 0)) is FAKE
    assert innermost(FAKE) is FAKE
