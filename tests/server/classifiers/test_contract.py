"""Classifiers: the contract they keep, the files that are refused, and the speed-up that may not change a function."""

import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from tests.fakes import fake_classifier
from tests.pretend_device import pretend_device
from tests.small_models import zipped
from trompe_server.classifiers import (
    Classifier,
    NetworkClassifier,
    ScoringClassifier,
    WhiteBoxClassifier,
    inspect,
    load_classifier,
    resized,
    score_based,
)
from trompe_server.classifiers.archive import read_program
from trompe_server.classifiers.contract import check_contract, sample_images
from trompe_server.classifiers.convolution import convolved
from trompe_server.classifiers.fold import BATCH_NORM, NAMES, PAD, Formatted, fold_batch_norm
from trompe_server.classifiers.onnx import OnnxClassifier, load_onnx
from trompe_server.classifiers.protocol import AT_ONCE, fit_images
from trompe_shared.errors import ClassifierError

SIZE = (20, 24)


class Net(nn.Module):
    """Convolutions with batch norm that has seen some data, then a linear layer."""

    def __init__(self, n_classes: int = 7) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.body = nn.Sequential(
            nn.Conv2d(3, 8, 3, stride=2, bias=False),
            nn.BatchNorm2d(8),
            nn.ReLU(),
            nn.Conv2d(8, 8, 3, padding=1, groups=8),
            nn.BatchNorm2d(8, affine=False),
            nn.ReLU6(),
            nn.AdaptiveAvgPool2d(2),
            nn.Flatten(),
            nn.Linear(32, n_classes),
        )

    def forward(self, image: Tensor) -> Tensor:
        logits: Tensor = self.body((image - 0.5) / 0.25)
        return logits


class Around(nn.Module):
    """Some function of a network's input and output."""

    def __init__(self, function: Callable[[Any, Tensor], Any]) -> None:
        super().__init__()
        self.net, self.function = Net(), function

    def forward(self, image: Tensor) -> Any:
        return self.function(self.net, image)


def filtered_by_itself(image: Tensor) -> Tensor:
    weight = image.mean((2, 3)).reshape(-1, 1, 1, 1) * torch.ones(3, 3)
    together = image.reshape(1, -1, *image.shape[2:])
    found: Tensor = nn.functional.conv2d(together, weight, groups=together.shape[1]).reshape(*image.shape[:2], -1)
    return found[..., None]


class TwoInputs(nn.Module):
    def forward(self, image: Tensor, scale: Tensor) -> Tensor:
        return (image * scale).mean(dim=(2, 3))


def trained(network: nn.Module) -> nn.Module:
    """The network with running statistics that are not those of a new one."""
    generator = torch.Generator().manual_seed(1)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean = torch.randn(module.num_features, generator=generator)
            module.running_var = torch.rand(module.num_features, generator=generator) + 0.5
    return network.eval()


def export(
    network: nn.Module,
    path: Path,
    *,
    shape: tuple[int, ...] = (2, 3, *SIZE),
    dtype: torch.dtype = torch.float32,
    dynamic: bool = True,
    most: int | None = None,
) -> Path:
    image = torch.rand(shape).to(dtype)
    many = torch.export.Dim.DYNAMIC if most is None else torch.export.Dim("batch", max=most)
    batch = ({0: many},) if dynamic else None
    torch.export.save(torch.export.export(trained(network), (image,), dynamic_shapes=batch), path)
    return path


def write_onnx(
    path: Path,
    *,
    batch: int | str = "n",
    channels: int | str = 3,
    size: tuple[int | str, int | str] = SIZE,
    kind: int = TensorProto.FLOAT,
    n_classes: int = 7,
    last: str = "Identity",
    inner: int = -1,
    outputs: tuple[str, ...] = ("logits",),
    **of_last: Any,
) -> Path:
    """A network: mean over the image, then a linear layer. ``inner``: the batch inside its graph, -1 for any."""
    weight = np.random.default_rng(0).normal(size=(3, n_classes)).astype(np.float32)
    nodes = [
        helper.make_node("Cast", ["image"], ["x"], to=TensorProto.FLOAT),
        helper.make_node("GlobalAveragePool", ["x"], ["pooled"]),
        helper.make_node("Constant", [], ["flattened"], value_ints=[inner, 3]),
        helper.make_node("Reshape", ["pooled", "flattened"], ["flat"]),
        helper.make_node("MatMul", ["flat", "weight"], ["raw"]),
        helper.make_node(last, ["raw"], ["logits"], **of_last),
    ]
    image = helper.make_tensor_value_info("image", kind, [batch, channels, *size])
    logits = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, n_classes]) for name in outputs]
    graph = helper.make_graph(nodes, "net", [image], logits, [numpy_helper.from_array(weight, "weight")])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path)
    return path


