"""The folder of a run: what a run writes, and how it is found again.

Whole files are written beside their place and then renamed, so a reader sees the old
one or the new one and never half of one. While a run goes on, `lunar_fg.recorder` adds its
estimates one by one.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel

from frontends.errors import InputError
from lunar_fg.arrays import DAMAGED
from lunar_fg.bounded import check_size
from lunar_fg.evaluation.metrics import Metrics
from lunar_fg.trajectory import Trajectory, Truth
from lunar_fg.trajectory_io import (
    kitti_text,
    position_text,
    read_track,
    read_trajectory,
    tum_text,
)

FloatArray = NDArray[np.float64]

#: First line of ``config.yaml``: a folder with it is a run's, and may be overwritten.
MARK = "# lunar-fg run"

_FILES = (
    "config.yaml",
    "trajectory.tum",
    "trajectory.kitti",
    "covariance.npz",
    "dead_reckoning.tum",
    "dead_reckoning.npz",
    "metrics.json",
    "run.log",
)
#: Files that later steps put into a run's folder; overwriting the run removes them too.
_LATER_FILES = (
    "run.db",
    "run.db-wal",
    "run.db-shm",
    "ground_truth.tum",
    "ground_truth_position.csv",
    "source.json",
    "frames.csv",
    "route.geojson",
    "route.csv",
    "run.rrd",
    "export.gpkg",
    "export.geojson",
    "report.html",
)
_PICTURES = ("*.png", "*.svg", "*.pdf")


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths, writers and readers of one run's folder.

    Make one with `create` or `open`.
    """

    path: Path

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: BaseModel | Mapping[str, Any],
        *,
        overwrite: bool = False,
    ) -> RunFolder:
        """Make the folder of a new run and write its effective configuration.

        Parameters
        ----------
        path
            A folder that does not exist yet, is empty, or (with `overwrite`) holds an
            earlier run.
        config
            Effective configuration; it must dump to plain YAML values.
        overwrite
            Remove the files of the earlier run. Files that no run writes are kept.

        Raises
        ------
        InputError
            When the place is taken. Nothing has been touched then.
        """
        folder = cls(Path(path))
        folder._claim(overwrite)
        values = config.model_dump(mode="json") if isinstance(config, BaseModel) else dict(config)
        text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
        write_whole(folder.config_path, f"{MARK}\n{text}".encode())
        return folder

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Find the folder of an earlier run.

        Raises
        ------
        InputError
            When there is none.
        """
        folder = cls(Path(path))
        if not folder.path.is_dir():
            raise InputError("no such folder", source=path)
        if not folder._is_run():
            raise InputError(
                "is not the folder of a run: no config.yaml of lunar-fg",
                source=path,
                remedy="give the folder that `lunar-fg run -o` wrote",
            )
        return folder

    @property
    def config_path(self) -> Path:
        """Effective configuration."""
        return self.path / "config.yaml"

    @property
    def tum_path(self) -> Path:
        """``map_T_rover`` with stamps."""
        return self.path / "trajectory.tum"

    @property
    def kitti_path(self) -> Path:
        """Poses as KITTI rows, see `write_trajectory`."""
        return self.path / "trajectory.kitti"

    @property
    def covariance_path(self) -> Path:
        """Arrays ``stamp_s`` (N,) and ``covariance`` (N, 6, 6)."""
        return self.path / "covariance.npz"

    @property
    def dead_reckoning_path(self) -> Path:
        """``map_T_rover`` by wheels and attitude alone; covariances in the ``.npz`` beside it."""
        return self.path / "dead_reckoning.tum"

    @property
    def metrics_path(self) -> Path:
        """Figures, see `lunar_fg.evaluation.metrics`."""
        return self.path / "metrics.json"

    @property
    def log_path(self) -> Path:
        """Text log of the run; the caller's logging writes it."""
        return self.path / "run.log"

    @property
    def database_path(self) -> Path:
        """Log of every measurement, see `lunar_fg.log`."""
        return self.path / "run.db"

    @property
    def source_path(self) -> Path:
        """What the run was made from, see `lunar_fg.run_source`."""
        return self.path / "source.json"

    @property
    def frames_path(self) -> Path:
        """Counts and times of every frame, see `lunar_fg.frame_table`."""
        return self.path / "frames.csv"

    @property
    def route_path(self) -> Path:
        """Planned route that the run was watched against."""
        return self.path / "route.geojson"

    @property
    def plots_path(self) -> Path:
        """Folder of the pictures."""
        return self.path / "plots"

    @property
    def fixes_path(self) -> Path:
        """Folder of the pictures of absolute fixes, see `lunar_fg.fix_pictures`."""
        return self.path / "fixes"

    def write_trajectory(
        self, trajectory: Trajectory, *, rover_T_camera: FloatArray | None = None
    ) -> None:
        """Write ``trajectory.tum``, ``covariance.npz`` and ``trajectory.kitti``.

        Parameters
        ----------
        trajectory
            ``map_T_rover``.
        rover_T_camera
            When given, the KITTI file holds the camera's poses in the frame of its first
            one, as the KITTI benchmark wants them; otherwise ``map_T_rover``.
        """
        write_whole(self.tum_path, tum_text(trajectory).encode())
        _write_covariance(self.covariance_path, trajectory)
        if rover_T_camera is not None:
            trajectory = trajectory.of_sensor(rover_T_camera).from_start()
        write_whole(self.kitti_path, kitti_text(trajectory).encode())

    def read_trajectory(self) -> Trajectory:
        """Read the trajectory, with covariances where all its poses have one."""
        return _with_covariance(read_trajectory(self.tum_path), self.covariance_path)

    def write_dead_reckoning(self, trajectory: Trajectory) -> None:
        """Write ``dead_reckoning.tum`` and its covariances."""
        write_whole(self.dead_reckoning_path, tum_text(trajectory).encode())
        _write_covariance(self.dead_reckoning_path.with_suffix(".npz"), trajectory)

    def read_dead_reckoning(self) -> Trajectory | None:
        """Read the drive by wheels and attitude alone, where there is one."""
        path = self.dead_reckoning_path
        if not path.is_file():
            return None
        return _with_covariance(read_trajectory(path), path.with_suffix(".npz"))

    def write_truth(self, truth: Truth) -> None:
        """Keep the truth that the run is compared with beside its results."""
        if isinstance(truth, Trajectory):
            write_whole(self.path / "ground_truth.tum", tum_text(truth).encode())
        else:
            write_whole(self.path / "ground_truth_position.csv", position_text(truth).encode())

    def read_truth(self) -> Truth | None:
        """Read the truth that the run was compared with, where there was one."""
        for name in ("ground_truth.tum", "ground_truth_position.csv"):
            if (self.path / name).is_file():
                return read_track(self.path / name)
        return None

    def write_metrics(self, metrics: Metrics) -> None:
        """Write ``metrics.json``."""
        write_whole(self.metrics_path, metrics.to_json().encode())

    def read_metrics(self) -> dict[str, Any]:
        """Read ``metrics.json`` as it stands."""
        return _read(self.metrics_path, json.loads)

    def read_config(self) -> dict[str, Any]:
        """Read the effective configuration."""
        return _read(self.config_path, yaml.safe_load)

    def _is_run(self) -> bool:
        try:
            with self.config_path.open(encoding="utf-8") as file:
                return file.readline().startswith(MARK)
        except (OSError, UnicodeDecodeError):
            return False

    def _claim(self, overwrite: bool) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise InputError("is a file, not a folder", source=self.path)
        taken = self.path.is_dir() and any(self.path.iterdir())
        if taken and not self._is_run():
            raise InputError(
                "holds files that are not a run's; they are left alone",
                source=self.path,
                remedy="name a new or empty folder",
            )
        if taken and not overwrite:
            raise InputError(
                "holds an earlier run",
                source=self.path,
                remedy="name another folder, or replace that run with --overwrite",
            )
        try:
            # The mark goes last: an interrupted clean-up leaves a folder still known as a run's.
            stale = [self.path / name for name in (*_FILES[1:], *_LATER_FILES)]
            stale += [file for kind in _PICTURES for file in self.plots_path.glob(kind)]
            stale += self.fixes_path.glob("fix_*.jpg")
            stale += self.path.glob(".*.tmp")
            for file in stale:
                file.unlink(missing_ok=True)
            self.plots_path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", source=self.path) from error


