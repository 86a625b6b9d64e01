"""Cameras and lights: Trompe's angles, Unity's Euler angles and matrices say the same."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from trompe_shared.errors import SpecError
from trompe_shared.geometry import (
    Camera,
    Light,
    View,
    euler_to_matrix,
    light_travel_direction,
    look_rotation,
    sailenv_pose,
    spherical,
    unity_to_opengl_rotation,
)

azimuths = st.floats(-720, 720)
elevations = st.floats(-90, 90)
distances = st.floats(0.05, 50)


centres = st.tuples(*[st.floats(-5, 5)] * 3)


@given(distances, azimuths, elevations, centres)
@example(1.0, 30.0, 90.0, (0.0, 0.0, 0.0))
@example(1.0, 77.0, -90.0, (0.0, 1.0, 0.0))
def test_a_camera_looks_at_its_centre_and_stands_upright(
    distance: float, azimuth: float, elevation: float, centre: tuple[float, float, float]
) -> None:
    right, up, back = look_rotation(azimuth, elevation).T
    assert np.allclose(back, spherical(azimuth, elevation), atol=1e-12)
    assert np.allclose(np.cross(right, up), back, atol=1e-12)
    assert abs(right[1]) < 1e-12
    assert up[1] > -1e-12
    seen = Camera(distance, azimuth, elevation, centre=centre).world_to_camera() @ [*centre, 1]
    assert np.allclose(seen, [0, 0, -distance, 1], atol=1e-9)


@given(distances, azimuths, elevations, azimuths, centres)
@example(1.0, 45.0, 90.0, 0.0, (0.0, 0.0, 0.0))
@example(1.0, 45.0, -90.0, 30.0, (0.0, 0.0, 0.0))
def test_a_sailenv_pose_is_the_same_camera(
    distance: float, azimuth: float, elevation: float, roll: float, centre: tuple[float, float, float]
) -> None:
    camera = Camera(distance, azimuth, elevation, roll, centre)
    position, euler = sailenv_pose(camera)
    rotation = unity_to_opengl_rotation(euler)
    assert np.allclose(rotation, look_rotation(azimuth, elevation, roll), atol=1e-9)
    assert np.allclose(rotation.T, camera.world_to_camera()[:3, :3], atol=1e-9)
    assert np.allclose(rotation.T @ (position - centre), [0, 0, distance], atol=1e-9)


@given(azimuths, elevations, azimuths)
def test_roll_turns_right_and_up_about_the_line_of_sight(azimuth: float, elevation: float, roll: float) -> None:
    right, up, back = look_rotation(azimuth, elevation).T
    cosine, sine = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    rolled = look_rotation(azimuth, elevation, roll).T
    assert np.allclose(rolled, [cosine * right + sine * up, cosine * up - sine * right, back], atol=1e-12)


def test_a_camera_rolled_to_the_left_shows_a_point_above_on_its_right() -> None:
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
def test_euler_angles_turn_as_unitys(euler: tuple[int, ...], vector: tuple[int, ...], turned: tuple[int, ...]) -> None:
    assert np.allclose(euler_to_matrix(np.array(euler)) @ vector, turned, atol=1e-12)


@given(st.tuples(azimuths, azimuths, azimuths))
def test_any_euler_angles_give_a_right_handed_camera(euler: tuple[float, float, float]) -> None:
    rotation = unity_to_opengl_rotation(np.array(euler))
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.isclose(np.linalg.det(rotation), 1.0)
    assert np.allclose(rotation[:, 2], -euler_to_matrix(np.array(euler))[:, 2])


@given(st.floats(-179, 179), st.floats(-90, 90))
def test_light_travels_from_its_angles_to_the_origin(azimuth: float, elevation: float) -> None:
    origin_of_light = Camera(1.0, azimuth, elevation).position()
    assert np.allclose(light_travel_direction(Light(azimuth=azimuth, elevation=elevation)), -origin_of_light)


@pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (0, 0), (0, 0, 256), (-1, 0, 0), "red"])
def test_a_colour_is_three_levels(colour: Any) -> None:
    for make in (partial(View, Camera(1, 0, 0), background=colour), partial(Light, colour=colour)):
        with pytest.raises(SpecError, match="must be three whole numbers from 0 to 255"):
            make()
    assert View(Camera(1, 0, 0), background=tuple(np.array([1, 2, 3]))).background == (1, 2, 3)
