"""Absolute fixes of a simulated traverse, some of them false, with exact truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.geometry import yaw_pitch_roll
from frontends.measurements import AbsoluteFix, FixCandidate, FloatArray


@dataclass(frozen=True, slots=True)
class FixSpec:
    """What to simulate.

    Attributes
    ----------
    every
        Keyframes between fixes.
    sigma_xy_m, sigma_yaw_rad
        Noise, as reported and as drawn.
    correlation
        Of y and yaw along the rover's heading, as reported and as drawn: a patch that was
        matched ahead of the rover has it.
    false_share
        Share of fixes that are wrong.
    false_within_m
        Wrong places lie up to this far off, uniform in a square.
    clustered
        All wrong fixes are off by the same vector (and noise): what a repetitive terrain or a
        shifted map does.
    candidates
        Places a fix holds; but for the best all are wrong, and the best may be.
    """

    every: int = 20
    sigma_xy_m: float = 1.0
    sigma_yaw_rad: float = 0.02
    correlation: float = 0.0
    false_share: float = 0.0
    false_within_m: float = 50.0
    clustered: bool = False
    candidates: int = 1


@dataclass(frozen=True, slots=True)
class SimulatedFixes:
    """The fixes and which of them are true.

    Attributes
    ----------
    fixes
        In the order of their keyframes.
    true
        (N,) whether the true place is among the candidates.
    """

    fixes: tuple[AbsoluteFix, ...]
    true: NDArray[np.bool_]


def simulate_fixes(
    frames: Sequence[int], map_T_rover: FloatArray, spec: FixSpec, seed: int
) -> SimulatedFixes:
    """Simulate the fixes of a traverse.

    Parameters
    ----------
    frames, map_T_rover
        Indices and true poses (N, 4, 4) of all keyframes.
    spec
        What to simulate.
    seed
        Of all random numbers.
    """
    rng = np.random.default_rng(seed)
    places = range(spec.every, len(frames), spec.every)
    false = rng.random(len(places)) < spec.false_share
    common = _wrong(spec, rng)
    fixes = []
    for k, wrong in zip(places, false, strict=True):
        covariance = _covariance(spec, map_T_rover[k])
        root = np.linalg.cholesky(covariance)
        yaw = yaw_pitch_roll(map_T_rover[k])[0]
        truth = np.array([map_T_rover[k, 0, 3], map_T_rover[k, 1, 3], yaw])
        offsets = [_wrong(spec, rng) for _ in range(spec.candidates)]
        if not wrong:
            offsets[0] = np.zeros(3)
        elif spec.clustered:
            offsets[0] = common
        found = (truth + offset + root @ rng.normal(size=3) for offset in offsets)
        fixes.append(
            AbsoluteFix(
                int(frames[k]),
                tuple(
                    FixCandidate(float(x), float(y), float(z), covariance, proposer="simulation")
                    for x, y, z in found
                ),
            )
        )
    return SimulatedFixes(tuple(fixes), ~false)


def _wrong(spec: FixSpec, rng: np.random.Generator) -> FloatArray:
    """An offset that is no noise: at least five sigmas in x or y."""
    while True:
        xy = rng.uniform(-spec.false_within_m, spec.false_within_m, 2)
        if np.abs(xy).max() > 5.0 * spec.sigma_xy_m:
            return np.array([*xy, 0.0])


def _covariance(spec: FixSpec, map_T_rover: FloatArray) -> FloatArray:
    """Of (x, y, yaw) in map axes; the correlation is of the rover's left axis with yaw."""
    xy, yaw = spec.sigma_xy_m, spec.sigma_yaw_rad
    cross = spec.correlation * xy * yaw
    heading = yaw_pitch_roll(map_T_rover)[0]
    covariance = np.diag([xy**2, xy**2, yaw**2])
    covariance[:2, 2] = covariance[2, :2] = cross * np.array([-np.sin(heading), np.cos(heading)])
    return covariance
