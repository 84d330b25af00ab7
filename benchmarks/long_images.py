"""A long rendered traverse, navigated: time a keyframe, memory and log size, tenth by tenth.

python benchmarks/long_images.py --length 1000 --step 0.5 --size 224 --json out.json

Every frame is rendered at its own place; nothing is driven twice. The rendered traverse stays
in the user's cache folder.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from frontends.measurements import Estimate
from lunar_fg import runs
from lunar_fg.config import Config
from lunar_fg.datasets import open_dataset
from lunar_fg.run_folder import RunFolder
from lunar_fg.simulation.cache import cached_dataset
from lunar_fg.simulation.spec import checked_spec


@dataclass
class Watch:
    """Takes the process's CPU time, memory and log size as the estimates come."""

    folder: RunFolder
    tenth: int
    rows: list[dict[str, float]] = field(default_factory=list)
    _spent: list[float] = field(default_factory=list)
    _last: float = field(default_factory=time.process_time)
    _count: int = 0

    def __call__(self, estimate: Estimate) -> None:
        """Take the figures after a keyframe."""
        now = time.process_time()
        self._spent.append(1e3 * (now - self._last))
        self._last = now
        self._count += 1
        if len(self._spent) < self.tenth:
            return
        log = self.folder.database_path
        size = sum(p.stat().st_size for p in log.parent.glob(f"{log.name}*"))
        self.rows.append(
            {
                "keyframes": self._count,
                "median_ms": float(np.median(self._spent)),
                "mean_ms": float(np.mean(self._spent)),
                "worst_ms": float(np.max(self._spent)),
                "memory_mb": psutil.Process().memory_info().rss / 1e6,
                "log_mb": size / 1e6,
            }
        )
        print({key: round(value, 1) for key, value in self.rows[-1].items()}, flush=True)
        self._spent = []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=float, default=1000.0)
    parser.add_argument("--step", type=float, default=0.5)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--seed", type=int, default=5)
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
    begin = time.process_time()
    dataset = open_dataset(
        cached_dataset(checked_spec(spec, "long traverse"), workers=arguments.workers)
    )
    rendering_s = time.process_time() - begin
    if arguments.render_only:
        return
    config = Config.model_validate({"map": {"use": False}})
    with tempfile.TemporaryDirectory() as scratch:
        folder = RunFolder.create(Path(scratch) / "run", config)
        watch = Watch(folder, max(1, len(dataset) // 10))
        metrics = runs.run(dataset, folder, config, watch)
    result = {
        "size_px": arguments.size,
        "frames": metrics.frames,
        "frames_lost": metrics.frames_lost,
        "distance_m": metrics.distance_m,
        "final_error_m": metrics.final_error_m,
        "rendering_cpu_s": rendering_s,
        "tenths": watch.rows,
    }
    print({key: value for key, value in result.items() if key != "tenths"})
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
