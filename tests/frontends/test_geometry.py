"""Rigid transforms against finite differences, GTSAM and scipy."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from frontends.geometry import (
    adjoint,
    inverse,
    is_rigid,
    pose,
    se3_exp,
    se3_log,
    skew,
    so3_exp,
    so3_log,
    transform_points,
    yaw_pitch_roll,
)

unit = st.floats(-1.0, 1.0, allow_nan=False)
metres = st.floats(-100.0, 100.0, allow_nan=False)
#: Angles from exactly 0 over the series' region to nearly pi.
angles = st.one_of(
    st.floats(0.0, 3.14),
    st.floats(-12.0, 0.0).map(lambda exponent: 10.0**exponent),
    st.just(0.0),
)


@st.composite
def rotation_vectors(draw):
    axis = np.array([draw(unit) + 1e-3, draw(unit), draw(unit)])
    return draw(angles) * axis / np.linalg.norm(axis)


@st.composite
def tangents(draw):
    return np.concatenate([draw(rotation_vectors()), [draw(metres) for _ in range(3)]])


def hat(xi):
    result = np.zeros((4, 4))
    result[:3, :3], result[:3, 3] = skew(xi[:3]), xi[3:]
    return result


@settings(max_examples=80, deadline=None)
@given(tangents())
def test_exp_and_log_are_inverse_to_each_other(xi):
    transform = se3_exp(xi)
    assert is_rigid(transform, 1e-9)
    np.testing.assert_allclose(se3_log(transform), xi, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(so3_log(so3_exp(xi[:3])), xi[:3], rtol=1e-6, atol=1e-9)


@settings(max_examples=80, deadline=None)
@given(tangents())
def test_exp_is_the_matrix_exponential(xi):
    np.testing.assert_allclose(se3_exp(xi), expm(hat(xi)), atol=1e-8 * (1 + abs(xi).max()))


@settings(max_examples=40, deadline=None)
@given(tangents())
def test_exp_and_adjoint_agree_with_gtsam(xi):
    theirs = gtsam.Pose3.Expmap(xi)
    np.testing.assert_allclose(se3_exp(xi), theirs.matrix(), atol=1e-8 * (1 + abs(xi).max()))
    np.testing.assert_allclose(adjoint(theirs.matrix()), theirs.AdjointMap(), atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(tangents(), tangents())
def test_adjoint_carries_a_right_perturbation_to_the_left(xi, direction):
    a_T_b = se3_exp(xi)
    small = 1e-3 * direction / max(1.0, np.linalg.norm(direction))
    np.testing.assert_allclose(
        se3_exp(adjoint(a_T_b) @ small) @ a_T_b, a_T_b @ se3_exp(small), atol=1e-7
    )


def test_adjoint_is_the_derivative_of_conjugation():
    a_T_b = se3_exp([0.4, -0.7, 0.2, 3.0, -1.0, 2.0])
    step = 1e-6
    numeric = np.column_stack(
        [
            (
                se3_log(a_T_b @ se3_exp(step * unit) @ inverse(a_T_b))
                - se3_log(a_T_b @ se3_exp(-step * unit) @ inverse(a_T_b))
            )
            / (2 * step)
            for unit in np.eye(6)
        ]
    )
    np.testing.assert_allclose(adjoint(a_T_b), numeric, atol=1e-8)


@settings(max_examples=40, deadline=None)
@given(tangents())
def test_inverse_undoes(xi):
    a_T_b = se3_exp(xi)
    np.testing.assert_allclose(inverse(a_T_b), np.linalg.inv(a_T_b), atol=1e-9)


def test_inverse_takes_a_stack():
    rng = np.random.default_rng(0)
    stack = np.stack([se3_exp(xi) for xi in rng.normal(size=(5, 6))]).reshape(5, 1, 4, 4)
    np.testing.assert_allclose(stack @ inverse(stack), np.broadcast_to(np.eye(4), stack.shape),
                               atol=1e-12)  # fmt: skip


def test_transform_points_is_the_homogeneous_product():
    rng = np.random.default_rng(1)
    a_T_b, points = se3_exp(rng.normal(size=6)), rng.normal(size=(7, 3))
    expected = (a_T_b @ np.column_stack([points, np.ones(7)]).T).T[:, :3]
    np.testing.assert_allclose(transform_points(a_T_b, points), expected, atol=1e-12)
    assert transform_points(a_T_b, np.zeros((0, 3))).shape == (0, 3)


def test_skew_is_the_cross_product():
    v, w = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.0])
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w))


@settings(max_examples=80, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_yaw_pitch_roll_inverts_the_convention(yaw, pitch, roll):
    rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(
        yaw_pitch_roll(pose(rotation, [1.0, 2.0, 3.0])), (yaw, pitch, roll), atol=1e-9
    )


def test_positive_pitch_is_nose_down_positive_yaw_left_positive_roll_right_side_down():
    forward, left = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    for name, place in (("yaw", 0), ("pitch", 1), ("roll", 2)):
        angles = [0.0, 0.0, 0.0]
        angles[place] = 0.3
        transform = pose(Rotation.from_euler("ZYX", angles).as_matrix(), np.zeros(3))
        assert yaw_pitch_roll(transform)[place] == pytest.approx(0.3), name
        nose, side = transform[:3, :3] @ forward, transform[:3, :3] @ left
        if name == "yaw":
            assert nose[1] > 0.0  # counter-clockwise: the nose goes to the left
        elif name == "pitch":
            assert nose[2] < 0.0
        else:
            assert side[2] > 0.0


def test_yaw_pitch_roll_survives_straight_down():
    transform = pose(Rotation.from_euler("ZYX", [0.2, np.pi / 2, 0.0]).as_matrix(), np.zeros(3))
    yaw, pitch, roll = yaw_pitch_roll(transform)
    assert pitch == pytest.approx(np.pi / 2, abs=1e-6)
    assert np.isfinite([yaw, roll]).all()


@pytest.mark.parametrize(
    "transform",
    [
        np.diag([1.0, 1.0, -1.0, 1.0]),  # left-handed
        np.diag([1.1, 1.0, 1.0, 1.0]),
        np.full((4, 4), np.nan),
        np.eye(3),
        np.eye(4) + np.eye(4, k=-3),  # last row
        np.diag([1.0, 1.0, 1.0, 0.0]),
    ],
    ids=["mirror", "scaled", "nan", "3x3", "last row", "zero corner"],
)
def test_is_rigid_refuses(transform):
    assert not is_rigid(transform)