def noise(count: int, size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, *size, 3), np.uint8)


@pytest.fixture(scope="session")
def pt2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(Net(), tmp_path_factory.mktemp("pt2") / "net.pt2")


def white_box(reference: Path | str, **options: Any) -> NetworkClassifier:
    classifier = load_classifier(reference, **options)
    assert isinstance(classifier, NetworkClassifier)
    return classifier


ONNX: dict[str, dict[str, Any]] = {
    "onnx": {},
    "onnx with a batch of 1": {"batch": 1},
    "onnx with a batch of 4": {"batch": 4},
    "onnx of one image inside": {"inner": 1},
    "onnx that mixes a batch": {"last": "LpNormalization", "axis": 0},
    "onnx with a name for its channels": {"channels": "num_channels"},
}


@pytest.fixture(scope="module", params=["fake", "pt2", "tiny", "resized", "score based", *ONNX])
def classifier(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Classifier:
    if request.param == "fake":
        return fake_classifier()
    if request.param == "resized":
        return resized(fake_classifier(), (16, 40))
    if request.param == "score based":
        return score_based(fake_classifier(), seed=0)
    if request.param == "tiny":
        return load_classifier("tiny")
    if request.param == "pt2":
        return load_classifier(request.getfixturevalue("pt2"))
    return load_classifier(write_onnx(tmp_path_factory.mktemp("onnx") / "net.onnx", **ONNX[request.param]))


def test_every_classifier_gives_float32_logits_for_any_number_of_images(classifier: Classifier) -> None:
    for count in (0, 1, 11):
        logits = classifier.predict(noise(count, classifier.image_size))
        assert logits.shape == (count, classifier.n_classes)
        assert logits.dtype == np.float32


def test_the_logits_of_an_image_do_not_depend_on_its_company(classifier: Classifier) -> None:
    images = noise(11, classifier.image_size)
    alone = np.concatenate([classifier.predict(image[None]) for image in images])
    np.testing.assert_allclose(classifier.predict(images), alone, rtol=1e-4, atol=1e-5)


def test_images_of_another_size_are_resized(classifier: Classifier) -> None:
    flat = np.full((1, 3 * classifier.image_size[0], 50, 3), 90, np.uint8)
    right = np.full((1, *classifier.image_size, 3), 90, np.uint8)
    np.testing.assert_allclose(classifier.predict(flat), classifier.predict(right), rtol=1e-4, atol=1e-5)


def test_scores_of_images_that_are_not_8_bit_are_the_predictions_of_those_that_are(classifier: Classifier) -> None:
    if not isinstance(classifier, ScoringClassifier):
        pytest.skip("gives gradients by a detour of its own")
    images = noise(11, classifier.image_size)
    scores = classifier.scores(fit_images(images, classifier.image_size).requires_grad_())
    assert not scores.requires_grad
    np.testing.assert_allclose(scores.numpy(), classifier.predict(images), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "images",
    [
        pytest.param(np.zeros((2, 8, 8, 3), np.float32), id="not uint8"),
        pytest.param(np.zeros((2, 3, 8, 8), np.uint8), id="channels first"),
        pytest.param(np.zeros((8, 8, 3), np.uint8), id="no batch"),
    ],
)
def test_images_of_another_form_are_refused(classifier: Classifier, images: np.ndarray) -> None:
    with pytest.raises(ClassifierError, match="uint8, sRGB"):
        classifier.predict(images)


def test_what_a_classifier_says_is_finite_and_nan_is_no_class() -> None:
    session = Mock(get_inputs=lambda: [Mock()])
    session.run.return_value = [np.array([[0.0, np.inf, -np.inf, 2.0]], np.float32)]
    classifier, image = OnnxClassifier("odd", session, (8, 8), 4, None), np.zeros((1, 8, 8, 3), np.uint8)
    (logits,) = classifier.predict(image)
    assert np.isfinite(logits).all()
    assert np.argsort(logits).tolist() == [2, 0, 3, 1]
    session.run.return_value[0][0, 0] = np.nan
    with pytest.raises(ClassifierError, match="gives NaN for 1 of 1 images"):
        classifier.predict(image)


def test_resizing_averages_what_it_shrinks() -> None:
    stripes = np.zeros((1, 8, 8, 3), np.uint8)
    stripes[:, ::2] = 255
    small = fit_images(stripes, (2, 2))
    assert small.shape == (1, 3, 2, 2)
    torch.testing.assert_close(small, torch.full_like(small, 0.5), atol=0.1, rtol=0)


def test_white_boxes_agree_with_their_own_predictions_and_train_nothing(pt2: Path) -> None:
    for classifier in (white_box(pt2), fake_classifier(image_size=SIZE), white_box("tiny")):
        assert isinstance(classifier, WhiteBoxClassifier)
        images = noise(3, classifier.image_size)
        inputs = fit_images(images, classifier.image_size).requires_grad_()
        logits = classifier.logits(inputs)
        np.testing.assert_allclose(logits.detach().numpy(), classifier.predict(images), rtol=1e-4, atol=1e-5)
        (gradient,) = torch.autograd.grad(logits.sum(), inputs)
        assert gradient.abs().amax(dim=(1, 2, 3)).min() > 0
        assert not any(parameter.requires_grad for parameter in classifier.network.parameters())


def test_an_exported_network_is_read_with_its_size_classes_and_name(pt2: Path, tmp_path: Path) -> None:
    classifier = load_classifier(pt2, classes=list("abcdefg"))
    assert (classifier.image_size, classifier.n_classes, classifier.name) == (SIZE, 7, "net")
    assert classifier.classes == tuple("abcdefg")
    assert load_classifier(pt2, name="mine").name == "mine"
    tiny = load_classifier("tiny", name="mine", classes=list("abcdefgh"))
    assert (tiny.name, tiny.classes) == ("mine", tuple("abcdefgh"))
    assert load_classifier(shutil.copy(pt2, tmp_path / "NET.PT2")).n_classes == 7


def test_the_number_of_class_names_must_be_that_of_the_logits(pt2: Path, tmp_path: Path) -> None:
    for file in (pt2, write_onnx(tmp_path / "net.onnx"), "tiny"):
        with pytest.raises(ClassifierError, match=r"[78] classes, but 2 class names"):
            load_classifier(file, classes=["a", "b"])


def test_an_exported_network_is_the_network_it_was(pt2: Path) -> None:
    images = fit_images(noise(5), SIZE).requires_grad_()
    classifier, source = white_box(pt2), read_program(pt2).module(check_guards=False)
    torch.testing.assert_close(classifier.logits(images), source(images))
    gradients = [torch.autograd.grad(f(images).square().sum(), images)[0] for f in (classifier.logits, source)]
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)


