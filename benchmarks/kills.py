"""A run is killed at random moments: the resumed one must end like the uninterrupted one.

Run from the checkout: ``python -m benchmarks.kills DATASET [--kills 20] [--json OUT]``. Each
time a new run is started as a process of its own, killed at a random moment between its first
logged frame and the time the uninterrupted run took, and resumed to the end.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from lunar_fg import runs
from lunar_fg.datasets import open_dataset
from lunar_fg.log import TraverseLog
from lunar_fg.run_folder import RunFolder
from lunar_fg.trajectory import Trajectory
from lunar_fg.warmup import warmup


def killed(dataset: Path, folder: Path, delay_s: float | None) -> tuple[bool, float]:
    """Start a run and kill it some time after its log has a frame, or never.

    Returns whether it was killed before it ended, and the time since that frame, s.
    """
    command = [sys.executable, "-m", "lunar_fg.cli", "run", str(dataset), "-o", str(folder)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet) as process:
        journal = folder / "run.db-wal"
        while process.poll() is None and not (journal.exists() and journal.stat().st_size > 100000):
            time.sleep(0.01)
        start = time.perf_counter()
        if delay_s is None:
            process.wait()
        else:
            time.sleep(delay_s)
        alive = process.poll() is None
        process.send_signal(signal.SIGKILL)
    return alive, time.perf_counter() - start


def difference(one: Trajectory, other: Trajectory) -> float:
    """Largest difference of any entry of any pose (m, or of a rotation matrix)."""
    if len(one) != len(other):
        return float("inf")
    return float(np.abs(one.map_T_rover - other.map_T_rover).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    moments, rows = random.Random(arguments.seed), []
    warmup()
    dataset = open_dataset(arguments.dataset)
    with tempfile.TemporaryDirectory() as place:
        # A process like the others: code just compiled and code from the cache round differently.
        _, took_s = killed(arguments.dataset, Path(place) / "whole", None)
        whole = RunFolder.open(Path(place) / "whole")
        expected, text = whole.read_trajectory(), whole.tum_path.read_text()
        while len(rows) < arguments.kills:
            path = Path(place) / f"killed-{len(rows)}"
            if not killed(arguments.dataset, path, moments.uniform(0.0, took_s))[0]:
                path.rename(path.with_name(f"ended-{time.monotonic_ns()}"))
                continue
            folder = RunFolder.open(path)
            with TraverseLog.open(folder.database_path) as log:
                logged = len(log.keyframes())
            start = time.perf_counter()
            runs.resume(dataset, folder)
            seconds = time.perf_counter() - start
            gap = difference(folder.read_trajectory(), expected)
            same = folder.tum_path.read_text() == text
            rows.append({"logged": logged, "gap": gap, "same_file": same, "resume_s": seconds})
            print(f"killed after {logged:4d} of {len(expected)} frames: gap {gap:.1e}, "
                  f"file {'identical' if same else 'differs'}, resumed in {seconds:.1f} s",
                  flush=True)  # fmt: skip
    worst = max(row["gap"] for row in rows)
    identical = sum(row["same_file"] for row in rows)
    print(f"{len(rows)} kills: largest gap {worst:.1e} (target 1e-9), {identical} files identical")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
