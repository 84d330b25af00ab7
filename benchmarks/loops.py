"""Closed loops: what is recognised under which sun, false closures, drift with and without.

    lunar-fg simulate DATA/c0 --spec CIRCUIT.yaml     (path: {length_m: 104, step_m: 0.8,
        circuit_m: 50, waypoint_offset_m: 2}; others with a later_sun)
    python -m benchmarks.loops DATA/c0 DATA/c30 DATA/c90 DATA/n20 --returns KITTI_06

Recognition: pairs of views, one of each half of a drive, with a predicted motion that is wrong
by 0.3 m and 1 degree on each axis. False closures: views that share nothing, as if the rover
believed to be there. Runs: the cameras are off for a fifth of the drive, which the wheels bridge.
``--returns``: real sequences that lead one way only, made to return: every other frame
forward, then the others backward, so that no image is seen twice. Writes
``docs/benchmarks/loops.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from frontends.geometry import inverse, se3_exp, se3_log
from frontends.measurements import StereoFrame, UnusableFrame
from frontends.relative import MotionPrediction, RelativeConfig
from frontends.revisit import Place, Revisiting
from frontends.stereo import StereoPerception
from lunar_fg.config import Config
from lunar_fg.datasets import open_dataset
from lunar_fg.faults.catalogue import parse_fault
from lunar_fg.faults.dataset import FaultyDataset
from lunar_fg.loop_closing import LoopClosingConfig
from lunar_fg.navigator import Navigator

RESULTS = Path(__file__).parents[1] / "docs" / "benchmarks"
SIGMA = np.array([math.radians(1.0)] * 3 + [0.3] * 3)
DISTANCES_M = (0.0, 0.5, 1.0, 1.5)
MOST_TURN_DEG = 20.0
STRANGERS = 700


@dataclass(frozen=True)
class Pair:
    """Two views: how far apart, whether they were tied, and how wrong that is."""

    distance_m: float
    same_place: bool
    tied: bool
    error_m: float = math.nan
    error_deg: float = math.nan
    nees: float = math.nan


def pairs(folder: Path) -> Iterator[Pair]:
    dataset = open_dataset(folder)
    perception = StereoPerception(dataset.camera)
    views = []
    for k, frame in enumerate(dataset.frames()):
        features = perception.perceive(frame)
        views.append(features.named(np.arange(len(features)) + 100_000 * k))
    true = dataset.ground_truth.map_T_rover
    in_map = true @ dataset.rover_T_camera
    half = len(views) // 2
    places = [Place.of(k, views[k], 300) for k in range(half)]
    revisiting = Revisiting(dataset.camera, RelativeConfig(false_alarms=1e-6))
    rng = np.random.default_rng(0)
    everything = [(i, j) for i in range(half) for j in range(half + 1, len(views))]
    strangers = 0
    for i, j in (everything[k] for k in rng.permutation(len(everything))):
        motion = inverse(true[i]) @ true[j]
        distance = float(np.linalg.norm(motion[:2, 3]))
        turn = abs(math.degrees(math.atan2(motion[1, 0], motion[0, 0])))
        same = distance <= DISTANCES_M[-1] and turn <= MOST_TURN_DEG
        other = distance > 7.0 or turn > 110.0
        if not same and (not other or strangers == STRANGERS):
            continue
        strangers += other
        expected = inverse(in_map[i]) @ in_map[j] if same else np.eye(4)
        off = SIGMA * rng.standard_normal(6)
        prediction = MotionPrediction(expected @ se3_exp(off), np.diag(SIGMA**2))
        found = revisiting.measure(places[i], views[j], prediction)
        if not (same and found.accepted):
            yield Pair(distance, same, found.accepted)
            continue
        error = se3_log(inverse(found.a_T_b) @ expected)
        nees = float(error @ np.linalg.solve(found.covariance, error)) / 6.0
        yield Pair(
            distance, True, True, float(np.linalg.norm(error[3:])),
            math.degrees(float(np.linalg.norm(error[:3]))), nees,
        )  # fmt: skip


def returned(frames: list[StereoFrame | UnusableFrame]) -> tuple[list[Any], list[int]]:
    """Every other frame forward, the others backward; and which frame each was."""
    order = [*range(0, len(frames), 2), *range(len(frames) - 1 - len(frames) % 2, 0, -2)]
    step_s = float(np.median(np.diff([frame.stamp_s for frame in frames]))) * 2.0
    # wheels and attitude would have to be turned round: the images alone
    turned = [
        replace(frames[k], index=n, stamp_s=n * step_s, odometry=None, attitude=None)
        for n, k in enumerate(order)
    ]
    return turned, order


def drive(dataset: Any, frames: list[Any], true: np.ndarray) -> dict[str, Any]:
    """Errors from a common start, with and without closed loops; and the closures' own."""
    result: dict[str, Any] = {}
    for name, use in (("without", False), ("with", True)):
        config = Config(loop_closing=LoopClosingConfig(use=use))
        navigator = Navigator(dataset.camera, config, dataset.rover_T_camera, dataset.start)
        for frame in frames:
            navigator.step(frame)
        navigator.finish()
        found = navigator.trajectory().map_T_rover
        aligned = true[0] @ inverse(found[0]) @ found
        error = np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1)
        stages = navigator.stopwatch.milliseconds()
        result[name] = {
            "final_m": float(error[-1]),
            "rms_m": float(np.sqrt(np.mean(error**2))),
            "closing_ms_median": float(np.nanmedian(stages["loop closing"])) if use else None,
        }
    closures = []
    for entry in navigator.ledger:
        closure = entry.measurement
        off = se3_log(inverse(closure.a_T_b) @ inverse(true[closure.base]) @ true[closure.frame])
        closures.append({
            "base": closure.base, "frame": closure.frame,
            "verdict": entry.ruling.verdict.value, "error_m": float(np.linalg.norm(off[3:])),
        })  # fmt: skip
    length = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())
    return {**result, "length_m": length, "closures": closures}


