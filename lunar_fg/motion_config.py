"""How the wheels and an unseen motion err."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from annotated_types import Ge, Gt, Le

#: A 1-sigma or a share; finite, not negative.
Sigma = Annotated[float, Ge(0), Le(1e6)]
Length = Annotated[float, Gt(0), Le(1e9)]


#: See `MotionConfig.steady_sigma`; over a longer gap nothing is known of the motion.
LONGEST_STEADY = 5.0


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """Uncertainties of the motion models.

    Attributes
    ----------
    slip
        1-sigma of the wheels' distance, as a share of it.
    wheel_sigma_m
        1-sigma of the wheels' distance that is there at any distance.
    heading_sigma
        1-sigma of the wheels' turn, as a share of it.
    slip_length_m
        Distance over which the slip stays about the same.
    veer_rad_per_m
        1-sigma of a turn that the wheels do not count, over a metre driven straight.
    attitude_drift_s
        Time over which the error of an attitude stays about the same.
    tilt_rate_rad_per_m
        1-sigma of the change of roll and pitch over a metre, where no attitude is known.
    tilt_rad
        1-sigma of roll and pitch on this ground, where no attitude is known.
    steady_sigma
        Constant velocity: 1-sigma of the change of the step, as a share of the step.
        A velocity is taken to last for `LONGEST_STEADY` times the time it was measured over.
    steady_sigma_m, steady_sigma_rad
        Constant velocity: 1-sigma that is there at any speed.
    unknown_sigma_m, unknown_sigma_rad
        1-sigma of a motion of which nothing is known.
    carried_sigma_m, carried_sigma_rad
        The same where the images before and after have nothing in common, though by the wheels
        they should show the same ground: the rover was carried, slid or fell.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    slip: Sigma = 0.1
    wheel_sigma_m: Sigma = 0.005
    heading_sigma: Sigma = 0.1
    slip_length_m: Length = 2.0
    veer_rad_per_m: Sigma = 0.01
    attitude_drift_s: Length = 1000.0
    tilt_rate_rad_per_m: Sigma = 0.1
    tilt_rad: Sigma = 0.15
    steady_sigma: Sigma = 0.5
    steady_sigma_m: Sigma = 0.05
    steady_sigma_rad: Sigma = 0.05
    unknown_sigma_m: Sigma = 1.0
    unknown_sigma_rad: Sigma = 0.3
    carried_sigma_m: Sigma = 20.0
    carried_sigma_rad: Sigma = 1.0
