"""Fundamental matrices of two views: found among wrong matches, refused for unrelated ones."""

import numpy as np
import pytest

from frontends.errors import InputError
from frontends.matching import find_fundamental
from frontends.matching.epipolar import epipolar_distance

FOCAL, CENTRE = 800.0, 400.0


def two_views(seed, count=300, wrong_share=0.4, sigma=0.3):
    """Pixels of a scene with depth seen from two poses; wrong matches are anywhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4, -3, 5], [4, 3, 20], (count, 3))
    angle = 0.15
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    moved = points @ rotation.T + [-1.0, 0.1, 0.4]
    first, second = (FOCAL * p[:, :2] / p[:, 2:] + CENTRE for p in (points, moved))
    first, second = (xy + sigma * rng.standard_normal(xy.shape) for xy in (first, second))
    wrong = np.arange(count) < wrong_share * count
    second[wrong] = rng.uniform(0, 2 * CENTRE, (int(wrong.sum()), 2))
    return first, second, wrong


@pytest.mark.parametrize("seed", range(5))
def test_recovered_with_many_matches_wrong(seed):
    first, second, wrong = two_views(seed)
    found = find_fundamental(first, second, seed=seed)
    assert found.verdict == "accepted", found.reason
    assert found.inlier[~wrong].mean() > 0.95
    assert found.inlier[wrong].mean() < 0.05
    assert found.error_px < 0.6
    exact_first, exact_second, _ = two_views(seed, wrong_share=0.0, sigma=0.0)
    assert np.median(epipolar_distance(found.matrix, exact_first, exact_second)) < 0.3


def test_unrelated_points_are_refused():
    for seed in range(80):
        rng = np.random.default_rng((5, seed))
        count = int(rng.integers(8, 300))
        first, second = rng.uniform(0, rng.uniform(100, 1000), (2, count, 2))
        found = find_fundamental(first, second, seed=seed)
        assert found.verdict == "refused", (seed, count, found.inlier.sum())
        assert not found.inlier.any()


def test_the_same_seed_gives_the_same_bytes():
    first, second, _ = two_views(3)
    results = {find_fundamental(first, second, seed=5).matrix.tobytes() for _ in range(2)}
    assert len(results) == 1


def test_few_and_bad_points():
    assert "needs 8" in find_fundamental(np.zeros((7, 2)), np.zeros((7, 2))).reason
    assert find_fundamental(np.zeros((30, 2)), np.zeros((30, 2))).verdict == "refused"
    with pytest.raises(InputError, match="NaN"):
        find_fundamental(np.zeros((9, 2)), np.full((9, 2), np.nan))
