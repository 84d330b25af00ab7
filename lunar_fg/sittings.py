"""A run that goes on: after an interruption, or in a further sitting of its traverse."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from frontends.errors import InputError
from lunar_fg.datasets.base import Dataset
from lunar_fg.evaluation import Metrics
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import Sitting
from lunar_fg.navigator import Navigator
from lunar_fg.orbital_files import open_orbital
from lunar_fg.route import RouteMonitor
from lunar_fg.run_folder import RunFolder
from lunar_fg.runs import Frame, OnEstimate, config_of, drive
from lunar_fg.trajectory import PositionTrack, Trajectory
from lunar_fg.truth import truth_of

logger = logging.getLogger("lunar_fg.runs")


def resume(
    dataset: Dataset,
    folder: RunFolder,
    on_estimate: OnEstimate | None = None,
    route: RouteMonitor | None = None,
) -> Metrics:
    """Go on with an interrupted run; it ends as it would have without the interruption.

    Parameters
    ----------
    dataset
        The one of the run's last sitting, see `last_sitting`.
    folder, on_estimate, route
        As for `lunar_fg.runs.run`.

    Raises
    ------
    InputError
        As for `lunar_fg.runs.run`; also when there is no log to go on from, another process
        writes it, or the dataset is not the run's.
    """
    with TraverseLog.reopen(folder.database_path) as log:
        navigator = _navigator_of(log, dataset)
        earlier, sitting = log.estimates(), log.sittings()[-1]
        last = earlier[-1].index if earlier else -1
        frames = _shifted(dataset.frames(after=last - sitting.index_offset), sitting)
        return drive(dataset, frames, folder, navigator, earlier, on_estimate, route)


def append(
    dataset: Dataset,
    folder: RunFolder,
    sitting: Sitting,
    gap_s: float | None = None,
    on_estimate: OnEstimate | None = None,
    route: RouteMonitor | None = None,
) -> Metrics:
    """Go on with a run in a further sitting of the same traverse.

    Frame numbers are raised where they do not follow those of the run. Over a gap that is
    long against the time between frames nothing is taken for known of the motion, unless
    the wheels measured it; landmarks are looked for all the same.

    Parameters
    ----------
    dataset
        Of the new sitting: same camera, same place on the rover.
    folder, on_estimate, route
        As for `lunar_fg.runs.run`.
    sitting
        How the dataset was opened.
    gap_s
        Time between the run's last frame and the first of this sitting, where the stamps of
        the two do not tell; None takes the stamps as they are.

    Raises
    ------
    InputError
        As for `resume`; also when the stamps do not follow.
    """
    with TraverseLog.reopen(folder.database_path) as log:
        navigator = _navigator_of(log, dataset)
        earlier = log.estimates()
        frames = dataset.frames()
        first = next(frames, None)
        if first is None or not earlier:
            source = folder.path if first else dataset.path
            raise InputError("has no frame", source=source, remedy="start a run without --append")
        last = earlier[-1]
        stamp_offset_s = 0.0 if gap_s is None else last.stamp_s + gap_s - first.stamp_s
        if first.stamp_s + stamp_offset_s <= last.stamp_s:
            raise InputError(
                f"begins at {first.stamp_s:g} s, the run ends at {last.stamp_s:g} s",
                source=dataset.path,
                field="stamp_s",
                remedy="say with --gap how many seconds lie between the two",
            )
        index_offset = 0 if first.index > last.index else last.index + 1 - first.index
        sitting = replace(sitting, index_offset=index_offset, stamp_offset_s=stamp_offset_s)
        _extend_truth(folder, dataset, stamp_offset_s)
        log.begin(sitting)
        frames = _shifted(chain([first], frames), sitting)
        return drive(dataset, frames, folder, navigator, earlier, on_estimate, route)


def last_sitting(folder: RunFolder) -> Sitting:
    """How the dataset was opened that a run went through last.

    Raises
    ------
    InputError
        The run's log is missing, or does not say.
    """
    with TraverseLog.open(folder.database_path) as log:
        sittings = log.sittings()
    if not sittings:
        raise InputError(
            "does not say which dataset it is of", source=folder.database_path,
            remedy="use `lunar-fg replay`, which needs no images",
        )  # fmt: skip
    return sittings[-1]


def _navigator_of(log: TraverseLog, dataset: Dataset) -> Navigator:
    """Make a navigator that stands where the log ends."""
    header = log.header()
    mount = np.allclose(header.rover_T_camera, dataset.rover_T_camera, rtol=0.0, atol=1e-9)
    if header.camera != dataset.camera or not mount:
        raise InputError(
            "has another camera, or the camera in another place, than the run",
            source=dataset.path,
            field="camera",
            remedy="give the dataset of the run, or start a new run",
        )
    config = config_of(header)
    navigator = Navigator(
        header.camera, config, header.rover_T_camera, header.start, log,
        orbital=open_orbital(dataset, config.map),
    )  # fmt: skip
    sitting = log.sittings()[-1]
    navigator.resume(_shifted(dataset.frames(), sitting))
    return navigator


def _shifted(frames: Iterable[Frame], sitting: Sitting) -> Iterator[Frame]:
    """Frames with numbers and stamps that follow the sitting before."""
    for frame in frames:
        yield replace(
            frame,
            index=frame.index + sitting.index_offset,
            stamp_s=frame.stamp_s + sitting.stamp_offset_s,
        )


def _extend_truth(folder: RunFolder, dataset: Dataset, stamp_offset_s: float) -> None:
    """Add a sitting's truth to the run's, where both are of a kind."""
    before, more = folder.read_truth(), truth_of(dataset.ground_truth)
    if before is None or more is None:
        return
    stamps = np.concatenate([before.stamp_s, more.stamp_s + stamp_offset_s])
    if isinstance(before, Trajectory) and isinstance(more, Trajectory):
        poses = np.concatenate([before.map_T_rover, more.map_T_rover])
        folder.write_truth(Trajectory(stamps, poses))
    elif isinstance(before, PositionTrack) and isinstance(more, PositionTrack):
        columns = min(before.position_m.shape[1], more.position_m.shape[1])
        positions = np.concatenate([t.position_m[:, :columns] for t in (before, more)])
        folder.write_truth(PositionTrack(stamps, positions))
    else:
        logger.warning("the truth of this sitting is of another kind than the run's: left out")
