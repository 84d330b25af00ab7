"""A motion must have more support than wrong matches give it."""

import numpy as np
import pytest

from frontends.consensus import false_alarms

GATE = 11.34


def distances2(rng, inliers, wrong, reach):
    """Squared distances: noise for the inliers, an even spread in a ball for the others."""
    true = rng.chisquare(3, inliers)
    radius = reach * np.cbrt(rng.uniform(size=wrong))
    return np.concatenate([true, radius**2])


@pytest.mark.parametrize("seed", range(20))
def test_a_true_motion_passes_among_many_wrong_matches(seed):
    rng = np.random.default_rng(seed)
    assert false_alarms(distances2(rng, 40, 200, 20.0), GATE) < 1e-3


def test_wrong_matches_alone_do_not_make_a_motion():
    """The best of 500 three-point samples of matches that are all wrong."""
    accepted = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        wrong = rng.uniform(-20.0, 20.0, (100, 3))
        best = max(
            (
                ((wrong - centre) ** 2).sum(axis=1)
                for centre in wrong[rng.integers(0, 100, (500, 3))].mean(axis=1)
            ),
            key=lambda chi2: int((chi2 < GATE).sum()),
        )
        accepted += false_alarms(best, GATE) < 1e-3
    assert accepted == 0


def test_too_few_prove_nothing():
    assert false_alarms(np.array([0.1, 0.2, 0.3, 500.0]), GATE) == np.inf
