"""The simulator against real planetary images, its cost, and odometry over longer steps.

    python benchmarks/simulation.py --shared ../shared/data --json out.json --sheet sheet.png

Parts: ``time`` (CPU of a stereo pair by image size), ``features`` (SURF on simulated and
real images, side by side), ``steps`` (odometry over 0.75, 1.5 and 3 m), ``sheet`` (frames
and orbital images under three suns). Rendered datasets are kept in the user's cache folder.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.measurements import Image, StereoFrame
from frontends.stereo import StereoPerception
from lunar_fg import runs
from lunar_fg.config import Config
from lunar_fg.datasets import open_dataset
from lunar_fg.match import MatchModel, match_images
from lunar_fg.run_folder import RunFolder
from lunar_fg.simulation.cache import cached_dataset
from lunar_fg.simulation.camera import camera_mount, take_pair
from lunar_fg.simulation.orbital import as_photograph, look_down
from lunar_fg.simulation.simulate import build_world
from lunar_fg.simulation.spec import (
    CameraSpec,
    OrbitalSpec,
    PathSpec,
    SimulationSpec,
    SunSpec,
)

#: Images are compared at this width.
WIDTH = 512
SUNS = (
    SunSpec(azimuth_deg=150.0, elevation_deg=8.0),
    SunSpec(azimuth_deg=60.0, elevation_deg=20.0),
    SunSpec(azimuth_deg=250.0, elevation_deg=50.0),
)
STEPS_M = (0.75, 1.5, 3.0)


@dataclass(frozen=True, slots=True)
class Statistics:
    """SURF on image pairs, medians over the pairs.

    ``share`` is inliers over matches; ``error_px`` the distance from the epipolar line;
    ``dense_px`` the median difference between the disparity of SURF's inliers and that of
    semi-global matching; ``truth_px`` the same against rendered depth.
    """

    pairs: int
    keypoints: float
    matches: float
    inliers: float
    share: float
    error_px: float
    dense_px: float | None = None
    truth_px: float | None = None


def grey(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"{path} cannot be read")
    scale = WIDTH / image.shape[1]
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def dense_disparity(left: Image, right: Image) -> NDArray[np.float32]:
    matcher = cv2.StereoSGBM_create(
        -16, 144, 7, 8 * 49, 32 * 49, disp12MaxDiff=1, uniquenessRatio=10
    )
    disparity = matcher.compute(left, right).astype(np.float32) / 16.0
    disparity[disparity <= -16.0] = np.nan
    return disparity


def compare(
    pairs: Iterable[tuple[Image, Image]],
    depth_to_disparity: list[NDArray[np.float64]] | None,
    *,
    stereo: bool,
) -> Statistics:
    rows, dense, truth = [], [], []
    for k, (first, second) in enumerate(pairs):
        result = match_images(first, second, MatchModel.FUNDAMENTAL)
        found = 0.0 if result.matches == 0 else result.inliers / result.matches
        rows.append(
            (np.mean(result.keypoints), result.matches, result.inliers, found, result.error_px)
        )
        if stereo and result.inliers:
            u, v = np.rint(result.first_xy).astype(int).T
            disparity = result.first_xy[:, 0] - result.second_xy[:, 0]
            dense += list(np.abs(disparity - dense_disparity(first, second)[v, u]))
            if depth_to_disparity is not None:
                truth += list(np.abs(disparity - depth_to_disparity[k][v, u]))
    keypoints, matches, inliers, share, error = np.nanmedian(np.array(rows, dtype=float), axis=0)
    return Statistics(
        len(rows),
        float(keypoints),
        float(matches),
        float(inliers),
        float(share),
        float(error),
        float(np.nanmedian(dense)) if dense else None,
        float(np.nanmedian(truth)) if truth else None,
    )


def real_pairs(data: Path) -> Iterator[tuple[str, list[tuple[Image, Image]], bool]]:
    run1 = data / "moonranger-run1"
    names = sorted(path.name for path in (run1 / "left").iterdir())
    stereo = [(grey(run1 / "left" / n), grey(run1 / "right" / n)) for n in names[::16]]
    yield "real: MoonRanger analogue, stereo", stereo, True
    follow = [
        (grey(run1 / "left" / a), grey(run1 / "left" / b))
        for a, b in zip(names[0:-1:16], names[1::16], strict=False)
    ]
    yield "real: MoonRanger analogue, next frame", follow, False
    msl = sorted((data / "msl-navcam-pair").glob("*.jpeg"))
    yield "real: Curiosity Navcam, stereo (raw)", [(grey(msl[0]), grey(msl[1]))], False
    k10 = data / "k10-stereo"
    yield "real: K10, stereo (raw)", [(grey(k10 / "left4.png"), grey(k10 / "right4.png"))], False
    apollo = sorted((data / "apollo17-surface" / "half-1170").glob("*.png"))
    follow = [(grey(a), grey(b)) for a, b in pairwise(apollo)]
    yield "real: Apollo 17, next photograph", follow, False


def feature_table(data: Path, simulated: list[Path]) -> dict[str, Statistics]:
    table = {}
    for name, pairs, stereo in real_pairs(data):
        table[name] = compare(pairs, None, stereo=stereo)
    for path in simulated:
        dataset = open_dataset(path)
        elevation = next(iter(dataset.frames())).sun
        frames = [f for f in dataset.frames() if isinstance(f, StereoFrame)]
        camera = dataset.camera
        depths = [np.load(path / "truth" / "depth" / f"{f.index:06d}.npy") for f in frames]
        true = [camera.fx * camera.baseline_m / depth.astype(np.float64) for depth in depths]
        label = f"simulated, sun {elevation.elevation_deg:g} deg" if elevation else "simulated"
        table[f"{label}, stereo"] = compare(
            [(f.left, f.right) for f in frames[::4]], true[::4], stereo=True
        )
        for skip in (1, 2):
            follow = [(a.left, b.left) for a, b in zip(frames[::4], frames[skip::4], strict=False)]
            step = 0.75 * skip
            table[f"{label}, next frame {step:g} m on"] = compare(follow, None, stereo=False)
    return table


def landmark_errors(path: Path) -> dict[str, float]:
    """Disparity of the navigator's own landmarks against rendered depth."""
    dataset = open_dataset(path)
    camera = dataset.camera
    perception = StereoPerception(camera)
    errors, scaled, rows = [], [], []
    for frame in dataset.frames():
        if not isinstance(frame, StereoFrame):
            continue
        seen = perception.perceive(frame).observations
        depth = np.load(path / "truth" / "depth" / f"{frame.index:06d}.npy").astype(np.float64)
        depth = cv2.remap(
            depth, seen.u_left.astype(np.float32), seen.v.astype(np.float32), cv2.INTER_LINEAR
        ).ravel()
        error = seen.disparity_px - camera.fx * camera.baseline_m / depth
        errors += list(error)
        scaled += list(error / seen.sigma_disparity_px)
        rows.append(len(seen))
    error, share = np.array(errors), np.array(scaled)
    known = np.isfinite(error)
    return {
        "landmarks": float(np.median(rows)),
        "median_px": float(np.median(error[known])),
        "sigma_px": float(1.4826 * np.median(np.abs(error[known]))),
        "beyond_1px": float(np.mean(np.abs(error[known]) > 1.0)),
        "scaled_sigma": float(1.4826 * np.median(np.abs(share[known]))),
    }


