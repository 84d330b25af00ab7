"""Wrong matches that lie on their epipolar line are known by their neighbours."""

import numpy as np
import pytest

from frontends.matching import find_fundamental
from frontends.matching.neighbours import among_neighbours


def ground(seed, count):
    """A plane that recedes, seen by a rectified pair: rows equal, disparities from 20 to 120 px."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(0, [1000, 600], (count, 2))
    return first, first - np.stack([20 + first[:, 1] / 6, np.zeros(count)], axis=1)


@pytest.mark.parametrize("count", [40, 100, 1000])
def test_those_put_elsewhere_on_their_line_are_found(count):
    kept_wrong, lost, wrong_count = 0, 0, 0
    for seed in range(20):
        first, second = ground(seed, count)
        wrong = np.arange(count) < max(1, count // 50)
        second[wrong, 0] = (second[wrong, 0] + 500) % 1000  # half the image off, same row
        agrees = among_neighbours(first, second)
        kept_wrong += int(agrees[wrong].sum())
        lost += int((~agrees[~wrong]).sum())
        wrong_count += int(wrong.sum())
    assert kept_wrong <= 0.02 * wrong_count + 1
    assert lost <= 0.005 * 20 * count


def test_turn_and_scale_do_not_matter():
    first, second = ground(0, 300)
    turned = 3.0 * second @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert np.array_equal(among_neighbours(first, second), among_neighbours(first, turned))


def test_few_matches_are_not_judged():
    rng = np.random.default_rng(0)
    assert among_neighbours(*rng.uniform(0, 100, (2, 39, 2))).all()


def test_fundamental_matrix_drops_them():
    rng = np.random.default_rng(1)
    first, second = ground(1, 400)
    second += 0.2 * rng.standard_normal(second.shape)
    second[:5, 0] = (second[:5, 0] + 500) % 1000
    found = find_fundamental(first, second)
    assert not found.inlier[:5].any()
    assert found.inlier[5:].mean() > 0.99
