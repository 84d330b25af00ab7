"""A disparity error found from the motion of points that are measured with noise."""

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from synthetic import CAMERA, PointCloud

from frontends.disparity_check import DisparityCheck, DisparityCheckConfig
from frontends.geometry import se3_exp
from frontends.rectification import observe

STEP = se3_exp([0.0, 0.012, 0.0, 0.0, 0.0, 0.12])


def check_of(seed, error=(0.0, 0.0, 0.0), frames=14, step=STEP, config=None, **cloud):
    rng = np.random.default_rng((6, seed))
    points = PointCloud.ahead(seed, count=220, **cloud)
    check = DisparityCheck(CAMERA, config or DisparityCheckConfig(frames=frames - 1))
    map_T_camera = np.eye(4)
    for _ in range(frames):
        check.add(points.observe(map_T_camera, rng, np.array(error)))
        map_T_camera = map_T_camera @ step
    return check


@pytest.mark.parametrize(
    "error",
    [(0.3, 0.0, 0.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.5, 2.0, 0.0)],
)
@pytest.mark.parametrize("seed", range(3))
def test_the_injected_field_is_found_within_its_sigmas(error, seed):
    finding = check_of(seed, error).finding()
    scale = finding.border_px / finding.field_px
    np.testing.assert_allclose(scale[0], 1.0)
    normalised = np.abs(finding.field_px - error) * scale / finding.border_sigma_px
    assert normalised.max() < 3.0, str(finding)
    if abs(error[0]) >= 0.5:
        assert finding.significant, str(finding)
        assert finding.chance < 1e-4


def test_a_clean_pair_is_left_alone():
    """No false alarm over 20 runs, and errors that the sigmas cover."""
    normalised = []
    for seed in range(20):
        finding = check_of(seed, frames=8).finding()
        assert not finding.significant, str(finding)
        normalised.append(finding.border_px / finding.border_sigma_px)
    assert np.mean(np.square(normalised)) < 1.3


def test_standing_still_tells_nothing():
    check = check_of(0, (2.0, 0.0, 0.0), step=np.eye(4))
    assert check.finding() is None
    assert not check.ready


def test_frames_without_landmarks_tell_nothing():
    nothing = PointCloud.ahead(0, count=0).observe(np.eye(4), np.random.default_rng(0))
    check = DisparityCheck(CAMERA)
    assert check.finding() is None
    for _ in range(3):
        check.add(nothing)
    assert check.finding() is None


def test_ready_after_the_frames_asked_for():
    assert not check_of(0, frames=6, config=DisparityCheckConfig(frames=6)).ready
    assert check_of(0, frames=7, config=DisparityCheckConfig(frames=6)).ready


def test_the_finding_says_what_it_found():
    text = str(check_of(1, (1.0, 0.0, 0.0), frames=8).finding())
    assert "frame pairs" in text
    assert "constant +" in text
    assert "\n" not in text


def test_it_is_a_function_of_its_input():
    first, second = (check_of(4, (0.5, 0.0, 0.0), frames=6).finding() for _ in range(2))
    assert first.field_px.tobytes() == second.field_px.tobytes()


@pytest.mark.parametrize("seed", range(3))
def test_one_landmark_in_ten_wrong_does_not_matter(seed):
    rng = np.random.default_rng((6, seed))
    points = PointCloud.ahead(seed, count=220)
    check = DisparityCheck(CAMERA)
    map_T_camera = np.eye(4)
    for _ in range(14):
        seen = points.observe(map_T_camera, rng, np.array([1.0, 0.0, 0.0]))
        wrong = rng.random(len(seen)) < 0.1
        u = np.where(wrong, seen.u_left + rng.uniform(-15, 15, len(seen)), seen.u_left)
        check.add(observe(CAMERA, seen.landmark_id, u, seen.v, seen.disparity_px, seen.sigma_px,
                          seen.sigma_disparity_px))  # fmt: skip
        map_T_camera = map_T_camera @ STEP
    finding = check.finding()
    assert abs(finding.field_px[0] - 1.0) < 3.0 * finding.border_sigma_px[0]


def test_disparities_below_half_a_pixel_are_no_crash():
    """A long baseline of sight: all landmarks at 0.3 to 0.45 px of disparity."""
    check = check_of(
        0, frames=6, step=se3_exp([0.0, 0.02, 0.0, 0.0, 0.0, 0.1]),
        nearest_m=64.0, farthest_m=96.0, sigma_disparity_px=0.05,
    )  # fmt: skip
    finding = check.finding()
    assert finding is None or not finding.significant


def test_the_covariance_before_the_floor_is_honest():
    squared = []
    for seed in range(20):
        solution = check_of(seed, frames=10)._solve()
        assert solution is not None
        field, covariance = solution
        squared.append(field @ np.linalg.solve(covariance, field) / 3.0)
    assert 0.5 < np.mean(squared) < 1.7


def test_landmarks_that_do_not_tell_the_motion_tell_nothing():
    """One place, one row, one column, two places: at many positions, since rounding decides."""
    n = 40
    along, sigma = np.linspace(0.0, 1.0, n), np.full(n, 0.1)
    for seed in range(160):
        v_place, depth = np.random.default_rng(seed).uniform([20.0, 4.0], [220.0, 20.0])
        check = DisparityCheck(CAMERA)
        for k in range(5):
            u, v = np.full(n, 100.0 + 5 * k), np.full(n, v_place)
            if seed % 4 == 1:
                u = 60.0 + 200.0 * along + 3 * k
            elif seed % 4 == 2:
                v = 20.0 + 200.0 * along
            elif seed % 4 == 3:
                u = np.where(np.arange(n) % 2, 100.0, 250.0) + 3 * k
            check.add(observe(CAMERA, np.arange(n), u, v, np.full(n, depth), sigma, sigma))
        assert len(check._pairs) == 4
        finding = check.finding()
        if finding is not None:
            assert np.isfinite(finding.border_sigma_px).all()
            assert not finding.significant


@pytest.mark.parametrize("degenerate", [False, True])
def test_a_pair_that_tells_nothing_does_not_spoil_the_others(degenerate):
    """Thirty landmarks at infinity, as after a turn towards the sky, among good pairs."""
    check = check_of(2, (1.0, 0.0, 0.0), frames=10)
    if degenerate:
        n = 40
        place, sigma = np.full(n, 100.0), np.full(n, 0.1)
        for k in range(2):
            far = observe(CAMERA, np.arange(900, 900 + n), place + 5 * k, place, 0.3 * sigma,
                          sigma, sigma)  # fmt: skip
            check.add(far)
    assert len(check._pairs) == 9 + degenerate
    finding = check.finding()
    assert finding.significant
    assert abs(finding.field_px[0] - 1.0) < 3.0 * finding.border_sigma_px[0]


def test_what_it_holds_does_not_grow_with_the_frames():
    """A rover that stands: no pairs, and only as many frames as the longest gap spans."""
    check = check_of(0, frames=60, step=np.eye(4))
    assert len(check._pairs) == 0
    assert len(check._frames) <= 11


@pytest.mark.parametrize(
    "bad",
    [
        {"frames": 1},
        {"false_alarm_probability": 0.0},
        {"false_alarm_probability": 1.0},
        {"floor_px": 0.0},
        {"floor_px": float("nan")},
        {"mode": "often"},
        {"floor": 0.1},
    ],
)
def test_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValidationError):
        TypeAdapter(DisparityCheckConfig).validate_python(bad)
