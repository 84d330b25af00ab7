"""Process CPU of a whole keyframe by stage, and the accuracy that it buys.

    python benchmarks/keyframe.py ../shared/data/kitti-06-000-050 --seeds 5 --json out.json

Beside lunar-fg runs what anyone would write with OpenCV: cv2.SIFT and cv2.ORB, brute-force
matching, PnP (`pnp_odometry`), OpenCV on one thread. All take each frame in turn, in one
process, so that load and caches are the same for all. The first frames compile or load the
kernels and are not counted. Results of other datasets in the JSON file are kept.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from pnp_odometry import PnpOdometry

from frontends.measurements import StereoFrame
from lunar_fg.config import Config
from lunar_fg.datasets import Dataset, open_dataset
from lunar_fg.evaluation import Accuracy
from lunar_fg.navigator import Navigator
from lunar_fg.stopwatch import Stopwatch
from lunar_fg.truth import compare, truth_of

KEYPOINTS = 1500
Times = dict[str, list[float]]
Results = dict[str, tuple[Accuracy, Times, int]]

METHODS: dict[str, Callable[[Dataset, int], Navigator | PnpOdometry]] = {
    "lunar-fg": lambda dataset, seed: Navigator(
        dataset.camera,
        Config(seed=seed),
        dataset.rover_T_camera,
        dataset.start,
        stopwatch=Stopwatch(time.process_time),
    ),
    "cv2.SIFT + PnP": lambda dataset, _: PnpOdometry(
        dataset.camera, dataset.rover_T_camera, cv2.SIFT_create(KEYPOINTS), cv2.NORM_L2
    ),
    "cv2.ORB + PnP": lambda dataset, _: PnpOdometry(
        dataset.camera, dataset.rover_T_camera, cv2.ORB_create(KEYPOINTS), cv2.NORM_HAMMING
    ),
}


def navigate(dataset: Dataset, seed: int, frames: int | None = None) -> Results:
    """One run of every method: accuracy, CPU milliseconds by stage and frame, frames lost."""
    cv2.setRNGSeed(seed)
    methods = {name: make(dataset, seed) for name, make in METHODS.items()}
    for count, frame in enumerate(dataset.frames()):
        if count == frames:
            break
        for method in methods.values():
            if isinstance(method, Navigator) or isinstance(frame, StereoFrame):
                method.step(frame)
    truth = truth_of(dataset.ground_truth)
    results = {}
    for name, method in methods.items():
        if isinstance(method, Navigator):
            method.finish()
        accuracy = compare(method.trajectory(), truth)
        results[name] = accuracy, method.stopwatch.milliseconds(), method.frames_lost
    return results


def figures(accuracy: Accuracy, lost: int) -> dict[str, float | int | None]:
    return {
        "ate_se3_m": accuracy.ate_rmse_m.se3,
        "ate_sim3_m": accuracy.ate_rmse_m.sim3,
        "scale": accuracy.scale_sim3,
        "drift_percent": accuracy.kitti.translation_percent,
        "rpe_m": accuracy.rpe.translation_m,
        "rpe_deg": accuracy.rpe.rotation_deg,
        "lost": lost,
    }


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--traverse", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    dataset = open_dataset(arguments.dataset, None, arguments.traverse)
    navigate(dataset, 0, frames=20)
    runs = [navigate(dataset, seed) for seed in range(arguments.seeds)]
    print(f"{dataset.name}: {len(dataset)} frames, load {os.getloadavg()[0]:.1f}")
    report = {}
    print("method           seed  ATE SE3  ATE Sim3  scale   drift %    RPE m  RPE deg  lost")
    for name in METHODS:
        rows = [figures(run[name][0], run[name][2]) for run in runs]
        report[name] = {"runs": rows}
        for seed, row in enumerate(rows):
            cells = "  ".join(
                "   -   " if value is None else f"{value:7.4f}"
                for key, value in row.items()
                if key != "lost"
            )
            print(f"{name:16s} {seed:4d}  {cells}  {row['lost']:4d}")
    print("\nprocess CPU a frame, ms          median    mean   x lunar-fg")
    own: dict[str, float] = {}
    for name in METHODS:
        stages = {}
        for stage in runs[0][name][1]:
            samples = np.concatenate([np.nan_to_num(run[name][1][stage]) for run in runs])
            mean = float(samples.mean())
            if name == "lunar-fg":
                own[stage] = mean
            ratio = mean / own[stage] if own.get(stage) else None
            stages[stage] = {"median": float(np.median(samples)), "mean": mean, "ratio": ratio}
            compared = "" if ratio is None else f"{ratio:8.1f}"
            print(f"{name:16s} {stage:15s} {np.median(samples):7.2f} {mean:7.2f} {compared}")
        report[name]["cpu_ms"] = stages
    if arguments.json:
        kept = json.loads(arguments.json.read_text()) if arguments.json.exists() else {}
        kept[dataset.name] = report
        arguments.json.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
