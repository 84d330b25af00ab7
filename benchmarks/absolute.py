"""Absolute fixes on simulated traverses: success, errors, false accepts, coverage, time.

    lunar-fg simulate DATA/mare --seed 11 --length 72 --step 1     (and others)
    python benchmarks/absolute.py DATA/mare DATA/rough DATA/smooth

The relief comes from dense stereo on the rendered images, laid out by the ESTIMATED poses of
a run without fixes. The same ground is rendered from above under four suns and averaged to
three ground distances. The prior is off by up to 6 m and 1 degree, the window +-15 m and
+-3 degrees. False accepts are looked for on the maps of all the other terrains and on maps of
nothing. Then the traverses are run with and without the map; those given with ``--runs`` are
only run. Writes ``docs/benchmarks/absolute.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from frontends.absolute import AbsoluteAdjustment, Search, make_patch
from frontends.geometry import inverse, pose, so3_exp, yaw_pitch_roll
from frontends.measurements import AbsoluteFix, UnusableFrame
from frontends.orbital import OrbitalMap
from frontends.terrain import DenseStereo, TerrainMap
from lunar_fg import runs
from lunar_fg.config import Config
from lunar_fg.datasets import open_dataset
from lunar_fg.navigator import Navigator
from lunar_fg.orbital_files import MapConfig
from lunar_fg.run_folder import RunFolder
from lunar_fg.simulation.orbital import MapFrame, as_photograph, look_down, write_geotiff
from lunar_fg.simulation.simulate import build_world
from lunar_fg.simulation.spec import OrbitalSpec, SunSpec, read_spec

SUN_DIFFERENCES_DEG = (0.0, 45.0, 90.0, 180.0)
GSDS_M = (0.25, 0.5, 1.0)
LENGTHS_M = (10.0, 20.0, 40.0, 60.0)
MAP_ELEVATION_DEG = 35.0
WINDOW = Search(15.0, 15.0, math.radians(3.0))
RESULTS = Path(__file__).parents[1] / "docs" / "benchmarks"


@dataclass(frozen=True)
class Ground:
    """What a run without fixes knows of a traverse, and the truth."""

    name: str
    terrain: TerrainMap
    estimated: dict[int, np.ndarray]
    true: dict[int, np.ndarray]
    crs: str
    origin: tuple[float, float, float]


@dataclass(frozen=True)
class Trial:
    """One attempt. `found`: the best place is the right one, believed or not."""

    terrain: str
    kind: str
    sun_difference_deg: float
    gsd_m: float
    length_m: float
    fixed: bool
    found: bool
    error_m: float
    error_yaw_deg: float
    nees: float
    cpu_s: float
    reason: str


def drive(folder: Path) -> Ground:
    dataset = open_dataset(folder)
    navigator = Navigator(dataset.camera, None, dataset.rover_T_camera, dataset.start)
    frames = list(dataset.frames())
    for frame in frames:
        navigator.step(frame)
    navigator.finish()
    dense, terrain = DenseStereo(dataset.camera, dataset.rover_T_camera), TerrainMap()
    rectification = navigator._frontend.perception.rectification
    for frame in frames:
        if not isinstance(frame, UnusableFrame):
            terrain.add(dense.measure(frame, rectification, 1.2))
    index = [frame.index for frame in frames]
    estimated = dict(zip(index, navigator.trajectory().map_T_rover, strict=True))
    true = dict(zip(index, dataset.ground_truth.map_T_rover, strict=True))
    reference = dataset.map_reference
    return Ground(folder.name, terrain, estimated, true, reference.crs, reference.origin_m)


def render_maps(folder: Path, ground: Ground, work: Path) -> None:
    """The traverse's surroundings from above, under each sun, at each ground distance."""
    spec = read_spec(folder / "simulation.yaml")
    world = None
    places = np.array([p[:2, 3] for p in ground.true.values()])
    west, south = places.min(axis=0) - 36.0
    east, north = places.max(axis=0) + 36.0
    frame = MapFrame.covering((west, south, east, north), min(GSDS_M))
    rows, columns = (n - n % 4 for n in (frame.rows, frame.columns))
    frame = MapFrame(frame.west, frame.north, frame.gsd_m, rows, columns)
    for difference in SUN_DIFFERENCES_DEG:
        paths = [work / f"{ground.name}_{difference:.0f}_{gsd}.tif" for gsd in GSDS_M]
        if all(path.exists() for path in paths):
            continue
        world = world or build_world(spec)
        sun = SunSpec(azimuth_deg=(spec.sun.azimuth_deg + difference) % 360.0,
                      elevation_deg=MAP_ELEVATION_DEG)  # fmt: skip
        light = OrbitalSpec(gsd_m=frame.gsd_m, sun=sun)
        strips = [
            look_down(world.scene, frame.strip(first, min(first + 64, rows)), light,
                      spec.camera.fill_light)
            for first in range(0, rows, 64)
        ]  # fmt: skip
        radiance = np.concatenate(strips)
        for gsd, path in zip(GSDS_M, paths, strict=True):
            k = round(gsd / frame.gsd_m)
            mean = radiance.reshape(rows // k, k, columns // k, k).mean(axis=(1, 3))
            rng = np.random.default_rng([spec.seed, round(difference), k])
            image = as_photograph(mean.astype(np.float32), light, rng)
            tags = {"SUN_AZIMUTH_DEG": f"{sun.azimuth_deg}",
                    "SUN_ELEVATION_DEG": f"{sun.elevation_deg}"}  # fmt: skip
            area = MapFrame(frame.west, frame.north, gsd, rows // k, columns // k)
            write_geotiff(path, image, area, ground.crs, ground.origin, tags)


def featureless(like: Path, path: Path, ground: Ground) -> None:
    """A map of nothing but noise, over the same place."""
    found = OrbitalMap.open(like, crs=ground.crs, origin_m=ground.origin).ortho
    west, south, east, north = found.bounds_m
    frame = MapFrame.covering((west, south, east, north), found.gsd_m)
    rng = np.random.default_rng(9)
    image = np.clip(128 + 2 * rng.standard_normal((frame.rows, frame.columns)), 0, 255)
    tags = {"SUN_AZIMUTH_DEG": "285", "SUN_ELEVATION_DEG": "35"}
    write_geotiff(path, image.astype(np.uint8), frame, ground.crs, ground.origin, tags)


def perturbed(ground: Ground, anchor: int, frames: list[int], seed: int) -> dict[int, np.ndarray]:
    """Estimated relative poses, put down where a bad prior has the anchor."""
    rng = np.random.default_rng(seed)
    true = ground.true[anchor]
    yaw = yaw_pitch_roll(true)[0] - yaw_pitch_roll(ground.estimated[anchor])[0]
    turn = so3_exp([0.0, 0.0, yaw + math.radians(rng.uniform(-1.0, 1.0))])
    off = np.array([*rng.uniform(-6.0, 6.0, 2), 0.0])
    anchor_xyz = ground.estimated[anchor][:3, 3]
    shift = pose(turn, true[:3, 3] + off - turn @ anchor_xyz)
    return {k: shift @ ground.estimated[k] for k in frames}


def attempt(
    ground: Ground, orbital: OrbitalMap, anchor: int, length: float, seed: int,
    kind: str, difference: float,
) -> Trial:  # fmt: skip
    frames = [
        k for k, p in ground.estimated.items()
        if np.linalg.norm(p[:2, 3] - ground.estimated[anchor][:2, 3]) <= 0.5 * length
    ]  # fmt: skip
    adjustment = AbsoluteAdjustment(orbital)
    start = time.process_time()
    patch = make_patch(ground.terrain, perturbed(ground, anchor, frames, seed), anchor,
                       adjustment.cell_m)  # fmt: skip
    result = adjustment.locate(patch, anchor, WINDOW)
    cpu = time.process_time() - start
    true, fix = ground.true[anchor], result.fix
    peak = result.proposals[0].peak if result.proposals else None
    limit = max(0.5, orbital.gsd_m)
    found, nees, yaw = False, math.nan, math.nan
    error = math.nan
    if peak is not None:
        error = math.hypot(peak.x_m - true[0, 3], peak.y_m - true[1, 3])
        found = error <= limit
    if fix.candidates:
        best = fix.candidates[0]
        off = np.array(
            [
                best.x_m - true[0, 3],
                best.y_m - true[1, 3],
                math.remainder(best.yaw_rad - yaw_pitch_roll(true)[0], math.tau),
            ]
        )
        error, yaw = float(np.hypot(off[0], off[1])), math.degrees(off[2])
        nees = float(off @ np.linalg.solve(best.covariance, off)) / 3.0
    return Trial(ground.name, kind, difference, orbital.gsd_m, length, bool(fix.candidates),
                 found, error, yaw, nees, cpu, fix.reason)  # fmt: skip


def anchors(ground: Ground, length: float, spacing_m: float = 8.0) -> list[int]:
    """Keyframes with the whole length of drive around them."""
    index = sorted(ground.estimated)
    places = np.array([ground.estimated[k][:2, 3] for k in index])
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    ends = 0.45 * length
    chosen = [k for k, d in zip(index, driven, strict=True) if ends <= d <= driven[-1] - ends]
    step = max(1, round(spacing_m / max(float(np.median(np.diff(driven))), 0.1)))
    return chosen[::step]


def trials(ground: Ground, work: Path, strangers: list[str]) -> Iterator[Trial]:
    """All attempts on a terrain's ground; `strangers` name terrains that it is not."""

    def opened(name: str, kind: float | str, gsd: float) -> OrbitalMap:
        text = kind if isinstance(kind, str) else f"{kind:.0f}"
        path = work / f"{name}_{text}_{gsd}.tif"
        return OrbitalMap.open(path, crs=ground.crs, origin_m=ground.origin)

    for gsd in GSDS_M:
        featureless(work / f"{ground.name}_0_{gsd}.tif",
                    work / f"{ground.name}_blank_{gsd}.tif", ground)  # fmt: skip
        maps = {d: opened(ground.name, d, gsd) for d in SUN_DIFFERENCES_DEG}
        blank = opened(ground.name, "blank", gsd)
        wrong = [opened(name, d, gsd) for name in strangers for d in SUN_DIFFERENCES_DEG]
        for length in LENGTHS_M:
            for n, anchor in enumerate(anchors(ground, length)):
                for difference, orbital in maps.items():
                    seed = int(1000 * n + difference)
                    yield attempt(ground, orbital, anchor, length, seed, "right map", difference)
                yield attempt(ground, blank, anchor, length, n, "featureless", math.nan)
                for k, orbital in enumerate(wrong):
                    seed = 1000 * n + k
                    yield attempt(ground, orbital, anchor, length, seed, "wrong map", math.nan)


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
            from lunar_fg.ledger import read_ledger

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


def summary(rows: list[Trial]) -> dict[str, object]:
    fixed = [t for t in rows if t.fixed]
    errors = np.array([t.error_m for t in fixed])
    nees = np.array([t.nees for t in fixed])
    good = [t for t in fixed if t.error_m <= max(0.5, t.gsd_m)]
    return {
        "trials": len(rows),
        "found": sum(t.found for t in rows),
        "fixed": len(fixed),
        "fixed_right": len(good),
        "median_error_m": float(np.median(errors)) if len(errors) else None,
        "error_95_m": float(np.percentile(errors, 95)) if len(errors) else None,
        "mean_nees": float(nees.mean()) if len(nees) else None,
        "coverage_95": float(np.mean(nees <= chi2.ppf(0.95, 3) / 3.0)) if len(nees) else None,
        "cpu_s": float(np.median([t.cpu_s for t in rows])),
    }


def table(rows: list[Trial]) -> list[str]:
    right = [t for t in rows if t.kind == "right map"]
    lines = [
        "| patch, GSD | " + " | ".join(f"sun {d:.0f} deg apart" for d in SUN_DIFFERENCES_DEG) +
        " | median / 95 % error of fixes, m | 95 % covered | NEES | CPU a fix, s |",
        "|---|" + "---|" * (len(SUN_DIFFERENCES_DEG) + 4),
    ]  # fmt: skip
    for gsd in GSDS_M:
        for length in LENGTHS_M:
            group = [t for t in right if t.gsd_m == gsd and t.length_m == length]
            if not group:
                continue
            cells = []
            for difference in SUN_DIFFERENCES_DEG:
                part = [t for t in group if t.sun_difference_deg == difference]
                n = max(len(part), 1)
                found, fixed = sum(t.found for t in part), sum(t.fixed for t in part)
                cells.append(f"{100 * found / n:.0f} / {100 * fixed / n:.0f}")
            s = summary(group)
            if s["fixed"]:
                rest = (f"{s['median_error_m']:.2f} / {s['error_95_m']:.2f} | "
                        f"{100 * s['coverage_95']:.0f} % | {s['mean_nees']:.2f}")  # fmt: skip
            else:
                rest = "- | - | -"
            lines.append(f"| {length:.0f} m, {gsd:.2f} m | " + " | ".join(cells) +
                         f" | {rest} | {s['cpu_s']:.2f} |")  # fmt: skip
    return lines


def write(rows: list[Trial], drives: list[dict[str, object]], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    right = [t for t in rows if t.kind == "right map"]
    wrong = [t for t in rows if t.kind == "wrong map"]
    blank = [t for t in rows if t.kind == "featureless"]
    content = {
        "right map": summary(right),
        "wrong map": summary(wrong),
        "featureless": summary(blank),
        "runs": drives,
        # of the others the counts are enough, as long as none is believed
        "trials": [
            {k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(t).items()}
            for t in rows
            if t.kind == "right map" or t.fixed
        ],
    }
    text = json.dumps(content).replace("NaN", "null").replace("}, {", "},\n {")
    (out / "absolute.json").write_text(text + "\n", encoding="utf-8")
    s = summary(right)
    false_right = s["fixed"] - s["fixed_right"]
    lines = [
        "# Absolute fixes: benchmark",
        "",
        "Made by `benchmarks/absolute.py`; see its text for the set-up. Simulated traverses, "
        f"{len({t.terrain for t in rows})} terrains, relief from dense stereo on rendered images, "
        "laid out by estimated poses.",
        "",
        "Per cent of places *found* (best place within max(0.5 m, 1 px)) / *fixed* (believed). "
        "Patches refused beforehand as too small (fewer than 800 cells) count as not found.",
        "",
        *table(rows),
        "",
        f"Fixes further than max(0.5 m, 1 px) from the truth: {false_right} of {s['fixed']} "
        f"fixes in {s['trials']} trials on the right map; {sum(t.fixed for t in wrong)} accepted "
        f"of {len(wrong)} on a map of another place; {sum(t.fixed for t in blank)} of "
        f"{len(blank)} on featureless ground. The graph's own gate and vote come after this.",
        "",
        "## Whole runs",
        "",
        "Horizontal error against truth without any alignment, m; the start prior is wrong by "
        "some decimetres, which only fixes can remove. Map sun 135 deg from the rover's.",
        "",
        "| terrain | length | wheels final | vision final / median | with fixes final / median "
        "| with fixes, medians of the thirds | fixes |",
        "|---|---|---|---|---|---|---|",
    ]
    for d in drives:
        wheels, vision, fixes = d.get("wheels"), d["vision"], d["vision + fixes"]
        w = "-" if wheels is None else f"{wheels['final_m']:.2f}"
        lines.append(
            f"| {d['terrain']} | {d['length_m']:.0f} m | {w} | "
            f"{vision['final_m']:.2f} / {vision['median_m']:.2f} | "
            f"{fixes['final_m']:.2f} / {fixes['median_m']:.2f} | "
            f"{', '.join(f'{m:.2f}' for m in fixes['thirds_m'])} | "
            f"{d['fixes'].count('accepted')} of {len(d['fixes'])} |"
        )
    (out / "absolute.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def kept(path: Path, make: Callable[[], Any]) -> Any:
    """What was made before, so that an interrupted benchmark goes on."""
    if not path.exists():
        path.write_text(json.dumps(make()))
    return json.loads(path.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--runs", nargs="*", default=[], type=Path)
    parser.add_argument("--work", type=Path, default=Path("build/absolute"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    work: Path = arguments.work
    work.mkdir(parents=True, exist_ok=True)
    grounds = {folder: drive(folder) for folder in arguments.datasets}
    for folder, ground in grounds.items():
        render_maps(folder, ground, work)
    rows: list[Trial] = []
    for folder, ground in grounds.items():
        strangers = [other.name for other in grounds if other != folder]

        def tried(ground: Ground = ground, strangers: list[str] = strangers) -> list[Any]:
            return [asdict(trial) for trial in trials(ground, work, strangers)]

        rows += [Trial(**t) for t in kept(work / f"{folder.name}_trials.json", tried)]
    drives = [
        kept(work / f"{folder.name}_runs.json", lambda folder=folder: full_runs(folder, work))
        for folder in (*arguments.datasets, *arguments.runs)
    ]
    write(rows, drives, arguments.out)


if __name__ == "__main__":
    main()
