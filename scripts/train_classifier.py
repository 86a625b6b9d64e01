"""Train the classifier that ships with Trompe on pictures of the shipped objects.

    python scripts/train_classifier.py [--cache FOLDER] [--out FILE] [--seed N] [--epochs N]

The pictures come from both renderers: the target (a renderer worker, started here) and the surrogate with its plain
diffuse shading. Each is taken on black and on white, which gives its opacity, so that training can put any colour
behind it. At the end the paper's grid of views, from which no training picture was taken, is classified, and attacked
in image space as a check that the network is an ordinary one. About five minutes on two idle cores.
"""

import argparse
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from trompe_server.attack.views import grid_views
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE, WEIGHTS, TinyNet, load_tiny, save_tiny
from trompe_server.renderers import local_renderer
from trompe_server.surrogate import SamplingModel, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.sailenv_client import SailenvTarget
from trompe_shared.shipped import ShippedObject, shipped_objects

PAINTS: Final = 12
"""Repainted versions of each object, the first half of them in its own colours."""
TARGET_VIEWS: Final = 20
SURROGATE_VIEWS: Final = 6
"""Views of each repainted version in each renderer."""
TO_YIQ: Final = np.array([[0.299, 0.587, 0.114], [0.596, -0.274, -0.322], [0.211, -0.523, 0.312]])
"""From RGB to brightness and two axes of colour."""
BLACK, WHITE = (0, 0, 0), (255, 255, 255)

Images = NDArray[np.uint8]


@dataclass(frozen=True)
class Pictures:
    """Pictures without their background: colour times opacity (N, 3, H, W) and opacity (N, 1, H, W), in [0, 1]."""

    colour: Tensor
    opacity: Tensor
    labels: Tensor


# --- pictures ---


def random_views(shipped: ShippedObject, count: int, random: np.random.Generator) -> list[View]:
    """Cameras and lights from all around what the paper's grid covers, on black."""
    low, high = shipped.elevation[0] - 10, min(shipped.elevation[1] + 10, 88)
    draw = random.uniform
    return [
        View(
            Camera(shipped.distance * draw(0.85, 1.15), draw(0, 360), draw(low, high)),
            Light(azimuth=draw(-70, 70), elevation=draw(35, 88)),
            BLACK,
        )
        for _ in range(count)
    ]


def repainted(obj: Object3D, random: np.random.Generator) -> Object3D:
    """The object with the hue of its textures turned a little, and their saturation and brightness changed."""
    turn, saturation, gain = np.radians(random.uniform(-25, 25)), random.uniform(0.8, 1.2), random.uniform(0.85, 1.15)
    c, s = saturation * np.cos(turn), saturation * np.sin(turn)
    matrix = np.linalg.inv(TO_YIQ) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ TO_YIQ * gain
    recolour = {name: np.clip(image @ matrix.T, 0, 255).astype(np.uint8) for name, image in obj.textures.items()}
    return obj.with_textures(recolour)


def on(colour: tuple[int, int, int], views: Sequence[View]) -> list[View]:
    """The same views before another background."""
    return [replace(view, background=colour) for view in views]


def surrogate_images(obj: Object3D, views: Sequence[View]) -> Images:
    """Images (2 * views, H, W, 3) on black, then on white, of the surrogate that knows diffuse light alone."""
    geometry = prepare_geometry(obj, views, size=IMAGE_SIZE, sampling=SamplingModel())
    images = []
    for colour in (BLACK, WHITE):
        surrogate = diffuse_surrogate(geometry, on(colour, views))
        images.append(surrogate.render(surrogate.texels(textures_of(obj)), range(len(views))))
    return np.asarray((torch.cat(images) * 255).round().byte().permute(0, 2, 3, 1).numpy())


def target_images(target: SailenvTarget, obj: Object3D, views: Sequence[View]) -> Images:
    """Images (2 * views, H, W, 3) on black, then on white, of the target renderer."""
    return target.render(obj, on(BLACK, views) + on(WHITE, views), size=IMAGE_SIZE)


