"""False fixes: what each way of protection makes of them; the study that `graph` prints.

Traverses at the level of motions (2 m a keyframe, tilt measured), good stereo or wheels only, a
fix of 1 m and 0.02 rad every 10, 100 or 500 m, false ones up to 50 m off. "oracle" is the
product given the true fixes alone. The other ways are GTSAM's ISAM2 over the fix keyframes,
with the same motions between them, as a user of GTSAM would write it: a robust kernel on each
fix, or a chi-square gate when it comes. A run has failed when its error is above three times
the oracle's. "oracle gate" is a chi-square gate that knows all true fixes: what it takes for
true, no gate can tell from true.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise, product
from time import process_time

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from frontends.measurements import AbsoluteFix, Verdict
from lunar_fg.graph import IncrementalSmoother
from lunar_fg.graph.network import Claim, Network
from lunar_fg.graph.planar import Planar, planar, planar_of, turned, wrapped
from lunar_fg.simulation.fixes import FixSpec, SimulatedFixes, simulate_fixes
from lunar_fg.simulation.measurements import (
    INDEPENDENT,
    SimulatedTraverse,
    TraverseSpec,
    simulate,
)

BoolArray = NDArray[np.bool_]

_STEP_M = 2.0
#: Keyframes of a run, by the metres between fixes.
_KEYFRAMES = {10: 201, 100: 1001, 500: 5001}
_LONG_M = 500
_GATE = float(chi2.ppf(0.999, 3))
_KERNEL = gtsam.noiseModel.mEstimator
KERNELS: dict[str, Callable[[], object] | None] = {
    "none": None,
    "Huber": lambda: _KERNEL.Huber.Create(1.345),
    "Cauchy": lambda: _KERNEL.Cauchy.Create(1.0),
    "Geman-McClure": lambda: _KERNEL.GemanMcClure.Create(1.0),
    "DCS": lambda: _KERNEL.DCS.Create(1.0),
    "gate alone": None,
}
FAILED = 3.0
#: Share of false fixes, and whether they agree.
CASES = ((0.2, False), (0.4, False), (0.6, False), (0.4, True))


@dataclass(frozen=True)
class FalseFixes:
    """One way in one setting, over all its runs."""

    sensor: str
    every_m: int
    false_share: float
    clustered: bool
    way: str
    runs: int
    failed: int
    ate_median_m: float
    false_accepted: float
    good_missed: float
    #: Wrong verdicts when they were given, at the end, and those of them that the oracle gate
    #: has right.
    wrong_at_first: int
    wrong_at_end: int
    wrong_for_gate: int
    ms_a_fix: float


@dataclass(frozen=True)
class _Result:
    ate_m: float
    #: When they came, and at the end.
    at_first: BoolArray
    accepted: BoolArray
    ms_a_fix: float


@dataclass(frozen=True)
class _Outcome:
    """One way in one run, beside the oracle and the oracle gate there."""

    result: _Result
    oracle: _Result
    gate: _Result
    true: BoolArray


def traverse(sensor: str, every_m: int, seed: int) -> SimulatedTraverse:
    """A traverse of motions only."""
    wheels = sensor == "wheels"
    spec = TraverseSpec(
        keyframes=_KEYFRAMES[every_m],
        step_m=_STEP_M,
        landmarks=0,
        odometry=wheels,
        odometry_sigmas=(4e-3, 4e-3, 3e-3, 0.04, 0.04, 0.04),
        relative_sigma_rot_rad=1e-3,
        relative_sigma_trans_m=0.01,
        tilt=True,
    )
    run = simulate(spec, seed)
    if not wheels:
        return run
    blind = (replace(k, observations=None, relative=None) for k in run.keyframes)
    return replace(run, keyframes=tuple(blind))


def product_way(
    run: SimulatedTraverse, fixes: SimulatedFixes, *, oracle: bool = False
) -> tuple[_Result, IncrementalSmoother]:
    """The smoother, given all fixes or only the true ones."""
    smoother = IncrementalSmoother(run.camera, run.rover_T_camera, run.start, INDEPENDENT)
    waiting = {f.frame: f for f, true in zip(fixes.fixes, fixes.true, strict=True)
               if true or not oracle}  # fmt: skip
    seconds = 0.0
    for keyframe in run.keyframes:
        smoother.add(keyframe)
        if keyframe.index in waiting:
            begin = process_time()
            smoother.add_fix(waiting[keyframe.index])
            seconds += process_time() - begin
    smoother.finish()
    poses = smoother.trajectory().map_T_rover
    frames = [f.frame for f in fixes.fixes]
    history = {e.frame: [r.verdict is Verdict.ACCEPTED for r in e.history]
               for e in smoother.ledger}  # fmt: skip
    verdicts = [history.get(frame, [False]) for frame in frames]
    at_first, accepted = (np.array([v[i] for v in verdicts], dtype=bool) for i in (0, -1))
    error = poses[frames, :2, 3] - run.map_T_rover[frames, :2, 3]
    ate = float(np.sqrt((error**2).sum(axis=1).mean()))
    return _Result(ate, at_first, accepted, 1e3 * seconds / max(len(waiting), 1)), smoother


def oracle_gate(run: SimulatedTraverse, fixes: SimulatedFixes, motions: list[Planar]) -> _Result:
    """A gate on each fix against the path and all true fixes."""
    start = planar_of(run.start.map_T_rover, run.start.covariance())
    network = Network(start, motions, [Claim(i, _seen(f)) for i, f in enumerate(fixes.fixes, 1)])
    weight = fixes.true.astype(float)
    path = network.solve(weight, network.dead_reckoned)
    believed = np.where(fixes.true, np.arange(len(fixes.fixes)), -1)
    covariance = network.path_covariance(weight, path.xyyaw)
    accepted = network.distances(path.xyyaw, covariance, believed) <= _GATE
    path = network.solve(accepted.astype(float), path.xyyaw)
    truth = np.array([planar(run.map_T_rover[f.frame]) for f in fixes.fixes])
    error = path.xyyaw[1:, :2] - truth[:, :2]
    return _Result(float(np.sqrt((error**2).sum(axis=1).mean())), accepted, accepted, 0.0)


def _seen(fix: AbsoluteFix) -> Planar:
    place = fix.candidates[0]
    return Planar(np.array([place.x_m, place.y_m, place.yaw_rad]), np.asarray(place.covariance))


def plain_way(
    name: str, run: SimulatedTraverse, fixes: SimulatedFixes, motions: list[Planar]
) -> _Result:
    """ISAM2 over the fix keyframes, with a kernel or a gate."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    isam, kernel = gtsam.ISAM2(params), KERNELS[name]
    begin = process_time()
    start = planar_of(run.start.map_T_rover, run.start.covariance())
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start.xyyaw), _noise(start)))
    values.insert(0, gtsam.Pose2(*start.xyyaw))
    isam.update(graph, values)
    accepted = np.ones(len(motions), dtype=bool)
    measured = []
    for i, (motion, fix) in enumerate(zip(motions, fixes.fixes, strict=True), start=1):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        step = gtsam.Pose2(*motion.xyyaw)
        graph.add(gtsam.BetweenFactorPose2(i - 1, i, step, _noise(motion)))
        values.insert(i, isam.calculateEstimatePose2(i - 1) * step)
        seen = _seen(fix)
        measured.append(seen)
        noise = _noise(seen)
        if kernel is not None:
            noise = gtsam.noiseModel.Robust.Create(kernel(), noise)
        factor = gtsam.PriorFactorPose2(i, gtsam.Pose2(*seen.xyyaw), noise)
        isam.update(graph, values)
        if name == "gate alone":
            accepted[i - 1] = _squared(isam, i, seen, marginal=True) <= _GATE
        if accepted[i - 1]:
            graph = gtsam.NonlinearFactorGraph()
            graph.add(factor)
            isam.update(graph, gtsam.Values())
        for _ in range(2):
            isam.update()
    ms = 1e3 * (process_time() - begin) / len(motions)
    for _ in range(10):
        isam.update()
    if kernel is not None:
        accepted = np.array([_squared(isam, i, seen, marginal=False) <= _GATE
                             for i, seen in enumerate(measured, start=1)])  # fmt: skip
    truth = np.array([planar(run.map_T_rover[f.frame]) for f in fixes.fixes])
    poses = [isam.calculateEstimatePose2(i) for i in range(1, len(motions) + 1)]
    error = np.array([[p.x(), p.y()] for p in poses]) - truth[:, :2]
    return _Result(float(np.sqrt((error**2).sum(axis=1).mean())), accepted, accepted, ms)


