"""Other backgrounds behind the views than in the probes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.attack_runs import SIZE, SMALL, SQUARE, surrogate_of
from trompe_server.attack import Backgrounds
from trompe_server.attack.backgrounds import MIN_WEIGHT
from trompe_server.surrogate import Surrogate, textures_of
from trompe_shared.geometry import Camera, View

PHOTO = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
CHOICE: list[dict[str, Any]] = [{"background": (0, 0, 0)}, {"background": (255, 255, 255)}, {"backdrop": "photo"}]


def in_front_of(choice: Sequence[int]) -> list[View]:
    """Views from all around, the k-th in front of ``CHOICE[choice[k]]``."""
    return [View(Camera(0.4, 15.0 * k, 10.0), **CHOICE[own]) for k, own in enumerate(choice)]


def before(own: Sequence[int]) -> Surrogate:
    return surrogate_of(SQUARE, in_front_of(own), backdrops={"photo": PHOTO})


def backgrounds(own: Sequence[int]) -> Backgrounds:
    plain = [np.full((*SIZE, 3), colour, np.uint8) for colour in (0, 255)]
    return Backgrounds(torch.from_numpy(np.stack([*plain, PHOTO])), own)


@given(seed=st.integers(0, 99), step=st.integers(0, 99), own=st.lists(st.integers(0, 2), min_size=3, max_size=13))
@SMALL
def test_views_look_as_if_measured_in_front_of_what_was_drawn(seed: int, step: int, own: list[int]) -> None:
    moved = backgrounds(own).behind(before(own), seed=seed, step=step)
    there = before(backgrounds(own).drawn(seed=seed, step=step).tolist())
    for batch in range(len(there.batches)):
        images = [each.render(each.texels(textures_of(SQUARE)), batch) for each in (moved, there)]
        torch.testing.assert_close(images[0], images[1], atol=1e-5, rtol=0)


def test_seed_and_step_decide_what_is_drawn() -> None:
    draws = ((1, 2), (1, 2), (1, 3), (2, 2))
    once, again, later, other = (backgrounds([0] * 12).drawn(seed=seed, step=step).tolist() for seed, step in draws)
    assert once == again
    assert once not in (later, other)
    assert set(once) == {0, 1, 2}


def test_backgrounds_are_drawn_by_how_often_the_object_is_recognised_there() -> None:
    own = [0, 0, 1, 1, 2, 2] * 20
    weighted = backgrounds(own).weighted([False, False, True, True, True, False] * 20)
    assert weighted.weights == [MIN_WEIGHT, 1 + MIN_WEIGHT, 0.5 + MIN_WEIGHT]
    drawn = [weighted.drawn(seed=0, step=step).numpy() for step in range(30)]
    counts = np.bincount(np.concatenate(drawn), minlength=3)
    np.testing.assert_allclose(counts / counts.sum(), np.array(weighted.weights) / sum(weighted.weights), atol=0.03)