def time_table(repeats: int) -> dict[int, dict[str, float]]:
    """CPU and wall seconds of a stereo pair with shadows, in one process."""
    spec = SimulationSpec(path=PathSpec(length_m=20.0), orbital=OrbitalSpec(margin_m=30.0))
    world = build_world(spec)
    poses = world.map_T_rover() @ camera_mount(spec.camera)
    cpu: dict[int, list[tuple[float, float]]] = {512: [], 768: [], 1024: []}
    for k in range(repeats):
        for size, times in cpu.items():
            camera = CameraSpec(width=size, height=size)
            start, wall = time.process_time(), time.perf_counter()
            pose = poses[k % len(poses)]
            take_pair(world.scene, pose, camera, spec.sun.direction(), np.random.default_rng(0))
            times.append((time.process_time() - start, time.perf_counter() - wall))
    return {
        size: dict(zip(("cpu_s", "wall_s"), map(float, np.median(times, axis=0)), strict=True))
        for size, times in cpu.items()
    }


def step_table(path: Path) -> dict[str, dict[str, float | None]]:
    """Odometry over every, every second and every fourth pair of a traverse."""
    with (path / "frames.csv").open() as file:
        header, *rows = csv.reader(file)
    results: dict[str, dict[str, float | None]] = {}
    for skip, step in zip((1, 2, 4), STEPS_M, strict=True):
        for wheels in (False, True):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                names = ["traverse.yaml", "ground_truth.tum", "left", "right", "orbital"]
                names += ["odometry.csv", "attitude.csv"] if wheels else []
                for file_name in names:
                    (folder / file_name).symlink_to((path / file_name).resolve())
                lines = [",".join(row) for row in (header, *rows[::skip])]
                (folder / "frames.csv").write_text("\n".join(lines) + "\n")
                run = RunFolder.create(folder / "run", Config())
                metrics = runs.run(open_dataset(folder), run)
            label = f"{step:g} m, " + ("with wheels and attitude" if wheels else "images alone")
            results[label] = {
                "pairs": metrics.frames - 1,
                "found_share": 1.0 - metrics.frames_lost / (metrics.frames - 1),
                "drift_percent": metrics.kitti.translation_percent,
                "rpe_m": metrics.rpe.translation_m,
                "rpe_deg": metrics.rpe.rotation_deg,
                "final_error_m": metrics.final_error_m,
                "nees": metrics.nees.mean,
            }
    return results