def _write_covariance(path: Path, trajectory: Trajectory) -> None:
    if trajectory.covariance is None:
        path.unlink(missing_ok=True)
        return
    buffer = io.BytesIO()
    np.savez(buffer, stamp_s=trajectory.stamp_s, covariance=trajectory.covariance)
    write_whole(path, buffer.getvalue())


def _with_covariance(trajectory: Trajectory, path: Path) -> Trajectory:
    if not path.is_file():
        return trajectory
    try:
        with np.load(path, allow_pickle=False) as arrays:
            stamps, covariance = arrays["stamp_s"], arrays["covariance"]
    except DAMAGED as error:
        problem = "is not an archive of stamp_s and covariance"
        raise InputError(problem, source=path) from error
    if len(stamps) != len(trajectory) or not np.allclose(
        stamps, trajectory.stamp_s, rtol=0.0, atol=1e-6
    ):
        return trajectory
    return Trajectory(stamps, trajectory.map_T_rover, covariance)


def write_whole(path: Path, content: bytes) -> None:
    """Write a whole file so that it is never seen half-written."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        beside.write_bytes(content)
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InputError(f"cannot be written: {error.strerror}", source=path) from error


def _read(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    check_size(path)
    try:
        return dict(parse(path.read_text(encoding="utf-8")) or {})
    except (OSError, ValueError, yaml.YAMLError) as error:
        problem = f"cannot be read: {' '.join(str(error).split())}"
        raise InputError(problem, source=path) from error
