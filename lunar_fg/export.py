"""A run in the formats of other programs: one function a format, found by its name."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType

import numpy as np

from frontends.measurements import AbsoluteFix
from lunar_fg.geo_export import export_geojson, export_geopackage
from lunar_fg.graph.keyframe import Keyframe, floored
from lunar_fg.graph.motions import in_rover_frames
from lunar_fg.log import TraverseLog
from lunar_fg.mcap_export import export_mcap
from lunar_fg.pose_graph import PoseEdge, PoseGraph, g2o_text
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.trajectory_io import euroc_text, kitti_text, tum_text

#: Writes a run to a file (others beside it) and returns all that was written.
Exporter = Callable[[RunFolder, Path], tuple[Path, ...]]


def export_tum(folder: RunFolder, target: Path) -> tuple[Path, ...]:
    """``stamp x y z qx qy qz qw``, ``map_T_rover``."""
    write_whole(target, tum_text(folder.read_trajectory()).encode())
    return (target,)


def export_euroc(folder: RunFolder, target: Path) -> tuple[Path, ...]:
    """EuRoC's ``timestamp [ns], x, y, z, qw, qx, qy, qz``, ``map_T_rover``."""
    write_whole(target, euroc_text(folder.read_trajectory()).encode())
    return (target,)


def export_kitti(folder: RunFolder, target: Path) -> tuple[Path, ...]:
    """KITTI's 3x4 rows of the left camera in the axes of its first pose; times beside it."""
    with TraverseLog.open(folder.database_path) as log:
        mount = log.header().rover_T_camera
    trajectory = folder.read_trajectory()
    write_whole(target, kitti_text(trajectory.of_sensor(mount).from_start()).encode())
    times = target.with_name(f"{target.stem}.times.txt")
    write_whole(times, "".join(f"{stamp:.9f}\n" for stamp in trajectory.stamp_s).encode())
    return target, times


def export_g2o(folder: RunFolder, target: Path) -> tuple[Path, ...]:
    """Pose graph of all keyframes, smoothed poses and measured motions; the rest beside it.

    g2o knows no priors: the start, the tilts, the accepted absolute fixes and the stamps go
    to ``NAME.priors.json``.
    """
    trajectory = folder.read_trajectory()
    with TraverseLog.open(folder.database_path) as log:
        header, keyframes, ledger = log.header(), log.keyframes(), log.ledger()
    edges = [
        edge
        for before, keyframe in pairwise(keyframes)
        for edge in _edges(before.index, keyframe, header.rover_T_camera)
    ]
    count = min(len(trajectory), len(keyframes))
    ids = tuple(keyframe.index for keyframe in keyframes[:count])
    known = set(ids)
    kept = tuple(edge for edge in edges if edge.a in known and edge.b in known)
    graph = PoseGraph(ids, trajectory.map_T_rover[:count], kept, ids[:1])
    write_whole(target, g2o_text(graph).encode())
    priors = {
        "start": {
            "keyframe": ids[0],
            "map_T_rover": header.start.map_T_rover.tolist(),
            "sigma_rot_rad": header.start.sigma_rot_rad,
            "sigma_trans_m": header.start.sigma_trans_m,
        },
        "tilts": [
            {
                "keyframe": keyframe.index,
                "roll_rad": keyframe.tilt.roll_rad,
                "pitch_rad": keyframe.tilt.pitch_rad,
                "sigma_rad": keyframe.tilt.sigma_rad,
            }
            for keyframe in keyframes
            if keyframe.tilt is not None
        ],
        "fixes": [
            {
                "keyframe": entry.frame,
                "x_m": place.x_m,
                "y_m": place.y_m,
                "yaw_rad": place.yaw_rad,
                "covariance": np.asarray(place.covariance).tolist(),
            }
            for entry in ledger
            if isinstance(entry.measurement, AbsoluteFix) and entry.ruling.candidate is not None
            for place in [entry.measurement.candidates[entry.ruling.candidate]]
        ],
        "stamps_s": {str(keyframe.index): keyframe.stamp_s for keyframe in keyframes},
    }
    beside = target.with_name(f"{target.stem}.priors.json")
    write_whole(beside, (json.dumps(priors, indent=1) + "\n").encode())
    return target, beside


def _edges(before: int, keyframe: Keyframe, rover_T_camera: np.ndarray) -> list[PoseEdge]:
    """Motions since the keyframe before: by the images, and independent of them by the wheels."""
    edges = []
    relative, odometry = keyframe.relative, keyframe.odometry
    if odometry is not None:
        edges.append(PoseEdge(before, keyframe.index, odometry.a_T_b, floored(odometry.covariance)))
    if relative is not None and (relative.accepted or odometry is None):
        motion, covariance = in_rover_frames(relative.a_T_b, relative.covariance, rover_T_camera)
        edges.append(PoseEdge(before, keyframe.index, motion, floored(covariance)))
    return edges


#: Every format by its name, with the ending of its files.
EXPORTERS: Mapping[str, tuple[str, Exporter]] = MappingProxyType(
    {
        "tum": ("tum", export_tum),
        "kitti": ("kitti.txt", export_kitti),
        "euroc": ("euroc.csv", export_euroc),
        "g2o": ("g2o", export_g2o),
        "mcap": ("mcap", export_mcap),
        "gpkg": ("gpkg", export_geopackage),
        "geojson": ("geojson", export_geojson),
    }
)
