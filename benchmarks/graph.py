"""What the graph costs a keyframe, and how well its ways agree; tables and JSON.

Run from the checkout: ``python -m benchmarks.graph [PART ...]``; the JSON and the page beside it
keep the parts that are not run. CPU time of the process, so a busy machine disturbs little. All
ways take each keyframe in turn, so that what disturbs one disturbs all. "plain iSAM2" is what
most tutorials do: every landmark in GTSAM's ISAM2 with its default parameters and its own
ordering, from the same gated tracks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time

import gtsam
import numpy as np

from benchmarks.false_fixes import study
from benchmarks.fix_cost import fix_at, fix_cost, taken_back
from benchmarks.graph_page import page
from benchmarks.segment_loss import largest_gap, over_seeds, segment_lengths
from benchmarks.traverses import kitti_fixes, spirit
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
from lunar_fg.graph.factors import pose_key
from lunar_fg.graph.landmarks import WholeGraph, map_point
from lunar_fg.graph.setup import Setup
from lunar_fg.simulation.measurements import INDEPENDENT, TraverseSpec, simulate

_WARM = 60
_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

Feed = Callable[[Keyframe], object]


@dataclass(frozen=True)
class Data:
    """A run to measure."""

    name: str
    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    keyframes: tuple[Keyframe, ...]
    truth: FloatArray | None
    config: GraphConfig


@dataclass(frozen=True)
class Cost:
    """Cost a keyframe over the last keyframes before `keyframes`, and of all so far."""

    way: str
    keyframes: int
    ms_median: float
    ms_mean: float
    ms_p95: float
    ms_max: float
    total_s: float


@dataclass(frozen=True)
class Agreement:
    """One way on one data set; gaps are against batch, and against all landmarks in iSAM2."""

    data: str
    way: str
    keyframes: int
    seconds: float
    gap_max_m: float
    gap_max_deg: float
    gap_full_max_m: float
    gap_full_max_deg: float
    ate_m: float | None
    nees_last: float | None


class PlainIsam:
    """Every landmark in ISAM2, default parameters."""

    def __init__(self, data: Data) -> None:
        self._data = data
        self._whole = WholeGraph(Setup(data.camera, data.rover_T_camera, data.start, data.config))
        self._isam = gtsam.ISAM2(gtsam.ISAM2Params())
        self._count = 0

    def add(self, keyframe: Keyframe) -> None:
        """Enter a keyframe and ask for its pose and covariance."""
        new = self._whole.add(keyframe)
        here, values = self._count, gtsam.Values()
        pose = self._data.start.map_T_rover
        if new.previous_T_rover is not None:
            pose = self._pose(here - 1) @ new.previous_T_rover
        values.insert(pose_key(here), gtsam.Pose3(pose))
        for key, ordinal, point in new.landmarks:
            seen_from = pose if ordinal == here else self._pose(ordinal)
            values.insert(key, map_point(seen_from, self._data.rover_T_camera, point))
        self._isam.update(new.factors, values)
        self._pose(here)
        self._isam.marginalCovariance(pose_key(here))
        self._count += 1

    def _pose(self, ordinal: int) -> FloatArray:
        return np.asarray(self._isam.calculateEstimatePose3(pose_key(ordinal)).matrix())


def smoother(data: Data, mode: str) -> IncrementalSmoother:
    config = data.config.model_copy(update={"landmarks": mode})
    return IncrementalSmoother(data.camera, data.rover_T_camera, data.start, config)


def cost_against_length(data: Data, marks: Sequence[int], most: dict[str, int]) -> list[Cost]:
    """Feed all ways keyframe by keyframe, each up to its own limit."""
    # What is loaded or compiled once a process belongs to no way.
    warm = fixed_feed(data)
    for keyframe in data.keyframes[:_WARM]:
        warm(keyframe)
    feeds: dict[str, Feed] = {
        "segments": smoother(data, "segments").add,
        "segments, a fix every 50": fixed_feed(data),
        "full": smoother(data, "full").add,
        "plain iSAM2": PlainIsam(data).add,
    }
    times: dict[str, list[float]] = {way: [] for way in feeds}
    rows = []
    for count, keyframe in enumerate(data.keyframes, start=1):
        for way in list(feeds):
            begin = process_time()
            try:
                feeds[way](keyframe)
            except RuntimeError as error:
                print(f"{way} ended at keyframe {count}: {str(error).strip().splitlines()[0]}")
                del feeds[way]
                continue
            times[way].append(1e3 * (process_time() - begin))
            if count in marks:
                rows.append(cost(way, times[way]))
            if count >= most[way]:
                del feeds[way]
        if not feeds:
            break
    return rows


def fixed_feed(data: Data) -> Feed:
    """Segments with a true fix of 1 m at every 50th keyframe, its vote included."""
    graph, rng = smoother(data, "segments"), np.random.default_rng(0)
    assert data.truth is not None
    truth = data.truth

    def feed(keyframe: Keyframe) -> None:
        graph.add(keyframe)
        if keyframe.index and keyframe.index % 50 == 0:
            graph.add_fix(fix_at(truth[keyframe.index], keyframe.index, rng))

    return feed


def cost(way: str, times: list[float]) -> Cost:
    """Of the last tenth, at least 50: what a keyframe costs at this length."""
    last = np.array(times[-max(50, len(times) // 10) :])
    return Cost(
        way,
        len(times),
        float(np.median(last)),
        float(last.mean()),
        float(np.percentile(last, 95)),
        float(last.max()),
        1e-3 * float(np.sum(times)),
    )


def agreement(data: Data) -> list[Agreement]:
    results: dict[str, tuple[SmoothedTrajectory, float]] = {}
    for mode in ("segments", "full"):
        begin, graph = process_time(), smoother(data, mode)
        for keyframe in data.keyframes:
            graph.add(keyframe)
        graph.finish()
        results[mode] = graph.trajectory(), process_time() - begin
    begin, first = process_time(), results["segments"][0]
    batch = optimize_batch(
        data.camera, data.rover_T_camera, data.start, data.keyframes, data.config, first
    ).trajectory
    results["batch"] = batch, process_time() - begin
    full = results["full"][0]
    return [compared(data, way, *result, batch, full) for way, result in results.items()]


def compared(
    data: Data,
    way: str,
    trajectory: SmoothedTrajectory,
    seconds: float,
    batch: SmoothedTrajectory,
    full: SmoothedTrajectory,
) -> Agreement:
    ate = nees = None
    if data.truth is not None:
        gap = trajectory.map_T_rover[:, :3, 3] - data.truth[:, :3, 3]
        ate = float(np.sqrt((gap**2).sum(axis=1).mean()))
        error = se3_log(inverse(trajectory.map_T_rover[-1]) @ data.truth[-1])
        nees = float(error @ np.linalg.solve(trajectory.covariance[-1], error) / 6.0)
    return Agreement(
        data.name,
        way,
        len(trajectory),
        seconds,
        *largest_gap(trajectory, batch),
        *largest_gap(trajectory, full),
        ate,
        nees,
    )


def simulated(keyframes: int) -> Data:
    """A traverse with wheels and inclinometer, about 100 observations a keyframe."""
    run = simulate(TraverseSpec(keyframes=keyframes, odometry=True, tilt=True), seed=1)
    return Data(
        "simulated", run.camera, run.rover_T_camera, run.start, run.keyframes, run.map_T_rover,
        INDEPENDENT,
    )  # fmt: skip


def costs(arguments: argparse.Namespace) -> list[Cost]:
    """Cost of a keyframe against the length of the run."""
    most = {
        "segments": arguments.most,
        "segments, a fix every 50": arguments.most_fixed,
        "full": arguments.most_full,
        "plain iSAM2": arguments.most_plain,
    }
    marks = [n for n in (100, 300, 600, 1_000, 1_100, 3_000, 10_000, 50_000) if n <= arguments.most]
    return cost_against_length(simulated(arguments.most), marks, most)


def agreements() -> list[Agreement]:
    """Segments, full and batch on simulated and on real landmarks."""
    kitti = read_landmarks("00s")
    real = Data(
        "KITTI-00s", kitti.camera, kitti.rover_T_camera, kitti.start, kitti.keyframes, None,
        GraphConfig(),
    )  # fmt: skip
    return [*agreement(simulated(200)), *agreement(real)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help="some of the page's; all where none is named")
    parser.add_argument("--most", type=int, default=10_000, help="keyframes for segments")
    parser.add_argument("--most-fixed", type=int, default=10_000, help="the same with fixes")
    parser.add_argument("--most-full", type=int, default=600, help="keyframes for full landmarks")
    parser.add_argument("--most-plain", type=int, default=300, help="keyframes for plain iSAM2")
    parser.add_argument("--runs", type=int, default=10, help="seeds of each false-fix setting")
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of the real data")
    parser.add_argument("--json", type=Path, default=Path("docs/benchmarks/graph.json"))
    arguments = parser.parse_args()
    most, data = arguments.most, arguments.data
    telemetry = data / "spirit-traverse" / "MERA-MER2-Spirit_traverse_path.csv"
    measure: dict[str, Callable[[], Sequence[object]]] = {
        "cost": lambda: costs(arguments),
        "agreement": agreements,
        "segment length": segment_lengths,
        "over seeds": over_seeds,
        "fix cost": lambda: [fix_cost(n) for n in (1_000, 3_000) if n <= most],
        "taken back": lambda: [r for n in (1_000, 10_000) if n <= most for r in taken_back(n)],
        "false fixes": lambda: study(arguments.runs),
        "KITTI-00": lambda: kitti_fixes(data / "kitti-gt-poses" / "gt" / "00.txt"),
        "Spirit": lambda: [spirit(telemetry, every) for every in (20, 50, 200)],
    }
    found = json.loads(arguments.json.read_text()) if arguments.json.is_file() else {}
    for part in arguments.parts or measure:
        found[part] = [asdict(row) for row in measure[part]()]  # type: ignore[call-overload]
        # Written part by part: what was measured is kept.
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
        arguments.json.with_suffix(".md").write_text(page(found))


if __name__ == "__main__":
    main()
