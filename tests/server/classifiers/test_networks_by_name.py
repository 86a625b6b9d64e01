"""Networks of torchvision, timm, RobustBench and the Hugging Face hub by name: their own size and normalisation, and
never random weights but those that are put into caches here."""

import importlib
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

from tests.server.classifiers.test_contract import white_box
from trompe_server import attack_object
from trompe_server.attack import Budget, ViewDistribution
from trompe_server.classifiers import classifier_file, load_classifier
from trompe_server.classifiers.fold import Formatted
from trompe_server.classifiers.registry import ZOOS
from trompe_server.classifiers.timm_networks import load_timm
from trompe_server.renderers import SailenvTarget
from trompe_shared.errors import ClassifierError
from trompe_shared.local_files import LOOKED_UP
from trompe_shared.object3d import Object3D

TAGS: Final = {
    "vit_tiny_patch16_224": "vit_tiny_patch16_224.augreg_in21k_ft_in1k",
    "mobilenetv3_small_050": "mobilenetv3_small_050.lamb_in1k",
    "inception_v3": "inception_v3.tv_in1k",
    "vit_tiny_patch16_384": "vit_tiny_patch16_384.augreg_in21k_ft_in1k",
}
"""Networks of timm and their repositories."""
FILES: Final = {
    "mobilenet_v2": "mobilenet_v2-7ebf99e0.pth",
    "inception_v3": "inception_v3_google-0cc3c7bd.pth",
    "squeezenet1_1": "squeezenet1_1-b8a52dc0.pth",
}
"""Networks of torchvision and their files in torch's cache."""
IMAGENET: Final = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
"""Mean and standard deviation."""


@pytest.fixture
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


def random_images(side: int, count: int = 1) -> Tensor:
    return torch.rand((count, 3, side, side), generator=torch.Generator().manual_seed(1))


def of_normalised(network: Callable[[Tensor], Tensor], images: Tensor, mean: Any, std: Any) -> Tensor:
    """What a network says of images in [0, 1] that it wants normalised."""
    with torch.no_grad():
        return network((images - torch.tensor(mean).reshape(3, 1, 1)) / torch.tensor(std).reshape(3, 1, 1))


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


def saved(network: nn.Module, path: Path) -> None:
    torch.save(network.state_dict(), path)


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Makes the folder of a repository in an empty cache of the Hugging Face hub, which cannot be reached."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)

    def folder(repository: str) -> Path:
        made = tmp_path / "hub" / f"models--{repository.replace('/', '--')}"
        snapshot = made / "snapshots" / ("0" * 40)
        snapshot.mkdir(parents=True)
        (made / "refs").mkdir()
        (made / "refs" / "main").write_text("0" * 40)
        return snapshot

    return folder


@pytest.fixture
def timm(models: Any) -> Any:
    return pytest.importorskip("timm")


@pytest.fixture
def stored(timm: Any, hub: Callable[[str], Path]) -> Callable[..., nn.Module]:
    """Puts a network of timm with random weights where timm's hub keeps it, and returns it."""

    def store(name: str, **options: Any) -> nn.Module:
        from safetensors.torch import save_file

        with torch.random.fork_rng():
            torch.manual_seed(0)
            network: nn.Module = timm.create_model(name, pretrained=False, **options).eval()
        save_file(network.state_dict(), hub(f"timm/{TAGS[name]}") / "model.safetensors")
        return network

    return store


# torchvision


@pytest.mark.parametrize(
    ("name", "options", "size"),
    [
        pytest.param("mobilenet_v2", {}, 224, id="mobilenet_v2"),
        pytest.param("inception_v3", {"init_weights": False, "transform_input": True}, 299, id="inception_v3"),
    ],
)
def test_a_torchvision_network_has_its_own_size_classes_and_normalisation(
    name: str, options: dict[str, Any], size: int, models: Any, cache: Path
) -> None:
    network = real(models, name, **options)
    saved(network, cache / FILES[name])
    classifier = white_box(f"torchvision:{name}")
    assert (classifier.name, classifier.image_size, classifier.n_classes) == (name, (size, size), 1000)
    assert classifier.classes is not None
    assert classifier.classes[0] == "tench"
    image = np.random.default_rng(0).integers(0, 256, (1, size, size, 3), np.uint8)
    its = models.get_model_weights(name).DEFAULT.transforms()
    expected = of_normalised(network, torch.from_numpy(image).permute(0, 3, 1, 2) / 255, its.mean, its.std)
    scale = float(expected.abs().max())
    np.testing.assert_allclose(classifier.predict(image) / scale, expected / scale, atol=1e-4)
    assert isinstance(classifier.network, Formatted), "it was not made faster"


