"""Frames of a body against rotations as matrices, and against MuJoCo itself, on random poses."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_mesh.instances.body_axes import relative_velocity, to_body, to_world, wrench_at_center

Floats = NDArray[np.float64]

# Products of three numbers of at most 10 that are added in another order: a few units in the last place of 1000.
ROUNDING = 1e-12

numbers = st.floats(-10.0, 10.0, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .map(np.array)
    .filter(lambda q: float(np.linalg.norm(q)) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


def matrix_of(quaternion: Floats) -> list[float]:
    """The rotation of a quaternion as MuJoCo makes it, row by row."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return [*matrix.tolist()]


@given(quaternions, vectors)
def test_a_vector_in_world_axes_is_the_rotated_one_in_body_axes(
    quaternion: Floats, vector: tuple[float, float, float]
) -> None:
    rotation = matrix_of(quaternion)
    matrix = np.reshape(rotation, (3, 3))

    assert to_world(rotation, vector) == pytest.approx(matrix @ vector, abs=ROUNDING)
    assert to_body(rotation, vector) == pytest.approx(matrix.T @ vector, abs=ROUNDING)


@given(quaternions, vectors)
def test_there_and_back_is_where_it_was(quaternion: Floats, vector: tuple[float, float, float]) -> None:
    matrix = matrix_of(quaternion)

    assert to_body(matrix, to_world(matrix, vector)) == pytest.approx(vector, abs=ROUNDING)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    turned = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)

    assert to_world(turned, (1.0, 0.0, 0.0)) == (0.0, 1.0, 0.0)
    assert to_body(turned, (0.0, 1.0, 0.0)) == (1.0, 0.0, 0.0)


def test_a_body_that_goes_with_the_wind_feels_none() -> None:
    turned = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)

    assert relative_velocity(turned, (1.0, 2.0, 3.0), (1.0, 2.0, 3.0)) == (0.0, 0.0, 0.0)
    assert relative_velocity(turned, (0.0, 3.0, 0.0), (0.0, 1.0, 0.0)) == (2.0, 0.0, 0.0)


@given(quaternions, vectors, vectors, vectors)
def test_a_force_at_the_origin_has_the_same_moment_about_every_point(
    quaternion: Floats,
    lever: tuple[float, float, float],
    force: tuple[float, float, float],
    moment: tuple[float, float, float],
) -> None:
    rotation = matrix_of(quaternion)

    acting, about_center = wrench_at_center(rotation, lever, force, moment)

    matrix = np.reshape(rotation, (3, 3))
    assert acting == pytest.approx(matrix @ force, abs=ROUNDING)
    about_origin = np.array(about_center) + np.cross(-np.array(lever), acting)
    assert about_origin == pytest.approx(matrix @ moment, abs=10 * ROUNDING)


@given(quaternions, vectors, vectors, vectors)
def test_a_body_accelerates_as_if_the_force_acted_at_its_origin(
    quaternion: Floats,
    offset: tuple[float, float, float],
    force: tuple[float, float, float],
    moment: tuple[float, float, float],
) -> None:
    # MuJoCo's own way to apply a force at a point, `mj_applyFT`, gives what our wrench gives as `xfrc_applied`.
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><inertial pos='{} {} {}' mass='2' diaginertia='1 2 2.5'/>"
        "</body></worldbody></mujoco>".format(*(f"{x / 10:.6f}" for x in offset))
    )
    data = mujoco.MjData(model)
    data.qpos[3:7] = quaternion
    mujoco.mj_forward(model, data)
    matrix = data.xmat[1].reshape(3, 3)
    mujoco.mj_applyFT(model, data, matrix @ force, matrix @ moment, data.xpos[1], 1, data.qfrc_applied)
    mujoco.mj_forward(model, data)
    expected = data.qacc.copy()

    lever = (data.xpos[1] - data.xipos[1]).tolist()
    acting, about = wrench_at_center(data.xmat[1].tolist(), lever, force, moment)
    data.qfrc_applied[:] = 0.0
    data.xfrc_applied[1] = (*acting, *about)
    mujoco.mj_forward(model, data)

    assert data.qacc == pytest.approx(expected, abs=100 * ROUNDING)
