"""Networks by name, from torchvision and torch hub: their own size and normalisation, and never random weights."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from trompe_server.classifiers import NetworkClassifier, load_classifier
from trompe_server.classifiers.fold import Formatted
from trompe_shared.errors import ClassifierError


@pytest.fixture(scope="module")
def models() -> Any:
    """torchvision's networks. Where torchvision was built for another torch its compiled operators are missing; no
    classification network uses one, so names for those that it looks for while it is imported are enough."""
    try:
        return importlib.import_module("torchvision.models")
    except ImportError:
        pytest.skip("torchvision is not installed")
    except RuntimeError:
        for name in ("nms", "qnms"):
            schema = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
            torch.library.define(f"torchvision::{name}", schema)
        return importlib.import_module("torchvision.models")


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Path]:
    """An empty cache in place of torch's own."""
    before = torch.hub.get_dir()
    torch.hub.set_dir(tmp_path / "hub")  # type: ignore[no-untyped-call]
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    yield tmp_path / "hub"
    torch.hub.set_dir(before)  # type: ignore[no-untyped-call]


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


def test_weights_are_found_in_torchs_cache(models: Any, hub: Path) -> None:
    network = real(models, "squeezenet1_1")
    saved(network, hub / "checkpoints" / "squeezenet1_1-b8a52dc0.pth")
    for classifier in (
        white_box("squeezenet1_1"),
        white_box("torchvision:squeezenet1_1", weights="IMAGENET1K_V1", name="mine"),
    ):
        images = torch.rand((1, 3, 224, 224), generator=torch.Generator().manual_seed(1))
        mean, std = (torch.tensor(v).reshape(3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
        torch.testing.assert_close(classifier.logits(images), network((images - mean) / std), atol=1e-4, rtol=1e-4)


def test_weights_that_are_nowhere_are_not_made_up(models: Any, hub: Path, tmp_path: Path) -> None:
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
    with pytest.raises(ClassifierError, match="holds no state dict"):
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


HUBCONF = """
import torch
from torch import nn

def _net(seed):
    torch.manual_seed(seed)
    return nn.Sequential(nn.AdaptiveAvgPool2d(2), nn.Flatten(), nn.Linear(12, 4))

def trained(pretrained=False, **options):
    assert not options
    return _net(5) if pretrained else nn.Sequential(nn.AdaptiveAvgPool2d(2), nn.Flatten(), nn.Linear(12, 4))

def modern(*, weights=None):
    return trained(pretrained=weights == "DEFAULT")

def plain():
    return _net(5)

def untrained():
    return trained()

def told():
    network = _net(5)
    network.pretrained_cfg = {"input_size": (3, 40, 48), "mean": (0.5,) * 3, "std": (0.25,) * 3, "url": ""}
    return network

def offline(pretrained=False):
    raise OSError("no route")

def text():
    return "network"

def wanting(depth):
    return _net(5)
"""


@pytest.fixture
def repository(hub: Path) -> Path:
    """A hub repository in the cache."""
    folder = hub / "someone_nets_main"
    folder.mkdir()
    (folder / "hubconf.py").write_text(HUBCONF)
    return folder


def hub_network(seed: int) -> nn.Module:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return nn.Sequential(nn.AdaptiveAvgPool2d(2), nn.Flatten(), nn.Linear(12, 4))


@pytest.mark.usefixtures("repository")
@pytest.mark.parametrize(
    ("model", "size", "mean", "std"),
    [
        *(
            (model, (224, 224), (0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
            for model in ("trained", "modern", "plain")
        ),
        ("told", (40, 48), (0.5, 0.5, 0.5), (0.25, 0.25, 0.25)),
    ],
)
def test_a_hub_network_is_loaded_with_its_weights_and_normalisation(
    model: str, size: tuple[int, int], mean: tuple[float, ...], std: tuple[float, ...]
) -> None:
    classifier = white_box(f"hub:someone/nets:{model}", classes=list("abcd"))
    assert (classifier.name, classifier.image_size, classifier.classes) == (model, size, tuple("abcd"))
    images = torch.rand((2, 3, *size), generator=torch.Generator().manual_seed(1))
    ready = (images - torch.tensor(mean).reshape(3, 1, 1)) / torch.tensor(std).reshape(3, 1, 1)
    torch.testing.assert_close(classifier.logits(images), hub_network(5)(ready), atol=1e-5, rtol=1e-4)


@pytest.mark.usefixtures("repository")
def test_a_hub_network_takes_weights_from_a_file_and_a_size_from_the_caller(tmp_path: Path) -> None:
    file = saved(hub_network(9), tmp_path / "own.pth")
    classifier = white_box("hub:someone/nets:untrained", weights=file, image_size=(32, 32))
    assert classifier.image_size == (32, 32)
    grey = torch.full((1, 3, 32, 32), 0.449)
    mean, std = (torch.tensor(v).reshape(3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    torch.testing.assert_close(classifier.logits(grey), hub_network(9)((grey - mean) / std), atol=1e-5, rtol=1e-4)
    with pytest.raises(ClassifierError, match=r"'bad.pth' does not fit"):
        load_classifier("hub:someone/nets:plain", weights=saved(nn.Linear(2, 2), tmp_path / "bad.pth"))


@pytest.mark.usefixtures("repository")
@pytest.mark.parametrize(
    ("reference", "message"),
    [
        pytest.param("hub:someone/nets:untrained", "comes with random weights", id="random weights"),
        pytest.param("hub:someone/nets:offline", r"cannot be loaded \(OSError: no route\)", id="weights missing"),
        pytest.param("hub:someone/nets:absent", "'absent' of 'someone_nets_main' cannot be loaded", id="no such model"),
        pytest.param("hub:someone/nets:text", "it is a str, not a network", id="no network"),
        pytest.param("hub:someone/nets:wanting", "wants arguments that are not known here", id="arguments"),
        pytest.param("hub:someone/other:net", "'someone/other' is not in torch's cache", id="not in the cache"),
        pytest.param("hub:someone/nets:v2:plain", "'someone/nets:v2' is not in torch's cache", id="another branch"),
        pytest.param("hub:nets:plain", "'nets' is no hub repository", id="no owner"),
    ],
)
def test_a_hub_network_that_cannot_be_had_with_trained_weights_is_refused(reference: str, message: str) -> None:
    with pytest.raises(ClassifierError, match=message):
        load_classifier(reference)


def test_options_that_a_classifier_cannot_use_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match="'tiny' has its own weights"):
        load_classifier("tiny", weights=tmp_path / "w.pth")
    with pytest.raises(ClassifierError, match=r"takes images of \(128, 128\), not \(64, 64\)"):
        load_classifier("tiny", image_size=(64, 64))


def test_a_device_that_is_not_there_is_refused() -> None:
    for device in ("nonsense", "cuda:99"):
        with pytest.raises(ClassifierError, match=f"The device '{device}' cannot be used here"):
            load_classifier("tiny", device=device)
