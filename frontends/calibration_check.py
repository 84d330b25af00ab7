"""Hold a calibration against the images: what a rectified pair should look like, and does not.

On a rectified pair the same thing lies in the same row, to the left in the right image, and
at a depth that a rover can see. A small turn ``(rx, ry, rz)`` of the right camera that the
calibration does not know, and a small tilt ``(ty, tz)`` of the baseline (a share of it), move
its pixels by

    dv = f (x y ry + x rz - (1 + y^2) rx) + D ty - y D tz

with x, y in units of the focal length and D the disparity: the turn that explains the
vertical disparities is what is wrong with the calibration, as far as images can tell.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.matching import match_descriptors
from frontends.measurements import StereoFrame
from frontends.rectification import robust_fit
from frontends.surf import SURF

FloatArray = NDArray[np.float64]

_ENOUGH_MATCHES = 50
#: Vertical disparities above this share of the image height are wrong matches.
_VERTICAL_SEARCH = 0.05
_NOTEWORTHY_VERTICAL_PX = 1.0
_NOTEWORTHY_SPREAD_PX = 1.5
_SWAPPED_SHARE = 0.5
_BEYOND_INFINITY_PX = -1.0
_BEYOND_INFINITY_SHARE = 0.02
#: Baselines and median depths of rovers lie well within these, m.
_BASELINES_M = (0.01, 5.0)
_DEPTHS_M = (0.2, 2000.0)


@dataclass(frozen=True, slots=True)
class CalibrationCheck:
    """What the images say of their calibration.

    Attributes
    ----------
    matches
        Between left and right, wrong ones left out.
    vertical_px
        Median vertical disparity, ``v_left - v_right``.
    vertical_range_px
        1st and 99th percentile of the vertical disparities that turn and tilt explain.
    spread_px
        Robust 1-sigma of the vertical disparities that is left after the turn.
    turn_deg
        (3,) turn of the right camera about x, y, z that the images ask for.
    tilt_deg
        (2,) turn of the baseline towards y and z that they ask for.
    disparity_px
        1st, 50th and 99th percentile.
    median_depth_m
        Depth of the median disparity; infinite where that is not positive.
    findings
        What looks wrong, one sentence each.
    """

    matches: int
    vertical_px: float
    vertical_range_px: tuple[float, float]
    spread_px: float
    turn_deg: FloatArray
    tilt_deg: FloatArray
    disparity_px: tuple[float, float, float]
    median_depth_m: float
    findings: tuple[str, ...]

    def summary(self) -> str:
        """Figures in one line."""
        low, middle, high = self.disparity_px
        return (
            f"{self.matches} matches, vertical disparity {self.vertical_px:+.2f} px (spread "
            f"{self.spread_px:.2f} px), disparity {low:.1f} / {middle:.1f} / {high:.1f} px, "
            f"median depth {self.median_depth_m:.3g} m"
        )


def check_calibration(camera: StereoCamera, frames: Iterable[StereoFrame]) -> CalibrationCheck:
    """Check a rectified pair's calibration on some of its frames."""
    surf = SURF(1.0, upright=True, max_keypoints=2000)
    found = []
    for frame in frames:
        left, left_descriptors = surf.detectAndCompute(frame.left)
        right, right_descriptors = surf.detectAndCompute(frame.right)
        pairs = match_descriptors(left_descriptors, right_descriptors, ratio=0.7)
        found.append(np.hstack([left.xy[pairs.query], right.xy[pairs.train]]))
    matches = np.vstack(found).astype(np.float64) if found else np.zeros((0, 4))
    vertical = matches[:, 1] - matches[:, 3]
    matches = matches[np.abs(vertical) < _VERTICAL_SEARCH * camera.height]
    if len(matches) < _ENOUGH_MATCHES:
        return CalibrationCheck(
            len(matches), float("nan"), (float("nan"),) * 2, float("nan"), np.zeros(3),
            np.zeros(2),
            (float("nan"),) * 3, float("nan"),
            (f"only {len(matches)} matches between left and right within "
             f"{_VERTICAL_SEARCH:.0%} of the image height: the calibration cannot be checked, "
             "and may be of other images",),
        )  # fmt: skip
    return _judge(camera, matches)


def _judge(camera: StereoCamera, matches: FloatArray) -> CalibrationCheck:
    x = (matches[:, 0] - camera.cx) / camera.fx
    y = (matches[:, 1] - camera.cy) / camera.fy
    vertical = matches[:, 1] - matches[:, 3]
    basis = _epipolar_basis(x, y, matches[:, 0] - matches[:, 2])
    terms, spread = robust_fit(basis, vertical)
    explained = basis @ terms
    agree = np.abs(vertical - explained) < 3.0 * max(spread, 0.3)
    disparity = (matches[:, 0] - matches[:, 2])[agree]
    low, middle, high = (float(value) for value in np.percentile(disparity, [1.0, 50.0, 99.0]))
    depth = camera.baseline_m * camera.fx / middle if middle > 0.0 else float("inf")
    least, most = (float(value) for value in np.percentile(explained[agree], [1.0, 99.0]))
    turn = np.degrees(-terms[:3] / camera.fy)
    return CalibrationCheck(
        int(agree.sum()),
        float(np.median(vertical[agree])),
        (least, most),
        spread,
        turn,
        np.degrees(terms[3:]),
        (low, middle, high),
        depth,
        tuple(_findings(camera, disparity, (least, most), spread, turn, depth)),
    )


def _epipolar_basis(x: FloatArray, y: FloatArray, disparity: FloatArray) -> FloatArray:
    return np.stack([1.0 + y**2, -x * y, -x, disparity, -y * disparity], axis=-1)


def _findings(
    camera: StereoCamera,
    disparity: FloatArray,
    field: tuple[float, float],
    spread: float,
    turn_deg: FloatArray,
    depth: float,
) -> list[str]:
    found = []
    swapped = float(np.mean(disparity < _BEYOND_INFINITY_PX))
    if swapped > _SWAPPED_SHARE:
        found.append(
            f"{swapped:.0%} of the matches have a negative disparity: left and right look swapped"
        )
    elif swapped > _BEYOND_INFINITY_SHARE:
        found.append(
            f"{swapped:.0%} of the matches lie beyond infinity (disparity down to "
            f"{np.percentile(disparity, 1.0):.1f} px): the cameras' toe-in is off by "
            f"{np.degrees(-np.percentile(disparity, 1.0) / camera.fx):.2f} deg or more, and "
            "depths come out too large"
        )
    if max(-field[0], field[1]) > _NOTEWORTHY_VERTICAL_PX:
        x, y, z = turn_deg
        found.append(
            f"vertical disparities from {field[0]:+.1f} to {field[1]:+.1f} px: the right camera "
            f"looks turned by ({x:+.2f}, {y:+.2f}, {z:+.2f}) deg about x, y, z against the "
            "calibration"
        )
    if spread > _NOTEWORTHY_SPREAD_PX:
        found.append(
            f"vertical disparities scatter by {spread:.1f} px about what any turn explains: the "
            "lens model looks wrong, or the calibration is of another image size"
        )
    if not _BASELINES_M[0] <= camera.baseline_m <= _BASELINES_M[1]:
        found.append(f"the baseline is {camera.baseline_m:g} m: check its unit")
    if swapped <= _SWAPPED_SHARE and not _DEPTHS_M[0] <= depth <= _DEPTHS_M[1]:
        found.append(
            f"the median depth is {depth:.3g} m: check focal length and the baseline's unit"
        )
    return found