def test_a_network_with_slashes_in_its_names_is_read_as_keras_writes_it(tmp_path: Path) -> None:
    network = Around(lambda net, x: net(x) + net.get_parameter("dense/bias"))
    network.net.register_parameter("dense/bias", nn.Parameter(torch.arange(7.0)))
    read, images = white_box(export(network, tmp_path / "net.pt2")), torch.rand((2, 3, *SIZE))
    torch.testing.assert_close(read.logits(images), network(images))


def test_a_network_exported_on_a_graphics_card_is_read_without_one(pt2: Path, tmp_path: Path) -> None:
    cpu, card = b'"type": "cpu", "index": null', b'"type": "cuda", "index": 0'
    with zipfile.ZipFile(pt2) as old, zipfile.ZipFile(tmp_path / "card.pt2", "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name).replace(cpu, card))
    assert card in (tmp_path / "card.pt2").read_bytes()
    np.testing.assert_array_equal(white_box(tmp_path / "card.pt2").predict(noise(2)), white_box(pt2).predict(noise(2)))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64], ids=str)
def test_logits_of_any_precision_become_float32(dtype: torch.dtype, tmp_path: Path) -> None:
    network = white_box(export(Around(lambda net, x: net(x).to(dtype)), tmp_path / "net.pt2"))
    images = noise(2)
    logits = network.logits(fit_images(images, SIZE))
    assert logits.dtype == torch.float32
    assert network.predict(images).dtype == np.float32
    torch.testing.assert_close(logits, trained(Net())(fit_images(images, SIZE)), atol=0.01, rtol=0.01)


def logits_and_gradients(path: str | Path, device: str, count: int) -> list[torch.Tensor]:
    network = white_box(path, device=device)
    images = torch.rand(count, 3, *network.image_size, generator=torch.Generator().manual_seed(0))
    images = images.to(device).requires_grad_()
    logits = network.logits(images)
    assert logits.shape == (count, network.n_classes)
    assert logits.device.type == device
    return [logits.detach().cpu(), *(each.cpu() for each in torch.autograd.grad(logits[:, 0].sum(), images))]


