"""A whole run: dataset in, run folder out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from pydantic import ValidationError

from frontends.errors import InputError, LunarFgError
from frontends.measurements import Estimate, StereoFrame, UnusableFrame
from lunar_fg.conclusion import conclude
from lunar_fg.config import Config
from lunar_fg.datasets.base import Dataset
from lunar_fg.evaluation import Metrics
from lunar_fg.fix_pictures import FixPictures
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader, Sitting
from lunar_fg.navigator import Navigator
from lunar_fg.orbital_files import open_orbital
from lunar_fg.order import InOrder
from lunar_fg.recorder import EstimateRecorder
from lunar_fg.route import RouteMonitor
from lunar_fg.run_folder import RunFolder
from lunar_fg.truth import truth_of

logger = logging.getLogger("lunar_fg.runs")

Frame = StereoFrame | UnusableFrame
OnEstimate = Callable[[Estimate], None]


class Watcher(Protocol):
    """Sees every frame of a run with what came of it."""

    def observe(self, frame: Frame, navigator: Navigator, estimate: Estimate) -> None:
        """Take in one frame, after the navigator."""
        ...


def run(
    dataset: Dataset,
    folder: RunFolder,
    config: Config | None = None,
    on_estimate: OnEstimate | None = None,
    route: RouteMonitor | None = None,
    sitting: Sitting | None = None,
    watcher: Watcher | None = None,
) -> Metrics:
    """Navigate through a dataset and write the run folder.

    Whatever ends the run early, the frames before it are written first.

    Parameters
    ----------
    dataset
        From `lunar_fg.datasets.open_dataset`.
    folder
        A new run folder.
    config
        Settings.
    on_estimate
        Called with each frame's estimate, e.g. for a progress bar.
    route
        Watches the estimates against a planned route.
    sitting
        How the dataset was opened, for `resume`; by its path alone where not given.
    watcher
        Sees every frame with what came of it, e.g. a live view.

    Returns
    -------
    Metrics
        As written to ``metrics.json``.

    Raises
    ------
    InputError
        When the dataset cannot be used from some frame on, or none of its frames can.
    """
    config = config or Config()
    truth = truth_of(dataset.ground_truth)
    if truth is not None:
        folder.write_truth(truth)
    header = RunHeader(
        dataset.camera, dataset.rover_T_camera, dataset.start, config.model_dump_json()
    )
    with TraverseLog.create(folder.database_path, header) as log:
        log.begin(sitting or Sitting(str(dataset.path.resolve())))
        navigator = Navigator(
            dataset.camera, config, dataset.rover_T_camera, dataset.start, log,
            orbital=open_orbital(dataset, config.map),
        )  # fmt: skip
        return drive(dataset, dataset.frames(), folder, navigator, (), on_estimate, route, watcher)


def settings_of(folder: RunFolder) -> Config:
    """Settings that a run was made with, from its log."""
    with TraverseLog.open(folder.database_path) as log:
        return config_of(log.header())


def config_of(header: RunHeader) -> Config:
    """Settings that a run was made with.

    Raises
    ------
    InputError
        They are none of this program's.
    """
    try:
        return Config.model_validate_json(header.config_json)
    except ValidationError as error:
        problem = f"holds settings that this program does not know: {error.errors()[0]['msg']}"
        raise InputError(problem, source="log", field="config") from error


def drive(
    dataset: Dataset,
    frames: Iterable[Frame],
    folder: RunFolder,
    navigator: Navigator,
    earlier: Sequence[Estimate],
    on_estimate: OnEstimate | None,
    route: RouteMonitor | None = None,
    watcher: Watcher | None = None,
) -> Metrics:
    """Take the frames through the navigator, and write all whatever happens."""
    if route is not None:
        for estimate in earlier:
            route.observe(estimate)
    if navigator.localisation is not None:
        navigator.localisation.on_attempt = FixPictures(folder.fixes_path).draw
    in_order = InOrder(frames)
    try:
        with EstimateRecorder(folder, navigator.rover_T_camera, earlier) as recorder:
            for frame in in_order:
                estimate = navigator.step(frame)
                recorder.record(estimate)
                if route is not None:
                    route.observe(estimate)
                if watcher is not None:
                    watcher.observe(frame, navigator, estimate)
                if on_estimate is not None:
                    on_estimate(estimate)
    except LunarFgError as error:
        logger.error("stopped after %d frames: %s", len(navigator.reports), error)
        if navigator.reports:
            try:
                reason = (f"stopped early: {error}", *in_order.warnings)
                conclude(dataset, folder, navigator, reason, route)
            except (LunarFgError, OSError) as second:
                logger.error("and the results could not be written whole: %s", second)
        raise
    if not navigator.reports:
        raise InputError("has no frame", source=dataset.path, remedy="give images")
    metrics = conclude(dataset, folder, navigator, in_order.warnings, route)
    if navigator.frames_usable == 0:
        raise InputError(
            "none of its frames could be used",
            source=dataset.path,
            remedy="run.log names the reason for each",
        )
    return metrics
