"""The paper's proposer: SURF between the ortho patch and the satellite image (2.3, eq. 7)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.absolute.channels import relit
from frontends.absolute.correlation import high_pass
from frontends.absolute.patch import ReliefPatch
from frontends.absolute.peak import Peak
from frontends.absolute.proposal import Proposal, map_pixel, window_bounds
from frontends.absolute.search import Search
from frontends.detector import FeatureDetector
from frontends.matching import find_similarity, match_descriptors
from frontends.measurements import Image
from frontends.orbital import MapWindow, OrbitalMap
from frontends.surf import SURF
from frontends.terrain import Grid

FloatArray = NDArray[np.float64]
Layer = NDArray[np.float32]

#: Both images are enlarged: a patch has few pixels for SURF's smallest filter.
_ENLARGE = 2
_CELLS = 8.0
#: The scale is known from the two grids: a fit that says otherwise is wrong.
_SCALE_TOLERANCE = 0.05
_RANSAC_CELLS = 1.5


def _detector() -> FeatureDetector:
    return SURF(hessian_threshold=50.0, accurate=True, max_keypoints=4000)


#: Features near each other err together, which their scatter does not show. From the headings of
#: crops of one real map found in another.
_INFLATION = 1.8


@dataclass(frozen=True, slots=True)
class SurfMatching:
    """Matches SURF features of the patch, as photographed or re-lit, with the map's.

    Attributes
    ----------
    source
        ``"ortho"``: the rover's own image, for maps under a like sun; ``"relit"``: the
        relief under the map's sun.
    """

    source: Literal["ortho", "relit"] = "ortho"
    detector: FeatureDetector = field(default_factory=_detector)

    @property
    def name(self) -> str:
        """Name, for the result."""
        return f"SURF, {self.source}"

    def propose(self, patch: ReliefPatch, orbital: OrbitalMap, search: Search) -> Proposal:
        """See `Proposer`."""
        if orbital.ortho is None:
            return Proposal(self.name, reason="no ortho image")
        values = patch.ortho
        if self.source == "relit":
            if orbital.sun is None:
                return Proposal(self.name, reason="the map's sun is not known")
            heights = np.where(patch.mask, patch.height_m, 0.0).astype(np.float32)
            pixel = map_pixel(orbital, patch)
            lit, seen = relit(heights, patch.mask, patch.grid.cell_m, orbital.sun, pixel)
            values = np.where(seen, lit, np.nan).astype(np.float32)
        window = orbital.ortho.window(window_bounds(patch, search), patch.grid.cell_m)
        found = match_layers(MapWindow(patch.grid, values), window, self.detector)
        if isinstance(found, str):
            return Proposal(self.name, reason=found, window=window, template=values)
        peak = found.place(patch)
        outside = (
            abs(peak.x_m - patch.x_m) > search.half_x_m
            or abs(peak.y_m - patch.y_m) > search.half_y_m
            or abs(peak.yaw_rad) > search.half_yaw_rad
        )
        if outside:
            reason = "the match lies outside of where the rover can be"
            return Proposal(self.name, reason=reason, window=window, template=values)
        return Proposal(
            self.name, peak, inliers=found.inliers, window=window, template=values,
            pixel_m=orbital.ortho.gsd_m, inflation=_INFLATION,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class LayerMatch:
    """Where one image lies in another: ``map = R(yaw) scale (first) + (x, y)``, m.

    Attributes
    ----------
    x_m, y_m, yaw_rad
        Rotation and translation that take coordinates of the first to the second
        (paper, eq. 7), counter-clockwise.
    covariance
        (3, 3) of these, at the first's `pivot`.
    scale
        As fitted; 1 where both grids say the truth.
    inliers, matches
        Counts.
    pivot
        Centre of the inliers in the first, about which x, y and yaw are uncorrelated, m.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    covariance: FloatArray
    scale: float
    inliers: int
    matches: int
    pivot: tuple[float, float]

    def place(self, patch: ReliefPatch) -> Peak:
        """Where the match puts the patch's anchor."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x = c * patch.x_m - s * patch.y_m + self.x_m
        y = s * patch.x_m + c * patch.y_m + self.y_m
        dx, dy = patch.x_m - self.pivot[0], patch.y_m - self.pivot[1]
        lever = np.eye(3)
        lever[0, 2], lever[1, 2] = -(s * dx + c * dy), c * dx - s * dy
        covariance = lever @ self.covariance @ lever.T
        share = self.inliers / max(self.matches, 1)
        # the match itself has been judged: it stands out, nothing comes second
        return Peak(x, y, self.yaw_rad, covariance, share, math.inf, 0.0, False)


def match_layers(
    first: MapWindow,
    second: MapWindow,
    detector: FeatureDetector | None = None,
    *,
    known_scale: bool = True,
) -> LayerMatch | str:
    """Find one image in another by SURF, ratio test and RANSAC over similarities.

    Parameters
    ----------
    first, second
        Images with their grids.
    detector
        SURF in its accurate mode by default.
    known_scale
        Whether the grids' cell sizes are true; then a fit of another scale is refused.

    Returns
    -------
    LayerMatch or str
        The place, or the reason why there is none.
    """
    detector = detector or _detector()
    features = []
    for layer in (first, second):
        image, mask = _as_image(layer.values)
        keypoints, descriptors = detector.detectAndCompute(image, mask)
        features.append((_to_map(keypoints.xy.astype(np.float64), layer.grid), descriptors))
    (a_xy, a_descriptors), (b_xy, b_descriptors) = features
    if min(len(a_xy), len(b_xy)) < 3:
        return f"too few features: {len(a_xy)} in the patch, {len(b_xy)} in the map"
    pairs = match_descriptors(a_descriptors, b_descriptors, ratio=0.85)
    a, b = a_xy[pairs.query], b_xy[pairs.train]
    if len(a) < 3:
        return f"{len(a)} matches"
    origin_a, origin_b = a.mean(axis=0), b.mean(axis=0)
    cell = max(first.grid.cell_m, second.grid.cell_m)
    fit = find_similarity((a - origin_a) / cell, (b - origin_b) / cell, threshold_px=_RANSAC_CELLS)
    if fit.reason:
        return fit.reason
    scale = float(np.hypot(fit.matrix[0, 0], fit.matrix[1, 0]))
    if known_scale and abs(math.log(scale)) > _SCALE_TOLERANCE:
        return f"the matches fit a scale of {scale:.3f}, the grids say 1"
    return _rigid(a[fit.inlier], b[fit.inlier], scale, known_scale, len(a))


def _rigid(a: FloatArray, b: FloatArray, scale: float, known: bool, matches: int) -> LayerMatch:
    """Least-squares rotation and translation (eq. 7) of the inliers."""
    pivot, target = a.mean(axis=0), b.mean(axis=0)
    u, v = a - pivot, b - target
    yaw = math.atan2(float(np.sum(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])), float(np.sum(u * v)))
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, -s], [s, c]])
    factor = 1.0 if known else scale
    rest = v - factor * u @ turn.T
    dof = max(2 * len(a) - 4, 1)
    variance = float(np.sum(rest**2)) / dof
    spread = max(float(np.sum(u**2)), 1e-12)
    shift = target - factor * turn @ pivot
    covariance = np.diag([variance / len(a), variance / len(a), variance / spread])
    return LayerMatch(
        float(shift[0]), float(shift[1]), yaw, covariance, scale, len(a), matches,
        (float(pivot[0]), float(pivot[1])),
    )  # fmt: skip


def _as_image(values: Layer) -> tuple[Image, Image]:
    """Eight-bit picture of a layer, high-passed so that exposure and albedo do not matter."""
    mask = np.isfinite(values)
    flat = high_pass(np.where(mask, values, 0.0).astype(np.float32), mask, _CELLS)
    spread = float(np.std(flat[mask])) if mask.any() else 1.0
    grey = np.clip(128.0 + 40.0 * flat / max(spread, 1e-12), 0, 255).astype(np.uint8)
    size = (_ENLARGE * grey.shape[1], _ENLARGE * grey.shape[0])
    image = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    keep = cv2.resize(inner, size, interpolation=cv2.INTER_NEAREST) * 255
    return np.asarray(image, dtype=np.uint8), np.asarray(keep, dtype=np.uint8)


def _to_map(xy: FloatArray, grid: Grid) -> FloatArray:
    """Enlarged pixels to metres."""
    cells = (xy + 0.5) / _ENLARGE - 0.5
    return np.stack(grid.place(cells[:, 0], cells[:, 1]), axis=1)