def _noise(place: Planar) -> gtsam.noiseModel.Gaussian:
    covariance = turned(place.covariance, place.xyyaw[2])
    return gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T))


def _squared(isam: gtsam.ISAM2, key: int, seen: Planar, *, marginal: bool) -> float:
    pose = isam.calculateEstimatePose2(key)
    off = seen.xyyaw - [pose.x(), pose.y(), pose.theta()]
    off[2] = wrapped(off[2])
    covariance = seen.covariance
    if marginal:
        covariance = covariance + turned(isam.marginalCovariance(key), -pose.theta())
    return float(off @ np.linalg.solve(covariance, off))


def study(
    runs: int,
    spacings: tuple[int, ...] = (10, 100, 500),
    cases: tuple[tuple[float, bool], ...] = CASES,
) -> list[FalseFixes]:
    """All settings, `runs` seeds each; half as many on the longest traverses."""
    rows = []
    for sensor, every_m, (share, clustered) in product(("stereo", "wheels"), spacings, cases):
        found: dict[str, list[_Outcome]] = {}
        for seed in range(runs if every_m < _LONG_M else -(-runs // 2)):
            run = traverse(sensor, every_m, seed)
            spec = FixSpec(every=int(every_m / _STEP_M), false_share=share, clustered=clustered)
            fixes = simulate_fixes(range(len(run.keyframes)), run.map_T_rover, spec, seed + 1000)
            oracle, smoother = product_way(run, fixes, oracle=True)
            frames = [0, *(f.frame for f in fixes.fixes)]
            motions = [smoother.motion(a, b) for a, b in pairwise(frames)]
            results = {name: plain_way(name, run, fixes, motions) for name in KERNELS}
            results["product"] = product_way(run, fixes)[0]
            results["oracle"] = oracle
            results["oracle gate"] = gate = oracle_gate(run, fixes, motions)
            for name, result in results.items():
                found.setdefault(name, []).append(_Outcome(result, oracle, gate, fixes.true))
        for name, outcomes in found.items():
            rows.append(_row(sensor, every_m, share, clustered, name, outcomes))
            print(row_text(rows[-1]), flush=True)
    return rows


def _row(
    sensor: str,
    every_m: int,
    share: float,
    clustered: bool,
    way: str,
    outcomes: list[_Outcome],
) -> FalseFixes:
    true = np.concatenate([o.true for o in outcomes])
    accepted = np.concatenate([o.result.accepted for o in outcomes])
    at_first = np.concatenate([o.result.at_first for o in outcomes])
    gate = np.concatenate([o.gate.accepted for o in outcomes])
    wrong = accepted != true
    return FalseFixes(
        sensor, every_m, share, clustered, way, len(outcomes),
        sum(o.result.ate_m > FAILED * o.oracle.ate_m for o in outcomes),
        float(np.median([o.result.ate_m for o in outcomes])),
        float(accepted[~true].mean()) if (~true).any() else 0.0,
        float((~accepted[true]).mean()) if true.any() else 0.0,
        int((at_first != true).sum()),
        int(wrong.sum()),
        int((wrong & (gate == true)).sum()),
        float(np.mean([o.result.ms_a_fix for o in outcomes])),
    )  # fmt: skip


def row_text(r: FalseFixes) -> str:
    """One line of the table."""
    kind = "clustered" if r.clustered else "random"
    return (
        f"{r.sensor:7} {r.every_m:4} m  {r.false_share:3.0%} {kind:9}  {r.way:14} "
        f"failed {r.failed:2}/{r.runs}  ATE {r.ate_median_m:7.3f} m  "
        f"false in {r.false_accepted:5.1%}  good out {r.good_missed:5.1%}  "
        f"wrong {r.wrong_at_first:3} -> {r.wrong_at_end:3} ({r.wrong_for_gate:3})  "
        f"{r.ms_a_fix:6.1f} ms"
    )


if __name__ == "__main__":
    study(5)
