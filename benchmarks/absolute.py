"""Absolute fixes on simulated traverses: success, errors, false accepts, coverage, time.

    lunar-fg simulate DATA/mare --seed 11 --length 72 --step 1     (and others)
    python -m benchmarks.absolute DATA/mare DATA/rough DATA/smooth

The relief comes from dense stereo on the rendered images, laid out by the ESTIMATED poses of
a run without fixes. The same ground is rendered from above under four suns and averaged to
three ground distances. The prior is off by up to 6 m and 1 degree, the window +-15 m and
+-3 degrees. The same is done on maps whose ground is moved about by 0.2 px, as that of real ones
is. False accepts are looked for on the maps of the other terrains (of the first of
``--own-maps``, too, which are else tried on their own maps alone) and on maps of nothing. Then the
traverses are run with and without the map; those given with ``--runs`` are only run. ``--held-out``
names terrains that had no part in setting anything.
Writes ``docs/benchmarks/absolute.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.absolute_maps import bent, featureless, render_maps
from benchmarks.absolute_page import write
from benchmarks.absolute_trials import GSDS_M, SUN_DIFFERENCES_DEG, Ground, Trial, drive, trials
from frontends.geometry import inverse
from frontends.measurements import AbsoluteFix
from lunar_fg import runs
from lunar_fg.config import Config
from lunar_fg.datasets import open_dataset
from lunar_fg.ledger import read_ledger
from lunar_fg.orbital_files import MapConfig
from lunar_fg.run_folder import RunFolder

RESULTS = Path(__file__).parents[1] / "docs" / "benchmarks"


def full_runs(folder: Path, work: Path) -> dict[str, Any]:
    """Final and median position error without any alignment: wheels, vision, with fixes."""
    result: dict[str, Any] = {"terrain": folder.name}
    dataset = open_dataset(folder)
    true = dataset.ground_truth.map_T_rover
    for name, use in (("vision", False), ("vision + fixes", True)):
        place = work / f"run_{folder.name}_{'fixes' if use else 'plain'}"
        shutil.rmtree(place, ignore_errors=True)
        config = Config(map=MapConfig(use=use))
        run = RunFolder.create(place, config)
        runs.run(dataset, run, config)
        trajectory = run.read_trajectory()
        error = trajectory.map_T_rover[:, :2, 3] - true[:, :2, 3]
        # what the start prior is wrong by is not drift: taken out with the first pose
        aligned = true[0] @ inverse(trajectory.map_T_rover[0]) @ trajectory.map_T_rover
        drift = aligned[:, :2, 3] - true[:, :2, 3]
        distance = np.linalg.norm(error, axis=1)
        result[name] = {
            "final_m": float(distance[-1]),
            "median_m": float(np.median(distance)),
            "after_first_fix_max_m": float(distance[len(distance) // 2 :].max()),
            "drift_final_m": float(np.linalg.norm(drift[-1])),
            "thirds_m": [float(np.median(part)) for part in np.array_split(distance, 3)],
        }
        result["length_m"] = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())
        if use:
            entries = read_ledger(run)
            fixes = [e for e in entries if isinstance(e.measurement, AbsoluteFix)]
            result["fixes"] = [entry.ruling.verdict.value for entry in fixes]
        else:
            by_wheels = run.read_dead_reckoning()
            if by_wheels is not None:
                rows = np.searchsorted(dataset.ground_truth.stamp_s, by_wheels.stamp_s - 1e-3)
                off = np.linalg.norm(by_wheels.map_T_rover[:, :2, 3] - true[rows, :2, 3], axis=1)
                result["wheels"] = {"final_m": float(off[-1]), "median_m": float(np.median(off))}
    return result


def kept(path: Path, make: Callable[[], Any]) -> Any:
    """What was made before, so that an interrupted benchmark goes on."""
    if not path.exists():
        path.write_text(json.dumps(make()))
    return json.loads(path.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--own-maps", nargs="*", default=[], type=Path)
    parser.add_argument("--held-out", nargs="*", default=[])
    parser.add_argument("--runs", nargs="*", default=[], type=Path)
    parser.add_argument("--work", type=Path, default=Path("build/absolute"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    work: Path = arguments.work
    work.mkdir(parents=True, exist_ok=True)
    folders = (*arguments.datasets, *arguments.own_maps)
    grounds = {folder: drive(folder) for folder in folders}
    for folder, ground in grounds.items():
        render_maps(folder, ground, work)
        for gsd in GSDS_M:
            plain = [work / f"{ground.name}_{d:.0f}_{gsd}.tif" for d in SUN_DIFFERENCES_DEG]
            featureless(plain[0], work / f"{ground.name}_blank_{gsd}.tif", ground)
            for path, d in zip(plain, SUN_DIFFERENCES_DEG, strict=True):
                bent(path, work / f"{ground.name}_{d:.0f}_bent_{gsd}.tif")
    rows: list[Trial] = []
    wrong = [folder.name for folder in (*arguments.datasets, *arguments.own_maps[:1])]
    for folder, ground in grounds.items():
        strangers: list[str] = []
        if folder in arguments.datasets:
            strangers = [name for name in wrong if name != ground.name]

        def tried(ground: Ground = ground, strangers: list[str] = strangers) -> list[Any]:
            return [asdict(trial) for trial in trials(ground, work, strangers)]

        rows += [Trial(**t) for t in kept(work / f"{folder.name}_trials.json", tried)]
    drives = [
        kept(work / f"{folder.name}_runs.json", lambda folder=folder: full_runs(folder, work))
        for folder in (*arguments.datasets, *arguments.runs)
    ]
    write(rows, drives, arguments.held_out, arguments.out)


if __name__ == "__main__":
    main()