@pytest.mark.parametrize("kind", ["pt2", "tiny"])
def test_another_device_gives_equal_logits_and_gradients(kind: str, pt2: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device, path = pretend_device(monkeypatch), pt2 if kind == "pt2" else kind
    found = [logits_and_gradients(path, name, 2) for name in ("cpu", device)]
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other, one)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("kind", ["pt2", "tiny"])
@pytest.mark.parametrize("count", [1, 7, AT_ONCE, AT_ONCE + 1])
def test_a_network_on_a_graphics_card_gives_logits_and_gradients_of_the_cpu(count: int, kind: str, pt2: Path) -> None:
    found = [logits_and_gradients(pt2 if kind == "pt2" else kind, name, count) for name in ("cpu", "cuda")]
    for one, other in zip(*found, strict=True):
        assert (other - one).norm() <= 1e-3 * one.norm()


def normed_by_its_batch(net: Any, x: Tensor) -> Tensor:
    return nn.functional.batch_norm(net.body[0](x), None, None, training=True).mean((2, 3))


def batch_norms(graph: Any) -> int:
    return sum(node.target is BATCH_NORM for node in graph.nodes)


def test_batch_norm_is_folded_into_the_convolution_before_it(pt2: Path) -> None:
    assert batch_norms(read_program(pt2).graph) == 2
    network = white_box(pt2).network
    assert isinstance(network, Formatted)
    assert network.memory_format is torch.channels_last
    assert batch_norms(network.network.graph) == 0


@pytest.mark.parametrize(
    "function",
    [
        pytest.param(
            lambda net, x: (net.body[1](y := net.body[0](x)) + y).mean((2, 3)), id="the convolution has another reader"
        ),
        pytest.param(lambda net, x: net.body[1](net.body[0](x).relu()).mean((2, 3)), id="something is in between"),
        pytest.param(normed_by_its_batch, id="training"),
    ],
)
def test_any_other_batch_norm_is_left_alone(function: Callable[[Any, Tensor], Tensor], tmp_path: Path) -> None:
    program = read_program(export(Around(function), tmp_path / "net.pt2"))
    images = fit_images(noise(3), SIZE)
    folded = fold_batch_norm(program.module(check_guards=False))
    assert batch_norms(folded.graph) == 1
    torch.testing.assert_close(folded(images), program.module(check_guards=False)(images))


def test_a_network_that_does_not_run_channels_last_is_left_as_it_was(tmp_path: Path) -> None:
    network = Around(lambda net, x: net.body[0](x).view(x.shape[0], -1)[:, :9])
    classifier = white_box(export(network, tmp_path / "net.pt2"))
    assert isinstance(classifier.network, Formatted)
    assert classifier.network.memory_format is torch.contiguous_format
    images = fit_images(noise(3), SIZE)
    torch.testing.assert_close(classifier.logits(images), network(images.contiguous()))


def padded_by_channel(net: Any, x: Tensor) -> Tensor:
    """As networks of TensorFlow do."""
    weight, bias = net.body[3].weight, net.body[3].bias
    return nn.functional.conv2d(nn.functional.pad(x, (0, 1, 0, 1)), weight, bias, stride=2, groups=8).relu()


@pytest.mark.parametrize(
    "function",
    [
        pytest.param(lambda net, x: nn.functional.relu6(net.body[0](x)).mean((2, 3)), id="an activation with bounds"),
        pytest.param(lambda net, x: net.body[0](x).relu().mean((2, 3)), id="an activation without"),
        pytest.param(lambda net, x: nn.functional.hardswish(net.body[0](x)).mean((2, 3)), id="a bent activation"),
        pytest.param(lambda net, x: net.body[0](nn.functional.pad(x, (2, 1, 0, 3))).mean((2, 3)), id="padding"),
        pytest.param(lambda net, x: padded_by_channel(net, net.body[0](x)).mean((2, 3)), id="padding of each channel"),
    ],
)
def test_convolutions_pad_and_apply_their_activations_with_equal_logits_and_gradients(
    function: Callable[[Any, Tensor], Tensor], tmp_path: Path
) -> None:
    program = read_program(export(Around(function), tmp_path / "net.pt2")).module(check_guards=False)
    network = white_box(tmp_path / "net.pt2")
    assert isinstance(network.network, Formatted)
    assert not [node for node in network.network.network.graph.nodes if node.target in (PAD, *NAMES)]
    images = fit_images(noise(3), SIZE).requires_grad_()
    expected, found = program(images), network.logits(images)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(network.scores(images), found.detach())
    torch.testing.assert_close(*(torch.autograd.grad(x[:, 0].sum(), images)[0] for x in (found, expected)))


def test_without_onednn_the_shipped_network_gives_equal_logits_and_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    found = logits_and_gradients("tiny", "cpu", 2)
    monkeypatch.setattr("trompe_server.classifiers.convolution.ONEDNN", False)
    torch.testing.assert_close(logits_and_gradients("tiny", "cpu", 2), found)