def test_weights_are_found_in_torchs_cache(models: Any, cache: Path) -> None:
    network = real(models, "squeezenet1_1")
    saved(network, cache / FILES["squeezenet1_1"])
    for classifier in (white_box("squeezenet1_1"), white_box("torchvision:squeezenet1_1", name="mine")):
        images = random_images(224)
        expected = of_normalised(network, images, *IMAGENET)
        torch.testing.assert_close(classifier.logits(images), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.usefixtures("models", "cache")
def test_weights_that_are_nowhere_are_not_made_up() -> None:
    with pytest.raises(ClassifierError, match=r"no file '.*mobilenet_v2-7ebf99e0.pth'.*nothing is downloaded"):
        load_classifier("mobilenet_v2")


def test_weights_are_read_as_tensors_alone_and_must_fit(models: Any, cache: Path) -> None:
    file = cache / FILES["squeezenet1_1"]
    for content, message in (
        (real(models, "squeezenet1_1"), "expected a state dict of tensors alone"),
        ({"epoch": 3}, "contains no state dict"),
        (real(models, "squeezenet1_1", num_classes=3).state_dict(), "do not fit torchvision's 'squeezenet1_1'"),
    ):
        torch.save(content, file)
        with pytest.raises(ClassifierError, match=message):
            load_classifier("squeezenet1_1")


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


def test_a_torchvision_for_another_torch_is_told_from_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, hub: Callable[[str], Path]
) -> None:
    (tmp_path / "torchvision").mkdir()
    (tmp_path / "torchvision" / "__init__.py").write_text("raise RuntimeError('operator torchvision::nms is missing')")
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    transformers = ModuleType("transformers")
    transformers.__path__ = [str(tmp_path)]
    monkeypatch.setitem(sys.modules, "transformers", transformers)
    monkeypatch.delitem(sys.modules, "transformers.modeling_utils", raising=False)
    (tmp_path / "modeling_utils.py").write_text("import torchvision")
    folder = hub("org/model")
    for name in ("preprocessor_config.json", "config.json", "model.safetensors"):
        (folder / name).write_text("{}")
    for reference in ("mobilenet_v2", "hf:org/model"):
        with pytest.raises(ClassifierError, match=r"another build of torch than .*torchvision::nms is missing"):
            load_classifier(reference)


# Libraries with a prefix


def test_every_prefix_has_a_loader() -> None:
    assert tuple(ZOOS) == LOOKED_UP


@pytest.mark.parametrize("name", TAGS)
def test_images_are_normalised_as_timm_does(name: str, timm: Any, stored: Callable[..., nn.Module]) -> None:
    """timm's resizing and cropping falls away: a renderer draws images at the network's size."""
    network, (whole, size, _) = stored(name), load_timm(name)
    whole.network = nn.Identity()
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    config = timm.data.resolve_model_data_config(network) | {"crop_pct": 1.0}
    its = timm.data.create_transform(**config, is_training=False)(Image.fromarray(image))
    ours = whole(torch.from_numpy(image).permute(2, 0, 1)[None] / 255)[0]
    torch.testing.assert_close(ours, its, atol=1e-6, rtol=0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "side"), [("vit_tiny_patch16_224", 224), ("inception_v3", 299), ("vit_tiny_patch16_384", 384)]
)
def test_a_network_of_timm_has_its_own_size_and_the_classes_of_imagenet(
    name: str, side: int, timm: Any, stored: Callable[..., nn.Module]
) -> None:
    network, classifier = stored(name), white_box(f"timm:{name}")
    assert (classifier.name, classifier.image_size, classifier.n_classes) == (name, (side, side), 1000)
    assert classifier.classes is not None
    assert classifier.classes[999] == "toilet tissue, toilet paper, bathroom tissue"
    images, config = random_images(side), timm.data.resolve_model_data_config(network)
    expected = of_normalised(network, images, config["mean"], config["std"])
    largest = max(1.0, float(expected.abs().max()))  # 1e8 for a deep network with random weights
    torch.testing.assert_close(classifier.scores(images), expected, atol=1e-4 * largest, rtol=1e-3)
    assert classifier_file(f"timm:{name}").name == "model.safetensors"


