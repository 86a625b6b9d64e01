"""Classifiers of ART and foolbox are victims, and ours are classifiers of ART and foolbox."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tests.attack_runs import default_sampling
from tests.fakes import FakeTarget, fake_classifier
from trompe_server import attack_object
from trompe_server.attack import Budget
from trompe_server.classifiers import NetworkClassifier, from_art, from_foolbox
from trompe_shared.errors import ClassifierError
from trompe_shared.object3d import Object3D

pytestmark = pytest.mark.filterwarnings("ignore")
MEAN, STD = [100.0, 120.0, 140.0], [50.0, 60.0, 70.0]


def of_foolbox(network: nn.Module) -> NetworkClassifier:
    foolbox = pytest.importorskip("foolbox")
    model = foolbox.PyTorchModel(network, bounds=(0, 255), preprocessing={"mean": MEAN, "std": STD, "axis": -3})
    return from_foolbox(model, image_size=(32, 32))


def of_art(network: nn.Module, **options: Any) -> NetworkClassifier:
    art = pytest.importorskip("art.estimators.classification")
    shape = (1, 3, 1, 1)
    ready = (np.reshape(MEAN, shape).astype(np.float32), np.reshape(STD, shape).astype(np.float32))
    given = {"clip_values": (0, 255), "preprocessing": ready, "input_shape": (3, 32, 32), "device_type": "cpu"}
    return from_art(art.PyTorchClassifier(network, nn.CrossEntropyLoss(), nb_classes=10, **given | options))


Adapt = Callable[..., NetworkClassifier]


@pytest.mark.parametrize("adapt", [of_foolbox, of_art])
def test_its_preprocessing_and_range_of_values_are_kept(adapt: Adapt) -> None:
    network = fake_classifier().network.eval()
    classifier = adapt(network)
    assert (classifier.image_size, classifier.n_classes) == ((32, 32), 10)
    images = torch.rand((3, 3, 32, 32), generator=torch.Generator().manual_seed(0)).requires_grad_()
    mean, std = (torch.tensor(each).reshape(3, 1, 1) for each in (MEAN, STD))
    expected, found = network((255 * images - mean) / std), classifier.logits(images)
    torch.testing.assert_close(found, expected)
    gradients = [torch.autograd.grad(each.sum(), images)[0] for each in (found, expected)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("adapt", [of_foolbox, of_art])
def test_an_attack_on_it_is_one_call(adapt: Adapt, mug: Object3D) -> None:
    classifier, target = adapt(fake_classifier().network.eval()), FakeTarget(2000)
    options: dict[str, Any] = {"target": target, "budget": Budget(epsilon=0.5, alpha=0.1), "steps": 2}
    with default_sampling():
        attacked = attack_object(mug, classifier, label=0, **options)
    assert attacked.painted.n_texels == mug.n_texels
    assert attacked.target.views == 40


def test_our_networks_are_classifiers_of_foolbox_and_art() -> None:
    classifier = fake_classifier()
    images = torch.rand((2, 3, 32, 32), generator=torch.Generator().manual_seed(0))
    foolbox = pytest.importorskip("foolbox")
    theirs = foolbox.PyTorchModel(classifier.network.eval(), bounds=(0, 1))
    torch.testing.assert_close(theirs(images), classifier.logits(images))
    art = pytest.importorskip("art.estimators.classification")
    model = art.PyTorchClassifier(
        classifier.network, nn.CrossEntropyLoss(), (3, 32, 32), 10, clip_values=(0, 1), device_type="cpu"
    )
    torch.testing.assert_close(torch.from_numpy(model.predict(images.numpy())), classifier.scores(images))


def test_what_is_no_classifier_of_torch_is_refused() -> None:
    network = fake_classifier().network.eval()
    with pytest.raises(ClassifierError, match="Expected foolbox's PyTorchModel, got "):
        from_foolbox(network, image_size=(32, 32))
    with pytest.raises(ClassifierError, match="Expected ART's PyTorchClassifier, got "):
        from_art(network)


def test_an_art_classifier_that_changes_its_scores_is_refused() -> None:
    defences = pytest.importorskip("art.defences.postprocessor")
    with pytest.raises(ClassifierError, match=r"changes scores by .*ReverseSigmoid"):
        of_art(fake_classifier().network.eval(), postprocessing_defences=defences.ReverseSigmoid())


@pytest.mark.parametrize("options", [{"clip_values": None}, {"input_shape": (28, 28)}])
def test_an_art_classifier_of_other_images_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ClassifierError, match=r"expected \(3, H, W\) and two numbers"):
        of_art(fake_classifier().network.eval(), **options)