@pytest.mark.parametrize(
    "function",
    [
        pytest.param(lambda net, x: ((y := net.body[0](x)).relu() + y).mean((2, 3)), id="another reader"),
        pytest.param(lambda net, x: net.body[0](x).sigmoid().mean((2, 3)), id="another activation"),
        pytest.param(lambda net, x: filtered_by_itself(x).relu().mean((2, 3)), id="weights from the image"),
        pytest.param(
            lambda net, x: net.body[0](nn.functional.pad(x, (1, 1, 1, 1), value=0.5)).mean((2, 3)), id="padding by grey"
        ),
    ],
)
def test_other_convolutions_stay(function: Callable[[Any, Tensor], Tensor], tmp_path: Path) -> None:
    network = white_box(export(Around(function), tmp_path / "net.pt2"))
    program = read_program(tmp_path / "net.pt2").module(check_guards=False)
    assert isinstance(network.network, Formatted)
    assert convolved not in [node.target for node in network.network.network.graph.nodes]
    images = fit_images(noise(3), SIZE).requires_grad_()
    expected, found = program(images), network.logits(images)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(*(torch.autograd.grad(x[:, 0].sum(), images)[0] for x in (found, expected)))


BREAKING: dict[str, tuple[nn.Module, dict[str, Any], str]] = {
    "fixed batch": (Net(), {"dynamic": False}, "batch is fixed to 2"),
    "few at once": (Net(), {"most": 8}, "batch is limited to 8: pass torch.export.Dim.DYNAMIC"),
    "one score": (Net(1), {}, "it gives one score"),
    "no image": (nn.Flatten(), {"shape": (2, 3, 8)}, r"its input is torch.float32 \(s"),
    "uint8 input": (nn.Flatten(), {"dtype": torch.uint8}, "its input is torch.uint8"),
    "maps, not logits": (nn.Conv2d(3, 4, 3), {}, r"its output for two images is torch.float32 \(2, 4,"),
    "two outputs": (Around(lambda net, x: (net(x), net(x))), {}, "its output for two images is a tuple"),
    "class index": (Around(lambda net, x: net(x).argmax(1)), {}, "its output for two images is torch.int64"),
    "probabilities": (Around(lambda net, x: net(x).softmax(1)), {}, "ends in a softmax"),
    "in half precision": (Around(lambda net, x: net(x).softmax(1).bfloat16()), {}, "ends in a softmax"),
    "not finite": (Around(lambda net, x: net(x) / 0), {}, "not finite"),
    "rounded": (Around(lambda net, x: (5 * net(x)).round()), {}, "no gradient in the image"),
    "detached": (Around(lambda net, x: net(x).detach()), {}, "no gradient in the image"),
    "dropout": (Around(lambda net, x: nn.functional.dropout(net(x), training=True)), {}, r"chance .* call eval\(\)"),
    "statistics of the batch": (Around(normed_by_its_batch), {}, r"its batch: call eval\(\) on the network first"),
}


@pytest.mark.parametrize(("network", "options", "message"), BREAKING.values(), ids=BREAKING)
def test_an_exported_network_that_breaks_the_contract_is_refused(
    network: nn.Module, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ClassifierError, match=message):
        load_classifier(export(network, tmp_path / "net.pt2", **options))


@pytest.mark.parametrize("bias", [-100, 100])
def test_a_class_may_be_constant(bias: float, tmp_path: Path) -> None:
    binary = Around(lambda net, x: torch.cat([torch.zeros_like(y := net(x)[:, :1]), y + bias], 1))
    assert load_classifier(export(binary, tmp_path / "net.pt2")).n_classes == 2


def test_an_image_by_keyword_is_refused_with_the_remedy(tmp_path: Path) -> None:
    batch = {"image": {0: torch.export.Dim.DYNAMIC}}
    program = torch.export.export(trained(Net()), (), {"image": torch.rand(2, 3, *SIZE)}, dynamic_shapes=batch)
    torch.export.save(program, tmp_path / "net.pt2")
    with pytest.raises(ClassifierError, match=r"takes its image as the keyword 'image': export it with \(images,\)"):
        load_classifier(tmp_path / "net.pt2")


class Stochastic(nn.Module):
    def forward(self, image: Tensor) -> Tensor:
        return image * torch.rand(()) if self.training else image


