"""Views in front of other backgrounds than those they were measured with."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from trompe_server.attack import Backgrounds, Budget, Goal, attack, load_state, save_state, start
from trompe_server.attack.backgrounds import SELDOM
from trompe_server.classifiers import fake_classifier
from trompe_server.surrogate import SamplingModel, Surrogate, diffuse_surrogate, prepare_geometry, textures_of
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D

SIZE = (32, 32)
PHOTO = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
CHOICE: list[tuple[int, int, int] | str] = [(0, 0, 0), (255, 255, 255), "photo"]
SMALL = settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])


def in_front_of(choice: Sequence[int]) -> list[View]:
    """Views from all around, the k-th in front of ``CHOICE[choice[k]]``."""
    views = [View(Camera(0.4, 15.0 * k, 10.0), Light()) for k in range(len(choice))]
    behind = [CHOICE[k] for k in choice]
    return [
        replace(view, backdrop=name) if isinstance(name, str) else replace(view, background=name)
        for view, name in zip(views, behind, strict=True)
    ]


def surrogate_of(obj: Object3D, views: list[View]) -> Surrogate:
    geometry = prepare_geometry(obj, views, size=SIZE, sampling=SamplingModel())
    return diffuse_surrogate(geometry, views, backdrops={"photo": PHOTO})


def backgrounds(own: Sequence[int]) -> Backgrounds:
    plain = [np.full((*SIZE, 3), colour, np.uint8) for colour in (0, 255)]
    return Backgrounds(torch.from_numpy(np.stack([*plain, PHOTO])), own)


@given(seed=st.integers(0, 99), step=st.integers(0, 99), own=st.lists(st.integers(0, 2), min_size=3, max_size=13))
@SMALL
def test_views_look_as_if_they_had_been_measured_in_front_of_what_was_drawn(
    square: Object3D, seed: int, step: int, own: list[int]
) -> None:
    moved = backgrounds(own).behind(surrogate_of(square, in_front_of(own)), seed=seed, step=step)
    there = surrogate_of(square, in_front_of(moved.now.tolist()))  # type: ignore[attr-defined]
    images = [each.render_all(each.texels(textures_of(square))) for each in (moved, there)]
    torch.testing.assert_close(images[0], images[1], atol=1e-5, rtol=0)


def test_seed_and_step_decide_what_is_drawn(square: Object3D) -> None:
    surrogate, own = surrogate_of(square, in_front_of([0] * 12)), backgrounds([0] * 12)

    def drawn(seed: int, step: int) -> list[int]:
        return own.behind(surrogate, seed=seed, step=step).now.tolist()  # type: ignore[attr-defined, no-any-return]

    assert drawn(1, 2) == drawn(1, 2)
    assert drawn(1, 2) != drawn(1, 3)
    assert drawn(1, 2) != drawn(2, 2)
    assert set(drawn(1, 2)) == {0, 1, 2}


def test_backgrounds_are_drawn_by_how_often_the_object_is_recognised_there(square: Object3D) -> None:
    own = [0, 0, 1, 1, 2, 2] * 20
    surrogate = surrogate_of(square, in_front_of(own))
    needed = backgrounds(own).by_need([False, False, True, True, True, False] * 20)
    assert needed.odds == [SELDOM, 1 + SELDOM, 0.5 + SELDOM]
    drawn = [needed.behind(surrogate, seed=0, step=step).now.numpy() for step in range(30)]  # type: ignore[attr-defined]
    counts = np.bincount(np.concatenate(drawn), minlength=3)
    np.testing.assert_allclose(counts / counts.sum(), np.array(needed.odds) / sum(needed.odds), atol=0.03)


@given(cut=st.integers(1, 4))
@SMALL
def test_a_run_over_several_backgrounds_can_be_cut_anywhere(square: Object3D, cut: int) -> None:
    own = [k % 3 for k in range(20)]
    surrogate, textures = surrogate_of(square, in_front_of(own)), textures_of(square)

    def run(steps: int, begun: bytes, behind: Backgrounds | None) -> bytes:
        state = attack(
            load_state(begun),
            textures,
            surrogate,
            fake_classifier(),
            goal=Goal(6),
            budget=Budget(0.06, 0.02),
            steps=steps,
            total_steps=5,
            views_per_step=10,
            backgrounds=behind,
        )
        return save_state(state)

    unpainted, several = save_state(start(textures)), backgrounds(own)
    whole = run(5, unpainted, several)
    assert run(5 - cut, run(cut, unpainted, several), several) == whole
    assert run(5, unpainted, None) != whole
