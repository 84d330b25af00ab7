"""What a fix costs against batch, and what is left when a false one is taken back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from frontends.measurements import AbsoluteFix, FixCandidate, FloatArray
from lunar_fg.graph import IncrementalSmoother, optimize_batch
from lunar_fg.graph.planar import planar
from lunar_fg.simulation.measurements import SimulatedTraverse, TraverseSpec, simulate

_SIGMAS = np.array([1.0, 1.0, 0.02])


@dataclass(frozen=True)
class FixCost:
    """A fix with its vote after so many keyframes, all of them with stereo landmarks."""

    keyframes: int
    fixes: int
    fix_ms_median: float
    fix_ms_p95: float
    batch_s: float
    batch_over_fix: float


@dataclass(frozen=True)
class TakenBack:
    """A false fix believed and taken back after so many keyframes of wheels and tilt."""

    keyframes: int
    moved_m: float
    ms: float
    left_mm: float


def fix_cost(keyframes: int, every: int = 20) -> FixCost:
    """Time every fix of a traverse, then batch from scratch on the same measurements."""
    run = simulate(TraverseSpec(keyframes=keyframes, landmarks=60, odometry=True, tilt=True), 1)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start)
    rng, times = np.random.default_rng(0), []
    for keyframe in run.keyframes:
        smoother.add(keyframe)
        if keyframe.index and keyframe.index % every == 0:
            fix = _fix(run, keyframe.index, rng)
            begin = process_time()
            smoother.add_fix(fix)
            times.append(1e3 * (process_time() - begin))
    smoother.finish()
    begin = process_time()
    optimize_batch(
        run.camera, run.rover_T_camera, run.start, run.keyframes,
        initial=smoother.trajectory(), ledger=smoother.ledger,
    )  # fmt: skip
    batch = process_time() - begin
    # With a full window only: what it costs in the long run.
    last = np.array(times[len(times) // 2 :])
    median = float(np.median(last))
    p95 = float(np.percentile(last, 95))
    return FixCost(keyframes, len(times), median, p95, batch, 1e3 * batch / median)


def taken_back(keyframes: int) -> list[TakenBack]:
    """Fixes every 200 keyframes; then false ones of 3 and 10 m at the end and midway."""
    run = simulate(TraverseSpec(keyframes=keyframes, landmarks=0, odometry=True, tilt=True), 1)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start)
    rng = np.random.default_rng(0)
    for keyframe in run.keyframes:
        smoother.add(replace(keyframe, observations=None, relative=None))
        if keyframe.index and keyframe.index % 200 == 0:
            smoother.add_fix(_fix(run, keyframe.index, rng))
    rows = []
    for frame, off in ((keyframes - 1, 3.0), (keyframes // 2 + 5, 10.0)):
        smoother.add_fix(_fix(run, frame, rng, off))
        smoother.reject(frame)
        before = smoother.trajectory().map_T_rover[:, :3, 3]
        smoother.accept(frame)
        between = smoother.trajectory().map_T_rover[:, :3, 3]
        begin = process_time()
        smoother.reject(frame)
        ms = 1e3 * (process_time() - begin)
        after = smoother.trajectory().map_T_rover[:, :3, 3]
        moved, left = _largest(between - before), _largest(after - before)
        rows.append(TakenBack(keyframes, moved, ms, 1e3 * left))
    return rows


def _fix(
    run: SimulatedTraverse, frame: int, rng: np.random.Generator, off_m: float = 0.0
) -> AbsoluteFix:
    x, y, yaw = planar(run.map_T_rover[frame]) + _SIGMAS * rng.normal(size=3)
    covariance = np.diag(_SIGMAS**2)
    return AbsoluteFix(frame, (FixCandidate(x + off_m, y + 0.5 * off_m, yaw, covariance),))


def _largest(gap: FloatArray) -> float:
    return float(np.linalg.norm(gap, axis=1).max())
