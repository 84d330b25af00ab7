"""A run's tracks and the truth in one frame, and the errors of each along the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.geometry import inverse
from lunar_fg.evaluation.alignment import Alignment, AlignmentKind, align, common_frame
from lunar_fg.evaluation.association import UndefinedMetricError, associate
from lunar_fg.evaluation.consistency import NeesFrame, nees_profile, single_pose_band
from lunar_fg.evaluation.drift import DriftProfile, drift_profile
from lunar_fg.results import RunResults
from lunar_fg.trajectory import Trajectory, Truth

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """NEES a degree of freedom along the way, and where 95 % of honest ones lie."""

    distance_m: FloatArray
    nees: FloatArray
    band: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class AgainstTruth:
    """A run compared with its truth.

    Attributes
    ----------
    truth_in_map
        (N, 3) true positions in the run's map frame, m.
    how
        What was aligned to get there, in words.
    profiles
        Errors along the way by track: ``smoothed``, ``on the way``, ``without fixes``,
        ``dead reckoning``.
    predicted_m
        (N,) rms position error that the covariances predict, at `profiles["smoothed"]`.
    consistency
        NEES; None where it is not defined.
    """

    truth_in_map: FloatArray
    how: str
    profiles: dict[str, DriftProfile]
    predicted_m: FloatArray | None
    consistency: Consistency | None


_HOW = {
    AlignmentKind.NONE: "both are in the same map, nothing was aligned",
    AlignmentKind.ORIGIN: "from a common first pose",
    AlignmentKind.SE3: "after a least-squares fit, since the truth has no orientation",
}


def same_map(results: RunResults) -> bool:
    """Whether a run's truth is in the map that its start pose was given in."""
    return results.georeference is not None and isinstance(results.truth, Trajectory)


def against_truth(results: RunResults, fixless: Trajectory | None = None) -> AgainstTruth | None:
    """Compare a run with its truth; None when it has none, or none that fits.

    `fixless` is what the run would be without its fixes.
    """
    truth = results.truth
    if truth is None:
        return None
    try:
        pair = associate(results.trajectory, truth)
        kind = common_frame(pair, same_map=same_map(results))
        alignment = align(kind, pair)
    except (InputError, UndefinedMetricError):
        return None
    profiles = {"smoothed": drift_profile(pair, alignment)}
    for name, track in (
        ("on the way", results.on_the_way),
        ("without fixes", fixless),
        ("dead reckoning", results.dead_reckoning),
    ):
        found = None if track is None else _profile(track, truth, kind)
        if found is not None:
            profiles[name] = found
    predicted = None
    if pair.estimate.covariance is not None:
        predicted = np.sqrt(np.einsum("nii->n", pair.estimate.covariance[:, 3:, 3:]))
    frame = NeesFrame.SAME_MAP if kind is AlignmentKind.NONE else NeesFrame.FROM_START
    try:
        values, dof = nees_profile(pair, frame)
        consistency = Consistency(pair.travelled_m()[1:], values, single_pose_band(dof))
    except UndefinedMetricError:
        consistency = None
    return AgainstTruth(
        _in_map(pair.truth, alignment), _HOW[kind], profiles, predicted, consistency
    )


def _profile(track: Trajectory, truth: Truth, kind: AlignmentKind) -> DriftProfile | None:
    try:
        pair = associate(track, truth)
        return drift_profile(pair, align(kind, pair))
    except (InputError, UndefinedMetricError):
        return None


def _in_map(truth: Truth, alignment: Alignment) -> FloatArray:
    """Carry true positions back into the estimate's frame."""
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = alignment.rotation, alignment.translation
    back = inverse(back)
    return np.asarray(truth.positions @ back[:3, :3].T + back[:3, 3])
