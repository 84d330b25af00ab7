"""When to ask the orbital map where the rover is, and with which ground."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray

from frontends.absolute import (
    AbsoluteAdjustment,
    AbsoluteConfig,
    Adjustment,
    Search,
    locate_everywhere,
    make_patch,
)
from frontends.camera import StereoCamera
from frontends.errors import EstimationError
from frontends.measurements import (
    AbsoluteFix,
    FixCandidate,
    StereoFrame,
    StereoObservations,
    UnusableFrame,
    Verdict,
)
from frontends.orbital import OrbitalMap
from frontends.rectification import RectificationError
from frontends.terrain import DenseStereo, DenseStereoConfig, TerrainMap
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.ledger import FixDecision, LedgerEntry
from lunar_fg.log_entries import LoggedFrame
from lunar_fg.motion_config import MotionConfig
from lunar_fg.plausibility import was_carried

logger = logging.getLogger("lunar_fg.localisation")

FloatArray = NDArray[np.float64]

#: Half width of the search window, in sigmas of the prediction.
_WINDOW_SIGMAS = 3.4
#: Fewer attempts say nothing of the map.
_FEW_ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class LocalisationConfig:
    """When fixes are tried.

    Attributes
    ----------
    mapping_step_m
        Ground is measured by dense stereo so often along the drive.
    most_sigma_m
        A predicted position less certain than this is fixed with half as much ground.
    most_window_m
        Largest half width of the search; a rover less certain is lost, and `lunar-fg
        locate --everywhere` looks for it.
    least_window_m, least_window_deg
        Least half widths of the search: what the map's own placement may be wrong by.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    mapping_step_m: Annotated[float, Gt(0)] = 0.8
    most_sigma_m: Annotated[float, Gt(0)] = 2.0
    most_window_m: Annotated[float, Gt(0)] = 80.0
    least_window_m: Annotated[float, Gt(0)] = 3.0
    least_window_deg: Annotated[float, Gt(0)] = 2.0


@dataclass(frozen=True, slots=True)
class _Station:
    """A keyframe whose ground is mapped, and how far the rover had driven."""

    frame: int
    driven_m: float


