"""Estimates of a run on disk as they come: what was computed survives an aborted run."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.measurements import Estimate
from lunar_fg.run_folder import RunFolder
from lunar_fg.trajectory import Trajectory
from lunar_fg.trajectory_io import tum_line

FloatArray = NDArray[np.float64]

#: Frames between two rewrites of the covariances while a run goes on.
SAVE_EVERY = 50

logger = logging.getLogger("lunar_fg.recorder")


class EstimateRecorder:
    """Keeps every estimate of a run on disk; for a ``with`` statement.

    Each estimate is a line of ``trajectory.tum`` at once; covariances and the KITTI file
    follow every `SAVE_EVERY` frames and when the ``with`` block ends, also by an exception.

    Parameters
    ----------
    folder
        Of the run.
    rover_T_camera
        For the KITTI file, see `RunFolder.write_trajectory`.
    earlier
        Estimates of the run before it was interrupted; they are written first.
    """

    def __init__(
        self,
        folder: RunFolder,
        rover_T_camera: FloatArray | None = None,
        earlier: Sequence[Estimate] = (),
    ) -> None:
        self._folder = folder
        self._rover_T_camera = rover_T_camera
        self._estimates: list[Estimate] = list(earlier)

    def __enter__(self) -> Self:
        """Start recording."""
        if self._estimates:
            self._save()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Write everything recorded, whether the block ended well or not."""
        if not self._estimates:
            return
        try:
            self._save()
        except InputError as failure:
            if error is None:
                raise
            logger.error("%s", failure)  # the first error is the one to report

    def record(self, estimate: Estimate) -> None:
        """Keep one estimate.

        Raises
        ------
        InputError
            When the folder cannot be written any more.
        """
        self._estimates.append(estimate)
        path = self._folder.tum_path
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(tum_line(estimate.stamp_s, estimate.map_T_rover) + "\n")
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", source=path) from error
        if len(self._estimates) % SAVE_EVERY == 0:
            self._save()

    def trajectory(self) -> Trajectory:
        """Trajectory of all estimates so far."""
        return Trajectory.from_estimates(self._estimates)

    def _save(self) -> None:
        self._folder.write_trajectory(self.trajectory(), rover_T_camera=self._rover_T_camera)