@pytest.mark.parametrize(
    "layer",
    [Stochastic(), nn.RReLU(), nn.LSTM(3, 3, 2, dropout=0.3), nn.MultiheadAttention(3, 1, dropout=0.3)],
    ids=str,
)
def test_whatever_depends_on_training_is_refused_in_it_and_else_taken(layer: nn.Module) -> None:
    layer.train()
    with pytest.raises(ClassifierError, match=r"in training: call eval\(\)"):
        NetworkClassifier("mine", nn.Sequential(Net().eval(), layer), SIZE, 7)
    NetworkClassifier("mine", nn.Sequential(Net().eval(), layer.eval()), SIZE, 7)
    NetworkClassifier("mine", nn.Conv2d(3, 7, 3), SIZE, 7)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_scripted_network_is_the_network() -> None:
    network = Net().eval()
    plain, scripted = (NetworkClassifier("mine", each, SIZE, 7) for each in (network, torch.jit.script(network)))
    np.testing.assert_allclose(scripted.predict(noise(2)), plain.predict(noise(2)), rtol=1e-5)


@pytest.mark.parametrize("size", [64, (3, 64, 64), (64.0, 64.0), None])
def test_a_size_that_is_not_height_and_width_is_refused(size: Any) -> None:
    with pytest.raises(ClassifierError, match=r"`image_size` of 'mine' must be \(height, width\)"):
        NetworkClassifier("mine", Net().eval(), size, 7)


def test_a_network_in_training_or_of_other_classes_is_refused() -> None:
    with pytest.raises(ClassifierError, match=r"'mine' is in training: call eval\(\)"):
        NetworkClassifier("mine", Net().train(), SIZE, 7)
    with pytest.raises(ClassifierError, match=r"gives \(7,\) scores an image, not 10"):
        NetworkClassifier("mine", Net().eval(), SIZE, 10).predict(noise(2))
    with pytest.raises(ClassifierError, match="has 7 classes, but 2 class names"):
        NetworkClassifier("mine", Net().eval(), SIZE, 7, classes=("a", "b"))
    with pytest.raises(ClassifierError, match="is a function, not a torch module"):
        NetworkClassifier("mine", lambda images: images, SIZE, 7)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (Around(lambda net, image: (net(image), image)), "gives a tuple; expected a tensor of logits"),
        (Around(lambda net, image: {"logits": net(image)}), "gives a dict; expected a tensor of logits"),
        (Around(lambda net, image: net(image).detach()), "has no gradient: its logits are detached"),
        (Net().half(), r"fails on float32 images \(2, 3, \d+, \d+\) \(.*type"),
        (TwoInputs(), r"fails on float32 images .*'scale'"),
    ],
)
def test_a_module_of_ones_own_that_breaks_the_contract_is_refused_at_its_first_images(
    network: nn.Module, message: str
) -> None:
    classifier = NetworkClassifier("mine", network.eval(), SIZE, 7)
    with pytest.raises(ClassifierError, match=message):
        classifier.logits(torch.rand(2, 3, *SIZE, requires_grad=True))


def test_a_network_with_two_inputs_is_refused(tmp_path: Path) -> None:
    inputs = (torch.rand(2, 3, *SIZE), torch.rand(1))
    torch.export.save(torch.export.export(TwoInputs(), inputs), tmp_path / "net.pt2")
    with pytest.raises(ClassifierError, match="takes 2 inputs"):
        load_classifier(tmp_path / "net.pt2")


def test_a_network_that_raises_any_error_breaks_the_contract() -> None:
    def refuse(_net: Any, _image: Tensor) -> Any:
        raise ValueError("Input image size (20*24) doesn't match model (224*224).")

    with pytest.raises(ClassifierError, match=r"'vit': it does not run on two images \(Input image size"):
        check_contract(Around(refuse), sample_images(SIZE), "vit")


