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
from lunar_fg import offline, runs
from lunar_fg.campaign.results import Results
from lunar_fg.campaign.study import read_study
from lunar_fg.campaign.trial import Outcome
from lunar_fg.config import Config, read_config
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.pds_label import read_label
from lunar_fg.evaluation import evaluate
from lunar_fg.export import export_g2o
from lunar_fg.pose_graph import read_g2o
from lunar_fg.route_file import read_route
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
    offline.optimize(RunFolder.open(folder))


def compare_files(folder: Path) -> None:
    evaluate(read_trajectory(folder / "trajectory.tum"), read_track(folder / "ground_truth.tum"))


LABEL = """PDS_VERSION_ID = PDS3
RECORD_TYPE = FIXED_LENGTH
RECORD_BYTES = 4096
FILE_RECORDS = 9
LABEL_RECORDS = 1
^IMAGE = 2
INSTRUMENT_ID = "NAVCAM_LEFT"
FRAME_ID = "LEFT"
PLANET_DAY_NUMBER = 12
ROVER_MOTION_COUNTER = (3,0,0,1,2)
SPACECRAFT_CLOCK_START_COUNT = "128278506.123"
GEOMETRY_PROJECTION_TYPE = RAW
GROUP = GEOMETRIC_CAMERA_MODEL
 MODEL_TYPE = CAHV
 MODEL_COMPONENT_1 = (0.7,-0.1,-1.5)
 MODEL_COMPONENT_2 = (0.94,0.0,0.34)
 MODEL_COMPONENT_3 = (60.0,128.0,21.0)
 MODEL_COMPONENT_4 = (16.0,0.0,145.0)
END_GROUP = GEOMETRIC_CAMERA_MODEL
GROUP = ROVER_COORDINATE_SYSTEM
 ORIGIN_OFFSET_VECTOR = (0.0,0.0,0.0)
 ORIGIN_ROTATION_QUATERNION = (1.0,0.0,0.0,0.0)
 QUATERNION_MEASUREMENT_METHOD = FINE
END_GROUP = ROVER_COORDINATE_SYSTEM
OBJECT = IMAGE
 LINES = 128
 LINE_SAMPLES = 128
 SAMPLE_TYPE = MSB_INTEGER
 SAMPLE_BITS = 16
 BANDS = 1
 SAMPLE_BIT_MASK = 2#0000111111111111#
END_OBJECT = IMAGE
END
"""
ROUTE = {
    "type": "Feature",
    "crs": {"type": "name", "properties": {"name": "map"}},
    "properties": {"name": "fuzzed", "half_width_m": 1.5},
    "geometry": {"type": "LineString", "coordinates": [[0.0, 0.0], [2.0, 0.1], [4.0, 0.0]]},
}


def run_kitti(folder: Path) -> None:
    runs.run(open_dataset(folder / "kitti"), RunFolder.create(folder.parent / "out", Config()))


def write_others(folder: Path, dataset: Path, run: Path) -> None:
    """Files of the other formats that are read."""
    kitti = folder / "kitti"
    for side, name in (("left", "image_0"), ("right", "image_1")):
        (kitti / name).mkdir(parents=True)
        for number, image in enumerate(sorted((dataset / side).glob("*.png"))[:4]):
            shutil.copy(image, kitti / name / f"{number:06d}.png")
    rows = (f"140 0 79.5 {x} 0 140 79.5 0 0 0 1 0" for x in (0, -42, 3, -39))
    (kitti / "calib.txt").write_text("".join(f"P{i}: {row}\n" for i, row in enumerate(rows)))
    (kitti / "poses.txt").write_text(
        "".join(f"1 0 0 0 0 1 0 0 0 0 1 {0.4 * k}\n" for k in range(4))
    )
    export_g2o(RunFolder.open(run), folder / "graph.g2o")
    (folder / "route.geojson").write_text(json.dumps(ROUTE, indent=1))
    (folder / "label.img").write_bytes(LABEL.encode().ljust(4096) + bytes(2 * 128 * 128))
    for number in range(3):
        Results(folder).append(Outcome(number, number, "fuzzed", warnings=("none",)))


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
    "head of a map (GeoTIFF)": ("dataset", "orbital/*.tif", run_dataset),
    "head of an image (PNG)": ("dataset", "left/*.png", run_dataset),
    "KITTI calib.txt": ("others", "kitti/calib.txt", run_kitti),
    "KITTI poses.txt": ("others", "kitti/poses.txt", run_kitti),
    "PDS label": ("others", "label.img", lambda folder: read_label(folder / "label.img")),
    "pose graph (g2o)": ("others", "graph.g2o", lambda folder: read_g2o(folder / "graph.g2o")),
    "route (GeoJSON)": (
        "others",
        "route.geojson",
        lambda folder: read_route(folder / "route.geojson"),
    ),
    "campaign's results.jsonl": ("others", "results.jsonl", lambda folder: Results(folder).read()),
    "study.yaml": ("run", "study.yaml", lambda folder: read_study(folder / "study.yaml").trials()),
}


#: Where only the head is spoiled, so many bytes of it: random ones mostly hit the pixels.
HEAD_BYTES = 512


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
    parser.add_argument("--only", nargs="*", help="targets; all by default")
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
        write_others(scratch / "others", dataset, sound)
        sources = {"dataset": dataset, "run": sound, "others": scratch / "others"}
        counts: dict[str, Counter[str]] = {
            target: Counter() for target in arguments.only or TARGETS
        }
        findings = []
        for target in counts:  # what is not spoiled is read
            source, _, use = TARGETS[target]
            outcome = attempt(use, Path(shutil.copytree(sources[source], scratch / "try" / source)))
            assert outcome[0] == "ran", (target, outcome)
            shutil.rmtree(scratch / "try")
        seed = arguments.seed
        while time.monotonic() - begin < 60.0 * arguments.minutes:
            rng = np.random.default_rng(seed)
            names = arguments.only or list(TARGETS)
            target = names[seed % len(names)]
            source, pattern, use = TARGETS[target]
            copy = Path(shutil.copytree(sources[source], scratch / "try" / source))
            paths = sorted(copy.glob(pattern))
            path = paths[int(rng.integers(len(paths)))]
            content = path.read_bytes()
            head = HEAD_BYTES if target.startswith("head of") else len(content)
            if target == "PDS label":
                head = len(LABEL)
            path.write_bytes(spoil(content[:head], rng) + content[head:])
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
