"""A run is killed at random moments: the resumed one must end like the uninterrupted one.

Run from the checkout: ``python -m benchmarks.kills DATASET [--kills 20] [--json OUT]``. Each
time a new run is started as a process of its own and killed with SIGKILL, a random part of a
frame after a random number of frames is in its log; then it is resumed to the end. Every so
often it is resumed in a process that compiles all kernels anew.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import numpy as np

from lunar_fg.run_folder import RunFolder
from lunar_fg.trajectory import Trajectory

_QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
_POLL_S = 0.005


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "lunar_fg.cli", *map(str, arguments)]


def logged(database: Path) -> int:
    """Keyframes that a run, going or not, has in its log."""
    if not database.is_file():
        return 0
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as connection:
        try:
            return int(connection.execute("SELECT count(*) FROM keyframe").fetchone()[0])
        except sqlite3.OperationalError:
            return 0


def whole_run(dataset: Path, folder: Path) -> float:
    """Run to the end; seconds from one frame in the log to the next."""
    times = []
    with subprocess.Popen(command("run", dataset, "-o", folder), **_QUIET) as process:
        while process.poll() is None:
            if logged(folder / "run.db") > len(times):
                times += [time.perf_counter()] * (logged(folder / "run.db") - len(times))
            time.sleep(_POLL_S)
    if process.returncode or not times:
        raise SystemExit(f"{dataset}: the run failed or has no frame")
    return (times[-1] - times[0]) / len(times)


def killed(dataset: Path, folder: Path, frames: int, part_s: float) -> bool:
    """Start a run and kill it `part_s` after it has so many frames; False where it had ended."""
    with subprocess.Popen(command("run", dataset, "-o", folder), **_QUIET) as process:
        while process.poll() is None and logged(folder / "run.db") < frames:
            time.sleep(_POLL_S)
        time.sleep(part_s)
        alive = process.poll() is None
        process.send_signal(signal.SIGKILL)
    return alive


def difference(one: Trajectory, other: Trajectory) -> float:
    """Largest difference of any entry of any pose (m, or of a rotation matrix)."""
    if len(one) != len(other):
        return float("inf")
    return float(np.abs(one.map_T_rover - other.map_T_rover).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--compile-every", type=int, default=2, help="resumptions")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    moments, rows = random.Random(arguments.seed), []
    with tempfile.TemporaryDirectory() as place:
        whole = RunFolder(Path(place) / "whole")
        frame_s = whole_run(arguments.dataset, whole.path)
        expected, text = whole.read_trajectory(), whole.tum_path.read_text()
        count = len(expected)
        while len(rows) < arguments.kills:
            folder = RunFolder(Path(place) / f"killed-{len(rows)}")
            # From before the first frame to the last one.
            frames, part_s = moments.randrange(count), moments.uniform(0.0, frame_s)
            if not killed(arguments.dataset, folder.path, frames, part_s):
                folder.path.rename(folder.path.with_name(f"ended-{time.monotonic_ns()}"))
                continue
            compiled = len(rows) % arguments.compile_every == 0
            cache = {"NUMBA_CACHE_DIR": f"{place}/kernels-{len(rows)}"} if compiled else {}
            kept = logged(folder.database_path)
            start = time.perf_counter()
            subprocess.run(
                command(*(["resume", folder.path] if kept else
                          ["run", arguments.dataset, "-o", folder.path, "--overwrite"])),
                check=True, env={**os.environ, **cache}, **_QUIET,
            )  # fmt: skip
            seconds = time.perf_counter() - start
            gap = difference(folder.read_trajectory(), expected)
            same = folder.tum_path.read_text() == text
            rows.append({"logged": kept, "compiled": compiled, "gap": gap, "same_file": same,
                         "resume_s": seconds})  # fmt: skip
            print(f"killed after {kept:4d} of {count} frames: gap {gap:.1e}, "
                  f"file {'identical' if same else 'differs'}, resumed in {seconds:.1f} s"
                  f"{', kernels compiled anew' if compiled else ''}", flush=True)  # fmt: skip
    worst = max(row["gap"] for row in rows)
    identical = sum(row["same_file"] for row in rows)
    print(f"{len(rows)} kills: largest gap {worst:.1e} (target 1e-9), {identical} files identical")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
