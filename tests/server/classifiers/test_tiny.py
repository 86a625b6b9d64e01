"""The shipped classifier: small, frozen, and right about the shipped objects."""

from pathlib import Path

import numpy as np
import pytest
import torch

from trompe_server.classifiers import tiny
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE, WEIGHTS, TinyNet, load_tiny, save_tiny
from trompe_server.surrogate import SamplingModel, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.errors import ClassifierError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import load_object
from trompe_shared.shipped import ShippedObject, shipped_objects


def test_it_is_small_frozen_and_knows_the_labels_of_the_shipped_objects() -> None:
    network = load_tiny()
    parameters = list(network.parameters())
    assert sorted(CLASSES) == sorted({shipped.label for shipped in shipped_objects().values()})
    assert sum(parameter.numel() for parameter in parameters) < 1_000_000
    assert WEIGHTS.stat().st_size < 4e6
    assert not any(module.training for module in network.modules())
    assert not any(parameter.requires_grad for parameter in parameters)
    assert {parameter.dtype for parameter in parameters} == {torch.float32}


def test_saving_and_loading_keeps_its_judgement(tmp_path: Path) -> None:
    torch.manual_seed(7)
    network, file = TinyNet().eval(), tmp_path / "other.npz"
    save_tiny(network, file)
    images = torch.rand(4, 3, *IMAGE_SIZE)
    with torch.no_grad():
        torch.testing.assert_close(load_tiny(file)(images), network(images), atol=2e-3, rtol=2e-3)


@pytest.mark.parametrize("content", [None, b"not an archive", "other arrays"], ids=["missing", "garbage", "other"])
def test_weights_that_cannot_be_read_are_an_error_that_says_what_to_do(tmp_path: Path, content: bytes | str) -> None:
    file = tmp_path / "weights.npz"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content is not None:
        np.savez(file, other=np.zeros(3))
    with pytest.raises(ClassifierError, match=r"weights\.npz.*train_classifier"):
        load_tiny(file)


@pytest.mark.parametrize("shipped", [pytest.param(s, id=name) for name, s in shipped_objects().items()])
def test_it_recognises_the_shipped_objects_from_all_sides(shipped: ShippedObject) -> None:
    obj = load_object(shipped.read())
    elevations = np.linspace(*shipped.elevation, 4)
    views = [View(Camera(shipped.distance, 80.0 * k + 20.0, float(e))) for k, e in enumerate(elevations)]
    surrogate = diffuse_surrogate(prepare_geometry(obj, views, size=tiny.IMAGE_SIZE, sampling=SamplingModel()), views)
    images = surrogate.render_all(surrogate.texels(textures_of(obj)))
    assert [CLASSES[k] for k in load_tiny()(images).argmax(dim=1)] == [shipped.label] * len(views)
