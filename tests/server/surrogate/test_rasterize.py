"""The rasteriser, judged by an independent ray caster in NumPy and by what must not matter."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.surfaces import object_of, quad
from trompe_server.surrogate import rasterize as module
from trompe_server.surrogate.rasterize import CENTRE, MSAA4, NEAR, Mesh, mesh_of, project, rasterize
from trompe_server.surrogate.sampling import fragments_of
from trompe_shared.geometry import FIELD_OF_VIEW, Camera
from trompe_shared.object3d import Object3D

SIZE = (12, 16)
Floats = NDArray[np.float64]
Samples = tuple[tuple[float, float], ...]


def mesh_from(corners: Floats, uvs: Floats | None = None) -> Mesh:
    """Triangles (F, 3, 3) without smooth normals, textured by ``uvs`` (F, 3, 2)."""
    positions = torch.tensor(corners, dtype=torch.float32)
    faces = len(positions)
    coordinates = torch.zeros(faces, 3, 2) if uvs is None else torch.tensor(uvs, dtype=torch.float32)
    number = torch.zeros(faces, dtype=torch.long)
    return Mesh(positions, coordinates, torch.zeros(faces, 3, 3), number, ("t",), number - 1)


def seen_faces(
    mesh: Mesh, camera: Camera, *, samples: Samples = CENTRE, cull: bool = False, size: tuple[int, int] = SIZE
) -> NDArray[np.int64]:
    """Which face every sample sees, (H, W, samples); -1 for none."""
    visibility = rasterize(project(mesh, camera, size, cull=cull), size, samples)
    faces = np.full((size[0] * size[1], len(samples)), -1)
    row = visibility.row.numpy()
    faces[visibility.pixel.numpy()] = np.where(row >= 0, visibility.planes.face.numpy()[row], -1)
    return faces.reshape(*size, len(samples))


def rays(camera: Camera, points: Floats, size: tuple[int, int]) -> Floats:
    """World directions (n, 3) through image ``points`` (n, 2), of depth one."""
    focal = size[0] / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    x, y = ((points - np.array([size[1], size[0]]) / 2) / focal).T
    return np.stack([x, -y, -np.ones_like(x)], axis=1) @ camera.world_to_camera()[:3, :3]


@dataclass(frozen=True)
class Hits:
    """Where rays (n) cross triangles (f): depth, barycentrics and whether the front is seen, by ray and triangle."""

    depth: Floats
    barycentric: Floats
    front: NDArray[np.bool_]


def cast(camera: Camera, directions: Floats, corners: Floats) -> Hits:
    """Plane by plane: where each ray meets each triangle's plane, and where in the triangle that is."""
    a, b, c = (corners[None, :, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    towards = (normal * directions[:, None]).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (normal * (a - camera.position())).sum(-1) / towards
        point = camera.position() + depth[..., None] * directions[:, None]
        areas = [(np.cross(q - p, point - p) * normal).sum(-1) for p, q in ((b, c), (c, a), (a, b))]
        barycentric = np.stack(areas, axis=-1) / (normal**2).sum(-1)[..., None]
    return Hits(depth, barycentric, towards < 0)


def positions(samples: Samples, size: tuple[int, int] = SIZE) -> Floats:
    """Image positions (H * W * samples, 2) of all samples."""
    y, x = np.mgrid[: size[0], : size[1]]
    corner = np.stack([x, y], axis=-1)[:, :, None]
    return np.asarray((corner + np.array(samples)).reshape(-1, 2), float)


def expected_faces(
    corners: Floats, camera: Camera, samples: Samples, *, cull: bool
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The nearest triangle of each sample, and where that is beyond doubt: no edge and no second one close by."""
    hits = cast(camera, rays(camera, positions(samples), SIZE), corners)
    least = hits.barycentric.min(axis=-1)
    possible = (hits.depth > NEAR) & (hits.front | (not cull)) & np.isfinite(hits.depth)
    inside = possible & (least >= 0)
    depth = np.where(inside, hits.depth, np.inf)
    order = np.sort(depth, axis=1)
    face = np.where(np.isfinite(order[:, 0]), depth.argmin(axis=1), -1)
    edge = (possible & (np.abs(least) < 0.02) & (hits.depth <= order[:, :1] * 1.01)).any(axis=1)
    close = (order[:, 1] < order[:, 0] * 1.01) if len(corners) > 1 else np.zeros(len(face), bool)
    near = (np.abs(hits.depth) < 10 * NEAR).any(axis=1)
    shape = (*SIZE, len(samples))
    return face.reshape(shape), ~(edge | close | near).reshape(shape)


@st.composite
def triangle_soups(draw: st.DrawFn) -> Floats:
    """One to five triangles of a decent shape around the origin, (F, 3, 3) metres, turned any way."""
    number = st.floats(-1, 1, width=32)
    soup = []
    for _ in range(draw(st.integers(1, 5))):
        centre, first = np.array(draw(st.tuples(number, number, number))), draw(st.floats(0.1, 1.5))
        axis = np.array(draw(st.tuples(number, number, number))) + np.array([1e-3, 2e-3, 3e-3])
        normal = axis / np.linalg.norm(axis)
        u = np.cross(normal, [0.36, 0.48, 0.8] if abs(normal[0]) > 0.5 else [1, 0, 0])
        u /= np.linalg.norm(u)
        v = np.cross(normal, u)
        turns = np.radians(np.array([0, 120, 240]) + np.array(draw(st.tuples(number, number, number))) * 40)
        soup.append(centre + first * (np.cos(turns)[:, None] * u + np.sin(turns)[:, None] * v))
    return np.array(soup, np.float32).astype(np.float64)


CAMERAS = st.builds(Camera, st.floats(0.3, 4), st.floats(-360, 360), st.floats(-90, 90))


IN_THE_LAST_COLUMN = np.array([[[0.6258, 0.3086, 0.6584], [0.624, -0.2732, 0.4577], [0.626, 0.0053, 0.9218]]])


@given(triangle_soups(), CAMERAS, st.sampled_from([CENTRE, MSAA4]), st.booleans())
@example(IN_THE_LAST_COLUMN, Camera(0.40625, -75, 0), CENTRE, False)
@settings(max_examples=120)
def test_every_sample_sees_what_a_ray_hits_first(soup: Floats, camera: Camera, samples: Samples, cull: bool) -> None:
    seen = seen_faces(mesh_from(soup), camera, samples=samples, cull=cull)
    expected, certain = expected_faces(soup, camera, samples, cull=cull)
    assert (seen == expected)[certain].all()


def test_the_ray_caster_is_certain_of_nearly_all_samples() -> None:
    random = np.random.default_rng(0)
    soup = np.float32(random.uniform(-1, 1, (4, 1, 3)) + random.uniform(-1, 1, (4, 3, 3))).astype(float)
    seen = seen_faces(mesh_from(soup), Camera(3, 20, 30), samples=MSAA4)
    expected, certain = expected_faces(soup, Camera(3, 20, 30), MSAA4, cull=False)
    assert certain.mean() > 0.8
    assert len(np.unique(seen[certain])) > 2
    assert (seen == expected)[certain].all()


CLOCKWISE = np.array([[[-0.5, -0.5, 0.0], [0.0, 0.5, 0.0], [0.5, -0.5, 0.0]]])


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (-0.5, -0.5), (1.0, -1.0), (-1.0, 1.0)])
@pytest.mark.parametrize("samples", [CENTRE, MSAA4], ids=["centre", "msaa"])
def test_a_camera_inside_a_room_sees_a_wall_wherever_it_looks(samples: Samples, shift: tuple[float, float]) -> None:
    x, y, z = np.eye(3)
    walls = []
    for n, u, v in ((x, y, z), (y, z, x), (z, x, y)):
        for side in (-1, 1):
            a, b, c, d = (side * n + i * u + j * v for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
            walls += [[a, b, c], [a, c, d]]
    room = mesh_from(np.array(walls))
    for camera in (Camera(0.5, 30, 20), Camera(0.9, 200, -70), Camera(0.01, 45, 90)):
        shifted = tuple((across + shift[0], down + shift[1]) for across, down in samples)
        assert (seen_faces(room, camera, samples=shifted) >= 0).all()


def test_the_floor_is_seen_up_to_the_horizon_though_it_reaches_behind_the_camera() -> None:
    floor = np.array([[[-1e3, -1.0, -1e3], [0, -1.0, 1e3], [1e3, -1.0, -1e3]]])
    seen = seen_faces(mesh_from(floor), Camera(2, 0, 0), size=(40, 40))[..., 0]
    assert (seen[:20] == -1).all()
    assert (seen[21:] == 0).all()


@pytest.mark.parametrize(
    "corners",
    [
        pytest.param(CLOCKWISE + np.array([0, 0, 2.5]), id="behind"),
        pytest.param(CLOCKWISE + np.array([0, 0, 2.0]), id="in the camera's plane"),
        pytest.param(CLOCKWISE + np.array([0, 0, 2.0 - NEAR / 2]), id="before the near plane"),
        pytest.param(np.zeros((0, 3, 3)), id="an empty mesh"),
    ],
)
def test_nothing_is_seen_of_what_is_not_in_front_of_the_camera(corners: Floats) -> None:
    assert (seen_faces(mesh_from(corners), Camera(2, 0, 0)) == -1).all()


@pytest.mark.parametrize("place", [(-1, 0), (1, 0), (0, -1), (0, 1)], ids=["left", "right", "bottom", "top"])
def test_triangles_beyond_the_edge_of_the_image_are_seen_as_far_as_they_reach_into_it(place: tuple[int, int]) -> None:
    size, camera = (16, 16), Camera(2, 0, 0)
    edge = 2 * np.tan(np.radians(FIELD_OF_VIEW / 2))
    pixel = 2 * edge / 16
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 2 * edge
    square += np.array([*place, 0]) * (3 * edge - 0.75 * pixel)
    seen = seen_faces(mesh_from(square[[[0, 1, 2], [0, 2, 3]]]), camera, size=size)[..., 0] >= 0
    expected = np.zeros(size, bool)
    x, y = place
    expected[{1: np.s_[:1], -1: np.s_[-1:], 0: np.s_[:]}[y], {1: np.s_[-1:], -1: np.s_[:1], 0: np.s_[:]}[x]] = True
    assert (seen == expected).all()


def composited(soup: Floats, camera: Camera, samples: Samples, alpha: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Weight of each triangle in each pixel (H * W, F), and where that is beyond doubt."""
    hits = cast(camera, rays(camera, positions(samples), SIZE), soup)
    inside = (hits.depth > NEAR) & (hits.barycentric.min(axis=-1) >= 0)
    depth = np.where(inside, hits.depth, np.inf)
    order = depth.argsort(axis=1)
    opacity = np.take_along_axis(np.where(inside, alpha, 0.0), order, 1)
    clear = np.cumprod(np.concatenate([np.ones((len(depth), 1)), 1 - opacity[:, :-1]], axis=1), axis=1)
    weights = np.zeros_like(depth)
    np.put_along_axis(weights, order, opacity * clear, 1)
    with np.errstate(invalid="ignore"):
        close = (np.diff(np.sort(depth, axis=1)) < 0.01 * depth.min(axis=1, keepdims=True)).any(axis=1)
    edge = (np.isfinite(hits.depth) & (np.abs(hits.barycentric.min(axis=-1)) < 0.02)).any(axis=1)
    near = (np.abs(hits.depth) < 10 * NEAR).any(axis=1)
    shape = (SIZE[0] * SIZE[1], len(samples), -1)
    return weights.reshape(shape).mean(axis=1), ~(close | edge | near).reshape(shape[:2]).any(axis=1)


@given(
    triangle_soups(),
    CAMERAS,
    st.sampled_from([CENTRE, MSAA4]),
    st.lists(st.sampled_from([0.1, 0.5, 0.9, 1.0]), min_size=5, max_size=5),
)
@settings(max_examples=120)
def test_blended_triangles_are_composited_over_each_other_and_over_the_nearest_opaque_one(
    soup: Floats, camera: Camera, samples: Samples, opacity: list[float]
) -> None:
    mesh, alpha = mesh_from(soup), torch.tensor(opacity[: len(soup)])
    planes = project(mesh, camera, SIZE, cull=False)
    visibility = rasterize(planes, SIZE, samples, blended=alpha[planes.face] < 1)
    found = fragments_of(
        visibility, mesh, SIZE[1], samples=samples, shade_at="centre", alpha=lambda fragments: alpha[fragments.face]
    )
    weights = np.zeros((SIZE[0] * SIZE[1], len(soup)))
    weights[visibility.pixel[found.entry], found.face] = found.weight
    expected, certain = composited(soup, camera, samples, alpha.double().numpy())
    np.testing.assert_allclose(weights[certain], expected[certain], atol=1e-5)


def test_a_blended_sheet_is_one_layer_also_where_its_triangles_meet() -> None:
    square = np.array([[-0.4, -0.4, 0], [0.4, -0.4, 0], [0.4, 0.4, 0], [-0.4, 0.4, 0]])
    mesh, size = mesh_from(square[[[0, 1, 2], [0, 2, 3]]]), (16, 16)  # the diagonal meets every pixel's centre
    planes = project(mesh, Camera(2, 0, 0), size, cull=True)
    visibility = rasterize(planes, size, CENTRE, blended=torch.ones(2, dtype=torch.bool))
    assert (visibility.row >= 0).sum(1).tolist() == [1] * len(visibility.pixel)
    assert len(visibility.pixel) > 20


def test_the_first_of_two_equal_triangles_is_seen() -> None:
    twice = mesh_from(np.concatenate([CLOCKWISE, CLOCKWISE]))
    assert set(np.unique(seen_faces(twice, Camera(2, 30, 10)))) == {-1, 0}


@pytest.mark.parametrize("camera", [Camera(0.4, 20, 10), Camera(0.5, -50, 35), Camera(0.7, 3, -60)])
def test_of_two_sheets_in_one_plane_the_first_is_seen_however_they_are_cut_into_triangles(camera: Camera) -> None:
    square = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    sheets = mesh_from(square[[[0, 1, 2], [0, 2, 3], [1, 2, 3], [1, 3, 0]]])
    seen = seen_faces(sheets, camera, size=(128, 128))
    assert (seen[seen >= 0] < 2).mean() > 0.95


@pytest.mark.parametrize(("candidates", "faces"), [(1, 2**14), (7, 1), (100, 1000)])
def test_drawing_in_small_portions_gives_the_same_picture(
    candidates: int, faces: int, mug: Object3D, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, camera = mesh_of(mug), Camera(0.157, 30, 20)
    whole = seen_faces(mesh, camera, samples=MSAA4)
    monkeypatch.setattr(module, "MAX_CANDIDATES", candidates)
    monkeypatch.setattr(module, "FACES_AT_ONCE", faces)
    assert (seen_faces(mesh, camera, samples=MSAA4) == whole).all()
    assert (whole >= 0).any()


SLIVERS = st.builds(
    lambda soup, axis, flat: soup * np.where(np.arange(3) == axis, flat, 1.0),
    triangle_soups(),
    st.integers(0, 2),
    st.sampled_from([1e-1, 1e-3, 1e-6, 0.0]),
)
OUTSIDE = tuple((x + 0.75, y - 0.9) for x, y in MSAA4)
EDGE_ON_A_PIXELS_CENTRE = np.array([[[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5]]])


@given(SLIVERS, CAMERAS, st.sampled_from([CENTRE, MSAA4, OUTSIDE]))
@example(EDGE_ON_A_PIXELS_CENTRE, Camera(1, 0, 90), CENTRE)
@example(EDGE_ON_A_PIXELS_CENTRE, Camera(1, 90, 90), CENTRE)
@example(EDGE_ON_A_PIXELS_CENTRE, Camera(1, 45, 90), CENTRE)
@settings(max_examples=200)
def test_no_sample_of_a_triangle_lies_outside_of_the_spans_that_are_tested(
    soup: Floats, camera: Camera, samples: Samples
) -> None:
    mesh, size = mesh_from(soup), (64, 80)
    seen = seen_faces(mesh, camera, samples=samples, size=size)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "ROUNDING", 1e12)  # the whole boxes
        assert (seen_faces(mesh, camera, samples=samples, size=size) == seen).all()


def test_a_mesh_keeps_the_order_of_its_parts_and_says_what_each_face_is_painted_with() -> None:
    quads = [quad(np.full((2, 2, 3), k, np.uint8), z=float(k)) for k in range(2)]
    mesh = mesh_of(object_of(*quads))
    assert mesh.textures == ("m0.png", "m1.png")
    assert mesh.texture.tolist() == [0, 0, 1, 1]
    assert mesh.positions[:, 0, 2].tolist() == [0, 0, 1, 1]
    assert (mesh.normals == torch.tensor([0.0, 0, 1])).all()
    np.testing.assert_allclose(mesh.uvs.numpy(), np.concatenate([uvs for _, uvs, _ in quads]))


@dataclass(frozen=True)
class Seen:
    """Fragments at pixel centres: image position (n, 2), face, UV, its derivatives, barycentrics."""

    point: Floats
    face: NDArray[np.int64]
    uv: Floats
    duv: Floats
    barycentric: Floats


def look(mesh: Mesh, camera: Camera) -> Seen:
    visibility = rasterize(project(mesh, camera, SIZE, cull=False), SIZE, CENTRE)
    found = fragments_of(visibility, mesh, SIZE[1], samples=CENTRE, shade_at="centre")
    pixel = visibility.pixel[found.entry].numpy()
    point = np.stack([pixel % SIZE[1], pixel // SIZE[1]], axis=1) + 0.5
    return Seen(point, *(x.double().numpy() for x in (found.face, found.uv, found.duv, found.barycentric)))


UVS = np.array([[0.1, -0.3], [2.0, 0.4], [0.7, 1.9]])


def uv_by_ray(camera: Camera, points: Floats, corners: Floats) -> Floats:
    """Texture coordinates (n, 2) on one triangle's plane, by casting rays."""
    return np.asarray(cast(camera, rays(camera, points, SIZE), corners[None]).barycentric[:, 0] @ UVS)


def decently_seen(camera: Camera, seen: Seen, corners: Floats) -> NDArray[np.bool_]:
    """Fragments whose ray does not graze its triangle, and that are not right before the lens."""
    directions = rays(camera, seen.point, SIZE)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    depth = cast(camera, rays(camera, seen.point, SIZE), corners[None]).depth[:, 0]
    return np.asarray((np.abs(directions @ normal) / np.linalg.norm(normal) > 0.1) & (depth > 0.05))


@given(triangle_soups(), CAMERAS)
@settings(max_examples=80)
def test_texture_coordinates_and_their_slopes_are_those_of_the_plane(soup: Floats, camera: Camera) -> None:
    corners, step = soup[0], 1e-4
    seen = look(mesh_from(soup[:1], UVS[None]), camera)
    good = decently_seen(camera, seen, corners)
    np.testing.assert_allclose(seen.uv[good], uv_by_ray(camera, seen.point, corners)[good], atol=2e-3)
    for axis, direction in enumerate(np.eye(2)):
        ahead, back = (uv_by_ray(camera, seen.point + s * step * direction, corners) for s in (1, -1))
        slope = (ahead - back)[good] / (2 * step)
        assert (np.abs(seen.duv[good][..., axis] - slope) <= 2e-3 + 0.01 * np.abs(slope)).all()


def test_texture_coordinates_are_perspective_correct_and_not_merely_interpolated_in_the_image() -> None:
    corners = np.array([[-0.5, -0.3, 1.0], [0.5, -0.3, 1.0], [0.0, -0.3, -6.0]])
    camera = Camera(2, 0, 0)
    seen = look(mesh_from(corners[None], UVS[None]), camera)
    assert len(seen.point) > 5
    np.testing.assert_allclose(seen.uv, uv_by_ray(camera, seen.point, corners), atol=1e-4)


def test_barycentrics_of_covered_centres_are_weights() -> None:
    seen = look(mesh_from(CLOCKWISE), Camera(2, 20, 30))
    assert (seen.barycentric >= -1e-5).all()
    np.testing.assert_allclose(seen.barycentric.sum(axis=1), 1, atol=1e-5)


AWKWARD = {
    "a point": [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
    "a line": [[-1, 0, 0], [0, 0, 0], [1, 0, 0]],
    "a needle": [[-1, 0, 0], [1, 0, 0], [1, 1e-6, 0]],
    "edge on": [[-0.5, 0, -0.5], [0.5, 0, -0.5], [0, 0, 0.5]],
    "tiny": [[0, 0, 0], [1e-7, 0, 0], [0, 1e-7, 0]],
    "huge": [[-1e6, -1e6, 0], [1e6, -1e6, 0], [0, 1e6, 0]],
    "a corner on the camera": [[0, 0, 2], [0.5, 0, 0], [0, 0.5, 0]],
    "an edge through the camera": [[0, -1, 2], [0, 1, 2], [0.5, 0, 0]],
}


@pytest.mark.parametrize("corners", AWKWARD.values(), ids=AWKWARD)
def test_awkward_triangles_give_finite_numbers_and_hide_only_what_is_behind_them(corners: list[list[float]]) -> None:
    awkward, wall, camera = np.array([corners], float), CLOCKWISE * 3 - [0, 0, 1], Camera(2, 0, 0)
    both = mesh_from(np.concatenate([awkward, wall]), np.stack([UVS, UVS]))
    seen, together = look(both, camera), seen_faces(both, camera).ravel()
    for values in (seen.uv, seen.duv, seen.barycentric):
        assert np.isfinite(values).all()
    covered = cast(camera, rays(camera, positions(CENTRE), SIZE), awkward).barycentric[:, 0].min(axis=-1) > -0.01
    assert covered[together == 0].all()
    assert (seen_faces(mesh_from(wall), camera).ravel()[together == -1] == -1).all()