def faulty_run(folder: Path, scratch: Path) -> dict[str, Any]:
    dataset = open_dataset(folder)
    first, last = round(0.19 * len(dataset)), round(0.38 * len(dataset))
    fault = parse_fault(f"wheels-only@{first}-{last}")
    faulty = FaultyDataset(dataset, [fault], 0, scratch)
    return drive(faulty, list(faulty.frames()), dataset.ground_truth.map_T_rover)


def real_return(folder: Path) -> dict[str, Any]:
    dataset = open_dataset(folder)
    frames, order = returned(list(dataset.frames()))
    return drive(dataset, frames, dataset.ground_truth.map_T_rover[order])


def recognition(name: str, found: list[Pair]) -> str:
    cells = []
    for near, far in pairwise(DISTANCES_M):
        part = [p for p in found if p.same_place and near <= p.distance_m < far]
        cells.append(f"{100 * np.mean([p.tied for p in part]):.0f} % of {len(part)}")
    tied = [p for p in found if p.same_place and p.tied]
    errors = "-"
    if tied:
        cm, nees = [100 * p.error_m for p in tied], [p.nees for p in tied]
        errors = (f"{np.median(cm):.1f} / {np.percentile(cm, 95):.1f} | {np.max(cm):.0f} | "
                  f"{np.mean(nees):.2f}")  # fmt: skip
    else:
        errors = "- | - | -"
    strangers = [p for p in found if not p.same_place]
    false = sum(p.tied for p in strangers)
    return f"| {name} | {' | '.join(cells)} | {errors} | {false} of {len(strangers)} |"


def row(name: str, run: dict[str, Any]) -> str:
    closures = run["closures"]
    believed = [c for c in closures if c["verdict"] == "accepted"]
    worst = f"{100 * max(c['error_m'] for c in believed):.1f}" if believed else "-"
    a, b = run["without"], run["with"]
    return (f"| {name} | {run['length_m']:.0f} | {a['final_m']:.3f} / {a['rms_m']:.3f} | "
            f"{b['final_m']:.3f} / {b['rms_m']:.3f} | {len(believed)} of {len(closures)} | {worst} "
            f"| {b['closing_ms_median']:.2f} |")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("circuits", nargs="+", type=Path)
    parser.add_argument("--returns", nargs="*", default=[], type=Path)
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    found = {folder.name: list(pairs(folder)) for folder in arguments.circuits}
    runs = {folder.name: faulty_run(folder, arguments.out) for folder in arguments.circuits}
    runs |= {f"{folder.name}, real": real_return(folder) for folder in arguments.returns}
    arguments.out.mkdir(parents=True, exist_ok=True)
    ties = {name: [asdict(p) for p in rows if p.tied] for name, rows in found.items()}
    content = {
        "ties": ties,
        "recognition": [recognition(*item) for item in found.items()],
        "runs": runs,
    }
    text = json.dumps(content).replace("NaN", "null").replace("}, {", "},\n {")
    (arguments.out / "loops.json").write_text(text + "\n", encoding="utf-8")
    bands = [f"{a} to {b} m apart" for a, b in pairwise(DISTANCES_M)]
    lines = [
        "# Closed loops: benchmark",
        "",
        "Made by `benchmarks/loops.py`; see its text for the set-up. The number of a circuit is "
        "by how many degrees of azimuth the sun stands elsewhere in the second half; n20 is of "
        "another terrain, sun and image size, and had no part in setting anything.",
        "",
        "Pairs of views within 20 degrees of heading that were tied:",
        "",
        f"| circuit | {' | '.join(bands)} | error, median / 95 %, cm | largest, cm | NEES / 6 "
        "| false, of views that share nothing |",
        f"|---|{'---|' * (len(bands) + 4)}",
        *(recognition(name, rows) for name, rows in found.items()),
        "",
        "## Runs",
        "",
        "Error from a common start, final / root mean square; the circuits with the cameras off "
        "for a fifth of the drive, the real sequences made to return.",
        "",
        "| sequence | length, m | without, m | with closed loops, m | believed | largest error of "
        "one, cm | time a frame, median ms |",
        "|---|---|---|---|---|---|---|",
        *(row(name, run) for name, run in runs.items()),
    ]
    (arguments.out / "loops.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
