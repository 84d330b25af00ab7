"""Writing a simulated traverse in the folder format (docs/formats.md)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.measurements import Image, StartPrior
from lunar_fg.simulation.base_relief import BaseRelief
from lunar_fg.simulation.camera import StereoPicture, camera_mount, stereo_camera
from lunar_fg.simulation.orbital import MapFrame, write_geotiff
from lunar_fg.simulation.sensors import AttitudeRows, WheelRows
from lunar_fg.simulation.spec import SimulationSpec
from lunar_fg.simulation.terrain import Extent
from lunar_fg.trajectory_io import tum_line

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

#: Written last: its presence says that the dataset is whole.
SPEC_NAME = "simulation.yaml"


def prepare(folder: Path) -> None:
    """Make the folders of a dataset.

    Raises
    ------
    InputError
        When the folder holds anything, or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file, not a folder", source=folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError("is not empty", source=folder, remedy="name a new or empty folder")
    try:
        for name in ("left", "right", "truth"):
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", source=folder) from error


def check_room(spec: SimulationSpec, land: Extent, near: Extent) -> None:
    """Refuse a base relief that does not hold the drive and its map."""
    room = min(near[0] - land[0], near[1] - land[1], land[2] - near[2], land[3] - near[3])
    if room < 0.0:
        raise InputError(
            f"is too small by {-room:.0f} m for a drive of {spec.path.length_m:.0f} m and its map",
            source=spec.terrain.dem or "terrain",
            remedy="drive less far (--length), or give a smaller map margin",
        )


def write_frames(folder: Path, stamp_s: FloatArray) -> None:
    """Write ``frames.csv``."""
    rows = [f"{k},{t:.6f},left/{k:06d}.png,right/{k:06d}.png" for k, t in enumerate(stamp_s)]
    _write(folder / "frames.csv", ["frame,stamp_s,left,right", *rows])


def write_truth(
    folder: Path, stamp_s: FloatArray, map_T_rover: FloatArray, rover_T_camera: FloatArray
) -> None:
    """Write the true poses of the body, and of the left camera under ``truth/``."""
    body = [tum_line(t, pose) for t, pose in zip(stamp_s, map_T_rover, strict=True)]
    camera = [
        tum_line(t, pose @ rover_T_camera) for t, pose in zip(stamp_s, map_T_rover, strict=True)
    ]
    _write(folder / "ground_truth.tum", body)
    _write(folder / "truth" / "camera.tum", camera)


def write_odometry(folder: Path, wheels: WheelRows) -> None:
    """Write ``odometry.csv``."""
    rows = [
        f"{t:.6f},{forward:.6f},{left:.6f},{yaw:.8f}"
        for t, (forward, left, yaw) in zip(wheels.stamp_s, wheels.increments, strict=True)
    ]
    _write(folder / "odometry.csv", ["stamp_s,d_forward_m,d_lateral_m,d_yaw_rad", *rows])


def write_attitude(folder: Path, attitude: AttitudeRows) -> None:
    """Write ``attitude.csv``."""
    rows = [
        f"{t:.6f},{roll:.8f},{pitch:.8f},{yaw:.8f},{attitude.sigma_rp_rad:.8f},{sigma:.8f}"
        for t, (roll, pitch, yaw), sigma in zip(
            attitude.stamp_s, attitude.angles, attitude.sigma_yaw_rad, strict=True
        )
    ]
    header = "stamp_s,roll_rad,pitch_rad,yaw_rad,sigma_rp_rad,sigma_yaw_rad"
    _write(folder / "attitude.csv", [header, *rows])


def write_traverse(
    folder: Path, spec: SimulationSpec, start: StartPrior, base: BaseRelief | None
) -> None:
    """Write ``traverse.yaml``."""
    camera = stereo_camera(spec.camera)
    crs, origin = _reference(spec, base)
    content = {
        "schema": "lunar-fg/traverse/1",
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "baseline_m": camera.baseline_m,
        },
        "rover_T_camera": camera_mount(spec.camera).tolist(),
        "map": {"crs": crs, "origin": list(origin)},
        "start": {
            "map_T_rover": start.map_T_rover.tolist(),
            "sigma_rot_rad": list(start.sigma_rot_rad),
            "sigma_trans_m": list(start.sigma_trans_m),
        },
        "orbital": {
            "ortho": "orbital/ortho.tif",
            "dem": "orbital/dem.tif",
            "sun_azimuth_deg": spec.orbital.sun.azimuth_deg,
            "sun_elevation_deg": spec.orbital.sun.elevation_deg,
        },
    }
    if spec.later_sun is None:
        content["sun"] = {
            "azimuth_deg": spec.sun.azimuth_deg,
            "elevation_deg": spec.sun.elevation_deg,
        }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
    (folder / "traverse.yaml").write_text(text, encoding="utf-8")


def write_pair(folder: Path, index: int, picture: StereoPicture) -> None:
    """Write the images of one frame, and its depth where there is one."""
    _write_png(folder / "left" / f"{index:06d}.png", picture.left)
    _write_png(folder / "right" / f"{index:06d}.png", picture.right)
    if picture.depth is not None:
        path = folder / "truth" / "depth" / f"{index:06d}.npy"
        path.parent.mkdir(exist_ok=True)
        np.save(path, picture.depth)


def write_map(
    folder: Path,
    spec: SimulationSpec,
    frame: MapFrame,
    ortho: Image,
    dem: Float32,
    base: BaseRelief | None,
) -> None:
    """Write ``ortho.tif`` and ``dem.tif``."""
    folder.mkdir(exist_ok=True)
    crs, origin = _reference(spec, base)
    sun = spec.orbital.sun
    tags = {
        "SUN_AZIMUTH_DEG": f"{sun.azimuth_deg:g}",
        "SUN_ELEVATION_DEG": f"{sun.elevation_deg:g}",
    }
    write_geotiff(folder / "ortho.tif", ortho, frame, crs, origin, tags)
    absolute = (dem + np.float32(origin[2])).astype(np.float32)
    write_geotiff(folder / "dem.tif", absolute, frame, crs, origin, {})


def write_spec(folder: Path, spec: SimulationSpec) -> None:
    """Write what was asked for; last of all files."""
    text = yaml.safe_dump(spec.model_dump(mode="json"), sort_keys=False)
    (folder / SPEC_NAME).write_text(text, encoding="utf-8")


def _reference(
    spec: SimulationSpec, base: BaseRelief | None
) -> tuple[str, tuple[float, float, float]]:
    return (spec.orbital.crs, spec.orbital.origin) if base is None else (base.crs, base.origin)


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_png(path: Path, image: Image) -> None:
    if not cv2.imwrite(str(path), image):
        raise InputError("cannot be written", source=path, remedy="is the disk full?")
