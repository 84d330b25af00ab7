from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lunar_fg.datasets.association import attitude_at_frames, odometry_between_frames
from lunar_fg.datasets.tables import AttitudeTable, OdometryTable


def table(stamps: list[float], rows: list[tuple[float, float, float]]) -> OdometryTable:
    return OdometryTable(np.array(stamps, float), np.array(rows, float))


def matrix(forward: float, lateral: float, yaw: float) -> np.ndarray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, forward], [s, c, lateral], [0, 0, 1]])


def as_matrix(odometry) -> np.ndarray:
    return matrix(odometry.d_forward_m, odometry.d_lateral_m, odometry.d_yaw_rad)


def test_rows_at_the_frames_are_taken_as_they_are():
    rows = [(0, 0, 0), (0.5, 0.1, 0.2), (0.3, 0, -0.1)]
    result = odometry_between_frames(np.array([0.0, 1.0, 2.0]), table([0, 1.0004, 2], rows))
    assert result[0] is None
    np.testing.assert_allclose(as_matrix(result[1]), matrix(*rows[1]), atol=1e-3)
    np.testing.assert_allclose(as_matrix(result[2]), matrix(*rows[2]), atol=1e-3)


def test_rows_between_frames_are_composed():
    rows = [(0, 0, 0), (1, 0, math.pi / 2), (1, 0, 0)]
    result = odometry_between_frames(np.array([0.0, 1.0]), table([0, 0.5, 1], rows))
    assert result[1] is not None
    np.testing.assert_allclose(as_matrix(result[1]), matrix(1, 1, math.pi / 2), atol=1e-12)


numbers = st.floats(-3.0, 3.0)


@given(row=st.tuples(numbers, numbers, numbers), split=st.floats(0.01, 0.99))
def test_the_parts_of_a_straddling_row_compose_to_the_row(row, split):
    frames = np.array([0.0, split, 1.0])
    _, first, second = odometry_between_frames(frames, table([0, 1], [(0, 0, 0), row]))
    np.testing.assert_allclose(as_matrix(first) @ as_matrix(second), matrix(*row), atol=1e-9)


def test_half_of_an_arc():
    quarter = (1.0, 1.0, math.pi / 2)  # a quarter of a unit circle
    result = odometry_between_frames(np.array([0, 0.5]), table([0, 1], [(0, 0, 0), quarter]))[1]
    half = (math.sin(math.pi / 4), 1 - math.cos(math.pi / 4), math.pi / 4)
    np.testing.assert_allclose(as_matrix(result), matrix(*half), atol=1e-12)


def test_intervals_that_are_not_covered_have_none():
    rows = [(0.1, 0, 0)] * 3
    result = odometry_between_frames(np.arange(5.0), table([1, 2, 3], rows))
    assert [item is None for item in result] == [True, False, False, False, True]
    late = odometry_between_frames(np.arange(3.0), table([0.9, 0.95, 2.0], rows))
    assert late[1] is None
    only = odometry_between_frames(np.arange(3.0), table([1.0], rows[:1]))
    assert only[1].d_forward_m == 0.1
    assert odometry_between_frames(np.array([0.0]), table([1.0], rows[:1])) == (None,)


def attitudes(stamps: list[float], yaws: list[float]) -> AttitudeTable:
    n = len(stamps)
    angles = np.column_stack([np.zeros(n), np.full(n, 0.1), yaws])
    sigmas = np.column_stack([np.linspace(0.01, 0.02, n), np.full(n, 0.05)])
    return AttitudeTable(np.array(stamps, float), angles, sigmas)


def test_attitude_is_interpolated_the_short_way():
    source = attitudes([0, 1], [3.1, -3.1])
    (result,) = attitude_at_frames(np.array([0.5]), source)
    assert math.cos(result.yaw_rad) == pytest.approx(-1.0)
    assert (result.pitch_rad, result.sigma_rp_rad) == (pytest.approx(0.1), 0.02)


def test_attitude_rules_at_rows_ends_and_gaps():
    source = attitudes([0, 1, 10], [0.0, 0.1, 0.2])
    frames = np.array([-0.04, 0.0005, 1.04, 5.0, 10.04, 11.0])
    result = attitude_at_frames(frames, source)
    yaws = [None if item is None else item.yaw_rad for item in result]
    assert yaws == [0.0, 0.0, 0.1, None, 0.2, None]