def contact_sheet(seed: int) -> NDArray[np.uint8]:
    """Frames of one drive and the orbital image, a row a sun."""
    spec = SimulationSpec(
        seed=seed, path=PathSpec(length_m=30.0), orbital=OrbitalSpec(margin_m=45.0)
    )
    rows = []
    for sun in SUNS:
        lit = spec.model_copy(update={"sun": sun})
        world = build_world(lit)
        poses = world.map_T_rover() @ camera_mount(spec.camera)
        row = []
        for k in (2, 10, 18):
            rng = np.random.default_rng(k)
            row.append(take_pair(world.scene, poses[k], spec.camera, sun.direction(), rng).left)
        orbital = spec.orbital.model_copy(update={"sun": sun})
        radiance = look_down(world.scene, world.map_frame, orbital, spec.camera.fill_light)
        ortho = as_photograph(radiance, orbital, np.random.default_rng(0))
        row.append(np.asarray(cv2.resize(ortho, (512, 512), interpolation=cv2.INTER_AREA)))
        rows.append(np.hstack(row))
    return np.vstack(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"))
    parser.add_argument("--parts", default="time,features,steps,sheet")
    parser.add_argument("--length", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--sheet", type=Path, default=Path("sheet.png"))
    arguments = parser.parse_args()
    parts = arguments.parts.split(",")
    results: dict[str, object] = {}
    if "sheet" in parts:
        cv2.imwrite(str(arguments.sheet), contact_sheet(arguments.seed))
    if "time" in parts:
        results["time"] = time_table(3)
    if "features" in parts or "steps" in parts:
        spec = SimulationSpec(
            seed=arguments.seed,
            path=PathSpec(length_m=arguments.length, step_m=STEPS_M[0]),
            orbital=OrbitalSpec(margin_m=30.0, wrong_map=False),
            depth=True,
        )
        path = cached_dataset(spec)
        if "features" in parts:
            results["landmarks"] = landmark_errors(path)
            table = feature_table(arguments.shared, [path])
            results["features"] = {name: asdict(row) for name, row in table.items()}
        if "steps" in parts:
            results["steps"] = step_table(path)
    text = json.dumps(results, indent=2)
    print(text)
    if arguments.json is not None:
        arguments.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
