"""The motion between two frames from noisy landmarks, right ones and wrong ones."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.stats import chi2
from synthetic import CAMERA, PointCloud

from frontends.geometry import inverse, se3_exp, se3_log, transform_points
from frontends.rectification import observe
from frontends.relative import (
    LANDMARK_CORRELATION,
    MotionPrediction,
    RelativeConfig,
    RelativePositioning,
    _samples,
    predicted_points,
    rigid_transform,
)
from frontends.reprojection import Part, TwoViewProblem
from frontends.tracks import common_landmarks

A_T_B = se3_exp([0.01, -0.03, 0.005, 0.02, 0.01, 0.25])
NOTHING_KNOWN = MotionPrediction(np.eye(4), np.diag([0.05**2] * 3 + [0.3**2] * 3))


def two_views(seed, wrong_share=0.0, a_T_b=A_T_B, **cloud):
    """Observations of common landmarks in a and b; `wrong` marks wrong partners in b."""
    rng = np.random.default_rng((5, seed))
    points = PointCloud.ahead(seed, **cloud)
    a, b = common_landmarks(points.observe(np.eye(4), rng), points.observe(a_T_b, rng))
    wrong = np.arange(len(b)) < round(wrong_share * len(b))
    other = np.arange(len(b))
    other[wrong] = np.roll(other[wrong], 1)
    b = replace(b.select(other), landmark_id=b.landmark_id)
    return a, b, wrong


def estimate(a, b, seed=0, config=None, prediction=NOTHING_KNOWN, correlation=LANDMARK_CORRELATION):
    positioning = RelativePositioning(CAMERA, config, seed, correlation)
    return positioning.estimate(a.points_cam, a.points_covariance, b, prediction)


def nees(found, truth=A_T_B):
    error = se3_log(inverse(found.a_T_b) @ truth)
    return error @ np.linalg.solve(found.covariance, error) / 6.0


@pytest.mark.parametrize("seed", range(5))
def test_rigid_transform_is_exact(seed):
    rng = np.random.default_rng(seed)
    b_T_a = se3_exp(rng.normal(size=6) * 2.0)
    for count in (3, 4, 50):
        points = rng.normal(size=(count, 3)) * 5.0
        np.testing.assert_allclose(
            rigid_transform(points, transform_points(b_T_a, points)), b_T_a, atol=1e-9
        )


def test_rigid_transform_never_mirrors():
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(20, 3)) * [1.0, 1.0, 0.0]
    for points_b in (flat * [1.0, -1.0, 1.0], rng.normal(size=(20, 3))):
        assert np.linalg.det(rigid_transform(flat, points_b)[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("wrong_share", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", range(6))
def test_the_motion_is_found_among_wrong_correspondences(seed, wrong_share):
    a, b, wrong = two_views(seed, wrong_share)
    found = estimate(a, b, seed)
    assert found.accepted, found.reason
    error = se3_log(inverse(found.a_T_b) @ A_T_B)
    assert np.linalg.norm(error[:3]) < 0.004
    assert np.linalg.norm(error[3:]) < 0.012
    inlier = np.isin(b.landmark_id, found.inlier_ids)
    assert inlier[~wrong].mean() > 0.95
    assert inlier[wrong].sum() <= 0.1 * wrong.sum()
    assert found.correspondences == len(b)


def mean_nees(seeds, landmark_correlation=0.0, **kwargs):
    """Of simulated landmarks, which err independently of each other."""
    found = (
        estimate(*two_views(seed, **kwargs)[:2], seed, correlation=landmark_correlation)
        for seed in seeds
    )
    return np.mean([nees(motion) for motion in found])


@pytest.mark.parametrize("wrong_share", [0.0, 0.3])
def test_the_covariance_is_honest(wrong_share):
    runs = 150
    low, high = chi2.ppf([0.025, 0.975], 6 * runs) / (6 * runs)
    assert low < mean_nees(range(100, 100 + runs), wrong_share=wrong_share) < high


def test_the_covariance_is_never_far_off():
    """Whatever its shape: mean NEES within a factor 1.7 both ways."""
    assert 0.6 < mean_nees(range(100, 160)) < 1.7
    assert 0.6 < mean_nees(range(100, 160), count=60) < 1.7
    assert 0.6 < mean_nees(range(100, 160), nearest_m=3.0, farthest_m=30.0) < 1.7


def test_many_landmarks_count_for_few_where_they_share_errors():
    apart, shared = (mean_nees(range(40), of, count=300) for of in (0.0, 0.01))
    assert 2.0 < apart / shared < 4.0


def test_larger_noise_than_stated_inflates_the_covariance():
    squared = []
    for seed in range(60):
        a, b, _ = two_views(seed, sigma_px=0.6, sigma_disparity_px=0.24)
        half = [
            observe(CAMERA, o.landmark_id, o.u_left, o.v, o.disparity_px, o.sigma_px / 2.0,
                    o.sigma_disparity_px / 2.0)
            for o in (a, b)
        ]  # fmt: skip
        found = estimate(*half, seed)
        assert found.accepted
        squared.append(nees(found))
    assert np.mean(squared) < 2.0  # 4 without


def test_refine_takes_correspondences_as_they_are():
    a, b, _ = two_views(3)
    positioning = RelativePositioning(CAMERA)
    found = positioning.refine(a.points_cam, a.points_covariance, b, NOTHING_KNOWN)
    assert found.accepted
    assert nees(found) < 4.0


@pytest.mark.parametrize("seed", range(10))
def test_refine_holds_with_landmarks_at_the_end_of_the_useful_range(seed):
    """A quarter of the depth as sigma is within the range that perception lets pass."""
    a, b, _ = two_views(seed, nearest_m=1.5, farthest_m=40.0, sigma_disparity_px=0.15)
    positioning = RelativePositioning(CAMERA)
    found = positioning.refine(a.points_cam, a.points_covariance, b, NOTHING_KNOWN)
    assert found.accepted, found.reason
    assert nees(found) < 5.0


def assert_refused(found, prediction=NOTHING_KNOWN):
    assert not found.accepted
    assert found.reason
    assert len(found.inlier_ids) == 0
    np.testing.assert_array_equal(found.a_T_b, prediction.a_T_b)
    np.testing.assert_array_equal(found.covariance, prediction.covariance)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 11])
def test_too_few_correspondences_are_refused(count):
    a, b, _ = two_views(0)
    found = estimate(a.select(np.arange(count)), b.select(np.arange(count)))
    assert_refused(found)
    assert f"{count} tracked landmarks" in found.reason
    assert found.correspondences == count


@pytest.mark.parametrize("seed", range(10))
def test_no_consensus_is_refused(seed):
    a, b, _ = two_views(seed, wrong_share=1.0, count=120)
    found = estimate(a, b, seed)
    assert_refused(found)
    assert "agree on one motion" in found.reason


@pytest.mark.parametrize("kind", ["one point", "a line", "two points"])
def test_points_that_do_not_fix_the_motion_are_refused(kind):
    n = 40
    u, v, disparity = np.full(n, 200.0), np.full(n, 100.0), np.full(n, 10.0)
    if kind == "a line":  # straight towards the camera's right: all on one row, one depth
        u = np.linspace(60.0, 280.0, n)
    elif kind == "two points":
        u = np.where(np.arange(n) % 2, 100.0, 250.0)
    sigma = np.full(n, 0.2)
    a = observe(CAMERA, np.arange(n), u, v, disparity, sigma, sigma)
    found = estimate(a, a)
    assert_refused(found)
    assert "six" in found.reason


def test_standing_still_is_a_motion():
    a, b, _ = two_views(0, a_T_b=np.eye(4))
    found = estimate(a, b)
    assert found.accepted
    assert np.abs(se3_log(found.a_T_b)).max() < 0.01


def test_a_wrong_prediction_does_not_matter():
    a, b, _ = two_views(2, 0.3)
    far = MotionPrediction(se3_exp([0.5, 1.0, -2.0, 3.0, 2.0, -9.0]), np.eye(6))
    error = se3_log(inverse(estimate(a, b).a_T_b) @ estimate(a, b, prediction=far).a_T_b)
    assert np.abs(error).max() < 1e-3


def test_the_seed_decides_and_nothing_that_ran_before():
    a, b, _ = two_views(7, 0.6)
    fresh = estimate(a, b, seed=3)
    used = RelativePositioning(CAMERA, seed=3)
    used.estimate(*_inputs(*two_views(8, 0.5)[:2]))
    again = used.estimate(*_inputs(a, b))
    assert fresh.a_T_b.tobytes() == again.a_T_b.tobytes()
    assert fresh.covariance.tobytes() == again.covariance.tobytes()
    other = estimate(a, b, seed=4)
    assert np.abs(se3_log(inverse(fresh.a_T_b) @ other.a_T_b)).max() < 0.01


def _inputs(a, b):
    return a.points_cam, a.points_covariance, b, NOTHING_KNOWN


@pytest.mark.parametrize("seed", range(30))
def test_nothing_finite_makes_it_raise(seed):
    """Points behind the camera, huge, tiny, repeated; sigmas over five decades."""
    rng = np.random.default_rng((31, seed))
    n = int(rng.integers(0, 60))
    scale = 10.0 ** rng.uniform(-3, 4)
    points = scale * rng.standard_normal((n, 3))
    root = scale * 10.0 ** rng.uniform(-4, 0) * rng.standard_normal((n, 3, 3))
    disparity = 10.0 ** rng.uniform(-2, 2, n)
    b = observe(
        CAMERA,
        np.arange(n),
        rng.uniform(0, 320, n),
        rng.uniform(0, 240, n),
        disparity,
        10.0 ** rng.uniform(-3, 2, n),
        10.0 ** rng.uniform(-3, 2, n),
    )
    prediction = MotionPrediction(se3_exp(rng.normal(size=6)), np.eye(6))
    found = RelativePositioning(CAMERA, seed=seed).estimate(
        points, root @ np.swapaxes(root, 1, 2), b, prediction
    )
    assert np.isfinite(found.a_T_b).all()
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    assert found.accepted or found.reason


def test_normal_equations_are_the_derivative_of_the_residual():
    """Gradient against finite differences of the whitened cost, kernel all but off."""
    a, b, _ = two_views(1, count=40)
    problem = TwoViewProblem.of_landmarks(CAMERA, a.points_cam, 0 * a.points_covariance, b)
    b_T_a = inverse(A_T_B) @ se3_exp([2e-3, -1e-3, 1e-3, 0.01, -0.01, 0.02])
    information, gradient, _ = problem.linearise(b_T_a, 1e6)
    step = 1e-6

    def cost(xi):
        return 0.5 * problem.linearise(b_T_a @ se3_exp(xi), 1e6)[2].sum()

    numeric = [(cost(step * e) - cost(-step * e)) / (2 * step) for e in np.eye(6)]
    np.testing.assert_allclose(gradient, -np.array(numeric), rtol=1e-4)
    np.testing.assert_allclose(information, information.T)
    assert np.linalg.eigvalsh(information)[0] > 0.0


def test_a_point_behind_the_camera_has_no_say():
    a, b, _ = two_views(1, count=40)
    problem = TwoViewProblem.of_landmarks(CAMERA, a.points_cam, a.points_covariance, b)
    information, gradient, _ = problem.linearise(inverse(A_T_B), 2.0)
    turned = a.points_cam.copy()
    turned[0, 2] = -1.0
    other = TwoViewProblem.of_landmarks(CAMERA, turned, a.points_covariance, b)
    information_2, gradient_2, chi2_2 = other.linearise(inverse(A_T_B), 2.0)
    assert chi2_2[0] == 1e12  # finite: compiled with fast arithmetic, never an inlier
    rest = problem.linearise(inverse(A_T_B), 2.0, among=np.arange(len(b)) > 0)
    np.testing.assert_allclose(information_2, rest[0])
    np.testing.assert_allclose(gradient_2, rest[1])
    assert not np.allclose(information, information_2)
    assert not np.allclose(gradient, gradient_2)


def test_predicted_points_carries_from_a_to_b():
    points = np.array([[0.0, 0.0, 5.0]])
    ahead = MotionPrediction(se3_exp([0, 0, 0, 0, 0, 1.0]), np.eye(6))
    np.testing.assert_allclose(predicted_points(ahead, points), [[0.0, 0.0, 4.0]])


def test_more_inliers_asked_for_than_there_are_is_a_reason():
    a, b, _ = two_views(0, count=60)
    found = estimate(a, b, config=RelativeConfig(min_inliers=1000))
    assert_refused(found)


@pytest.mark.parametrize("least", [0, 2])
def test_fewer_than_three_inliers_asked_for_is_no_crash(least):
    a, b, _ = two_views(0)
    found = estimate(
        a.select(np.arange(least)), b.select(np.arange(least)),
        config=RelativeConfig(min_inliers=least),
    )  # fmt: skip
    assert_refused(found)


def test_refine_is_not_led_astray_by_a_few_points_at_infinity():
    """As the disparity correction leaves them: 0.02 px of disparity, depth unknown."""
    a, b, _ = two_views(0)
    far = np.arange(len(a)) < 10

    def pushed_out(seen, seed):
        tiny = np.random.default_rng(seed).uniform(0.001, 0.1, len(seen))
        disparity = np.where(far, tiny, seen.disparity_px)
        return observe(CAMERA, seen.landmark_id, seen.u_left, seen.v, disparity, seen.sigma_px,
                       seen.sigma_disparity_px)  # fmt: skip

    a, b = pushed_out(a, 1), pushed_out(b, 2)
    known = MotionPrediction(A_T_B, 1e-4 * np.eye(6))
    found = RelativePositioning(CAMERA).refine(a.points_cam, a.points_covariance, b, known)
    assert found.accepted, found.reason


def two_view_problem(seed=1, count=60):
    a, b, _ = two_views(seed, count=count)
    return TwoViewProblem.of_landmarks(CAMERA, a.points_cam, a.points_covariance, b)


def test_the_parts_are_what_their_names_say():
    """Landmark by landmark against the formulas of `Part`."""
    problem, b_T_a, kernel = two_view_problem(), inverse(A_T_B), 1.5
    sums = {part: problem.linearise(b_T_a, kernel, part=part) for part in Part}
    expected = {part: np.zeros((6, 6)) for part in Part}
    for k in range(len(problem)):
        plain, _, chi2 = problem.linearise(b_T_a, 1e9, among=np.arange(len(problem)) == k)
        m2 = float(chi2[k])
        weight = 1.0 / (1.0 + m2 / kernel**2)
        expected[Part.SOLVE] += weight * plain
        expected[Part.CURVATURE] += (weight - 2.0 * weight**2 * m2 / (3.0 * kernel**2)) * plain
        expected[Part.SCATTER] += weight**2 * m2 / 3.0 * plain
    for part in Part:
        information, gradient, chi2 = sums[part]
        np.testing.assert_allclose(chi2, sums[Part.SOLVE][2])
        np.testing.assert_allclose(information, expected[part], rtol=1e-5)
        np.testing.assert_allclose(gradient, sums[Part.SOLVE][1])
        np.testing.assert_allclose(chi2, problem.distances2(b_T_a))


def test_no_covariance_where_the_motion_is_open():
    problem = two_view_problem()
    assert problem.motion_covariance(inverse(A_T_B), 2.0) is not None
    two = np.arange(len(problem)) < 2
    assert problem.motion_covariance(inverse(A_T_B), 2.0, among=two) is None
    nothing = np.zeros(len(problem), bool)
    assert problem.motion_covariance(inverse(A_T_B), 2.0, among=nothing) is None
    turned_away = se3_exp([0.0, np.pi, 0.0, 0.0, 0.0, 0.0])
    assert problem.motion_covariance(turned_away, 2.0) is None


@pytest.mark.parametrize(
    "bad",
    [
        {"min_inliers": 2},
        {"min_inliers": 12.5},
        {"inlier_probability": 1.0},
        {"confidence": 0.0},
        {"confidence": float("nan")},
        {"max_hypotheses": 0},
        {"kernel_sigma": -1.0},
        {"least_inliers": 12},
    ],
)
def test_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValidationError):
        TypeAdapter(RelativeConfig).validate_python(bad)


@pytest.mark.parametrize("count", [12, 64, 65, 200])
def test_gauss_newton_ends_where_the_gradient_vanishes(count):
    """Whole and part blocks of landmarks; measured in sigmas of the motion."""
    problem = two_view_problem(count=count)
    start = inverse(A_T_B) @ se3_exp([2e-3, -1e-3, 1e-3, 0.01, -0.01, 0.02])
    among = np.arange(len(problem)) % 5 > 0
    motion = problem.solve(start, 2.0, iterations=50, among=among)
    information, gradient, _ = problem.linearise(motion, 2.0, among=among)
    assert gradient @ np.linalg.solve(information, gradient) < 1e-6
    assert np.abs(motion - start).max() > 1e-4


def test_further_unknowns_are_derivatives_too():
    """Gradient by the disparity terms against finite differences of the cost."""
    a, b, _ = two_views(1, count=70)
    rng = np.random.default_rng(3)
    terms = rng.normal(size=(len(b), 4, 2))
    terms[:, :3] *= 0.05
    flat = 1e-12 * a.points_covariance

    def problem(c):
        moved = a.points_cam + terms[:, :3] @ c
        shown = replace(b, u_right=b.u_right + terms[:, 3] @ c)  # less disparity there
        return TwoViewProblem.of_landmarks(CAMERA, moved, flat, shown, terms)

    b_T_a, step = inverse(A_T_B), 1e-6
    _, gradient, _ = problem(np.zeros(2)).linearise(b_T_a, 1e6)

    def cost(c):
        return 0.5 * problem(c).distances2(b_T_a).sum()

    numeric = [(cost(step * e) - cost(-step * e)) / (2 * step) for e in np.eye(2)]
    np.testing.assert_allclose(gradient[6:], -np.array(numeric), rtol=1e-3)


def test_samples_are_three_different_landmarks_all_equally_likely():
    triples, counts = np.unique(
        _samples(np.random.default_rng(0), 5, 60_000), axis=0, return_counts=True
    )
    assert len(triples) == 5 * 4 * 3
    assert all(len(set(triple)) == 3 for triple in triples.tolist())
    assert np.abs(counts - 1000).max() < 5 * np.sqrt(1000)
