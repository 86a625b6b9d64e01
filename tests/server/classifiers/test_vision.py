"""torchvision's networks by name: their own size and normalisation, and never random weights."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tests.torchvision_here import import_torchvision
from trompe_server.classifiers import NetworkClassifier, load_classifier
from trompe_server.classifiers.fold import Formatted
from trompe_shared.errors import ClassifierError


@pytest.fixture(scope="module")
def models() -> Any:
    return import_torchvision()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in place of torch's cache of weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    return tmp_path / "hub" / "checkpoints"


def real(models: Any, name: str, **options: Any) -> nn.Module:
    """The real architecture with random weights, its batch norms as if they had seen data."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network: nn.Module = models.get_model(name, weights=None, **options).eval()
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.running_mean = 0.1 * torch.randn(module.num_features)
                module.running_var = torch.rand(module.num_features) + 0.5
    return network


def saved(network: nn.Module, path: Path) -> Path:
    torch.save(network.state_dict(), path)
    return path


def white_box(*arguments: Any, **options: Any) -> NetworkClassifier:
    classifier = load_classifier(*arguments, **options)
    assert isinstance(classifier, NetworkClassifier)
    return classifier


@pytest.mark.parametrize(
    ("name", "options", "size"),
    [
        pytest.param("mobilenet_v2", {}, 224, id="mobilenet_v2"),
        pytest.param("inception_v3", {"init_weights": False, "transform_input": True}, 299, id="inception_v3"),
    ],
)
def test_a_torchvision_network_has_its_own_size_classes_and_normalisation(
    name: str, options: dict[str, Any], size: int, models: Any, tmp_path: Path
) -> None:
    network = real(models, name, **options)
    classifier = white_box(f"torchvision:{name}", weights=saved(network, tmp_path / "weights.pth"))
    assert (classifier.name, classifier.image_size, classifier.n_classes) == (name, (size, size), 1000)
    assert classifier.classes is not None
    assert classifier.classes[0] == "tench"
    image = np.random.default_rng(0).integers(0, 256, (1, size, size, 3), np.uint8)
    normalised = models.get_model_weights(name).DEFAULT.transforms()
    ready = (torch.from_numpy(image).permute(0, 3, 1, 2) / 255 - torch.tensor(normalised.mean).reshape(3, 1, 1)) / (
        torch.tensor(normalised.std).reshape(3, 1, 1)
    )
    with torch.no_grad():
        expected = network(ready)
    scale = float(expected.abs().max())
    np.testing.assert_allclose(classifier.predict(image) / scale, expected / scale, atol=1e-4)
    assert isinstance(classifier.network, Formatted), "it was not made faster"


def test_weights_are_found_in_torchs_cache(models: Any, cache: Path) -> None:
    network = real(models, "squeezenet1_1")
    saved(network, cache / "squeezenet1_1-b8a52dc0.pth")
    for classifier in (
        white_box("squeezenet1_1"),
        white_box("torchvision:squeezenet1_1", weights="IMAGENET1K_V1", name="mine"),
    ):
        images = torch.rand((1, 3, 224, 224), generator=torch.Generator().manual_seed(1))
        mean, std = (torch.tensor(v).reshape(3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
        torch.testing.assert_close(classifier.logits(images), network((images - mean) / std), atol=1e-4, rtol=1e-4)


def test_weights_that_are_nowhere_are_not_made_up(models: Any, cache: Path, tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match=r"no file '.*mobilenet_v2-7ebf99e0.pth'.*nothing is downloaded"):
        load_classifier("mobilenet_v2")
    with pytest.raises(ClassifierError, match="one of IMAGENET1K_V1, IMAGENET1K_V2"):
        load_classifier("mobilenet_v2", weights=tmp_path / "absent.pth")


def test_a_network_of_other_classes_is_read_with_their_names(models: Any, tmp_path: Path) -> None:
    file = saved(real(models, "squeezenet1_1", num_classes=3), tmp_path / "own.pth")
    classifier = white_box("squeezenet1_1", weights=file, classes=["mug", "ball", "lamp"])
    assert (classifier.n_classes, classifier.classes) == (3, ("mug", "ball", "lamp"))
    with pytest.raises(ClassifierError, match=r"'own.pth' do not fit torchvision's 'squeezenet1_1' with 1000 classes"):
        load_classifier("squeezenet1_1", weights=file)


def test_weights_are_read_as_tensors_alone(models: Any, tmp_path: Path) -> None:
    file = tmp_path / "whole.pth"
    torch.save(real(models, "squeezenet1_1"), file)
    with pytest.raises(ClassifierError, match="expected a state dict of tensors alone"):
        load_classifier("squeezenet1_1", weights=file)
    torch.save({"epoch": 3}, file)
    with pytest.raises(ClassifierError, match="contains no state dict"):
        load_classifier("squeezenet1_1", weights=file)


def test_a_name_that_torchvision_does_not_have_is_answered_with_some_that_it_has(models: Any) -> None:
    with pytest.raises(ClassifierError, match=r"no classification network 'mobilnet_v2'.*mobilenet_v2"):
        load_classifier("torchvision:mobilnet_v2")
    with pytest.raises(ClassifierError, match="no classification network 'fasterrcnn_resnet50_fpn'"):
        load_classifier("torchvision:fasterrcnn_resnet50_fpn")


def test_without_torchvision_a_name_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchvision.models", None)
    for name in ("mobilenet_v2", "torchvision:mobilenet_v2"):
        with pytest.raises(ClassifierError, match=r"torchvision is not installed.*'vision' extra"):
            load_classifier(name)
    with pytest.raises(ClassifierError, match="Or give 'tiny'"):
        load_classifier("mobilenet_v2")


def test_a_torchvision_for_another_torch_is_told_from_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "torchvision").mkdir()
    (tmp_path / "torchvision" / "__init__.py").write_text("raise RuntimeError('operator torchvision::nms is missing')")
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ClassifierError, match=r"another build of torch than .*torchvision::nms is missing"):
        load_classifier("mobilenet_v2")
