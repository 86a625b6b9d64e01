"""Surrogates of several renderers as one: the joint one is what its parts are, side by side."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.attack_runs import LABEL, SQUARE, SURROGATE, VIEWS, objective_of, random_state, run, surrogate_of
from trompe_server.attack import Backgrounds, Budget, Goal, movable
from trompe_server.surrogate import AnySurrogate, SamplingModel, Surrogate, diffuse_surrogate, joined, textures_of
from trompe_shared.geometry import Camera, View

LINEAR = SamplingModel(filtered="linear", samples="centre", lod="area")


@pytest.fixture(scope="module")
def parts() -> tuple[Surrogate, Surrogate, Surrogate]:
    """Three renderers: one, one with another sampling, and one with the sampling of the first before black."""
    black = [replace(view, background=(0, 0, 0)) for view in VIEWS]
    return SURROGATE, surrogate_of(SQUARE, VIEWS, sampling=LINEAR), diffuse_surrogate(SURROGATE.geometry, black)


def test_loss_and_gradient_are_those_of_all_parts(parts: Sequence[Surrogate]) -> None:
    joint, random = joined(parts), np.random.default_rng(0)
    masks = torch.from_numpy(random.random((joint.n_views, 32, 32)) < 0.7)
    deltas = random_state(Budget(0.06, 0.02), seed=1).deltas

    def evaluated(surrogate: AnySurrogate, masks: torch.Tensor) -> tuple[float, dict[str, torch.Tensor]]:
        one = objective_of(surrogate=surrogate, goal=Goal(LABEL, loss="cross_entropy"), masks=masks)
        active = torch.ones(surrogate.n_views, dtype=torch.bool)
        found = one.evaluate(one.join(deltas), range(len(surrogate.batches)), active)
        assert found.images == surrogate.n_views
        return found.loss, one.split(found.gradient)

    loss, gradient = evaluated(joint, masks)
    alone = [evaluated(part, masks[12 * number :][:12]) for number, part in enumerate(parts)]
    assert loss == pytest.approx(np.mean([each for each, _ in alone]))
    for name, value in gradient.items():
        torch.testing.assert_close(value, sum(each[name] for _, each in alone), atol=1e-5, rtol=1e-4)
    influence = joint.influence(masks)
    for name, weight in influence.items():
        own = [part.influence(masks[12 * number :][:12])[name] for number, part in enumerate(parts)]
        torch.testing.assert_close(weight, torch.stack(own).sum(0))


def test_parts_with_one_geometry_share_their_texels(parts: Sequence[Surrogate]) -> None:
    joint, textures = joined(parts), textures_of(SQUARE)
    assert len(joint.texels(textures)) == sum(part.n_texels for part in parts[:2])
    for batch, views in enumerate(joint.batches):
        part, first = parts[views.start // 12], views.start // 12 * 12
        own = part.batches.index(range(views.start - first, views.stop - first))
        torch.testing.assert_close(joint.render(joint.texels(textures), batch), part.render(part.texels(textures), own))


def test_parts_count_for_a_footprint_as_much_as_they_see_of_the_texture() -> None:
    """The second square of two, which the first part does not see."""
    others = [View(Camera(distance, 0, 0, centre=(0.0, 0.0, 9.0))) for distance in (0.6, 0.9)]
    joint, whole = joined([SURROGATE, surrogate_of(SQUARE, others)]), surrogate_of(SQUARE, [*VIEWS, *others])
    assert joint.footprint == pytest.approx(whole.footprint)
    assert joint.footprint["m1.png"] > 1.5
    assert joined([SURROGATE, SURROGATE]).footprint["m1.png"] == 1


def test_one_part_is_itself_and_twice_the_same_takes_the_same_steps(parts: Sequence[Surrogate]) -> None:
    assert joined(parts[:1]) is parts[0]
    twice = joined([parts[0], parts[0]])
    once, both = (run(each, texels=movable(parts[0], Budget(0.06, 0.02))) for each in (parts[0], twice))
    assert all(torch.equal(once.deltas[name], both.deltas[name]) for name in once.deltas)


def test_the_bound_on_images_holds_in_each_part(parts: Sequence[Surrogate]) -> None:
    budget = Budget(0.06, 0.02, epsilon_view=0.02)
    painted = budget.repaint(SQUARE, run(joined(parts), budget=budget).deltas)
    for part in parts:
        before, after = (part.render_all(part.texels(textures_of(each))) for each in (SQUARE, painted))
        assert 0.005 < (after - before).abs().max() <= 0.02 + 1e-5


def test_backgrounds_are_drawn_in_each_part(parts: Sequence[Surrogate]) -> None:
    joint = joined(parts)
    pictures = torch.stack([torch.full((32, 32, 3), grey, dtype=torch.uint8) for grey in (255, 0)])
    backgrounds = Backgrounds(pictures, [0] * 24 + [1] * 12)
    moved, drawn = backgrounds.behind(joint, seed=0, step=0), backgrounds.drawn(seed=0, step=0)
    texels = joint.texels(textures_of(SQUARE))
    corner = torch.cat([moved.render(texels, batch)[:, 0, 0, 0] for batch in range(len(joint.batches))])
    assert torch.equal(corner, 1 - drawn.float())
    assert set(drawn.tolist()) == {0, 1}
