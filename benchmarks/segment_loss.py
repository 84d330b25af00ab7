"""What segments lose against batch: by where tracks are cut, and over seeds; part of `graph`."""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time

import numpy as np

from frontends.geometry import inverse, se3_log
from frontends.measurements import FloatArray
from lunar_fg.datasets.landmarks import read_landmarks
from lunar_fg.graph import GraphConfig, IncrementalSmoother, SmoothedTrajectory, optimize_batch
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate

_LENGTHS = (5, 10, 20, 40, 76)
_NO_LIMIT = 1_000_000
_KEYFRAMES = 161


@dataclass(frozen=True)
class SegmentLength:
    """KITTI-00s in segments of so many motions: the largest gap of any pose from batch."""

    segment_keyframes: int
    max_landmarks: int
    seconds: float
    gap_max_m: float
    gap_max_deg: float
    sigma_m: float


@dataclass(frozen=True)
class OverSeeds:
    """Error of one way over simulated traverses, root mean square, m."""

    way: str
    runs: int
    keyframes: int
    ate_rms_m: float
    over_batch: float


def segment_lengths() -> list[SegmentLength]:
    """KITTI-00s' real landmarks; `sigma_m` is what is claimed of the last position."""
    kitti = read_landmarks("00s")
    given = (kitti.camera, kitti.rover_T_camera, kitti.start)
    batch = optimize_batch(*given, kitti.keyframes).trajectory
    rows = []
    for most in (GraphConfig().max_landmarks, _NO_LIMIT):
        for length in _LENGTHS:
            begin = process_time()
            config = GraphConfig(segment_keyframes=length, max_landmarks=most)
            smoother = IncrementalSmoother(*given, config)
            for keyframe in kitti.keyframes:
                smoother.add(keyframe)
            smoother.finish()
            seconds, trajectory = process_time() - begin, smoother.trajectory()
            sigma = float(np.sqrt(np.trace(trajectory.covariance[-1, 3:, 3:])))
            gap = largest_gap(trajectory, batch)
            rows.append(SegmentLength(length, most, seconds, *gap, sigma))
    return rows


def over_seeds(runs: int = 10) -> list[OverSeeds]:
    """Segments of 10 and of 20 motions, and batch, on the same simulated measurements."""
    errors: dict[str, list[float]] = {}
    for seed in range(runs):
        run = simulate(TraverseSpec(keyframes=_KEYFRAMES, odometry=True, tilt=True), seed)
        given = (run.camera, run.rover_T_camera, run.start)
        first: SmoothedTrajectory | None = None
        for length in (10, 20):
            config = INDEPENDENT.model_copy(update={"segment_keyframes": length})
            smoother = IncrementalSmoother(*given, config)
            for keyframe in run.keyframes:
                smoother.add(keyframe)
            smoother.finish()
            first = smoother.trajectory()
            error = _ate(first.map_T_rover, run.map_T_rover)
            errors.setdefault(f"segments of {length}", []).append(error)
        batch = optimize_batch(*given, run.keyframes, INDEPENDENT, first).trajectory
        errors.setdefault("batch", []).append(_ate(batch.map_T_rover, run.map_T_rover))
    rms = {way: float(np.sqrt(np.square(found).mean())) for way, found in errors.items()}
    return [OverSeeds(way, runs, _KEYFRAMES, ate, ate / rms["batch"]) for way, ate in rms.items()]


def largest_gap(one: SmoothedTrajectory, other: SmoothedTrajectory) -> tuple[float, float]:
    """Of any pose, m and degrees."""
    steps = [
        se3_log(inverse(a) @ b) for a, b in zip(one.map_T_rover, other.map_T_rover, strict=True)
    ]
    return (
        max(float(np.linalg.norm(step[3:])) for step in steps),
        float(np.rad2deg(max(np.linalg.norm(step[:3]) for step in steps))),
    )


def _ate(poses: FloatArray, truth: FloatArray) -> float:
    gap = poses[:, :3, 3] - truth[:, :3, 3]
    return float(np.sqrt((gap**2).sum(axis=1).mean()))
