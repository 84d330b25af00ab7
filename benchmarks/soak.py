"""Runs with everything drawn at random, for a given time: do they end, and is the end sound.

python benchmarks/soak.py --minutes 30 --json soak.json

Every run is a process of its own, forked from one that has everything loaded, and all of it
follows from its seed: the traverse, the settings, what goes wrong. One run in four goes through
images, with up to three faults; the others are landmarks, wheels, attitude and fixes, many of
them false, some taken back by a person, with the log closed and read again on the way.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from fuzz import SPEC, attempt

from frontends.geometry import inverse, is_rigid, se3_log
from frontends.measurements import AbsoluteFix
from lunar_fg import runs
from lunar_fg.config import Config
from lunar_fg.datasets import open_dataset
from lunar_fg.faults import FAULTS, FaultyDataset, parse_fault
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.feed import feed
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.run_folder import RunFolder
from lunar_fg.simulation.cache import cached_dataset
from lunar_fg.simulation.fixes import FixSpec, simulate_fixes
from lunar_fg.simulation.measurements import SimulatedTraverse, TraverseSpec, simulate
from lunar_fg.simulation.spec import checked_spec
from lunar_fg.warmup import warmup

#: A pose that is this many sigmas off, and nothing was said, is a silent wrong result. With
#: true sigmas 6 degrees of freedom are as far off once in 1e9 poses; correlated errors of
#: drawn settings that the graph is not told of are farther, and 8 allows for them.
SILENT_SIGMAS = 8.0
KINDS = ("measurements, segments", "measurements, full", "images")


def traverse_of(rng: np.random.Generator) -> TraverseSpec:
    return TraverseSpec(
        keyframes=int(rng.integers(2, 120)),
        step_m=float(rng.uniform(0.05, 1.5)),
        turn_rad=float(rng.uniform(0.0, 0.2)),
        landmarks=int(rng.integers(15, 120)),
        most_track=int(rng.integers(2, 12)),
        sigma_px=float(rng.uniform(0.1, 2.0)),
        sigma_disparity_px=float(rng.uniform(0.1, 2.0)),
        bad_share=float(rng.choice([0.0, 0.05, 0.2])),
        odometry=bool(rng.random() < 0.7),
        tilt=bool(rng.random() < 0.7),
    )


def fixes_of(rng: np.random.Generator, made: SimulatedTraverse) -> dict[int, AbsoluteFix]:
    spec = FixSpec(
        every=int(rng.integers(3, 30)),
        sigma_xy_m=float(rng.uniform(0.05, 1.0)),
        sigma_yaw_rad=float(rng.uniform(0.003, 0.05)),
        false_share=float(rng.choice([0.0, 0.2, 0.4])),
        clustered=bool(rng.random() < 0.3),
        candidates=int(rng.integers(1, 4)),
    )
    frames = [keyframe.index for keyframe in made.keyframes]
    fixes = simulate_fixes(frames, made.map_T_rover, spec, int(rng.integers(1 << 30))).fixes
    # a fix comes when its ground has been passed
    late = int(rng.integers(0, 12))
    return {min(fix.frame + late, frames[-1]): fix for fix in fixes}


def check(poses: np.ndarray, covariances: np.ndarray, expected: int) -> None:
    assert len(poses) == expected, f"{len(poses)} poses of {expected} keyframes"
    assert np.isfinite(poses).all(), "a pose is not finite"
    assert np.isfinite(covariances).all(), "a covariance is not finite"
    assert all(is_rigid(pose) for pose in poses), "a pose is not rigid"
    least = float(np.linalg.eigvalsh(covariances).min())
    assert least > 0.0, f"a covariance has the eigenvalue {least:.1e}"


def by_measurements(folder: Path, rng: np.random.Generator, mode: str) -> None:
    made = simulate(traverse_of(rng), int(rng.integers(1 << 30)))
    config = GraphConfig(
        landmarks=mode,
        segment_keyframes=int(rng.integers(1, 20)),
        fix_window=int(rng.integers(1, 60)),
        max_landmarks=int(rng.integers(20, 200)),
        min_tracks=int(rng.integers(3, 20)),
        max_track_gap=int(rng.integers(1, 12)),
        landmark_correlation=float(rng.choice([0.0, 0.005, 0.1])),
    )
    waiting = fixes_of(rng, made)
    smoother = IncrementalSmoother(made.camera, made.rover_T_camera, made.start, config)
    header = RunHeader(made.camera, made.rover_T_camera, made.start)
    path = folder / "run.db"
    with TraverseLog.create(path, header) as log:
        for keyframe in made.keyframes:
            log.append(keyframe, smoother.add(keyframe))
            fix = waiting.get(keyframe.index)
            if fix is None:
                continue
            log.append_decisions([smoother.add_fix(fix)])
            if rng.random() < 0.1:
                log.append_decisions([smoother.reject(fix.frame)])
    before = smoother.trajectory()
    check(before.map_T_rover, before.covariance, len(made.keyframes))
    with TraverseLog.open(path) as log:
        keyframes, ledger = log.keyframes(), log.ledger()
    again = IncrementalSmoother(made.camera, made.rover_T_camera, made.start, config)
    list(feed(again, keyframes, ledger))
    apart = np.abs(again.trajectory().map_T_rover - before.map_T_rover).max()
    assert apart < 1e-6, f"the log leads {apart:.1e} away"
    smoother.finish()
    after = smoother.trajectory()
    check(after.map_T_rover, after.covariance, len(made.keyframes))
    off = np.array([
        se3_log(inverse(pose) @ true)
        for pose, true in zip(after.map_T_rover, made.map_T_rover, strict=True)
    ])  # fmt: skip
    squares = np.einsum("ni,ni->n", off, np.linalg.solve(after.covariance, off[..., None])[..., 0])
    worst = float(np.sqrt(squares.max()))
    assert worst < SILENT_SIGMAS or smoother.warnings, f"silently {worst:.1f} sigma off"


def by_images(folder: Path, rng: np.random.Generator, dataset: Path) -> None:
    count = len(open_dataset(dataset))
    faults = []
    for _ in range(int(rng.integers(0, 4))):
        first, last = sorted(rng.integers(0, count, 2))
        faults.append(parse_fault(f"{rng.choice(list(FAULTS))}@{first}-{last}"))
    config = Config.model_validate(
        {
            "seed": int(rng.integers(1000)),
            "map": {"use": bool(rng.random() < 0.5)},
            "graph": {"landmarks": str(rng.choice(["segments", "full"]))},
            "loop_closing": {"use": bool(rng.random() < 0.5)},
            "disparity_check": {"mode": str(rng.choice(["apply", "report", "off"]))},
        }
    )
    source = FaultyDataset(open_dataset(dataset), faults, int(rng.integers(1000)), folder)
    run_folder = RunFolder.create(folder / "run", config)
    metrics = runs.run(source, run_folder, config)
    trajectory = run_folder.read_trajectory()
    assert trajectory.covariance is not None
    check(trajectory.map_T_rover, trajectory.covariance, metrics.frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    warmup()
    dataset = cached_dataset(checked_spec(SPEC, "soak"))
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    findings, reasons, seed = [], Counter[str](), arguments.seed
    begin = time.monotonic()
    while time.monotonic() - begin < 60.0 * arguments.minutes:
        rng = np.random.default_rng(seed)
        kind = KINDS[int(rng.choice(3, p=[0.5, 0.25, 0.25]))]

        def one(folder: Path, kind: str = kind, rng: np.random.Generator = rng) -> None:
            if kind == "images":
                by_images(folder, rng, dataset)
            else:
                by_measurements(folder, rng, kind.split(", ")[1])

        with tempfile.TemporaryDirectory() as scratch:
            outcome, text = attempt(one, Path(scratch))
        counts[kind][outcome] += 1
        if outcome == "named":
            reasons[text.splitlines()[0][:120]] += 1
        elif outcome != "ran":
            findings.append(f"{kind}, seed {seed}: {outcome}: {text[:300]}")
            print(findings[-1], flush=True)
        seed += 1
    result = {
        "seconds": time.monotonic() - begin,
        "seeds": [arguments.seed, seed],
        "kinds": {kind: dict(count) for kind, count in counts.items()},
        "named": dict(reasons.most_common(20)),
        "findings": findings,
    }
    print(json.dumps(result, indent=1))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