class RunsCode:
    """Writes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"open({str(self.mark)!r}, 'w').close()",)


def pickled(thing: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(thing, buffer)
    return buffer.getvalue()


Tamper = Callable[[dict[str, bytes], Path], None]


def replacing(old: str, new: str, file: str = "models/model.json") -> Tamper:
    """Replaces text of the program, or of another file of the archive; ``MARK`` stands for the path of the mark."""

    def tamper(members: dict[str, bytes], mark: Path) -> None:
        (name,) = (member for member in members if member.endswith(file))
        members[name] = members[name].decode().replace(old, new.replace("MARK", str(mark))).encode()

    return tamper


def _pickled_inputs(members: dict[str, bytes], mark: Path) -> None:
    (name,) = (member for member in members if member.endswith("sample_inputs/model.pt"))
    members[name] = pickled((RunsCode(mark),))


def _pickled_weights(members: dict[str, bytes], mark: Path) -> None:
    (name,) = (member for member in members if member.endswith("/weight_0"))
    members[name] = pickled(RunsCode(mark))
    replacing('"use_pickle": false', '"use_pickle": true', "model_weights_config.json")(members, mark)


def _pickled_constants(members: dict[str, bytes], mark: Path) -> None:
    config = next(member for member in members if member.endswith("model_constants_config.json"))
    payload = {"path_name": "opaque_obj_0", "is_param": False, "use_pickle": True, "tensor_meta": None}
    members[config] = json.dumps({"config": {"c": payload}}).encode()


def _compiled_library(members: dict[str, bytes], mark: Path) -> None:
    root = next(iter(members)).split("/")[0]
    members[f"{root}/data/aotinductor/model/model.so"] = b"\x7fELF"


SUBTRACTION = "torch.ops.aten.sub.Tensor"
EFFECTS = ("from_file", "save", "warn", "_print", "manual_seed", "set_grad_enabled", "_cufft_clear_plan_cache")
"""Operators of ATen that do more than compute."""
TAMPERED: dict[str, tuple[Tamper, str]] = {
    "pickled sample inputs": (_pickled_inputs, "sample inputs that are not tensors"),
    "pickled weights": (_pickled_weights, "pickled weights"),
    "pickled constants": (_pickled_constants, "pickled constants"),
    "a size that is code": (
        replacing("integer=True)", "integer=True) + __import__('os').system('touch MARK')"),
        "expr_str",
    ),
    "an operator that is not ATen's": (replacing(SUBTRACTION, "torch.os.system"), "torch.os.system"),
    **{name: (replacing(SUBTRACTION, f"torch.ops.aten.{name}.default"), f"aten.{name}") for name in EFFECTS},
    "a name that is code": (replacing("body.0.weight", 'a\\")+exec(\\"'), "exec"),
    "an input tree that could import": (replacing('\\"context\\": \\"[]\\"', '\\"context\\": \\"{}\\"'), "the tree"),
    "a compiled library": (_compiled_library, "aotinductor"),
}


@pytest.mark.parametrize(("tamper", "message"), TAMPERED.values(), ids=TAMPERED)
def test_a_file_that_could_run_code_is_refused_in_time(tamper: Tamper, message: str, tmp_path: Path, pt2: Path) -> None:
    mark, file = tmp_path / "ran", tmp_path / "net.pt2"
    with zipfile.ZipFile(pt2) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    tamper(members, mark)
    file.write_bytes(zipped(members, method=zipfile.ZIP_STORED))
    with pytest.raises(ClassifierError, match=rf"(?s)is refused.*{message}"):
        load_classifier(file)
    assert not mark.exists()


def test_a_file_in_torch_2_7s_format_is_refused_unread(tmp_path: Path) -> None:
    mark, file = tmp_path / "ran", tmp_path / "old.pt2"
    state = {"serialized_state_dict.pt": pickled((RunsCode(mark),))}
    file.write_bytes(zipped({"version": b"8.20", "serialized_exported_program.json": b"{}"} | state))
    with pytest.raises(ClassifierError, match="cannot be read as an exported program"):
        load_classifier(file)
    assert not mark.exists()


def test_cut_and_foreign_files_are_refused(pt2: Path, tmp_path: Path) -> None:
    for ending in (".pt2", ".onnx"):
        for data in (b"", b"not a classifier", pt2.read_bytes()[:3000]):
            file = tmp_path / f"net{ending}"
            file.write_bytes(data)
            with pytest.raises(ClassifierError, match=r"cannot be read|cannot read it"):
                load_classifier(file)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param({"size": ("h", "w")}, "no height and width: fix them with", id="symbolic size"),
        pytest.param({"channels": "c", "size": ("h", "w")}, "no height and width: fix them with", id="symbolic image"),
        pytest.param({"channels": 1}, r"its input is tensor\(float\) \['n', 1,", id="grey input"),
        pytest.param(
            {"outputs": ("logits", "raw")}, r"it has 1 inputs \(image\) and 2 outputs \(logits, raw\)", id="two"
        ),
        pytest.param({"kind": TensorProto.UINT8}, r"its input is tensor\(uint8\)", id="uint8 input"),
        pytest.param({"last": "Softmax"}, "ends in a softmax", id="probabilities"),
        pytest.param({"last": "Shape"}, "onnxruntime cannot read it|its output for one image", id="no logits"),
        pytest.param({"last": "Log"}, "not finite", id="not finite"),
        pytest.param({"channels": "h", "size": ("w", 3)}, "channels last: put a Transpose", id="channels last"),
        pytest.param({"n_classes": 1}, "it gives one score", id="one score"),
        pytest.param({"last": "RandomNormalLike"}, "depend on chance", id="chance"),
        pytest.param({"last": "LpNormalization", "axis": 0, "batch": 4}, "others of its batch of 4", id="mixed batch"),
    ],
)
def test_an_onnx_network_against_the_contract_is_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ClassifierError, match=message):
        load_onnx(write_onnx(tmp_path / "net.onnx", **options))


def test_an_onnx_network_whose_output_is_a_table_is_refused(tmp_path: Path) -> None:
    """As scikit-learn's converter makes it."""
    model = onnx.load(write_onnx(tmp_path / "net.onnx"))
    row = helper.make_map_type_proto(TensorProto.INT64, helper.make_tensor_type_proto(TensorProto.FLOAT, []))
    table = helper.make_value_info("table", helper.make_sequence_type_proto(row))
    zipped = helper.make_node("ZipMap", ["logits"], ["table"], domain="ai.onnx.ml", classlabels_int64s=range(7))
    graph = helper.make_graph([*model.graph.node, zipped], "g", model.graph.input, [table], model.graph.initializer)
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid("ai.onnx.ml", 3)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=10), tmp_path / "table.onnx")
    with pytest.raises(ClassifierError, match=r"its output is seq\(map.*export the raw scores alone"):
        load_onnx(tmp_path / "table.onnx")


