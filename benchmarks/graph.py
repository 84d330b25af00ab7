"""What the graph costs a keyframe, and how well its ways agree; a table and JSON.

Run from the checkout: ``python -m benchmarks.graph [--keyframes 200] [--json OUT]``. CPU time of
the process, so a busy machine disturbs little; set OPENBLAS_NUM_THREADS=1 for steadier figures.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time

import numpy as np

from frontends.camera import StereoCamera
from frontends.geometry import inverse, se3_log
from frontends.measurements import FloatArray, StartPrior
from lunar_fg.datasets.landmarks import read_landmarks
from lunar_fg.graph import (
    GraphConfig,
    IncrementalSmoother,
    Keyframe,
    SmoothedTrajectory,
    optimize_batch,
)
from lunar_fg.simulation.measurements import TraverseSpec, simulate


@dataclass(frozen=True)
class Row:
    """One way on one data set; gaps are against batch."""

    data: str
    way: str
    keyframes: int
    ms_mean: float
    ms_median: float
    ms_p95: float
    ms_max: float
    finish_ms: float
    gap_max_m: float
    gap_max_deg: float
    ate_m: float | None
    nees_last: float | None


@dataclass(frozen=True)
class Data:
    """A run to measure."""

    name: str
    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    keyframes: tuple[Keyframe, ...]
    truth: FloatArray | None


def incremental(data: Data, mode: str) -> tuple[SmoothedTrajectory, list[float], float]:
    config = GraphConfig(landmarks="segments" if mode == "segments" else "full")
    smoother = IncrementalSmoother(data.camera, data.rover_T_camera, data.start, config)
    times = []
    for keyframe in data.keyframes:
        begin = process_time()
        smoother.add(keyframe)
        times.append(1e3 * (process_time() - begin))
    begin = process_time()
    smoother.finish()
    return smoother.trajectory(), times, 1e3 * (process_time() - begin)


def row(
    data: Data,
    way: str,
    result: tuple[SmoothedTrajectory, list[float], float],
    reference: SmoothedTrajectory,
) -> Row:
    trajectory, times, finish = result
    steps = [
        se3_log(inverse(a) @ b)
        for a, b in zip(trajectory.map_T_rover, reference.map_T_rover, strict=True)
    ]
    ate = nees = None
    if data.truth is not None:
        gap = trajectory.map_T_rover[:, :3, 3] - data.truth[:, :3, 3]
        ate = float(np.sqrt((gap**2).sum(axis=1).mean()))
        error = se3_log(inverse(trajectory.map_T_rover[-1]) @ data.truth[-1])
        nees = float(error @ np.linalg.solve(trajectory.covariance[-1], error) / 6.0)
    return Row(
        data.name,
        way,
        len(trajectory),
        float(np.mean(times)),
        float(np.median(times)),
        float(np.percentile(times, 95)),
        max(times),
        finish,
        max(float(np.linalg.norm(step[3:])) for step in steps),
        float(np.rad2deg(max(np.linalg.norm(step[:3]) for step in steps))),
        ate,
        nees,
    )


def measure(data: Data) -> list[Row]:
    results = {mode: incremental(data, mode) for mode in ("segments", "full")}
    begin = process_time()
    batch = optimize_batch(
        data.camera,
        data.rover_T_camera,
        data.start,
        data.keyframes,
        initial=results["segments"][0],
    )
    spent = 1e3 * (process_time() - begin)
    results["batch"] = (batch.trajectory, [spent / len(data.keyframes)], 0.0)
    return [row(data, way, result, batch.trajectory) for way, result in results.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    spec = TraverseSpec(keyframes=arguments.keyframes, odometry=True, tilt=True)
    run = simulate(spec, seed=1)
    simulated = Data(
        "simulated", run.camera, run.rover_T_camera, run.start, run.keyframes, run.map_T_rover
    )
    kitti = read_landmarks("00s")
    real = Data("KITTI-00s", kitti.camera, kitti.rover_T_camera, kitti.start, kitti.keyframes, None)
    rows = [*measure(simulated), *measure(real)]
    print(
        "data       way       frames  ms mean median   p95   max finish  gap m   deg   ATE m  NEES"
    )
    for r in rows:
        accuracy = "" if r.ate_m is None else f"  {r.ate_m:.3f}  {r.nees_last:.2f}"
        print(
            f"{r.data:10} {r.way:9} {r.keyframes:6} {r.ms_mean:8.2f} {r.ms_median:6.2f} "
            f"{r.ms_p95:6.1f} {r.ms_max:6.1f} {r.finish_ms:7.0f} {r.gap_max_m:7.4f} "
            f"{r.gap_max_deg:6.4f}{accuracy}"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(r) for r in rows], indent=1))


if __name__ == "__main__":
    main()
