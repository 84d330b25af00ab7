"""How well a correlation peak is known, and what a few bright cells may do to it."""

import numpy as np

from frontends.absolute.correlation import winsorised
from frontends.absolute.peak import find_peak
from frontends.absolute.search import Volume
from frontends.terrain import Grid

STEP = 0.02


def volume(rng, rough):
    """A peak at 0, 0, 0 whose height jumps from one yaw to the next."""
    yaws = STEP * np.arange(-10, 11)
    y, x = np.mgrid[-20:21, -20:21]
    shape = np.exp(-(x**2 + y**2) / 8.0)
    height = 0.4 * np.exp(-((yaws / 0.06) ** 2)) + rough * rng.standard_normal(len(yaws))
    values = height[:, None, None] * shape + 0.02 * rng.standard_normal((len(yaws), 41, 41))
    return Volume(values.astype(np.float32), yaws, Grid(-20.0, 20.0, 1.0, 41, 41))


def test_a_peak_among_others_as_high_is_not_as_sharp_as_it_looks():
    off, sigma = [], []
    for seed in range(120):
        peak = find_peak(volume(np.random.default_rng(seed), 0.04))
        if peak is None or not np.isfinite(peak.covariance).all():
            continue  # no clear peak: refused
        off.append(peak.yaw_rad)
        sigma.append(np.sqrt(peak.covariance[2, 2]))
    assert len(off) > 100
    smooth = find_peak(volume(np.random.default_rng(0), 0.0))
    # it is rough indeed: the curvature and the noise elsewhere alone know nothing of it
    assert np.std(off) > 3.0 * np.sqrt(smooth.covariance[2, 2])
    # two departures tell the roughness: the tail is that of Student's t, here 1 in 10
    assert np.mean(np.abs(off) > 3.0 * np.array(sigma)) < 0.12


def test_a_smooth_peak_is_as_sharp_as_it_looks():
    peak = find_peak(volume(np.random.default_rng(1), 0.0))
    assert abs(peak.yaw_rad) < 0.2 * STEP
    assert np.sqrt(peak.covariance[2, 2]) < 0.5 * STEP


def test_a_few_bright_cells_are_limited_and_the_rest_is_left_alone():
    rng = np.random.default_rng(2)
    values, mask = rng.standard_normal((50, 50)).astype(np.float32), np.ones((50, 50), dtype=bool)
    mask[:5] = False
    bright = values.copy()
    bright[20, 20] = 80.0
    limited = winsorised(bright, mask)
    assert 2.5 < limited[20, 20] < 3.5
    assert (limited[:5] == 0.0).all()
    inner = mask & (np.abs(values) < 2.5)
    inner[20, 20] = False
    np.testing.assert_array_equal(limited[inner], bright[inner])
    nothing = np.zeros_like(mask)
    np.testing.assert_array_equal(winsorised(values, nothing), values)