class Localisation:
    """Maps the ground along the drive and proposes absolute fixes of it.

    Every keyframe's ground is used for one fix only: fixes are independent measurements.
    A refused attempt is repeated with more ground and the trajectory as it is by then.

    Parameters
    ----------
    camera, rover_T_camera
        The rectified pair and its place in the rover.
    orbital
        The map.
    config, absolute, dense, motion
        Settings.

    Attributes
    ----------
    on_attempt
        Called with each attempt, e.g. to draw it; attempts are not kept.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        orbital: OrbitalMap,
        config: LocalisationConfig | None = None,
        absolute: AbsoluteConfig | None = None,
        dense: DenseStereoConfig | None = None,
        motion: MotionConfig | None = None,
    ) -> None:
        self.config = config or LocalisationConfig()
        self._motion = motion or MotionConfig()
        self.terrain = TerrainMap()
        self.on_attempt: Callable[[Adjustment], None] | None = None
        self.adjustment = AbsoluteAdjustment(orbital, absolute)
        self._camera = camera
        self._rover_T_camera = rover_T_camera
        self._dense = DenseStereo(camera, rover_T_camera, dense)
        self._stations: list[_Station] = []
        self._driven_m = 0.0
        self._last: FloatArray | None = None
        self._next_try_m = 0.0
        self._tried: set[int] = set()
        self._believed = self._refused = 0

    def observe(
        self,
        frame: StereoFrame | UnusableFrame,
        observations: StereoObservations | None,
        rectification: RectificationError,
        map_T_rover: FloatArray,
        *,
        measure: bool = True,
    ) -> bool:
        """Measure the ground of a frame, where the rover has come far enough since the last.

        Parameters
        ----------
        frame
            The pair.
        observations
            Its landmarks: how near the ground begins.
        rectification
            What rectification left over.
        map_T_rover
            Pose as estimated.
        measure
            False: only count the way.

        Returns
        -------
        bool
            Whether there is new ground.
        """
        if self._last is not None:
            step = float(np.linalg.norm(map_T_rover[:2, 3] - self._last[:2, 3]))
            if step < self.config.mapping_step_m and self._stations:
                return False
            self._driven_m += step
        self._last = map_T_rover
        if isinstance(frame, UnusableFrame):
            return False
        self._stations.append(_Station(frame.index, self._driven_m))
        if not measure:
            return True
        near = None
        if observations is not None and len(observations) > 20:
            near = 0.8 * float(np.percentile(observations.points_cam[:, 2], 2.0))
        self.terrain.add(self._dense.measure(frame, rectification, near))
        return True

    def lose(self) -> None:
        """Begin anew with ground: what was seen so far cannot be joined with what comes."""
        self._stations, self._last = [], None
        self._next_try_m = self._driven_m

    def restore(
        self,
        frames: Iterable[StereoFrame | UnusableFrame],
        logged: Mapping[int, LoggedFrame],
        ledger: Iterable[LedgerEntry],
        rectification: RectificationError,
    ) -> None:
        """Stand as after these frames of an interrupted run: measure again what is still open.

        Parameters
        ----------
        frames
            Of the dataset, up to where the log ends or further.
        logged
            What the log has of each, by frame.
        ledger
            Of the run.
        rectification
            As it stands.
        """
        came: dict[int, list[LedgerEntry]] = {}
        for entry in ledger:
            if isinstance(entry.measurement, AbsoluteFix):
                came.setdefault(entry.history[0].at_frame, []).append(entry)
        settled = max(
            (at for at, of in came.items() if of[0].history[0].verdict is Verdict.ACCEPTED),
            default=-1,
        )
        for frame in frames:
            if frame.index not in logged:
                break
            past = logged[frame.index]
            if was_carried(past.keyframe, self._motion):
                self.lose()
            # ground that a believed fix has used is not needed again
            used = frame.index <= settled and not isinstance(frame, UnusableFrame)
            self.observe(
                frame, past.keyframe.observations, rectification,
                past.estimate.map_T_rover, measure=not used,
            )  # fmt: skip
            for entry in came.get(frame.index, ()):
                self._tried.add(entry.frame)
                self.settle(entry.history[0].verdict is Verdict.ACCEPTED)

    def correct(self, rectification: RectificationError) -> None:
        """Remove a disparity error that was found after the ground was measured."""
        self.terrain.replace(
            [
                self.terrain.points(frame).corrected(
                    self._camera, self._rover_T_camera, rectification
                )
                for frame in self.terrain.frames
            ]
        )
        self._last = None

    def fix(self, smoother: IncrementalSmoother, *, last: bool = False) -> FixDecision | None:
        """Try a fix if there is ground enough, and let the graph judge it.

        `last`: nothing more will be seen; half as much ground will do.
        """
        result = self.attempt(smoother, last=last)
        if result is None:
            return None
        logger.info(describe(result))
        decision = smoother.add_fix(result.fix)
        self.settle(decision.accepted)
        return decision

    def attempt(self, smoother: IncrementalSmoother, *, last: bool = False) -> Adjustment | None:
        """Look for the ground in the map if there is enough of it; None when there is not.

        Tell `settle` what the graph made of it.
        """
        anchor = self._due(smoother, last)
        if anchor is None:
            return None
        try:
            poses = {s.frame: smoother.predicted(s.frame).map_T_rover for s in self._stations}
            planar = smoother.predicted(anchor).planar()
        except EstimationError:
            return None
        patch = make_patch(self.terrain, poses, anchor, self.adjustment.cell_m)
        sigma = np.sqrt(np.maximum(np.diag(planar.covariance), 0.0))
        search, orbital = self._search(sigma), self.adjustment.orbital
        # coarse to fine is for images; an elevation model alone is searched as ever
        lost = search.half_yaw_rad >= 0.5 * math.pi and None not in (orbital.ortho, orbital.sun)
        if lost and patch is not None:
            coarse = make_patch(self.terrain, poses, anchor, self.adjustment.coarse_cell_m)
            result = locate_everywhere(self.adjustment, patch, coarse or patch, search)
        else:
            result = self.adjustment.locate(patch, anchor, search)
        self._tried.add(anchor)
        if self.on_attempt is not None:
            self.on_attempt(result)
        return result

    def settle(self, accepted: bool) -> None:
        """Let go of the ground of a fix that is in the graph; keep it after a refusal."""
        length = self.adjustment.length_m
        self._believed += accepted
        self._refused += not accepted
        if accepted:
            self._stations = []
            self._next_try_m = self._driven_m
            return
        self._next_try_m = self._driven_m + 0.25 * length
        oldest = self._driven_m - 1.5 * length
        self._stations = [s for s in self._stations if s.driven_m >= oldest]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Whether the map seems not to fit."""
        tried = self._believed + self._refused
        if tried < _FEW_ATTEMPTS or self._refused <= self._believed:
            return ()
        return (
            f"of {tried} attempts at an absolute fix {self._believed} were believed: the ground "
            "shows too little of itself, or the map is not of this place, scale and orientation",
        )

    def _due(self, smoother: IncrementalSmoother, last: bool) -> int | None:
        """The anchor of the next attempt: the keyframe in the middle of the ground."""
        early = not last and self._driven_m < self._next_try_m
        if len(self._stations) < 3 or early:
            return None
        length = self.adjustment.length_m
        driven = self._stations[-1].driven_m - self._stations[0].driven_m
        if driven < 0.5 * length:
            return None
        middle = 0.5 * (self._stations[-1].driven_m + self._stations[0].driven_m)
        free = [s for s in self._stations if s.frame not in self._tried]
        if not free:
            return None
        anchor = min(free, key=lambda s: abs(s.driven_m - middle)).frame
        if driven >= length or last:
            return anchor
        planar = smoother.predicted(self._stations[-1].frame).planar()
        sigma = math.sqrt(float(np.linalg.eigvalsh(planar.covariance[:2, :2])[-1]))
        return anchor if sigma > self.config.most_sigma_m else None

    def _search(self, sigma: FloatArray) -> Search:
        config = self.config
        x, y = (
            min(config.least_window_m + _WINDOW_SIGMAS * float(s), config.most_window_m)
            for s in sigma[:2]
        )
        yaw = math.radians(config.least_window_deg) + _WINDOW_SIGMAS * float(sigma[2])
        return Search(x, y, min(yaw, math.pi))


def describe(adjustment: Adjustment) -> str:
    """One line on an attempt, for the log of the run."""
    fix = adjustment.fix
    if not fix.candidates:
        return f"keyframe {fix.frame}: no fix: {fix.reason}"
    best: FixCandidate = fix.candidates[0]
    sigma = np.sqrt(np.diag(best.covariance))
    return (
        f"keyframe {fix.frame}: fix by {best.proposer} at {best.x_m:.2f}, {best.y_m:.2f} m "
        f"(sigma {sigma[0]:.2f}, {sigma[1]:.2f} m), second place at "
        f"{fix.second_best_ratio:.0%} of its standing"
    )