def test_weights_of_timm_must_fit(stored: Callable[..., nn.Module]) -> None:
    stored("mobilenetv3_small_050", num_classes=3)
    with pytest.raises(ClassifierError, match=r"model.safetensors' do not fit timm's 'mobilenetv3_small_050'"):
        load_classifier("timm:mobilenetv3_small_050")


def test_names_and_weights_that_are_nowhere_are_errors(timm: Any, hub: Callable[[str], Path]) -> None:
    with pytest.raises(ClassifierError, match=r"timm has no network 'resnet5'; try one of .*resnet50"):
        load_classifier("timm:resnet5")
    with pytest.raises(ClassifierError, match=r"'model.safetensors' of 'timm/resnet18.*' is neither in the cache"):
        load_classifier("timm:resnet18")
    with pytest.raises(ClassifierError, match=r"'vit_small_patch14_dinov2' \(lvd142m\) have no classes"):
        load_classifier("timm:vit_small_patch14_dinov2")
    with pytest.raises(ClassifierError, match="expected ORG/MODEL"):
        load_classifier("hf:../secret")
    with pytest.raises(ClassifierError, match=r"'org/a--b' is neither in the cache.*Check the name"):
        load_classifier("hf:org/a--b")


@pytest.mark.parametrize("prefix", [prefix for prefix in ZOOS if prefix != "torchvision:"])
def test_without_its_library_a_name_says_what_to_install(prefix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    extra = prefix.removesuffix(":")
    for library in ("huggingface_hub", "robustbench", "timm", "pyautoattack"):
        monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ClassifierError, match=rf"not installed or incomplete.*pip install 'trompe\[{extra}\]'"):
        load_classifier(f"{prefix}org/model")


@pytest.mark.thorough
def test_a_vision_transformer_by_name_is_attacked_end_to_end(
    stored: Callable[..., nn.Module], mug: Object3D, target: SailenvTarget
) -> None:
    stored("vit_tiny_patch16_224")
    network = white_box("timm:vit_tiny_patch16_224")
    views = ViewDistribution(distance=0.3, elevation=(10, 50)).sample(3, generator=np.random.default_rng(0))
    label = int(network.predict(target.render(mug, views[:1], size=network.image_size)).argmax())
    attacked = attack_object(
        mug,
        network,
        label=label,
        target=target,
        views=views[:2],
        held_out=views[2:],
        budget=Budget(epsilon=0.5, alpha=0.1),
        steps=4,
        image_pipeline="none",
    )
    before, after = attacked.target.a_before, attacked.target.a_after
    assert before is not None
    assert after is not None
    assert after < before


LABELS: Final = {0: "tench, Tinca tinca", 1: "mug", 2: "lamp"}


