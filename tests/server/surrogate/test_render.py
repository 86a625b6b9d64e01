"""The surrogate as a whole: its gradients are right, of itself and, what matters, of the real target."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from tests.attack_runs import surrogate_of
from tests.fakes import FakeTarget
from trompe_server.renderers import SailenvTarget, TargetRenderer
from trompe_server.surrogate import SamplingModel, Surrogate, curve_surrogate, prepare_geometry, textures_of
from trompe_server.surrogate.calibration import CALIBRATED_GREYS, CURVE_GREYS, painted_grey
from trompe_server.surrogate.surrogate import BATCH
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, load_object

SIZE = (96, 96)
VIEWS = [
    View(Camera(0.157, 30, 25)),
    View(Camera(0.18, 100, 40), Light(40, 50, 1.0, 0.3), (10, 20, 30)),
    View(Camera(0.16, 250, 0), Light(-30, 80)),
]
BLOCK = 64
"""Side, in texels, of the squares that are repainted."""


def measured(
    obj: Object3D, target: TargetRenderer, greys: Sequence[int], views: Sequence[View] = VIEWS
) -> tuple[Surrogate, NDArray[np.uint8]]:
    """A surrogate measured on ``target``, and the target's images of ``obj``."""
    clean = target.render(obj, views, size=SIZE)
    probes = np.stack([target.render(painted_grey(obj, grey), views, size=SIZE) for grey in greys])
    geometry = prepare_geometry(obj, views, size=SIZE, sampling=SamplingModel())
    return curve_surrogate(geometry, obj, views, clean, greys, probes), clean


@pytest.fixture(scope="module")
def curved(mug: Object3D) -> Surrogate:
    return measured(mug, FakeTarget(), CURVE_GREYS)[0]


def images_of(surrogate: Surrogate, textures: dict[str, Tensor]) -> Tensor:
    return surrogate.render_all(surrogate.texels(textures))


def masked_images(surrogate: Surrogate, texels: Tensor, masks: Tensor | None) -> Tensor:
    return torch.cat([surrogate.render(texels, batch, masks=masks) for batch in range(len(surrogate.batches))])


def gradient_of(surrogate: Surrogate, obj: Object3D, weights: Tensor, masks: Tensor | None = None) -> dict[str, Tensor]:
    """Gradient of the ``weights`` sum of all images, by texture."""
    leaves = {name: texture.requires_grad_() for name, texture in textures_of(obj).items()}
    images = masked_images(surrogate, surrogate.texels(leaves), masks)
    gradients = torch.autograd.grad((images * weights).sum(), list(leaves.values()))
    return dict(zip(leaves, gradients, strict=True))


def random_weights() -> Tensor:
    return torch.randn(len(VIEWS), 3, *SIZE, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("model", "tolerance"),
    [
        pytest.param(SamplingModel(), 0.01, id="diffuse, encoded"),
        pytest.param(SamplingModel(filtered="linear", lod="area", samples="centre", bias=0.5), 0.01, id="linear"),
        pytest.param(None, 0.05, id="measured"),
    ],
)
def test_the_gradient_is_that_of_finite_differences(
    mug: Object3D, curved: Surrogate, model: SamplingModel | None, tolerance: float
) -> None:
    """Along random directions. Pixels that are black or white are left out: they can change one way only."""
    surrogate = surrogate_of(mug, VIEWS, sampling=model, size=SIZE) if model else curved
    textures, step = textures_of(mug), 2e-3
    shown = images_of(surrogate, textures)
    weights = random_weights() * ((shown > 0.05) & (shown < 0.95))
    gradients = gradient_of(surrogate, mug, weights)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        ways = {n: torch.randn(t.shape, generator=generator).clamp(-2, 2) * (t - t**2) * 4 for n, t in textures.items()}
        moved = [{n: textures[n] + s * step * way for n, way in ways.items()} for s in (1, -1)]
        values = [(images_of(surrogate, each) * weights).double().sum() for each in moved]
        slope = float(values[0] - values[1]) / (2 * step)
        told = float(sum((gradients[n].double() * way).sum() for n, way in ways.items()))
        assert told == pytest.approx(slope, rel=tolerance, abs=tolerance * 5)


@dataclass(frozen=True)
class Repaint:
    """A square of a texture, made lighter or darker."""

    name: str
    row: int
    column: int

    def of(self, obj: Object3D) -> Object3D:
        """``obj`` with the square changed by 20 of 255 towards grey: up where dark, down where light."""
        image = obj.textures[self.name].copy()
        square = image[self.row : self.row + BLOCK, self.column : self.column + BLOCK]
        square[:] = np.where(square < 128, square + 20, square - 20)
        return obj.with_textures({self.name: image})


