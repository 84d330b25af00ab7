"""When to ask the orbital map where the rover is, and with which ground."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
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
from lunar_fg.stations import Stations

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
        self._stations = Stations(self.config.mapping_step_m, self.adjustment.length_m)
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
        usable = not isinstance(frame, UnusableFrame)
        if not self._stations.come(frame.index, map_T_rover, usable=usable):
            return False
        if not measure or isinstance(frame, UnusableFrame):
            return True
        near = None
        if observations is not None and len(observations) > 20:
            near = 0.8 * float(np.percentile(observations.points_cam[:, 2], 2.0))
        self.terrain.add(self._dense.measure(frame, rectification, near))
        return True

    def lose(self) -> None:
        """Begin anew with ground: what was seen so far cannot be joined with what comes."""
        self._stations.lose()

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
                self._stations.tried(entry.frame)
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
        self._stations.jump()

    def fix(self, smoother: IncrementalSmoother, *, last: bool = False) -> FixDecision | None:
        """Try a fix if there is ground enough, and let the graph judge it.

        `last`: nothing more will be seen; half as much ground will do.
        """
        result = self.attempt(smoother, last=last)
        if result is None:
            return None
        logger.info("%s", result)
        decision = smoother.add_fix(result.fix)
        self.settle(decision.accepted)
        return decision

    def attempt(self, smoother: IncrementalSmoother, *, last: bool = False) -> Adjustment | None:
        """Look for the ground in the map if there is enough of it; None when there is not.

        Tell `settle` what the graph made of it.
        """

        def sigma_m(frame: int) -> float:
            covariance = smoother.predicted(frame).planar().covariance
            return math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))

        anchor = self._stations.due(
            last=last, most_sigma_m=self.config.most_sigma_m, sigma_m=sigma_m
        )
        if anchor is None:
            return None
        try:
            frames = self._stations.frames
            poses = {k: smoother.predicted(k).map_T_rover for k in frames}
            motions = [smoother.motion(a, b).covariance for a, b in pairwise(frames)]
            planar = smoother.predicted(anchor).planar()
        except EstimationError:
            return None
        patch = make_patch(self.terrain, poses, anchor, self.adjustment.cell_m, motions)
        sigma = np.sqrt(np.maximum(np.diag(planar.covariance), 0.0))
        search, orbital = self._search(sigma), self.adjustment.orbital
        # coarse to fine is for images; an elevation model alone is searched as ever
        lost = search.half_yaw_rad >= 0.5 * math.pi and None not in (orbital.ortho, orbital.sun)
        if lost and patch is not None:
            coarse = make_patch(self.terrain, poses, anchor, self.adjustment.coarse_cell_m, motions)
            result = locate_everywhere(self.adjustment, patch, coarse or patch, search)
        else:
            result = self.adjustment.locate(patch, anchor, search)
        self._stations.tried(anchor)
        if self.on_attempt is not None:
            self.on_attempt(result)
        return result

    def settle(self, accepted: bool) -> None:
        """Let go of the ground of a fix that is in the graph; keep it after a refusal."""
        self._believed += accepted
        self._refused += not accepted
        self._stations.settle(accepted)

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

    def _search(self, sigma: FloatArray) -> Search:
        config = self.config
        x, y = (
            min(config.least_window_m + _WINDOW_SIGMAS * float(s), config.most_window_m)
            for s in sigma[:2]
        )
        yaw = math.radians(config.least_window_deg) + _WINDOW_SIGMAS * float(sigma[2])
        return Search(x, y, min(yaw, math.pi))