def vision_transformer(folder: Path, dtype: torch.dtype = torch.float32) -> Any:
    """A small network of transformers for 32 x 32 images with random weights, saved to ``folder`` in ``dtype``."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    shape = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "intermediate_size": 64}
    config = transformers.ViTConfig(**shape, image_size=32, patch_size=8, id2label=LABELS)
    network = transformers.ViTForImageClassification(config).eval().to(dtype)
    network.save_pretrained(folder)
    return network.float()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16], ids=str)
def test_a_repository_of_transformers_is_a_white_box(hub: Callable[[str], Path], dtype: torch.dtype) -> None:
    folder = hub("org/model")
    network = vision_transformer(folder, dtype)
    its = {"do_normalize": True, "image_mean": [0.5, 0.4, 0.3], "image_std": [0.5, 0.6, 0.7]}
    (folder / "preprocessor_config.json").write_text(json.dumps(its | {"size": {"height": 32, "width": 32}}))
    classifier, images = white_box("hf:org/model"), random_images(32, 2)
    assert (classifier.image_size, classifier.classes) == ((32, 32), tuple(LABELS.values()))
    expected = of_normalised(lambda x: network(x).logits, images, its["image_mean"], its["image_std"])
    torch.testing.assert_close(classifier.scores(images), expected, atol=1e-5, rtol=1e-4)
    assert classifier_file("hf:org/model") == folder / "model.safetensors"


@pytest.mark.parametrize(
    ("labels", "classes"),
    [
        pytest.param({"0": 10, "1": 20, "2": 30}, ("10", "20", "30"), id="numbers as names"),
        pytest.param({"1": "a", "2": "b", "3": "c"}, None, id="numbered from 1"),
    ],
)
def test_class_names_of_transformers_are_those_of_the_logits(
    labels: dict[str, Any], classes: tuple[str, ...] | None, hub: Callable[[str], Path]
) -> None:
    folder = hub("org/model")
    vision_transformer(folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"id2label": labels}))
    (folder / "preprocessor_config.json").write_text('{"size": 32, "do_normalize": false}')
    assert load_classifier("hf:org/model").classes == classes


@pytest.mark.parametrize(
    ("processor", "settings"),
    [
        pytest.param("ViT", {"rescale_factor": 1 / 100}, id="another range"),
        pytest.param("ViT", {"do_rescale": False, "do_normalize": False}, id="0 to 255"),
        pytest.param("MobileViT", {"do_center_crop": False}, id="BGR"),
        pytest.param("EfficientNet", {"image_std": [0.5, 0.6, 0.7]}, id="divided twice"),
        pytest.param("EfficientNet", {"rescale_offset": True, "rescale_factor": 1 / 127.5}, id="-1 to 1"),
    ],
)
@pytest.mark.usefixtures("models")
def test_pixels_become_transformers_input(processor: str, settings: dict[str, Any], hub: Callable[[str], Path]) -> None:
    folder = hub("org/model")
    network = vision_transformer(folder)
    theirs = getattr(pytest.importorskip("transformers"), f"{processor}ImageProcessor")
    its = theirs(size={"height": 32, "width": 32}, **settings)
    its.save_pretrained(folder)
    image = np.random.default_rng(0).integers(0, 256, (1, 32, 32, 3), np.uint8)
    with torch.no_grad():
        expected = network(its(Image.fromarray(image[0]), return_tensors="pt").pixel_values).logits
    np.testing.assert_allclose(white_box("hf:org/model").predict(image), expected, atol=1e-5, rtol=1e-4)


def test_a_repository_with_a_pickle_is_refused(hub: Callable[[str], Path]) -> None:
    folder = hub("org/model")
    for name in ("preprocessor_config.json", "config.json"):
        (folder / name).write_text("{}")
    torch.save({}, folder / "pytorch_model.bin")
    with pytest.raises(ClassifierError, match=r"'model.safetensors' of 'org/model'.*only safetensors are read"):
        load_classifier("hf:org/model")


def test_a_repository_without_a_trained_head_is_refused(hub: Callable[[str], Path]) -> None:
    folder = hub("org/model")
    vision_transformer(folder).vit.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text('{"size": 32, "do_normalize": false}')
    lacking = r"not trained to classify images: its file lacks classifier.bias, classi"
    with pytest.raises(ClassifierError, match=lacking):
        load_classifier("hf:org/model")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        pytest.param("{", "preprocessor_config.json of 'org/model' is not JSON", id="not JSON"),
        pytest.param("[]", "preprocessor_config.json of 'org/model' has no settings", id="a list"),
        pytest.param('{"size": 32}', "config.json of 'org/model' names no image_mean or no image_std", id="no mean"),
    ],
)
def test_unreadable_settings_of_images_are_refused(settings: str, message: str, hub: Callable[[str], Path]) -> None:
    folder = hub("org/model")
    vision_transformer(folder)
    (folder / "preprocessor_config.json").write_text(settings)
    with pytest.raises(ClassifierError, match=message):
        load_classifier("hf:org/model")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("cache")
def test_a_network_of_robustbench_contains_its_normalisation(models: Any) -> None:
    pytest.importorskip("pyautoattack")
    file = classifier_file("robustbench:Salman2020Do_R18")
    os.makedirs(file.parent)
    network = models.resnet18().eval()
    saved(network, file)
    classifier, images = white_box("robustbench:Salman2020Do_R18"), random_images(224)
    assert (classifier.image_size, classifier.n_classes) == ((224, 224), 1000)
    assert classifier.classes is not None
    assert classifier.classes[999] == "toilet tissue"
    expected = of_normalised(network, images, *IMAGENET)
    torch.testing.assert_close(classifier.scores(images), expected, atol=1e-3, rtol=1e-3)
    with pytest.raises(ClassifierError, match=r"no ImageNet network 'Salman'"):
        load_classifier("robustbench:Salman")
