"""What a graph is made for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frontends.camera import StereoCamera
from frontends.errors import InputError
from frontends.measurements import FloatArray, StartPrior
from lunar_fg.graph.checks import check_covariance, check_pose
from lunar_fg.graph.config import GraphConfig


@dataclass(frozen=True, slots=True)
class Setup:
    """The rover's camera, where the rover starts, and how its measurements are used.

    Attributes
    ----------
    camera
        The rectified stereo camera of all observations.
    rover_T_camera
        (4, 4) pose of the left camera in the rover.
    start
        Prior on the first keyframe.
    config
        How the measurements are used.
    """

    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    config: GraphConfig

    @classmethod
    def checked(
        cls,
        camera: StereoCamera,
        rover_T_camera: FloatArray,
        start: StartPrior | None = None,
        config: GraphConfig | None = None,
    ) -> Setup:
        """Check what a caller gives, and fill in what is left out.

        Raises
        ------
        InputError
            When an argument is not finite, not rigid, or a sigma is not positive.
        """
        start = start or StartPrior()
        check_pose(rover_T_camera, "rover_T_camera", "")
        check_pose(start.map_T_rover, "start", "map_T_rover")
        check_covariance(start.covariance(), 6, "start", "sigmas")
        if min(*start.sigma_rot_rad, *start.sigma_trans_m) <= 0.0:
            raise InputError(
                "must all be above 0", source="start", field="sigmas",
                remedy="1e-4 rad and 1e-3 m hold the start as good as fixed",
            )  # fmt: skip
        return cls(camera, np.array(rover_T_camera, float), start, config or GraphConfig())