def seen_squares(surrogate: Surrogate, count: int) -> list[Repaint]:
    """The squares of the texture grid that the views see best, best first."""
    found = []
    for name, weight in surrogate.influence().items():
        sums = weight.unfold(0, BLOCK, BLOCK).unfold(1, BLOCK, BLOCK).sum((2, 3))
        best = sums.flatten().topk(count)
        found += [
            (float(v), Repaint(name, int(k) // sums.shape[1] * BLOCK, int(k) % sums.shape[1] * BLOCK))
            for v, k in zip(*best, strict=True)
        ]
    return [square for _, square in sorted(found, key=lambda row: -row[0])[:count]]


def test_the_surrogate_predicts_what_the_real_target_shows(mug: Object3D, target: SailenvTarget) -> None:
    surrogate, clean = measured(mug, target, CURVE_GREYS)
    before = images_of(surrogate, textures_of(mug))
    torch.testing.assert_close(before.permute(0, 2, 3, 1) * 255, torch.from_numpy(clean).float(), atol=0.51, rtol=0)
    weights, told, true = random_weights(), [], []
    gradients = gradient_of(surrogate, mug, weights)
    for square in seen_squares(surrogate, 10):
        repainted = square.of(mug)
        shown = torch.from_numpy(target.render(repainted, VIEWS, size=SIZE)).float().permute(0, 3, 1, 2) / 255
        predicted = (images_of(surrogate, textures_of(repainted)) - before).flatten()
        change = (shown - torch.from_numpy(clean).float().permute(0, 3, 1, 2) / 255).flatten()
        assert torch.corrcoef(torch.stack([predicted, change]))[0, 1] > 0.95
        moved = textures_of(repainted)[square.name] - textures_of(mug)[square.name]
        told.append(float((gradients[square.name] * moved).sum()))
        true.append(float((change.view_as(weights) * weights).sum()))
    assert np.corrcoef(told, true)[0, 1] > 0.95
    assert np.polyfit(told, true, 1)[0] == pytest.approx(1, abs=0.25)


def waves(obj: Object3D, generator: np.random.Generator) -> dict[str, NDArray[np.int64]]:
    """A wave of a few periods over each texture, of its own direction and phase in each channel, +-12 of 255."""

    def wave(height: int, width: int) -> NDArray[np.float64]:
        y, x = np.mgrid[:height, :width] / np.array([height, width]).reshape(2, 1, 1)
        phase = generator.integers(-4, 5) * x + generator.integers(1, 5) * y + generator.random()
        return np.asarray(np.cos(2 * np.pi * phase))

    return {
        name: np.rint(12 * np.stack([wave(*image.shape[:2]) for _ in range(3)], -1)).astype(np.int64)
        for name, image in obj.textures.items()
    }


def moved_by(obj: Object3D, way: dict[str, NDArray[np.int64]], sign: int) -> Object3D:
    return obj.with_textures(
        {name: (image + sign * way[name]).clip(0, 255).astype(np.uint8) for name, image in obj.textures.items()}
    )


@pytest.mark.assets
@pytest.mark.parametrize("name", ["candle", "toilet"])
def test_the_gradient_is_that_of_finite_differences_of_the_target(name: str, target: SailenvTarget) -> None:
    """Smooth changes of a real object's textures, both ways, in the images of the real target.

    Pixels that are nearly black or white are left out: they can change one way only.
    """
    objects = Path(os.environ["TROMPE_ASSETS"]) / "objects"
    obj, facts = load_object(objects / name), json.loads((objects / "objects.json").read_text())[name]
    distance, (low, high) = facts["distance"], facts["elevation_range"]
    views = [View(Camera(distance, 90 * k, low + (high - low) * k / 3), background=(0, 0, 0)) for k in range(4)]
    surrogate, clean = measured(obj, target, CURVE_GREYS, views)
    random, before = np.random.default_rng(0), torch.from_numpy(clean).permute(0, 3, 1, 2) / 255
    coarse = torch.from_numpy(random.normal(size=(len(views), 3, 6, 6))).float()
    weights = interpolate(coarse, SIZE, mode="bilinear") * ((before > 0.1) & (before < 0.9))
    gradients = gradient_of(surrogate, obj, weights)
    told, true = [], []
    for _ in range(8):
        way = waves(obj, random)
        up, down = (moved_by(obj, way, sign) for sign in (1, -1))
        shown = [torch.from_numpy(target.render(each, views, size=SIZE)).float() / 255 for each in (up, down)]
        steps = {key: textures_of(up)[key] - textures_of(down)[key] for key in obj.textures}
        true.append(float(((shown[0] - shown[1]).permute(0, 3, 1, 2) * weights).sum()))
        told.append(sum(float((gradients[key] * step).sum()) for key, step in steps.items()))
    assert np.corrcoef(told, true)[0, 1] > 0.995
    assert np.polyfit(told, true, 1)[0] == pytest.approx(1, abs=0.05)


def test_pixels_outside_of_the_masks_pass_no_gradient_and_keep_their_colours(mug: Object3D, curved: Surrogate) -> None:
    masks = torch.rand(len(VIEWS), *SIZE, generator=torch.Generator().manual_seed(1)) < 0.3
    weights = random_weights()
    masked = gradient_of(curved, mug, weights, masks)
    expected = gradient_of(curved, mug, weights * masks[:, None])
    nothing = gradient_of(curved, mug, weights, torch.zeros_like(masks))
    texels = curved.texels(textures_of(mug))
    assert torch.equal(masked_images(curved, texels, torch.zeros_like(masks)), curved.render_all(texels))
    for name, gradient in masked.items():
        torch.testing.assert_close(gradient, expected[name])
        assert gradient.abs().max() > 0
        assert (nothing[name] == 0).all()


MANY = [View(Camera(0.16 + 0.002 * k, 30.0 * k, 5.0 * k - 25), background=(20 * k, 0, 255)) for k in range(12)]
"""More than a batch of views."""


def test_views_are_rendered_in_successive_batches(mug: Object3D) -> None:
    surrogate = surrogate_of(mug, MANY, size=SIZE)
    assert surrogate.batches == (range(BATCH), range(BATCH, 2 * BATCH), range(2 * BATCH, 12))
    texels = surrogate.texels(textures_of(mug))
    images = [surrogate.render(texels, k) for k in range(3)]
    assert [tuple(some.shape) for some in images] == [(BATCH, 3, *SIZE), (BATCH, 3, *SIZE), (2, 3, *SIZE)]
    assert all(some.is_contiguous(memory_format=torch.channels_last) for some in images)
    assert torch.equal(surrogate.render_all(texels), torch.cat(images))


def test_the_order_of_the_views_changes_neither_images_nor_gradient(mug: Object3D) -> None:
    order = [11, 3, 0, 7, 1, 9, 2, 10, 4, 8, 5, 6]
    weights = torch.randn(len(MANY), 3, *SIZE, generator=torch.Generator().manual_seed(0))
    masks = weights[:, 0] > 0
    one, other = (surrogate_of(mug, views, size=SIZE) for views in (MANY, [MANY[k] for k in order]))
    shown, moved = (images_of(each, textures_of(mug)) for each in (one, other))
    torch.testing.assert_close(shown[order], moved, atol=1e-6, rtol=0)
    first, second = gradient_of(one, mug, weights, masks), gradient_of(other, mug, weights[order], masks[order])
    for name, gradient in first.items():
        assert gradient.abs().max() > 0
        torch.testing.assert_close(gradient, second[name], atol=1e-5, rtol=1e-4)


def test_the_same_work_gives_the_same_bits(mug: Object3D, curved: Surrogate) -> None:
    first, second = (gradient_of(curved, mug, random_weights()) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_influence_sums_to_the_pixels_that_read(mug: Object3D, curved: Surrogate) -> None:
    (batch,) = curved.geometry.batches
    everything = curved.influence()
    assert {name: tuple(weight.shape) for name, weight in everything.items()} == {
        name: texture.shape[:2] for name, texture in mug.textures.items()
    }
    assert sum(float(weight.sum()) for weight in everything.values()) == pytest.approx(sum(batch.counts), rel=1e-3)
    masks = torch.zeros(len(VIEWS), *SIZE, dtype=torch.bool)
    masks[1] = True
    second = sum(float(weight.sum()) for weight in curved.influence(masks).values())
    assert second == pytest.approx(batch.counts[1], rel=1e-3)
    assert all((weight >= 0).all() for weight in everything.values())


@pytest.mark.parametrize("greys", [CALIBRATED_GREYS, CURVE_GREYS], ids=["calibrated", "curve"])
def test_the_unpainted_object_is_predicted_as_the_target_shows_it(mug: Object3D, greys: tuple[int, ...]) -> None:
    surrogate, clean = measured(mug, FakeTarget(), greys)
    images = images_of(surrogate, textures_of(mug)).permute(0, 2, 3, 1) * 255
    torch.testing.assert_close(images, torch.from_numpy(clean).float(), atol=0.51, rtol=0)
    assert surrogate.model == ("calibrated" if len(greys) == 2 else "curve")


def test_a_prediction_that_rounds_to_what_the_target_shows_is_kept_as_it_is(mug: Object3D, curved: Surrogate) -> None:
    shown = curved.geometry.batches[0].of(curved.base) / 255
    colours, _ = curved.colours(curved.texels(textures_of(mug)), 0)
    assert curved.missed is not None
    (missed,) = curved.missed
    near = missed.abs() < 0.49 / 255
    assert 0.05 < near.float().mean() < 0.95
    torch.testing.assert_close(colours[near], (shown - missed)[near], atol=1e-6, rtol=0)
    torch.testing.assert_close(colours[~near], shown[~near], atol=0.51 / 255, rtol=0)


def test_the_diffuse_surrogate_shows_each_views_own_background(mug: Object3D) -> None:
    images = images_of(surrogate_of(mug, VIEWS, size=SIZE), textures_of(mug)) * 255
    assert images[0, :, 0, 0].tolist() == [255, 255, 255]
    torch.testing.assert_close(images[1, :, 0, 0], torch.tensor([10.0, 20, 30]))


def test_images_are_colours(mug: Object3D, curved: Surrogate) -> None:
    wild = {n: torch.rand(t.shape, generator=torch.Generator().manual_seed(0)) for n, t in textures_of(mug).items()}
    for surrogate in (curved, surrogate_of(mug, VIEWS, size=SIZE)):
        images = images_of(surrogate, wild)
        assert images.min() >= 0
        assert images.max() <= 1
