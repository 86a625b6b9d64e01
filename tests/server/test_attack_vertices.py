"""Vertices that move: bounds, seams, the rewritten OBJ, and whether the prediction knows where the loss goes."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from trompe_server.attack import Goal
from trompe_server.attack.beyond import (
    Relief,
    Shape,
    VertexBudget,
    VertexState,
    VertexStep,
    load_vertices,
    move_vertices,
    probe_light,
    save_vertices,
    shape_of,
    with_vertices,
)
from trompe_server.classifiers import NetworkClassifier, fake_classifier
from trompe_server.surrogate import SamplingModel
from trompe_server.target import FakeTarget, SailenvTarget, TargetRenderer
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, load_object, object_from_files

SIZE = (48, 48)
VIEWS = [View(Camera(0.25, azimuth, elevation), Light(40, 50)) for azimuth in (0, 120, 240) for elevation in (10, 40)]


def corners(obj: Object3D) -> NDArray[np.float64]:
    """(faces, 3, 3), metres."""
    return np.concatenate([part.vertices[part.faces] for part in obj.parts]).astype(np.float64)


def field(shape: Shape, seed: int) -> torch.Tensor:
    """Shares in [-1, 1], many of them at an end."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand(len(shape.positions), generator=generator, dtype=torch.float64)
    return (4 * values - 2).clamp(-1, 1)


def state(shape: Shape, seed: int) -> VertexState:
    start = VertexState.of(shape)
    return VertexState(1, field(shape, seed), start.momentum, start.seen)


@pytest.fixture(scope="module")
def shape(mug: Object3D) -> Shape:
    return shape_of(mug)


@pytest.fixture(scope="module")
def network() -> NetworkClassifier:
    return fake_classifier(image_size=SIZE)


def relief_of(obj: Object3D, shape: Shape, target: TargetRenderer) -> Relief:
    ask = partial(target.render, obj, size=SIZE)
    clean = ask(VIEWS)
    return Relief(obj, shape, tuple(VIEWS), clean, probe_light(ask, VIEWS), np.full_like(clean, 255), SamplingModel())


@pytest.fixture(scope="module")
def relief(mug: Object3D, shape: Shape) -> Relief:
    return relief_of(mug, shape, FakeTarget(points=20_000))


@settings(max_examples=15)
@given(seed=st.integers(0, 99), epsilon=st.sampled_from([1e-9, 1e-5, 1e-3, 0.02, 0.3]), smoothing=st.integers(0, 4))
def test_no_vertex_of_the_saved_object_is_further_off_than_epsilon(
    mug: Object3D, shape: Shape, seed: int, epsilon: float, smoothing: int
) -> None:
    moved = VertexBudget(epsilon, smoothing=smoothing).reshape(mug, shape, state(shape, seed))
    apart = np.linalg.norm(corners(load_object(moved.to_zip())) - corners(mug), axis=2)
    assert apart.max() <= epsilon * mug.radius
    if smoothing == 0 and epsilon > 1e-6:
        assert apart.max() >= 0.9 * epsilon * mug.radius


@settings(max_examples=10)
@given(seed=st.integers(0, 99))
def test_corners_at_one_place_stay_at_one_place(mug: Object3D, shape: Shape, seed: int) -> None:
    moved = with_vertices(mug, shape, 1e-3 * field(shape, seed))
    before, after = (corners(obj).reshape(-1, 3) for obj in (mug, moved))
    place = np.unique(before, axis=0, return_inverse=True)[1].reshape(-1)
    assert place.max() + 1 < len(mug.parts[0].vertices) * len(mug.parts), "the mug has seams"
    for axis in range(3):
        low, high = np.full(place.max() + 1, np.inf), np.full(place.max() + 1, -np.inf)
        np.minimum.at(low, place, after[:, axis])
        np.maximum.at(high, place, after[:, axis])
        assert (low == high).all()


def test_without_displacement_not_a_byte_changes(mug: Object3D, shape: Shape) -> None:
    assert VertexBudget(0.02).reshape(mug, shape, VertexState.of(shape)).to_zip() == mug.to_zip()


def test_everything_but_the_mesh_stays_as_it_was(mug: Object3D, shape: Shape) -> None:
    moved = with_vertices(mug, shape, 1e-3 * field(shape, 0))
    changed = [name for name in mug.files if moved.files[name] != mug.files[name]]
    assert changed == [f"{mug.name}.obj"]
    for before, after in zip(mug.parts, moved.parts, strict=True):
        assert before.material == after.material
        assert np.array_equal(before.uvs[before.faces], after.uvs[after.faces])