def photograph(target: SailenvTarget, shipped: ShippedObject, seed: int) -> Images:
    """Pairs of images (2, N, H, W, 3) of an object, on black and on white."""
    random = np.random.default_rng([seed, CLASSES.index(shipped.label)])
    plain, pairs = load_object(shipped.path), []
    for paint in range(PAINTS):
        obj = plain if paint < PAINTS // 2 else repainted(plain, random)
        pairs.append(target_images(target, obj, random_views(shipped, TARGET_VIEWS, random)))
        pairs.append(surrogate_images(obj, random_views(shipped, SURROGATE_VIEWS, random)))
    halves = [pair.reshape(2, -1, *pair.shape[1:]) for pair in pairs]
    return np.concatenate(halves, axis=1)


def cached(target: SailenvTarget, shipped: ShippedObject, seed: int, folder: Path) -> Images:
    """``photograph``, kept in ``folder`` for the next run."""
    settings = f"{seed} {PAINTS} {TARGET_VIEWS} {SURROGATE_VIEWS} {IMAGE_SIZE} {shipped.distance} {shipped.elevation}"
    key = hashlib.sha256(shipped.read() + settings.encode()).hexdigest()[:16]
    file = folder / f"{shipped.name}-{key}.npy"
    if not file.exists():
        print(f"taking pictures of {shipped.name}", flush=True)
        np.save(file, photograph(target, shipped, seed), allow_pickle=False)
    return np.asarray(np.load(file, allow_pickle=False))


def collect(target: SailenvTarget, seed: int, folder: Path) -> Pictures:
    """Pictures of all objects."""
    folder.mkdir(parents=True, exist_ok=True)
    colours, opacities, labels = [], [], []
    for shipped in shipped_objects().values():
        black, white = (as_batch(images) for images in cached(target, shipped, seed, folder))
        colours.append(black)
        opacities.append((1 - (white - black).mean(dim=1, keepdim=True)).clamp(0, 1))
        labels.append(torch.full((len(black),), CLASSES.index(shipped.label)))
    return Pictures(torch.cat(colours), torch.cat(opacities), torch.cat(labels))


