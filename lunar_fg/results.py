"""Everything that a finished run left behind, read once: what reports and exports are made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from frontends.errors import InputError
from frontends.measurements import Estimate
from lunar_fg.frame_table import FrameTable
from lunar_fg.georeference import Georeference
from lunar_fg.graph.ledger import Height, LedgerEntry
from lunar_fg.log import TraverseLog
from lunar_fg.route import PlannedRoute
from lunar_fg.route_file import read_route
from lunar_fg.run_folder import RunFolder
from lunar_fg.run_source import RunSource
from lunar_fg.trajectory import Trajectory, Truth
from lunar_fg.trajectory_io import read_trajectory

T = TypeVar("T")

#: Trajectory by wheels and attitude alone, where the run has one.
DEAD_RECKONING = "dead_reckoning.tum"


@dataclass(frozen=True, slots=True, eq=False)
class RunResults:
    """Results of one run.

    Attributes
    ----------
    folder, name
        Where it lies; name of its dataset, or of the folder.
    trajectory
        Smoothed, with covariances where the run has them.
    estimates
        As each frame left them, before anything later corrected them; from the log.
    dead_reckoning
        By wheels and attitude alone.
    truth
        What the run was compared with.
    source, georeference
        Where images and maps lie; where the map frame lies.
    route
        Planned route.
    ledger
        Every absolute fix and loop closure with all verdicts on it.
    frames
        Counts and times of every frame.
    metrics, config
        As they stand in the run folder.
    notes
        What could not be read, and why.
    """

    folder: RunFolder
    name: str
    trajectory: Trajectory
    estimates: tuple[Estimate, ...]
    dead_reckoning: Trajectory | None
    truth: Truth | None
    source: RunSource | None
    georeference: Georeference | None
    route: PlannedRoute | None
    ledger: tuple[LedgerEntry, ...]
    frames: FrameTable | None
    metrics: dict[str, Any]
    config: dict[str, Any]
    notes: tuple[str, ...]

    @property
    def on_the_way(self) -> Trajectory | None:
        """Trajectory of the estimates as each frame left them."""
        return Trajectory.from_estimates(self.estimates) if self.estimates else None


def read_results(folder: RunFolder) -> RunResults:
    """Read all results of a run; what is missing or damaged becomes a note.

    Raises
    ------
    InputError
        There is no trajectory.
    """
    notes: list[str] = []

    def attempt(read: Callable[[], T], otherwise: T) -> T:
        try:
            return read()
        except InputError as error:
            notes.append(str(error))
            return otherwise

    trajectory = folder.read_trajectory()
    source = attempt(lambda: RunSource.read(folder), None)
    reference = None if source is None else source.map_reference
    georeference = None
    if reference is not None:
        georeference = attempt(lambda: Georeference.of(reference, folder.source_path), None)
    nothing: tuple[tuple[Estimate, ...], tuple[LedgerEntry, ...]] = ((), ())
    estimates, ledger = attempt(lambda: _logged(folder), nothing)
    return RunResults(
        folder=folder,
        name=folder.path.resolve().name if source is None else source.name,
        trajectory=trajectory,
        estimates=estimates,
        dead_reckoning=attempt(lambda: _track(folder, DEAD_RECKONING), None),
        truth=attempt(folder.read_truth, None),
        source=source,
        georeference=georeference,
        route=attempt(lambda: _route(folder, georeference), None),
        ledger=tuple(entry for entry in ledger if not isinstance(entry.measurement, Height)),
        frames=attempt(lambda: FrameTable.read(folder.frames_path), None),
        metrics=attempt(folder.read_metrics, {}),
        config=attempt(folder.read_config, {}),
        notes=tuple(notes),
    )


def _logged(folder: RunFolder) -> tuple[tuple[Estimate, ...], tuple[LedgerEntry, ...]]:
    if not folder.database_path.is_file():
        return (), ()
    with TraverseLog.open(folder.database_path) as log:
        return tuple(log.estimates()), tuple(log.ledger())


def _track(folder: RunFolder, name: str) -> Trajectory | None:
    path = folder.path / name
    return read_trajectory(path) if path.is_file() else None


def _route(folder: RunFolder, georeference: Georeference | None) -> PlannedRoute | None:
    if not folder.route_path.is_file():
        return None
    return read_route(folder.route_path, georeference)
