"""Trials of the absolute-fix benchmark: one patch looked for in one map."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from frontends.absolute import AbsoluteAdjustment, Search, make_patch
from frontends.geometry import pose, so3_exp, yaw_pitch_roll
from frontends.measurements import UnusableFrame
from frontends.orbital import OrbitalMap
from frontends.terrain import DenseStereo, TerrainMap
from lunar_fg.datasets import open_dataset
from lunar_fg.navigator import Navigator

SUN_DIFFERENCES_DEG = (0.0, 45.0, 90.0, 180.0)
GSDS_M = (0.25, 0.5, 1.0)
LENGTHS_M = (10.0, 20.0, 40.0, 60.0)
WINDOW = Search(15.0, 15.0, math.radians(3.0))


@dataclass(frozen=True)
class Ground:
    """What a run without fixes knows of a traverse, and the truth.

    `motions`: covariance of x, y and yaw of the motion from each keyframe to the next.
    """

    name: str
    terrain: TerrainMap
    estimated: dict[int, np.ndarray]
    true: dict[int, np.ndarray]
    motions: dict[int, np.ndarray]
    crs: str
    origin: tuple[float, float, float]


@dataclass(frozen=True)
class Trial:
    """One attempt.

    `found`: the best place is the right one, believed or not. `within_3_sigma`: share of x, y and
    yaw.
    """

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
    within_3_sigma: float
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
    motion = navigator._smoother.motion
    motions = {a: motion(a, b).covariance for a, b in pairwise(index)}
    true = dict(zip(index, dataset.ground_truth.map_T_rover, strict=True))
    reference = dataset.map_reference
    return Ground(folder.name, terrain, estimated, true, motions, reference.crs, reference.origin_m)


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
    motions = [sum(ground.motions[k] for k in range(a, b)) for a, b in pairwise(frames)]
    patch = make_patch(ground.terrain, perturbed(ground, anchor, frames, seed), anchor,
                       adjustment.cell_m, motions)  # fmt: skip
    result = adjustment.locate(patch, anchor, WINDOW)
    cpu = time.process_time() - start
    true, fix = ground.true[anchor], result.fix
    peak = result.proposals[0].peak if result.proposals else None
    limit = max(0.5, orbital.gsd_m)
    found, nees, within, yaw = False, math.nan, math.nan, math.nan
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
        within = float(np.mean(np.abs(off) <= 3.0 * np.sqrt(np.diag(best.covariance))))
    return Trial(ground.name, kind, difference, orbital.gsd_m, length, bool(fix.candidates),
                 found, error, yaw, nees, within, cpu, fix.reason)  # fmt: skip


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

    def opened(name: str, kind: str, gsd: float) -> OrbitalMap:
        path = work / f"{name}_{kind}_{gsd}.tif"
        return OrbitalMap.open(path, crs=ground.crs, origin_m=ground.origin)

    for gsd in GSDS_M:
        maps = {d: opened(ground.name, f"{d:.0f}", gsd) for d in SUN_DIFFERENCES_DEG}
        warped = {d: opened(ground.name, f"{d:.0f}_bent", gsd) for d in SUN_DIFFERENCES_DEG}
        blank = opened(ground.name, "blank", gsd)
        wrong = [opened(name, f"{d:.0f}", gsd) for name in strangers for d in SUN_DIFFERENCES_DEG]
        for length in LENGTHS_M:
            for n, anchor in enumerate(anchors(ground, length)):
                for difference, orbital in maps.items():
                    seed = int(1000 * n + difference)
                    yield attempt(ground, orbital, anchor, length, seed, "right map", difference)
                for difference, orbital in warped.items():
                    seed = int(1000 * n + difference)
                    yield attempt(ground, orbital, anchor, length, seed, "bent map", difference)
                yield attempt(ground, blank, anchor, length, n, "featureless", math.nan)
                for k, orbital in enumerate(wrong):
                    seed = 1000 * n + k
                    yield attempt(ground, orbital, anchor, length, seed, "wrong map", math.nan)