def as_batch(images: Images) -> Tensor:
    """Images (N, H, W, 3) uint8 as (N, 3, H, W) in [0, 1]."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255


# --- training ---


def augmented(colour: Tensor, opacity: Tensor, random: torch.Generator) -> Tensor:
    """Images (N, 3, H, W): random crops, mirrored, on any background, in other light, slightly noisy.

    Half of the crops show more than half of the picture, the others as little as a tenth, as is usual in training for
    ImageNet: the network learns what the objects look like in detail, not their outlines alone.
    """
    n = len(colour)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(n, *shape, generator=random) * (high - low) + low

    layers = torch.cat([colour, opacity], dim=1)
    mirror = torch.where(draw(0, 1) < 0.5, -1.0, 1.0)
    share = torch.where(draw(0, 1) < 0.5, draw(0.5, 1.2), draw(0.1, 0.5)).sqrt()
    maps = torch.zeros(n, 2, 3)
    maps[:, 0, 0], maps[:, 1, 1] = mirror * share, share
    maps[:, :, 2] = draw(-1, 1, 2) * (0.1 + 0.6 * (1 - share).clamp(min=0))[:, None]
    grid = F.affine_grid(maps, list(layers.shape), align_corners=False)
    layers = F.grid_sample(layers, grid, align_corners=False)
    choice = draw(0, 1, 1, 1, 1)
    plain = torch.where(choice < 0.35, 1.0, 0.0).expand(-1, 3, -1, -1)
    behind = torch.where(choice < 0.5, plain, draw(0, 1, 3, 1, 1))
    turn, saturation = draw(-torch.pi, torch.pi), draw(0, 1.3)
    images = recoloured(layers[:, :3], turn, saturation).clamp(min=0) + (1 - layers[:, 3:]) * behind
    images = (images - 0.5) * draw(0.7, 1.2, 1, 1, 1) + 0.5 + draw(-0.1, 0.1, 1, 1, 1)
    return (images + draw(0, 0.01, 1, 1, 1) * torch.randn(images.shape, generator=random)).clamp(0, 1)


def recoloured(images: Tensor, turn: Tensor, saturation: Tensor) -> Tensor:
    """Images (N, 3, H, W) with their hues turned by ``turn`` (N,) radians and their ``saturation`` (N,) multiplied."""
    maps = torch.zeros(len(images), 3, 3)
    maps[:, 0, 0] = 1
    maps[:, 1, 1] = maps[:, 2, 2] = saturation * turn.cos()
    maps[:, 2, 1] = saturation * turn.sin()
    maps[:, 1, 2] = -maps[:, 2, 1]
    to_yiq = torch.from_numpy(TO_YIQ).float()
    return torch.einsum("nij,njhw->nihw", torch.linalg.inv(to_yiq) @ maps @ to_yiq, images)


def train(pictures: Pictures, *, epochs: int, seed: int, batch: int = 64) -> TinyNet:
    """An ordinary training: AdamW, one cycle of the learning rate, smoothed labels, weight decay."""
    torch.manual_seed(seed)
    random = torch.Generator().manual_seed(seed)
    network = TinyNet()
    steps = epochs * (len(pictures.labels) // batch)
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=4e-3, total_steps=steps, pct_start=0.2)
    for epoch in range(epochs):
        order = torch.randperm(len(pictures.labels), generator=random)
        right, total_loss = 0, 0.0
        for start in range(0, len(order) // batch * batch, batch):
            chosen = order[start : start + batch]
            images = augmented(pictures.colour[chosen], pictures.opacity[chosen], random)
            logits = network(images)
            loss = F.cross_entropy(logits, pictures.labels[chosen], label_smoothing=0.1)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
            right += int((logits.argmax(dim=1) == pictures.labels[chosen]).sum())
            total_loss += loss.item() * batch
        count = len(order) // batch * batch
        print(f"epoch {epoch + 1:2d}/{epochs}: loss {total_loss / count:.3f}, right {right / count:.1%}", flush=True)
    network.eval()
    return network


# --- judging ---


def pgd(network: TinyNet, images: Tensor, label: int, *, epsilon: float, alpha: float, steps: int) -> Tensor:
    """Images within ``epsilon`` of ``images`` that the network mistakes: sign-gradient ascent on the cross-entropy."""
    labels, found = torch.full((len(images),), label), images.clone()
    for _ in range(steps):
        found = found.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(F.cross_entropy(network(found), labels), found)
        found = images + (found.detach() + alpha * gradient.sign() - images).clamp(-epsilon, epsilon)
        found = found.clamp(0, 1)
    return found


def judge(target: SailenvTarget, network: TinyNet) -> None:
    """Print per object: accuracy on the paper's grid and on its lighter sister on black, and after an image attack."""
    print(f"{'object':8s} {'white':>6s} {'black':>6s} {'PGD, epsilon 0.05':>18s}")
    for shipped in shipped_objects().values():
        obj, label = load_object(shipped.path), CLASSES.index(shipped.label)
        grid = {"distance": shipped.distance, "elevation": shipped.elevation}
        shares = []
        for background in (WHITE, BLACK):
            views = grid_views(**grid, azimuths=6, elevations=10, background=background)  # type: ignore[arg-type]
            images = as_batch(target.render(obj, views, size=IMAGE_SIZE))
            shares.append(accuracy(network, images, label))
            if background == WHITE:
                attacked = accuracy(network, pgd(network, images, label, epsilon=0.05, alpha=0.01, steps=10), label)
        print(f"{shipped.name:8s} {shares[0]:6.1%} {shares[1]:6.1%} {attacked:18.1%}", flush=True)


@torch.no_grad()
def accuracy(network: TinyNet, images: Tensor, label: int) -> float:
    """Share of images that are classified as ``label``."""
    return float((network(images).argmax(dim=1) == label).float().mean())


def main() -> None:
    """Take the pictures, train, save, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, default=Path("build/pictures"), help="folder that keeps the pictures")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="file to write (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--epochs", type=int, default=9)
    options = parser.parse_args()
    with local_renderer() as target:
        network = train(collect(target, options.seed, options.cache), epochs=options.epochs, seed=options.seed)
        save_tiny(network, options.out)
        judge(target, load_tiny(options.out))


if __name__ == "__main__":
    main()
