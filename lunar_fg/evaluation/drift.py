"""How far an estimate drifts from the truth: absolute, over segments, from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.geometry import inverse
from lunar_fg.evaluation.alignment import Alignment
from lunar_fg.evaluation.association import Pair, UndefinedMetricError

FloatArray = NDArray[np.float64]

#: Segment lengths of the KITTI odometry benchmark, m, and its step between starts, frames.
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP = 10
#: Segment lengths for paths too short for the benchmark's, m.
SHORT_LENGTHS_M = (10.0, 20.0, 30.0, 40.0, 50.0)
#: For still shorter ones: parts of the path's length.
LENGTH_FRACTIONS = (0.1, 0.2, 0.3, 0.4, 0.5)
#: Below this extent, m, a path is standing still and has no drift per metre.
MIN_EXTENT_M = 0.5


@dataclass(frozen=True, slots=True)
class SegmentErrors:
    """Mean error over all segments of all lengths, as the KITTI benchmark defines it.

    Attributes
    ----------
    translation_percent
        Of the segment's length.
    rotation_deg_per_m
        Over the segment's length.
    lengths_m
        Segment lengths that were used.
    segments
        How many segments were averaged.
    """

    translation_percent: float
    rotation_deg_per_m: float
    lengths_m: tuple[float, ...]
    segments: int


@dataclass(frozen=True, slots=True, eq=False)
class DriftProfile:
    """Errors along the way: (N,) each, `orientation_deg` None without true orientation."""

    distance_m: FloatArray
    position_m: FloatArray
    orientation_deg: FloatArray | None


def position_errors(pair: Pair, alignment: Alignment) -> FloatArray:
    """Distance of each aligned position to its truth, m, (N,)."""
    offset = alignment.points(pair.estimate.positions) - pair.truth.positions
    return np.asarray(np.linalg.norm(offset, axis=1))


def ate_rmse_m(pair: Pair, alignment: Alignment) -> float:
    """Absolute trajectory error: root mean square of `position_errors`, m."""
    return _rms(position_errors(pair, alignment))


def drift_profile(pair: Pair, alignment: Alignment) -> DriftProfile:
    """Position and orientation error against the distance travelled."""
    orientation = None
    try:
        truth = pair.true_poses
    except UndefinedMetricError:
        pass
    else:
        aligned = alignment.rotation @ pair.estimate.map_T_rover[:, :3, :3]
        orientation = _angles_deg(truth[:, :3, :3].transpose(0, 2, 1) @ aligned)
    return DriftProfile(pair.travelled_m(), position_errors(pair, alignment), orientation)


def relative_pose_error(pair: Pair) -> tuple[float, float]:
    """RPE from each pose to the next: rmse of translation, m, and rotation, deg.

    Raises
    ------
    UndefinedMetricError
        Without true orientation, or with fewer than two poses.
    """
    truth, estimate = pair.true_poses, pair.estimate.map_T_rover
    if len(pair) < 2:
        raise UndefinedMetricError("fewer than two poses have truth")
    true_motion = inverse(truth[:-1]) @ truth[1:]
    motion = inverse(estimate[:-1]) @ estimate[1:]
    error = inverse(true_motion) @ motion
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    return _rms(translation), _rms(_angles_deg(error[:, :3, :3]))


def segment_plan(path_m: float, extent_m: float) -> tuple[tuple[float, ...], int]:
    """Segment lengths, m, and the step between their starts, frames, for a path.

    - 200 m and more: 100, 200, ... 800 m as far as they fit, a start every 10 frames
      (the KITTI benchmark);
    - 20 m and more: 10, 20, ... 50 m as far as they fit, a start every frame;
    - shorter: 10, 20, ... 50 % of the path, a start every frame.

    Raises
    ------
    UndefinedMetricError
        When the path stays within `MIN_EXTENT_M` of its start.
    """
    if extent_m < MIN_EXTENT_M:
        raise UndefinedMetricError(f"the path stays within {MIN_EXTENT_M} m of its start")
    if path_m >= 2 * KITTI_LENGTHS_M[0]:
        return tuple(x for x in KITTI_LENGTHS_M if x < path_m), KITTI_STEP
    if path_m >= 2 * SHORT_LENGTHS_M[0]:
        return tuple(x for x in SHORT_LENGTHS_M if x < path_m), 1
    return tuple(fraction * path_m for fraction in LENGTH_FRACTIONS), 1


def segment_errors(pair: Pair) -> SegmentErrors:
    """Relative errors over segments of the true path, after the KITTI benchmark.

    A segment of length L from pose i ends at the first pose more than L further along the
    true path; its error is divided by L. Lengths follow `segment_plan`.

    Raises
    ------
    UndefinedMetricError
        Without true orientation, or on a path that goes nowhere.
    """
    truth, estimate = pair.true_poses, pair.estimate.map_T_rover
    distance = pair.travelled_m()
    extent = float(np.linalg.norm(truth[:, :3, 3] - truth[0, :3, 3], axis=1).max())
    lengths, step = segment_plan(float(distance[-1]), extent)
    translation: list[FloatArray] = []
    rotation: list[FloatArray] = []
    used = []
    for length in lengths:
        first = np.arange(0, len(pair), step)
        last = np.searchsorted(distance, distance[first] + length, side="right")
        first, last = first[last < len(pair)], last[last < len(pair)]
        if not len(first):
            continue
        used.append(length)
        true_motion = inverse(truth[first]) @ truth[last]
        error = inverse(inverse(estimate[first]) @ estimate[last]) @ true_motion
        translation.append(100.0 * np.linalg.norm(error[:, :3, 3], axis=1) / length)
        rotation.append(_angles_deg(error[:, :3, :3]) / length)
    if not used:
        raise UndefinedMetricError("the path is too short for any segment")
    percents, rates = np.concatenate(translation), np.concatenate(rotation)
    return SegmentErrors(float(percents.mean()), float(rates.mean()), tuple(used), len(rates))


def _angles_deg(rotations: FloatArray) -> FloatArray:
    return np.asarray(np.rad2deg(Rotation.from_matrix(rotations).magnitude()))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
