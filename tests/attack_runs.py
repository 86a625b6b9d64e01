"""Small attacks on a square, 32 x 32 pixels, with the fake classifier."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pytest
import torch
from hypothesis import settings
from torch import Tensor

from tests.fakes import fake_classifier
from tests.surfaces import object_of, quad
from trompe_server.attack import AttackState, Budget, Goal, Step, attack, start
from trompe_server.attack.objective import Objective
from trompe_server.classifiers import NetworkClassifier, WhiteBoxClassifier
from trompe_server.surrogate import (
    AnySurrogate,
    SamplingModel,
    Surrogate,
    diffuse_surrogate,
    prepare_geometry,
    textures_of,
)
from trompe_server.surrogate.blocks import repeated
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D

SIZE: Final = (32, 32)
LABEL: Final = 6
"""Class of the square for the fake classifier in all ``VIEWS``."""

VIEWS: Final = [View(Camera(0.3, azimuth, elevation)) for azimuth in (-40, -10, 20, 45) for elevation in (-20, 0, 30)]
"""All see the front of ``SQUARE``."""

EPS: Final = 1e-6
SMALL: Final = settings(max_examples=6)


def surrogate_of(
    obj: Object3D,
    views: Sequence[View],
    *,
    sampling: SamplingModel | None = None,
    size: tuple[int, int] = SIZE,
    **options: Any,
) -> Surrogate:
    geometry = prepare_geometry(obj, views, size=size, sampling=sampling or SamplingModel())
    return diffuse_surrogate(geometry, views, **options)


@contextmanager
def default_sampling() -> Iterator[None]:
    """Calibrations with the default sampling: its search takes four times as long as the rest of a small job."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trompe_server.surrogate.calibration.find_sampling", lambda _: SamplingModel())
        patch.setattr("trompe_server.surrogate.calibration.find_physics", lambda best, *_: best)
        yield


_RANDOM: Final = np.random.default_rng(0)
SQUARE: Final = object_of(*(quad(_RANDOM.integers(40, 216, (16, 16, 3), dtype=np.uint8), z=z) for z in (0.0, 9.0)))
"""A square, and one behind the cameras that none sees."""
SURROGATE: Final = surrogate_of(SQUARE, VIEWS)


def run(
    surrogate: AnySurrogate = SURROGATE,
    *,
    obj: Object3D = SQUARE,
    steps: int = 6,
    state: AttackState | None = None,
    classifier: WhiteBoxClassifier | Sequence[WhiteBoxClassifier] | None = None,
    **options: Any,
) -> AttackState:
    """An attack from ``state``, by default the unpainted object, on ``classifier``, by default the fake one."""
    textures = textures_of(obj)
    asked: dict[str, Any] = {"goal": Goal(LABEL), "budget": Budget(0.06, 0.02)} | options
    victim = fake_classifier() if classifier is None else classifier
    return attack(state or start(textures), textures, surrogate, victim, steps=steps, **asked)


def random_state(budget: Budget, seed: int) -> AttackState:
    """A random change within the budget, to begin at."""
    generator, textures = torch.Generator().manual_seed(seed), textures_of(SQUARE)
    wishes = {
        name: torch.empty_like(texture).uniform_(-1, 1, generator=generator) for name, texture in textures.items()
    }
    return AttackState(0, {name: budget.box(textures[name]).project(wish) for name, wish in wishes.items()})


def steps_of(surrogate: AnySurrogate = SURROGATE, **options: Any) -> list[Step]:
    """The steps that ``run`` reports."""
    seen: list[Step] = []
    run(surrogate, on_step=seen.append, **options)
    return seen


def same(one: AttackState, other: AttackState) -> bool:
    tables = ((one.deltas, other.deltas), (one.memory, other.memory), (one.momentum, other.momentum))
    return one.step == other.step and all(
        mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)
        for mine, theirs in tables
    )


def objective_of(
    *members: WhiteBoxClassifier,
    surrogate: AnySurrogate = SURROGATE,
    goal: Goal | None = None,
    masks: Tensor | None = None,
) -> Objective:
    """All texels may move."""
    textures = textures_of(SQUARE)
    canvas = surrogate.canvas(textures, {name: texture[..., 0] >= 0 for name, texture in textures.items()})
    return Objective(textures, surrogate, members or (fake_classifier(),), goal or Goal(LABEL), masks, canvas)


def mean_loss(state: AttackState, goal: Goal | None = None) -> float:
    """Mean loss of a state over all views."""
    objective = objective_of(goal=goal)
    deltas = {name: repeated(state.deltas[name], texture.shape) for name, texture in objective.textures.items()}
    return objective.score(objective.join(deltas)).loss


def fooled_classifier() -> NetworkClassifier:
    """A classifier that any image fools, safely."""
    last = torch.nn.Linear(3, 10)
    with torch.no_grad():
        last.bias.fill_(50.0)[LABEL] = -50.0
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), last)
    return replace(fake_classifier(), network=network)


class _Constant(torch.nn.Module):
    """The same logits for all images, with a gradient of zero."""

    def forward(self, images: Tensor) -> Tensor:
        logits = torch.zeros(len(images), 10).index_fill(1, torch.tensor(LABEL), 3.0)
        return logits + 0 * images.sum((1, 2, 3))[:, None]


def constant_classifier() -> NetworkClassifier:
    """A classifier that no image fools."""
    return NetworkClassifier("constant", _Constant(), SIZE, 10)
