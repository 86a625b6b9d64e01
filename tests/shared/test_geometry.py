"""Cameras and lights: Trompe's angles, Unity's Euler angles and matrices say the same."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from trompe_shared.geometry import (
    Camera,
    Light,
    direction_to_angles,
    euler_to_matrix,
    light_travel_direction,
    look_rotation,
    sailenv_pose,
    spherical,
    unity_to_opengl_rotation,
)

Ints = tuple[int, int, int]

azimuths = st.floats(-720, 720)
elevations = st.floats(-90, 90)
distances = st.floats(0.05, 50)


@given(azimuths, elevations)
@example(30.0, 90.0)
@example(30.0, -90.0)
def test_a_camera_looks_at_the_origin_and_stands_upright(azimuth: float, elevation: float) -> None:
    right, up, back = look_rotation(azimuth, elevation).T
    assert np.allclose(back, spherical(azimuth, elevation), atol=1e-12)
    assert np.allclose(np.cross(right, up), back, atol=1e-12)
    assert abs(right[1]) < 1e-12
    assert up[1] > -1e-12


@given(distances, azimuths, elevations)
@example(1.0, 0.0, 90.0)
@example(1.0, 77.0, -90.0)
def test_the_origin_is_straight_ahead_of_a_camera(distance: float, azimuth: float, elevation: float) -> None:
    origin = Camera(distance, azimuth, elevation).world_to_camera() @ [0, 0, 0, 1]
    assert np.allclose(origin, [0, 0, -distance, 1], atol=1e-9)


@given(distances, azimuths, elevations, azimuths)
@example(1.0, 45.0, 90.0, 0.0)
@example(1.0, 45.0, -90.0, 30.0)
def test_what_sailenv_is_told_is_the_same_camera(
    distance: float, azimuth: float, elevation: float, roll: float
) -> None:
    camera = Camera(distance, azimuth, elevation, roll)
    position, euler = sailenv_pose(camera)
    rotation = unity_to_opengl_rotation(euler)
    assert np.allclose(rotation, look_rotation(azimuth, elevation, roll), atol=1e-9)
    assert np.allclose(rotation.T, camera.world_to_camera()[:3, :3], atol=1e-9)
    assert np.allclose(rotation.T @ position, [0, 0, distance], atol=1e-9)


@given(azimuths, elevations, azimuths)
def test_roll_turns_right_and_up_about_the_line_of_sight(azimuth: float, elevation: float, roll: float) -> None:
    right, up, back = look_rotation(azimuth, elevation).T
    cosine, sine = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    rolled = look_rotation(azimuth, elevation, roll).T
    assert np.allclose(rolled, [cosine * right + sine * up, cosine * up - sine * right, back], atol=1e-12)


def test_a_camera_that_rolls_to_the_left_sees_what_is_above_on_its_right() -> None:
    above = Camera(2.0, 0, 0, roll=90).world_to_camera() @ [0, 1, 0, 1]
    assert np.allclose(above, [1, 0, -2, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("euler", "vector", "turned"),
    [
        pytest.param((0, 90, 0), (0, 0, 1), (1, 0, 0), id="y turns forward to the right"),
        pytest.param((90, 0, 0), (0, 0, 1), (0, -1, 0), id="x tips forward down"),
        pytest.param((0, 0, 90), (1, 0, 0), (0, 1, 0), id="z rolls right to up"),
        pytest.param((90, 90, 0), (0, 0, 1), (0, -1, 0), id="x comes before y"),
        pytest.param((90, 0, 90), (1, 0, 0), (0, 0, 1), id="z comes before x"),
    ],
)
def test_euler_angles_turn_as_unitys_do(
    euler: tuple[int, ...], vector: tuple[int, ...], turned: tuple[int, ...]
) -> None:
    assert np.allclose(euler_to_matrix(np.array(euler)) @ vector, turned, atol=1e-12)


@given(st.tuples(azimuths, azimuths, azimuths))
def test_any_euler_angles_give_a_right_handed_camera(euler: tuple[float, float, float]) -> None:
    rotation = unity_to_opengl_rotation(np.array(euler))
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.isclose(np.linalg.det(rotation), 1.0)
    assert np.allclose(rotation[:, 2], -euler_to_matrix(np.array(euler))[:, 2])


@given(st.floats(-179, 179), st.floats(-89, 89), st.floats(0.1, 10))
def test_a_lights_direction_gives_its_angles_back(azimuth: float, elevation: float, length: float) -> None:
    direction = length * light_travel_direction(Light(azimuth=azimuth, elevation=elevation))
    assert np.allclose(direction_to_angles(direction), (azimuth, elevation), atol=1e-6)


@pytest.mark.parametrize("elevation", [-90.0, 90.0])
def test_light_from_straight_above_or_below_keeps_its_elevation(elevation: float) -> None:
    direction = light_travel_direction(Light(azimuth=20.0, elevation=elevation))
    assert np.allclose(direction, [0, -np.sign(elevation), 0])
    assert np.isclose(direction_to_angles(direction)[1], elevation)


@pytest.mark.parametrize("direction", [(0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 0)])
def test_a_light_needs_a_direction(direction: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="light direction"):
        direction_to_angles(np.array(direction, dtype=float))