def test_the_saved_normals_are_those_the_prediction_shades_with(mug: Object3D, shape: Shape) -> None:
    heights = 1e-3 * field(shape, 0)
    moved = with_vertices(mug, shape, heights)
    saved = np.concatenate([part.normals[part.faces] for part in moved.parts])
    assert np.allclose(saved, shape.shaded(shape.moved(heights))[shape.normal].numpy(), atol=1e-5)


OBJ = """# a roof of two quads
mtllib roof.mtl
v -1 0 1 0.5 0.5 0.5
v 1 0 1
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0.7 0.7
vn 0 0.7 -0.7
usemtl front
f 1/1/1 2/2/1 3/3/1 4/4/1
v 1 0 -1
v -1 0 -1
v 9 9 9
usemtl back
s off
f -3/1/2 -2/2/-1 4/3/2 -5/4/2
"""


@pytest.fixture(scope="module")
def roof(mug: Object3D) -> Object3D:
    picture = mug.files[next(iter(mug.textures))]
    table = b'{"front": {"albedo": "a.png"}, "back": {"albedo": "a.png"}}'
    return object_from_files({"roof.obj": OBJ.encode(), "roof_mat_def.json": table, "a.png": picture})


def test_polygons_relative_indices_and_other_statements_are_kept(roof: Object3D) -> None:
    shape = shape_of(roof)
    ridge = (shape.positions[:, 1] == 1).double()
    lines = with_vertices(roof, shape, 0.1 * ridge).files["roof.obj"].decode().splitlines()
    kept = [line for line in OBJ.splitlines() if line.split()[0] not in {"f", "vn"} and "1 0" not in line[-4:]]
    assert [line for line in kept if line in lines] == kept
    assert "v -1 0 1 0.5 0.5 0.5" in lines
    assert sum(line.startswith("f ") for line in lines) == 2
    assert [[word.split("/")[:2] for word in line.split()[1:]] for line in lines if line.startswith("f ")][1] == [
        ["-3", "1"],
        ["-2", "2"],
        ["4", "3"],
        ["-5", "4"],
    ]


def test_an_object_whose_file_has_no_normals_moves_too(square: Object3D) -> None:
    shape = shape_of(square)
    moved = with_vertices(square, shape, torch.full((len(shape.positions),), 0.01, dtype=torch.float64))
    assert np.allclose(corners(moved) - corners(square), [0, 0, 0.01], atol=1e-6)
    assert b"vn" not in moved.files["made.obj"]


def test_a_hard_edge_stays_hard(roof: Object3D) -> None:
    """The two sides of the roof keep normals of their own at the ridge, which turn towards each other's horizon."""
    shape = shape_of(roof)
    ridge = (shape.positions[:, 1] == 1).double()
    front, back = with_vertices(roof, shape, 0.1 * ridge).parts
    assert (front.normals[:, 2] > 0.72).all()
    assert (back.normals[:, 2] < -0.72).all()


@settings(max_examples=20)
@given(seed=st.integers(0, 99), rounds=st.integers(0, 20))
def test_smoothing_keeps_bounds_and_constants(shape: Shape, seed: int, rounds: int) -> None:
    values = field(shape, seed)
    smooth = shape.smoothed(values, rounds)
    assert values.min() - 1e-12 <= smooth.min() <= smooth.max() <= values.max() + 1e-12
    assert torch.allclose(shape.smoothed(torch.full_like(values, 0.3), rounds), torch.full_like(values, 0.3))


def test_at_rest_the_prediction_is_what_the_target_showed(relief: Relief, shape: Shape) -> None:
    for view in range(len(VIEWS)):
        seen = relief.at(shape.positions, view)
        image = relief.image(seen, view, shape.positions, shape.normals).permute(1, 2, 0).reshape(-1, 3)[seen.pixel]
        clean = torch.from_numpy(relief.clean[view]).view(-1, 3)[seen.pixel] / 255
        filled = seen.covered[:, 0] == 1
        assert filled.sum() > 100
        assert (image - clean)[filled].abs().mean() < 1e-3


