"""The a-contrario test: what chance explains is refused, what it does not is not."""

import numpy as np
import pytest
from scipy.special import comb
from scipy.stats import binom

from frontends.matching.chance import (
    FALSE_ALARMS,
    agreement,
    line_chance,
    point_chance,
    separate,
)


def scattered(count, seed=0, size=1000.0):
    """Matches on a jittered lattice: none is near another."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    pitch = size / side
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    first = (cells[:count] + 0.5) * pitch + rng.uniform(-0.1, 0.1, (count, 2)) * pitch
    return first, first + 5.0


@pytest.mark.parametrize("alpha", [1e-5, 1e-3, 0.02])
@pytest.mark.parametrize("sample", [2, 4, 7])
def test_the_bound_is_the_least_count_with_few_enough_false_alarms(alpha, sample):
    first, second = scattered(60)
    found = agreement(first, second, np.ones(60, bool), sample, alpha)
    assert found.matches == 60

    def false_alarms(inliers):
        return comb(60, sample) * binom.sf(inliers - sample - 1, 60 - sample, alpha)

    assert false_alarms(found.needed) <= FALSE_ALARMS < false_alarms(found.needed - 1)
    assert found.reason == ""
    few = np.arange(60) < found.needed - 1
    assert f"{found.needed} are needed" in agreement(first, second, few, sample, alpha).reason


def test_certain_agreement_proves_nothing():
    first, second = scattered(50)
    found = agreement(first, second, np.ones(50, bool), 4, 1.0)
    assert found.needed > 50
    assert found.reason
    assert agreement(first[:3], second[:3], np.ones(3, bool), 4, 1e-6).reason


def test_a_rock_found_at_many_scales_is_one_match():
    first, second = scattered(40)
    rock = np.tile(first[7], (200, 1)) + np.random.default_rng(1).normal(0, 2, (200, 2))
    inlier = np.zeros(240, bool)
    inlier[40:] = True
    found = agreement(np.vstack([first, rock]), np.vstack([second, rock - 300.0]), inlier, 4, 1e-5)
    assert found.inliers <= 3
    assert found.reason


def test_separate_matches_are_apart_in_both_images_and_leave_no_room():
    rng = np.random.default_rng(2)
    first, second = rng.uniform(0, 200, (2, 500, 2))
    kept = separate(first, second, 12.0)
    for xy in (first, second):
        distance = np.linalg.norm(xy[kept][:, None] - xy[kept], axis=2)
        assert distance[~np.eye(len(kept), dtype=bool)].min() > 12.0
    for i in np.setdiff1d(np.arange(500), kept):
        nearest = min(np.linalg.norm(xy[kept] - xy[i], axis=1).min() for xy in (first, second))
        assert nearest <= 12.0
    assert len(separate(np.zeros((0, 2)), np.zeros((0, 2)))) == 0


@pytest.mark.parametrize("crowded", [False, True])
def test_the_chance_of_a_point_is_what_is_drawn(crowded):
    """Two matches of the same density meet as often as the formula says, or less."""
    rng = np.random.default_rng(3)
    draw = rng.uniform(0, 800, (40_000, 2))
    if crowded:  # half of all matches lie along a horizon
        draw[:20_000, 1] = rng.normal(100, 30, 20_000)
        rng.shuffle(draw)
    meet = np.mean(np.linalg.norm(draw[:20_000] - draw[20_000:], axis=1) < 8.0)
    stated = np.mean([point_chance(draw[k : k + 200], 8.0) for k in range(0, 4000, 200)])
    assert stated == pytest.approx(meet, rel=0.35)


def test_the_chance_of_a_line_bounds_what_is_drawn():
    rng = np.random.default_rng(4)
    points = rng.uniform([0, 0], [1000, 400], (2000, 2))
    stated = line_chance(points, 2.0)
    for angle in rng.uniform(0, np.pi, 50):
        normal = np.array([np.cos(angle), np.sin(angle)])
        offset = normal @ rng.uniform([0, 0], [1000, 400])
        assert np.mean(np.abs(points @ normal - offset) < 2.0) < 1.2 * stated + 0.003