def test_a_network_that_onnxruntime_runs_leaves_nothing_in_the_home_folder(tmp_path: Path) -> None:
    """onnxruntime records its use there and reports it, unless told not to before its import."""
    file, home = write_onnx(tmp_path / "net.onnx"), tmp_path / "home"
    home.mkdir()
    code = f"from trompe_server.classifiers import load_classifier; load_classifier({str(file)!r})"
    variables = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    subprocess.run([sys.executable, "-c", code], env={**variables, "HOME": str(home)}, check=True)
    assert list(home.rglob("*")) == []


def test_an_onnx_network_runs_on_the_cpu_where_onnxruntime_has_no_other_device(tmp_path: Path) -> None:
    """As in a service on a card with the plain onnxruntime, which judges by such files too."""
    file, images = write_onnx(tmp_path / "net.onnx"), np.full((2, *SIZE, 3), 90, np.uint8)
    np.testing.assert_allclose(load_onnx(file, "cuda:0").predict(images), load_onnx(file).predict(images), rtol=1e-3)


def test_an_onnx_network_whose_weights_are_elsewhere_is_refused_with_the_remedy(tmp_path: Path) -> None:
    file = write_onnx(tmp_path / "net.onnx")
    options: dict[str, Any] = {"save_as_external_data": True, "location": "net.onnx.data", "size_threshold": 0}
    onnx.save(onnx.load(file), file, **options)
    assert load_onnx(file).n_classes == 7
    (tmp_path / "net.onnx.data").unlink()
    with pytest.raises(ClassifierError, match=r"'net.onnx' keeps its weights in another file.*onnx.save\("):
        load_onnx(file)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        *[
            pytest.param(name, {}, "not a supported classifier; give 'tiny'", id=name)
            for name in ("weights.h5", "net.pt", "net.torchscript", "hub:owner/nets:small")
        ],
        pytest.param(Path("absent.pt2"), {}, "There is no classifier file", id="no file"),
        *[
            pytest.param("tiny", {"device": device}, f"The device '{device}' cannot be used here", id=device)
            for device in ("nonsense", "cuda:99")
        ],
    ],
)
def test_what_cannot_be_loaded_is_refused_in_words(name: str | Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ClassifierError, match=message):
        load_classifier(name, **options)


def test_inspect_prints_one_line_of_json(pt2: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert inspect.main([str(pt2)]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line) == {"white_box": True, "image_size": [*SIZE], "n_classes": 7, "classes": None}
    (tmp_path / "bad.pt2").write_bytes(b"no")
    assert inspect.main([str(tmp_path / "bad.pt2")]) == 1
    assert list(json.loads(capsys.readouterr().out)) == ["error"]


@pytest.mark.assets
@pytest.mark.parametrize("name", ["mobilenet_v2", "mobilenet_edgetpu_075", "squeezenet1_1"])
def test_real_networks_agree_between_their_exported_and_onnx_files(name: str) -> None:
    folder = Path(os.environ["TROMPE_ASSETS"]) / "classifiers"
    exported, judge = white_box(folder / f"{name}.pt2"), load_classifier(folder / f"{name}.onnx")
    assert isinstance(exported.network, Formatted)
    assert batch_norms(exported.network.network.graph) == 0
    assert exported.image_size == judge.image_size
    images = noise(4, (240, 240))
    np.testing.assert_allclose(exported.predict(images), judge.predict(images), atol=1e-3)
