"""A long rendered traverse, navigated: time a keyframe, memory and log size, tenth by tenth.

python benchmarks/long_images.py --length 1000 --step 0.5 --size 224 --json out.json

Every frame is rendered at its own place; nothing is driven twice. The rendered traverse stays
in the user's cache folder. A machine is faster at one time than at another, and one ground has
more landmarks than the next: every frame therefore goes through a second navigator, too, which
has begun one to two tenths before, alternately and in the same process. The ratio of the two
CPU times is what the length of the drive does.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from frontends.measurements import StereoFrame, UnusableFrame
from lunar_fg.config import Config
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.base import Dataset
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.navigator import Navigator
from lunar_fg.simulation.cache import cached_dataset
from lunar_fg.simulation.spec import checked_spec
from lunar_fg.truth import compare, truth_of

#: Tenths that a second navigator runs before it is compared.
RUN_IN = 1


def step_ms(navigator: Navigator, frame: StereoFrame | UnusableFrame) -> float:
    begin = time.process_time()
    navigator.step(frame)
    return 1e3 * (time.process_time() - begin)


class Pair:
    """The navigator of the whole drive, and young ones beside it."""

    def __init__(self, dataset: Dataset, config: Config, folder: Path) -> None:
        self._dataset, self._config, self._folder = dataset, config, folder
        self._logs: dict[Navigator, TraverseLog] = {}
        self.old = self._begin("old")
        self._young: list[Navigator] = []

    def _begin(self, name: str) -> Navigator:
        dataset = self._dataset
        header = RunHeader(
            dataset.camera, dataset.rover_T_camera, dataset.start, self._config.model_dump_json()
        )
        (self._folder / name).mkdir()
        log = TraverseLog.create(self._folder / name / "run.db", header)
        log.__enter__()
        navigator = Navigator(
            dataset.camera, self._config, dataset.rover_T_camera, dataset.start, log
        )
        self._logs[navigator] = log
        return navigator

    def turn(self, tenth: int) -> None:
        """A tenth begins: so does a young navigator, and the oldest of them ends."""
        if len(self._young) > RUN_IN:
            ended = self._young.pop(0)
            self._logs.pop(ended).__exit__(None, None, None)
        self._young.append(self._begin(f"young-{tenth}"))

    def step(self, frame: StereoFrame | UnusableFrame) -> tuple[float, float | None]:
        """CPU of the old one and of the young one that has run in, ms."""
        old = step_ms(self.old, frame)
        spent = [step_ms(young, frame) for young in self._young]
        return old, spent[0] if len(spent) > RUN_IN else None

    def log_mb(self) -> float:
        """Size of the old one's log."""
        return sum(p.stat().st_size for p in (self._folder / "old").glob("run.db*")) / 1e6

    def close(self) -> None:
        """Close all logs."""
        for log in self._logs.values():
            log.__exit__(None, None, None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=float, default=1000.0)
    parser.add_argument("--step", type=float, default=0.5)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--frames", type=int, help="leave out the rest")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--render-only", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    spec = {
        "seed": arguments.seed,
        "camera": {"width": arguments.size, "height": arguments.size, "supersampling": 1},
        "path": {"length_m": arguments.length, "step_m": arguments.step},
        "orbital": {"margin_m": 10.0, "gsd_m": 1.0, "wrong_map": False},
    }
    dataset = open_dataset(
        cached_dataset(checked_spec(spec, "long traverse"), workers=arguments.workers)
    )
    if arguments.render_only:
        return
    config = Config.model_validate({"map": {"use": False}})
    count = min(arguments.frames or len(dataset), len(dataset))
    tenth = max(1, count // 10)
    rows: list[dict[str, float | None]] = []
    with tempfile.TemporaryDirectory() as scratch:
        pair = Pair(dataset, config, Path(scratch))
        old: list[float] = []
        young: list[float] = []
        for number, frame in enumerate(dataset.frames()):
            if number == count:
                break
            if number % tenth == 0:
                pair.turn(number // tenth)
            spent, beside = pair.step(frame)
            old.append(spent)
            if beside is not None:
                young.append(beside)
            if len(old) < tenth:
                continue
            reports = pair.old.reports[-tenth:]
            rows.append(
                {
                    "keyframes": number + 1,
                    "median_ms": float(np.median(old)),
                    "mean_ms": float(np.mean(old)),
                    "worst_ms": float(np.max(old)),
                    "ratio": float(np.median(old) / np.median(young)) if young else None,
                    "mean_ratio": float(np.mean(old) / np.mean(young)) if young else None,
                    "landmarks": float(np.mean([report.landmarks for report in reports])),
                    "memory_mb": psutil.Process().memory_info().rss / 1e6,
                    "log_mb": pair.log_mb(),
                }
            )
            print({k: v and round(v, 2) for k, v in rows[-1].items()}, flush=True)
            old, young = [], []
        pair.old.finish()
        trajectory = pair.old.trajectory()
        pair.close()
    truth = truth_of(dataset.ground_truth)
    accuracy = compare(trajectory, truth)
    result = {
        "size_px": arguments.size,
        "frames": count,
        "frames_lost": pair.old.frames_lost,
        "distance_m": accuracy.distance_m,
        "final_error_m": accuracy.final_error_m,
        "tenths": rows,
    }
    print({key: value for key, value in result.items() if key != "tenths"})
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
