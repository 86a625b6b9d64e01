"""The surrogate on another device: nothing is made elsewhere by mistake, and the results are those of the CPU."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.fakes import FakeTarget
from tests.pretend_device import pretend_device
from trompe_server.surrogate import (
    SamplingModel,
    Surrogate,
    curve_surrogate,
    diffuse_surrogate,
    prepare_geometry,
    textures_of,
)
from trompe_server.surrogate.calibration import CALIBRATED_GREYS, CURVE_GREYS, painted_grey, painted_noise
from trompe_server.surrogate.fidelity import measure_fidelity
from trompe_server.surrogate.tone import ToneMap
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (64, 64)
VIEWS = [View(Camera(0.16 + 0.004 * k, 60 * k, 10 * k - 25), Light(20 * k, 50), (40 * k, 0, 255)) for k in range(6)]
MODELS = [
    pytest.param(SamplingModel(), id="encoded"),
    pytest.param(SamplingModel(filtered="linear", lod="area", shade_at="centroid", bias=0.3), id="linear"),
    pytest.param(SamplingModel(mips="rounded", encoding="power"), id="rounded"),
    pytest.param(SamplingModel(encoding="measured"), id="measured"),
]
TONE = ToneMap(
    torch.linspace(0, 1, 1025).expand(3, -1), torch.linspace(-0.1, 0.1, 2187).view(9, 9, 9, 3), torch.tensor(0.01)
)


def surrogates(obj: Object3D, model: SamplingModel, device: str) -> list[Surrogate]:
    """The diffuse one, and one measured on the fake target."""
    target, greys = FakeTarget(2000), CALIBRATED_GREYS if model.encoding == "measured" else CURVE_GREYS
    clean = target.render(obj, VIEWS, size=SIZE)
    probes = np.stack([target.render(painted_grey(obj, grey), VIEWS, size=SIZE) for grey in greys])
    geometry = prepare_geometry(obj, VIEWS, size=SIZE, sampling=model, device=device)
    assert geometry.device.type == device
    curve = curve_surrogate(geometry, obj, VIEWS, clean, greys, probes, tone=TONE)
    noise = painted_noise(obj, np.random.default_rng(0))
    measure_fidelity(curve, obj, clean, noise, target.render(noise, VIEWS, size=SIZE))
    return [diffuse_surrogate(geometry, VIEWS), curve]


def everything(surrogate: Surrogate, obj: Object3D, device: str) -> list[Tensor]:
    """Images, their gradient in some direction (masked, too), and the influence of each texel."""
    leaves = {name: t.requires_grad_() for name, t in textures_of(obj, device=device).items()}
    random = np.random.default_rng(0)
    weights, masks = random.normal(size=(len(VIEWS), 3, *SIZE)), random.random((len(VIEWS), *SIZE)) < 0.5
    texels, pixels = surrogate.texels(leaves), torch.from_numpy(masks).to(device)
    images = torch.cat([surrogate.render(texels, k, masks=pixels) for k in range(len(surrogate.batches))])
    total = (images * torch.from_numpy(weights).float().to(device)).sum()
    gradients = torch.autograd.grad(total, list(leaves.values()))
    return [images.detach(), *gradients, *surrogate.influence().values()]


@pytest.mark.parametrize("model", MODELS)
def test_another_device_gives_the_images_and_gradients_of_the_cpu_and_nothing_is_made_elsewhere(
    mug: Object3D, model: SamplingModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = pretend_device(monkeypatch)
    for one, other in zip(surrogates(mug, model, "cpu"), surrogates(mug, model, device), strict=True):
        expected, found = everything(one, mug, "cpu"), everything(other, mug, device)
        assert all(each.device.type == device for each in found)
        assert all(torch.equal(here, there.cpu()) for here, there in zip(expected, found, strict=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("model", MODELS)
def test_a_graphics_card_gives_the_images_and_gradients_of_the_cpu(mug: Object3D, model: SamplingModel) -> None:
    """All but a few pixels (on edges, where rounding decides what is seen) within a thousandth of the range."""
    pairs = zip(surrogates(mug, model, "cpu"), surrogates(mug, model, "cuda"), strict=True)
    for one, other in pairs:
        images, *rest = zip(everything(one, mug, "cpu"), everything(other, mug, "cuda"), strict=True)
        off = (images[0] - images[1].cpu()).abs() > 1e-3
        assert off.float().mean() < 1e-3
        for here, there in rest:
            assert (here - there.cpu()).norm() <= 0.01 * here.norm()
