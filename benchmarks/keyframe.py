"""Process CPU of a whole keyframe by stage, and the accuracy that it buys.

    python benchmarks/keyframe.py ../shared/data/kitti-06-000-050 --seeds 5 --json out.json

The first pass compiles or loads the kernels and is not counted.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np

from lunar_fg.config import Config
from lunar_fg.datasets import Dataset, open_dataset
from lunar_fg.evaluation import Accuracy
from lunar_fg.navigator import Navigator
from lunar_fg.runs import compare, truth_of
from lunar_fg.stopwatch import Stopwatch


def navigate(dataset: Dataset, seed: int) -> tuple[Accuracy, dict[str, list[float]], int]:
    """One run: accuracy, CPU milliseconds by stage and frame, frames lost."""
    navigator = Navigator(
        dataset.camera,
        Config(seed=seed),
        dataset.rover_T_camera,
        dataset.start,
        stopwatch=Stopwatch(time.process_time),
    )
    for frame in dataset.frames():
        navigator.step(frame)
    navigator.finish()
    accuracy = compare(navigator.trajectory(), truth_of(dataset.ground_truth))
    return accuracy, navigator.stopwatch.milliseconds(), navigator.frames_lost


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--traverse", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.dataset, None, arguments.traverse)
    navigate(dataset, 0)
    runs = [navigate(dataset, seed) for seed in range(arguments.seeds)]
    print(f"{dataset.name}: {len(dataset)} frames, load {os.getloadavg()[0]:.1f}")
    print("seed  ATE SE3  ATE Sim3  scale    drift %  RPE m    RPE deg  lost")
    rows = []
    for seed, (accuracy, _, lost) in enumerate(runs):
        figures = (
            accuracy.ate_rmse_m.se3,
            accuracy.ate_rmse_m.sim3,
            accuracy.scale_sim3,
            accuracy.kitti.translation_percent,
            accuracy.rpe.translation_m,
            accuracy.rpe.rotation_deg,
        )
        rows.append([seed, *figures, lost])
        cells = "  ".join("   -   " if f is None else f"{f:7.4f}" for f in figures)
        print(f"{seed:4d}  {cells}  {lost:3d}")
    print("\nprocess CPU a frame, ms   median    mean")
    stages = {}
    for stage in runs[0][1]:
        samples = np.concatenate([np.nan_to_num(times[stage]) for _, times, _ in runs])
        stages[stage] = {"median": float(np.median(samples)), "mean": float(samples.mean())}
        print(f"{stage:24s} {stages[stage]['median']:7.2f} {stages[stage]['mean']:7.2f}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"runs": rows, "cpu_ms": stages}, indent=1) + "\n")


if __name__ == "__main__":
    main()
