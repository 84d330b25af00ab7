"""Spoil input files at random and see what the commands make of them.

python benchmarks/fuzz.py --minutes 30 --json fuzz.json

Every try runs in a process of its own, forked from one that has everything loaded. A try must
end in a result or in one of lunar-fg's own errors; anything else is a finding, with its seed.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import resource
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from frontends.errors import LunarFgError
from lunar_fg import runs
from lunar_fg.campaign.study import read_study
from lunar_fg.config import Config, read_config
from lunar_fg.datasets import open_dataset
from lunar_fg.evaluation import evaluate
from lunar_fg.run_folder import RunFolder
from lunar_fg.simulation.cache import cached_dataset
from lunar_fg.simulation.spec import checked_spec
from lunar_fg.trajectory_io import read_track, read_trajectory
from lunar_fg.warmup import warmup

#: Of a try: CPU time, so that a busy machine does not look like a hang; and of what only waits.
CPU_LIMIT_S, WALL_LIMIT_S = 60, 1800.0
MEMORY_LIMIT = 6 << 30
SPEC = {
    "camera": {"width": 160, "height": 160},
    "path": {"length_m": 4.0, "step_m": 0.4},
    "orbital": {"margin_m": 15.0},
}
STUDY = """schema: lunar-fg/study/1
name: fuzzed
base: {measurements: {keyframes: 12}, config: {graph: {landmarks: full}}}
vary: {measurements.bad_share: [0.0, 0.1]}
seeds: [1, 2, 3]
"""


def run_dataset(folder: Path) -> None:
    runs.run(open_dataset(folder), RunFolder.create(folder.parent / "out", Config()))


def use_log(folder: Path) -> None:
    runs.optimize(RunFolder.open(folder))


def compare_files(folder: Path) -> None:
    evaluate(read_trajectory(folder / "trajectory.tum"), read_track(folder / "ground_truth.tum"))


WORDS = (b"nan", b"-1", b"1e308", b"99999999999", b"0", b"\n", b",", b"'", b"{", b"\x00")

#: What is spoiled, in which of the two folders, and what then reads it.
TARGETS: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "image (PNG)": ("dataset", "left/*.png", run_dataset),
    "traverse.yaml": ("dataset", "traverse.yaml", run_dataset),
    "frames.csv": ("dataset", "frames.csv", run_dataset),
    "odometry.csv": ("dataset", "odometry.csv", run_dataset),
    "attitude.csv": ("dataset", "attitude.csv", run_dataset),
    "ground_truth.tum": ("dataset", "ground_truth.tum", run_dataset),
    "map (GeoTIFF)": ("dataset", "orbital/*.tif", run_dataset),
    "log (SQLite)": ("run", "run.db", use_log),
    "trajectory.tum": ("run", "trajectory.tum", compare_files),
    "config.yaml": ("run", "config.yaml", lambda folder: read_config(folder / "config.yaml")),
    "study.yaml": ("run", "study.yaml", lambda folder: read_study(folder / "study.yaml").trials()),
}


def spoil(data: bytes, rng: np.random.Generator) -> bytes:
    """Change some bytes."""
    spoiled = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        if not spoiled:
            break
        at = int(rng.integers(len(spoiled)))
        span = int(min(len(spoiled) - at, rng.integers(1, 1 + max(1, len(spoiled) // 20))))
        way = rng.integers(6)
        if way == 0:
            spoiled[at] ^= 1 << int(rng.integers(8))
        elif way == 1:
            spoiled[at : at + span] = rng.bytes(span)
        elif way == 2:
            del spoiled[at:]
        elif way == 3:
            spoiled[at:at] = spoiled[at : at + span]
        elif way == 4:
            del spoiled[at : at + span]
        else:
            spoiled[at : at + 1] = WORDS[int(rng.integers(len(WORDS)))]
    return bytes(spoiled)


def child(use: Callable[[Path], object], folder: Path, told: Connection) -> None:
    """Run one try and tell how it ended."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S + 5))
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        try:
            use(folder)
            outcome, text = "ran", ""
        except LunarFgError as error:
            outcome, text = "named", str(error)
        except BaseException as error:  # every other exception is a finding
            outcome, text = "other", f"{type(error).__name__}: {error}"
    told.send((outcome, text))


def attempt(use: Callable[[Path], object], folder: Path) -> tuple[str, str]:
    """Run one try in a process of its own."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=child, args=(use, folder, there))
    process.start()
    there.close()
    told = None
    if here.poll(WALL_LIMIT_S):
        with contextlib.suppress(EOFError):
            told = here.recv()
    elif process.is_alive():
        process.kill()
        process.join()
        return "hang", f"did not end within {WALL_LIMIT_S:.0f} s"
    process.join()
    if process.exitcode == -signal.SIGXCPU:
        return "hang", f"did not end within {CPU_LIMIT_S} s of CPU time"
    return told or ("crash", f"exit code {process.exitcode}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    warmup()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        dataset = cached_dataset(checked_spec(SPEC, "fuzz"))
        sound = scratch / "run"
        first = attempt(
            lambda _: runs.run(open_dataset(dataset), RunFolder.create(sound, Config())), dataset
        )
        assert first[0] == "ran", first
        (sound / "study.yaml").write_text(STUDY)
        sources = {"dataset": dataset, "run": sound}
        counts: dict[str, Counter[str]] = {target: Counter() for target in TARGETS}
        findings = []
        seed = arguments.seed
        while time.monotonic() - begin < 60.0 * arguments.minutes:
            rng = np.random.default_rng(seed)
            target = list(TARGETS)[seed % len(TARGETS)]
            source, pattern, use = TARGETS[target]
            copy = Path(shutil.copytree(sources[source], scratch / "try" / source))
            paths = sorted(copy.glob(pattern))
            path = paths[int(rng.integers(len(paths)))]
            path.write_bytes(spoil(path.read_bytes(), rng))
            outcome, text = attempt(use, copy)
            counts[target][outcome] += 1
            if outcome not in ("ran", "named"):
                findings.append(f"{target}, seed {seed}: {outcome}: {text[:300]}")
                print(findings[-1], flush=True)
            shutil.rmtree(scratch / "try")
            seed += 1
    result = {
        "seconds": time.monotonic() - begin,
        "files": {target: dict(count) for target, count in counts.items()},
        "findings": findings,
    }
    print(json.dumps(result["files"], indent=1))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