def climb(
    relief: Relief, network: NetworkClassifier, start: VertexState, steps: int, log: list[VertexStep] | None = None
) -> VertexState:
    goal = Goal(int(network.predict(relief.clean).sum(0).argmax()), loss="cross_entropy")
    return move_vertices(
        start,
        relief,
        network,
        goal=goal,
        budget=VertexBudget(0.05, smoothing=1),
        steps=steps,
        total_steps=7,
        views_per_step=4,
        look_anew=3,
        on_step=(log if log is not None else []).append,
    )


def test_in_one_go_or_in_several_through_files_the_result_is_the_same(
    relief: Relief, shape: Shape, network: NetworkClassifier
) -> None:
    whole = climb(relief, network, VertexState.of(shape), 7)
    part = climb(relief, network, VertexState.of(shape), 2)
    assert save_vertices(climb(relief, network, load_vertices(save_vertices(part)), 5)) == save_vertices(whole)


def test_the_predicted_chance_rises(relief: Relief, shape: Shape, network: NetworkClassifier) -> None:
    log: list[VertexStep] = []
    found = climb(relief, network, VertexState.of(shape), 7, log)
    assert log[6].won > log[0].won
    assert found.shares.abs().max() <= 1


def predicted(relief: Relief, weight: torch.Tensor, heights: torch.Tensor, seen: Sequence[object]) -> torch.Tensor:
    """A linear function of the predicted images."""
    positions = relief.shape.moved(heights)
    normals = relief.shape.shaded(positions)
    images = [relief.image(seen[k], k, positions, normals) for k in range(len(VIEWS))]  # type: ignore[arg-type]
    return (torch.stack(images).double() * weight).sum()


def smooth_weight() -> torch.Tensor:
    """Bright above, dark below: a smooth pattern (3, H, W)."""
    return torch.linspace(1, -1, SIZE[0], dtype=torch.float64)[None, :, None].expand(3, *SIZE)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_gradient_is_that_of_the_prediction(relief: Relief, shape: Shape, seed: int) -> None:
    """Against finite differences along a random direction, away from the lattice of pixel centres."""
    here = shape.smoothed(2e-3 * field(shape, seed), 2).requires_grad_()
    way = shape.smoothed(field(shape, seed + 10), 2)
    seen = [relief.at(shape.moved(here.detach()), view) for view in range(len(VIEWS))]
    predicted(relief, smooth_weight(), here, seen).backward()  # type: ignore[no-untyped-call]
    assert here.grad is not None
    step = 2e-5
    ahead, behind = (predicted(relief, smooth_weight(), here.detach() + s * way, seen) for s in (step, -step))
    slope = float(ahead - behind) / (2 * step)
    assert slope == pytest.approx(float(here.grad @ way), rel=0.1, abs=0.02 * float(here.grad.abs().sum()))


def test_along_the_gradient_the_real_target_goes_where_the_prediction_says(
    mug: Object3D, shape: Shape, target: SailenvTarget
) -> None:
    """Both ways from rest, with displacements of 1 % of the radius, for three linear functions of the images."""
    relief = relief_of(mug, shape, target)
    pattern = smooth_weight()
    for weight in (pattern, pattern.transpose(1, 2), pattern * pattern.transpose(1, 2)):
        leaf = torch.zeros(len(shape.positions), dtype=torch.float64, requires_grad=True)
        seen = [relief.at(shape.positions, view) for view in range(len(VIEWS))]
        predicted(relief, weight, shape.smoothed(leaf, 2), seen).backward()  # type: ignore[no-untyped-call]
        assert leaf.grad is not None
        step = 0.01 * mug.radius * shape.smoothed(leaf.grad.sign(), 2)
        shown = [_images(target, with_vertices(mug, shape, way * step)) for way in (1, -1)]
        assert float(((shown[0] - shown[1]) * weight).sum()) > 0


def _images(target: TargetRenderer, obj: Object3D) -> torch.Tensor:
    return torch.from_numpy(target.render(obj, VIEWS, size=SIZE)).permute(0, 3, 1, 2).double() / 255


@pytest.mark.parametrize("options", [{"epsilon": 0}, {"epsilon": 0.6}, {"epsilon": 0.1, "alpha": 0}], ids=str)
def test_a_budget_that_cannot_be_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(SpecError, match="vertex budget"):
        VertexBudget(**options)  # type: ignore[arg-type]


def test_damaged_states_are_refused() -> None:
    with pytest.raises((ValueError, OSError)):
        load_vertices(b"nothing")
