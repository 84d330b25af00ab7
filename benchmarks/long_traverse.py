"""A long traverse without images: time a keyframe, memory and log size, tenth by tenth.

python benchmarks/long_traverse.py --keyframes 20000 --json docs/benchmarks/long_traverse.json
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from frontends.geometry import inverse
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.log import RunHeader, TraverseLog
from lunar_fg.simulation.measurements import TraverseSpec, simulate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    spec = TraverseSpec(keyframes=arguments.keyframes, odometry=True, tilt=True)
    made = simulate(spec, arguments.seed)
    smoother = IncrementalSmoother(made.camera, made.rover_T_camera, made.start)
    process = psutil.Process()
    tenth = max(1, arguments.keyframes // 10)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "run.db"
        header = RunHeader(made.camera, made.rover_T_camera, made.start)
        with TraverseLog.create(path, header) as log:
            spent: list[float] = []
            for keyframe in made.keyframes:
                begin = time.process_time()
                log.append(keyframe, smoother.add(keyframe))
                spent.append(1e3 * (time.process_time() - begin))
                if len(spent) == tenth:
                    rows.append(
                        {
                            "keyframes": keyframe.index + 1,
                            "median_ms": float(np.median(spent)),
                            "mean_ms": float(np.mean(spent)),
                            "worst_ms": float(np.max(spent)),
                            "memory_mb": process.memory_info().rss / 1e6,
                            "log_mb": path.stat().st_size / 1e6,
                        }
                    )
                    print(
                        "{keyframes:7d} keyframes: {median_ms:6.2f} ms median, {mean_ms:6.2f} "
                        "mean, {worst_ms:7.1f} worst; {memory_mb:6.0f} MB, log {log_mb:6.0f} MB"
                        .format(**rows[-1]),
                        flush=True,
                    )  # fmt: skip
                    spent = []
    smoother.finish()
    errors = inverse(smoother.trajectory().map_T_rover) @ made.map_T_rover
    driven = float(np.linalg.norm(np.diff(made.map_T_rover[:, :3, 3], axis=0), axis=1).sum())
    final = float(np.linalg.norm(errors[-1, :3, 3]))
    print(f"{driven:.0f} m driven, final error {final:.2f} m ({100 * final / driven:.3f} %)")
    if arguments.json is not None:
        result = {"distance_m": driven, "final_error_m": final, "tenths": rows}
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
