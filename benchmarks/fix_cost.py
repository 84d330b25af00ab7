"""What a fix costs against batch, and what is left when a false one is taken back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from frontends.measurements import AbsoluteFix, FixCandidate, FloatArray
from lunar_fg.graph import IncrementalSmoother, optimize_batch
from lunar_fg.graph.descent import descend
from lunar_fg.graph.planar import planar
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate

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
    """A false fix believed and taken back after so many keyframes of wheels and tilt.

    `later` says how many keyframes, with their fixes, came between; `snapshot` whether the copy
    from before it was still kept. `left_mm` is against the positions before (or, where keyframes
    came between, between those that end up with and without a copy), `off_mm` against the optimum
    of the same factors, which `off_before_mm` says of the positions before.
    """

    keyframes: int
    at: int
    later: int
    snapshot: bool
    moved_m: float
    ms_median: float
    ms_max: float
    graph_ms_median: float
    left_mm: float
    off_before_mm: float | None
    off_mm: float


def fix_cost(keyframes: int, every: int = 20) -> FixCost:
    """Time every fix of a traverse, then batch from scratch on the same measurements."""
    run = simulate(TraverseSpec(keyframes=keyframes, landmarks=60, odometry=True, tilt=True), 1)
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, INDEPENDENT)
    rng, times = np.random.default_rng(0), []
    for keyframe in run.keyframes:
        smoother.add(keyframe)
        if keyframe.index and keyframe.index % every == 0:
            fix = fix_at(run.map_T_rover[keyframe.index], keyframe.index, rng)
            begin = process_time()
            smoother.add_fix(fix)
            times.append(1e3 * (process_time() - begin))
    smoother.finish()
    begin = process_time()
    optimize_batch(
        run.camera, run.rover_T_camera, run.start, run.keyframes, INDEPENDENT,
        initial=smoother.trajectory(), ledger=smoother.ledger,
    )  # fmt: skip
    batch = process_time() - begin
    # With a full window only: what it costs in the long run.
    last = np.array(times[len(times) // 2 :])
    median = float(np.median(last))
    p95 = float(np.percentile(last, 95))
    return FixCost(keyframes, len(times), median, p95, batch, 1e3 * batch / median)


def taken_back(keyframes: int, repeats: int = 3) -> list[TakenBack]:
    """Fixes every 200 keyframes; then false ones of 3 and 10 m at the end and midway.

    Believed on a person's word, and rejected: at once, and, the one at the end, after 250 more
    keyframes and another fix; with the copy from before it, and without one.
    """
    later = 250
    spec = TraverseSpec(keyframes=keyframes + later, landmarks=0, odometry=True, tilt=True)
    run = simulate(spec, 1)

    def fix(frame: int, off: float = 0.0) -> AbsoluteFix:
        return fix_at(run.map_T_rover[frame], frame, np.random.default_rng(frame), off)

    def drive(smoother: IncrementalSmoother, first: int, last: int) -> None:
        for keyframe in run.keyframes[first:last]:
            smoother.add(replace(keyframe, observations=None, relative=None))
            if keyframe.index and keyframe.index % 200 == 0:
                smoother.add_fix(fix(keyframe.index))

    def driven() -> IncrementalSmoother:
        smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, INDEPENDENT)
        drive(smoother, 0, keyframes)
        return smoother

    rows = []
    end, middle = keyframes - 1, keyframes // 2 + 5
    for frame, off in ((end, 3.0), (middle, 10.0)):
        smoother = driven()
        smoother.add_fix(fix(frame, off))
        for snapshot in (True, False):
            smoother.reject(frame)
            before, off_before = _positions(smoother), _off_optimum(smoother)
            times = []
            for _ in range(repeats):
                smoother.accept(frame)
                between = _positions(smoother)
                times.append(_rejected(smoother, frame, snapshot=snapshot))
            left = _largest(_positions(smoother) - before)
            off_m = (left, off_before, _off_optimum(smoother))
            rows.append(_row(keyframes, frame, 0, snapshot, between - before, times, off_m))
    ends = []
    for snapshot in (True, False):
        times = []
        for _ in range(repeats):
            smoother = driven()
            smoother.add_fix(fix(end, 3.0))
            smoother.accept(end)
            between = _positions(smoother)
            drive(smoother, keyframes, keyframes + later)
            times.append(_rejected(smoother, end, snapshot=snapshot))
        ends.append((_positions(smoother), times, _off_optimum(smoother)))
    left = _largest(ends[1][0] - ends[0][0])
    for snapshot, (after, times, off) in zip((True, False), ends, strict=True):
        moved = between - after[:keyframes]
        rows.append(_row(keyframes, end, later, snapshot, moved, times, (left, None, off)))
    return rows


def _rejected(smoother: IncrementalSmoother, frame: int, *, snapshot: bool) -> tuple[float, float]:
    """Reject a fix: milliseconds of all of it, and of the graph alone."""
    graph = smoother._graph._isam  # type: ignore[attr-defined]
    if not snapshot:
        graph._snapshots.clear()
    spent = []
    exchange = graph.exchange

    def timed(*arguments: object) -> None:
        begin = process_time()
        exchange(*arguments)
        spent.append(1e3 * (process_time() - begin))

    graph.exchange = timed
    begin = process_time()
    smoother.reject(frame)
    whole = 1e3 * (process_time() - begin)
    del graph.exchange
    return whole, sum(spent)


def _row(
    keyframes: int,
    at: int,
    later: int,
    snapshot: bool,
    moved: FloatArray,
    times: list[tuple[float, float]],
    off_m: tuple[float, float | None, float],
) -> TakenBack:
    whole, graph = np.array(times).T
    return TakenBack(
        keyframes, at, later, snapshot, _largest(moved), float(np.median(whole)),
        float(whole.max()), float(np.median(graph)),
        *(None if off is None else 1e3 * off for off in off_m),
    )  # fmt: skip


def _off_optimum(smoother: IncrementalSmoother) -> float:
    """Largest distance (m) of a pose of the graph from where it belongs by all its factors."""
    graph = smoother._graph._isam  # type: ignore[attr-defined]
    here = graph._isam.calculateEstimate()
    there = descend(graph._books.factors, here, 100).values
    gap = [here.atPose3(k).translation() - there.atPose3(k).translation() for k in there.keys()]  # noqa: SIM118
    return _largest(np.array(gap))


def _positions(smoother: IncrementalSmoother) -> FloatArray:
    return smoother.trajectory().map_T_rover[:, :3, 3]


def fix_at(
    map_T_rover: FloatArray, frame: int, rng: np.random.Generator, off_m: float = 0.0
) -> AbsoluteFix:
    """A fix of 1 m and 0.02 rad on a true pose, or off by as much as is said."""
    x, y, yaw = planar(map_T_rover) + _SIGMAS * rng.normal(size=3)
    covariance = np.diag(_SIGMAS**2)
    return AbsoluteFix(frame, (FixCandidate(x + off_m, y + 0.5 * off_m, yaw, covariance),))


def _largest(gap: FloatArray) -> float:
    return float(np.linalg.norm(gap, axis=1).max())
