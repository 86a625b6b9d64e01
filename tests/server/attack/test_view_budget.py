"""The bound on the surrogate's images."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.attack_runs import SMALL, random_state, run, surrogate_of
from trompe_server.attack import Budget
from trompe_server.surrogate import SamplingModel, Surrogate, textures_of
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D


def images_of(surrogate: Surrogate, textures: dict[str, Tensor]) -> Tensor:
    with torch.no_grad():
        return surrogate.render_all(surrogate.texels(textures))


def attacked(
    obj: Object3D, surrogate: Surrogate, epsilon_view: float | None, **options: Any
) -> tuple[dict[str, Tensor], float]:
    """The deltas of an attack, and the largest change of its images, for floats and for saved textures."""
    textures, budget = textures_of(obj), Budget(0.3, 0.1, epsilon_view)
    state = run(obj, surrogate, budget=budget, steps=3, **options)
    painted = {name: textures[name] + delta for name, delta in state.deltas.items()}
    clean, saved = images_of(surrogate, textures), textures_of(budget.repaint(obj, state.deltas))
    change = max(float((images_of(surrogate, each) - clean).abs().max()) for each in (painted, saved))
    return dict(state.deltas), change


@pytest.mark.parametrize("optimiser", ["pgd", "nesterov"])
@given(epsilon_view=st.floats(0.002, 0.3), seed=st.integers(0, 9))
@SMALL
def test_no_pixel_changes_by_more_than_the_bound(
    optimiser: str, square: Object3D, surrogate: Surrogate, epsilon_view: float, seed: int
) -> None:
    begin = random_state(square, Budget(0.3, 0.1), seed)
    _, change = attacked(square, surrogate, epsilon_view, optimiser=optimiser, state=begin)
    assert change <= epsilon_view + 1e-5


def test_the_bound_is_used_up_at_no_needless_cost(square: Object3D, surrogate: Surrogate) -> None:
    bounded, change = attacked(square, surrogate, 0.05)
    free, largest = attacked(square, surrogate, None)
    assert largest > 0.1
    assert 0.045 < change <= 0.05 + 1e-5
    assert bounded["m0.png"].abs().mean() > 0.8 * free["m0.png"].abs().mean() * 0.05 / largest


@pytest.mark.parametrize("filtered", ["linear", "encoded"])
def test_the_bound_holds_for_textures_seen_from_afar(
    filtered: Any, make_object: Callable[..., Object3D], make_quad: Callable[..., Any]
) -> None:
    obj = make_object(make_quad(np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)))
    views = [View(Camera(distance, azimuth, 10)) for distance in (0.3, 1.5) for azimuth in (-80, 0, 30)]
    surrogate = surrogate_of(obj, views, sampling=SamplingModel(filtered=filtered))
    for epsilon_view in (0.01, 0.03):
        assert attacked(obj, surrogate, epsilon_view)[1] <= epsilon_view + 1e-5


def test_an_unreached_bound_changes_nothing(square: Object3D, surrogate: Surrogate) -> None:
    bounded, _ = attacked(square, surrogate, 1.0)
    free, _ = attacked(square, surrogate, None)
    assert all(torch.equal(bounded[name], free[name]) for name in free)
