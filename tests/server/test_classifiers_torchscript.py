"""TorchScript classifiers: the contract, the size of the images, and the files that are refused before they run."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from trompe_server.classifiers import NetworkClassifier, WhiteBoxClassifier, load_classifier
from trompe_shared.errors import ClassifierError

SIZE = (20, 24)


def network() -> nn.Sequential:
    """A convolution with a batch norm that has seen some data, then a linear layer; fixed weights."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        layers = nn.Sequential(
            nn.Conv2d(3, 8, 3), nn.BatchNorm2d(8), nn.Tanh(), nn.AdaptiveAvgPool2d(2), nn.Flatten(), nn.Linear(32, 5)
        )
        assert isinstance(layers[1], nn.BatchNorm2d)
        layers[1].running_mean = torch.randn(8)
        layers[1].running_var = torch.rand(8) + 0.5
    return layers.eval()


class Function(nn.Module):
    """A network with no weights."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, image: Tensor) -> Tensor:
        return self.function(image)


class Saves(nn.Module):
    """A network that writes a file when it runs."""

    def __init__(self, mark: str) -> None:
        super().__init__()
        self.mark = mark

    def forward(self, image: Tensor) -> Tensor:
        torch.save(image, self.mark)
        return image.mean((2, 3))


class Wakes(nn.Module):
    """A network that runs code when it is read."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = 1.0

    def forward(self, image: Tensor) -> Tensor:
        return image.mean((2, 3)) * self.scale

    @torch.jit.export
    def __getstate__(self) -> tuple[float, bool]:
        return (self.scale, self.training)

    @torch.jit.export
    def __setstate__(self, state: tuple[float, bool]) -> None:
        self.scale = state[0]
        self.training = state[1]


def script(module: nn.Module, path: Path, *, image_size: str | None = "20 24") -> Path:
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        extra = None if image_size is None else {"image_size": image_size}
        torch.jit.save(torch.jit.script(module), path, _extra_files=extra)
    return path


def trace(module: nn.Module, path: Path, shape: tuple[int, ...] = (2, 3, *SIZE)) -> Path:
    with warnings.catch_warnings(action="ignore"):
        torch.jit.save(torch.jit.trace(module, torch.rand(shape)), path)
    return path


@pytest.mark.parametrize("ending", [".pt", ".torchscript"])
@pytest.mark.parametrize("write", [script, trace])
def test_a_torchscript_file_is_the_network_it_was(write: Callable[..., Path], ending: str, tmp_path: Path) -> None:
    classifier = load_classifier(write(network(), tmp_path / f"net{ending}"), classes=list("abcde"))
    assert isinstance(classifier, NetworkClassifier)
    assert isinstance(classifier, WhiteBoxClassifier)
    assert (classifier.name, classifier.image_size, classifier.n_classes) == ("net", SIZE, 5)
    assert classifier.classes == tuple("abcde")
    images = torch.rand((3, 3, *SIZE), generator=torch.Generator().manual_seed(2)).requires_grad_()
    for _ in range(3):  # TorchScript compiles itself anew on its first calls
        torch.testing.assert_close(classifier.logits(images), network()(images))
        gradients = [
            torch.autograd.grad(net(images).square().sum(), images)[0] for net in (classifier.logits, network())
        ]
        torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)
    assert not any(parameter.requires_grad for parameter in classifier.network.parameters())


def test_a_torchscript_network_judges_any_number_of_images(tmp_path: Path) -> None:
    classifier = load_classifier(trace(network(), tmp_path / "net.pt"))
    images = np.random.default_rng(0).integers(0, 256, (11, *SIZE, 3), np.uint8)
    alone = np.concatenate([classifier.predict(image[None]) for image in images])
    np.testing.assert_allclose(classifier.predict(images), alone, rtol=1e-4, atol=1e-5)
    assert classifier.predict(images[:0]).shape == (0, 5)


def test_the_caller_may_tell_the_size_that_a_script_does_not(tmp_path: Path) -> None:
    file = script(network(), tmp_path / "net.pt", image_size=None)
    assert load_classifier(file, image_size=(40, 30)).image_size == (40, 30)
    with pytest.raises(ClassifierError, match="does not tell the size of its images; write it into the file"):
        load_classifier(file)


@pytest.mark.parametrize("text", ["224", "0 4", "4 x 4", "-4 4"])
def test_a_size_that_is_none_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match="not height and width, such as '224 224'"):
        load_classifier(script(network(), tmp_path / "net.pt", image_size=text))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        pytest.param(lambda x: x.mean((2, 3)).softmax(1), "ends in a softmax", id="probabilities"),
        pytest.param(lambda x: x, r"its output for two images is torch.float32 \(2, 3,", id="images"),
        pytest.param(lambda x: x.mean((2, 3)) / 0, "not finite", id="not finite"),
        pytest.param(lambda x: x.mean((2, 3)).round(), "no gradient in the image", id="rounded"),
    ],
)
def test_a_torchscript_network_that_breaks_the_contract_is_refused(
    function: Callable[[Tensor], Tensor], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ClassifierError, match=message):
        load_classifier(trace(Function(function), tmp_path / "net.pt"))


def test_a_torchscript_network_that_does_not_run_on_its_size_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match="does not run on two images"):
        load_classifier(script(nn.Sequential(nn.Flatten(), nn.Linear(4, 2)), tmp_path / "net.pt"))


def test_a_network_that_writes_files_is_refused_before_it_runs(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    file = script(Saves(str(mark)), tmp_path / "net.pt")
    with pytest.raises(ClassifierError, match="the operator aten::save"):
        load_classifier(file)
    assert not mark.exists()


def test_a_network_that_runs_code_while_it_is_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match="__setstate__ in 'code/"):
        load_classifier(script(Wakes(), tmp_path / "net.pt"))


@pytest.mark.parametrize("what", ["module", "state dict", "nothing", "damaged"])
def test_what_is_no_torchscript_is_refused_unread(what: str, tmp_path: Path) -> None:
    file = tmp_path / "net.pt"
    if what == "damaged":
        file.write_bytes(trace(network(), file).read_bytes()[:2000])
    elif what == "nothing":
        file.write_bytes(b"")
    else:
        torch.save(network() if what == "module" else network().state_dict(), file)
    with pytest.raises(ClassifierError, match=r"'net.pt' cannot be read as TorchScript"):
        load_classifier(file)
