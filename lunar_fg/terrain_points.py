"""What a run's stereo pairs saw of the ground, measured once and kept in its folder.

The points of each keyframe stay in the rover's axes of that keyframe, so they outlive every
correction of the trajectory: maps are made of them and the poses as they stand.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frontends.errors import InputError
from frontends.measurements import FloatArray, StereoFrame
from frontends.rectification import RectificationError
from frontends.terrain import DenseStereo, SurfacePoints
from lunar_fg.arrays import DAMAGED
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.base import Dataset
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import Sitting
from lunar_fg.results import RunResults
from lunar_fg.run_folder import write_whole

#: File of a run folder's ``map`` that keeps the points.
POINTS = "points.npz"
_LAYERS = ("points", "sigma_m", "grey", "count")


def measure_points(
    results: RunResults, spacing_m: float, on_frame: Callable[[], None] | None = None
) -> list[SurfacePoints]:
    """Measure the ground by dense stereo, a keyframe every `spacing_m` of the way.

    Parameters
    ----------
    results
        Of a run whose images are still where they were.
    spacing_m
        Distance between keyframes that are looked at.
    on_frame
        Called for each frame read, e.g. for a progress bar.

    Raises
    ------
    InputError
        The run has no log, or its images are gone.
    """
    with TraverseLog.open(results.folder.database_path) as log:
        header, sittings, kept = log.header(), log.sittings(), log.checkpoint()
    rectification = RectificationError() if kept is None else kept[1].rectification
    dense = DenseStereo(header.camera, header.rover_T_camera)
    wanted = _spaced(results, spacing_m)
    found = []
    for sitting in sittings:
        calibration = [Path(path) for path in sitting.calibration]
        dataset = open_dataset(sitting.dataset, sitting.images, sitting.traverse, calibration)
        for frame in _frames(dataset, sitting):
            if on_frame is not None:
                on_frame()
            if frame.index in wanted:
                found.append(dense.measure(frame, rectification))
    return found


def write_points(path: Path, points: list[SurfacePoints]) -> None:
    """Keep the points as a NumPy archive."""
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(item, name) for item in points]) for name in _LAYERS
    }
    frames = np.array([item.frame for item in points], dtype=np.int64)
    lengths = np.array([len(item) for item in points], dtype=np.int64)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, frame=frames, length=lengths, **arrays)
    write_whole(path, buffer.getvalue())


def read_points(path: Path) -> list[SurfacePoints]:
    """Read what `write_points` wrote.

    Raises
    ------
    InputError
        The file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            ends = np.cumsum(arrays["length"])[:-1]
            layers = [np.split(arrays[name], ends) for name in _LAYERS]
            frames = arrays["frame"].tolist()
        points = [SurfacePoints(frame, *p) for frame, *p in zip(frames, *layers, strict=True)]
    except DAMAGED as error:
        raise InputError(
            "cannot be read", source=path, remedy="measure anew with --measure"
        ) from error
    return points


def poses_by_frame(results: RunResults) -> dict[int, FloatArray]:
    """Smoothed pose (4, 4) of every frame by its number."""
    rows = {round(1e6 * stamp): row for row, stamp in enumerate(results.trajectory.stamp_s)}
    return {
        estimate.index: results.trajectory.map_T_rover[rows[round(1e6 * estimate.stamp_s)]]
        for estimate in results.estimates
        if round(1e6 * estimate.stamp_s) in rows
    }


def _spaced(results: RunResults, spacing_m: float) -> set[int]:
    """Frames that lie at least `spacing_m` apart; those whose motion was lost are left out."""
    lost = {estimate.index for estimate in results.estimates if estimate.lost}
    chosen: set[int] = set()
    last = None
    for frame, pose in poses_by_frame(results).items():
        if frame in lost:
            continue
        if last is None or np.linalg.norm(pose[:3, 3] - last) >= spacing_m:
            chosen.add(frame)
            last = pose[:3, 3]
    return chosen


def _frames(dataset: Dataset, sitting: Sitting) -> Iterator[StereoFrame]:
    for frame in dataset.frames():
        if isinstance(frame, StereoFrame):
            yield replace(frame, index=frame.index + sitting.index_offset)
