"""Absolute adjustment: where in the orbital map the rover's own ground lies (paper, 2.3).

Several proposers look for the patch, one verifier judges what they find. The window is a
limit of the search, not part of the estimate: a fix is a measurement of the map alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt, Lt
from numpy.typing import NDArray

from frontends.absolute.correlating import ReliefInDem, RelitRelief
from frontends.absolute.patch import ReliefPatch
from frontends.absolute.peak import Peak
from frontends.absolute.proposal import Proposal, Proposer, window_bounds
from frontends.absolute.search import Search
from frontends.measurements import AbsoluteFix, FixCandidate
from frontends.orbital import OrbitalMap
from frontends.terrain import Grid

FloatArray = NDArray[np.float64]

#: Larger cells do not show the relief that makes an image, m.
_COARSEST_CELL_M = 0.5


@dataclass(frozen=True, slots=True)
class AbsoluteConfig:
    """Settings of the absolute adjustment.

    Attributes
    ----------
    length_pixels, least_length_m, most_length_m
        Length of the drive whose ground makes a patch: so many pixels of the map, within
        these limits.
    least_cells
        Cells of known ground that a patch needs.
    false_alarm
        Probability that chance parts best and second place as far as they are, below
        which a place is believed.
    map_sigma_pixels
        1-sigma of the map itself, per axis and in its pixels: how far the ground of a patch lies
        from where the image has it. Orthorectification over an elevation model that is wrong by
        some decimetres, jitter of the camera and the seams of mosaics make it; what a
        patch shows cannot tell. Where the whole map lies is another matter, which fixes
        leave open.
    dem_sigma_m
        1-sigma of the elevation model's heights.
    candidates
        Most places given for one keyframe.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    length_pixels: Annotated[float, Gt(0)] = 80.0
    least_length_m: Annotated[float, Gt(0)] = 20.0
    most_length_m: Annotated[float, Gt(0)] = 60.0
    least_cells: Annotated[int, Ge(1)] = 800
    false_alarm: Annotated[float, Gt(0), Lt(1)] = 1e-5
    map_sigma_pixels: Annotated[float, Ge(0)] = 0.2
    dem_sigma_m: Annotated[float, Gt(0)] = 0.3
    candidates: Annotated[int, Ge(1)] = 3

    def length_m(self, gsd_m: float) -> float:
        """Length of a patch for a map of this ground distance."""
        return min(max(self.length_pixels * gsd_m, self.least_length_m), self.most_length_m)


@dataclass(frozen=True, slots=True)
class Adjustment:
    """A fix and how it came about, for pictures and the log.

    Attributes
    ----------
    fix
        The result.
    patch
        What was looked for.
    proposals
        What each method found.
    """

    fix: AbsoluteFix
    patch: ReliefPatch | None
    proposals: tuple[Proposal, ...]

    def __str__(self) -> str:
        """One line, for the log of a run."""
        fix = self.fix
        if not fix.candidates:
            return f"keyframe {fix.frame}: no fix: {fix.reason}"
        best = fix.candidates[0]
        sigma = np.sqrt(np.diag(best.covariance))
        return (
            f"keyframe {fix.frame}: fix by {best.proposer} at {best.x_m:.2f}, {best.y_m:.2f} m "
            f"(sigma {sigma[0]:.2f}, {sigma[1]:.2f} m), second place at "
            f"{fix.second_best_ratio:.0%} of its standing"
        )


class AbsoluteAdjustment:
    """Finds a patch in an orbital map.

    Parameters
    ----------
    orbital
        The map.
    config
        Settings.
    proposers
        Methods to ask, the most precise first; the re-lit relief and, where there is an
        elevation model, the relief in it by default. `SurfMatching` is the paper's.
    """

    def __init__(
        self,
        orbital: OrbitalMap,
        config: AbsoluteConfig | None = None,
        proposers: Sequence[Proposer] | None = None,
    ) -> None:
        self.orbital = orbital
        self.config = config or AbsoluteConfig()
        self.proposers = tuple(proposers or (RelitRelief(), ReliefInDem()))

    @property
    def cell_m(self) -> float:
        """Cells that patches are compared in: the map's pixels, or halves of coarse ones.

        A relief is lit on cells that show its slopes; in pixels of a metre they are gone.
        """
        gsd_m = self.orbital.gsd_m
        return gsd_m / math.ceil(gsd_m / _COARSEST_CELL_M - 1e-6)

    @property
    def coarse_cell_m(self) -> float:
        """Cells twice as large, where these still show the relief: a lost rover's are tried so."""
        return max(self.cell_m, min(2.0 * self.cell_m, _COARSEST_CELL_M))

    @property
    def length_m(self) -> float:
        """Length of drive that a patch should show."""
        return self.config.length_m(self.orbital.gsd_m)

    def locate(self, patch: ReliefPatch | None, frame: int, search: Search) -> Adjustment:
        """Look for a patch within a window about the pose it was laid out by.

        Parameters
        ----------
        patch
            See `make_patch`; None where nothing was seen.
        frame
            The anchor.
        search
            The window.

        Returns
        -------
        Adjustment
            Its fix has candidates, the best first, or the reason why there are none.
        """
        reason = self._unfit(patch)
        if reason or patch is None:
            return Adjustment(AbsoluteFix(frame, reason=reason), patch, ())
        proposals = tuple(
            proposer.propose(patch, self.orbital, search) for proposer in self.proposers
        )
        return Adjustment(self._verified(patch, proposals, search), patch, proposals)

    def _unfit(self, patch: ReliefPatch | None) -> str:
        if patch is None:
            return "too small: no ground was seen"
        cells, needed = int(np.count_nonzero(patch.mask)), self.config.least_cells
        if cells < needed:
            return f"too small: {cells} cells of the map were seen, {needed} are needed"
        if patch.relief_m < 2.0 * patch.sigma_m:
            return (
                f"too flat: {100 * patch.relief_m:.1f} cm of relief, heights are known to "
                f"{100 * patch.sigma_m:.1f} cm"
            )
        return ""

    def _verified(
        self, patch: ReliefPatch, proposals: tuple[Proposal, ...], search: Search
    ) -> AbsoluteFix:
        window = window_bounds(patch, search)
        believed: list[tuple[Proposal, Peak]] = []
        reasons = []
        for proposal in proposals:
            reason = self._doubt(proposal)
            if proposal.peak is None or reason:
                reasons.append(f"{proposal.proposer}: {reason}")
            elif not any(self._agree(proposal.peak, peak) for _, peak in believed):
                believed.append((proposal, proposal.peak))
        if not believed:
            return AbsoluteFix(patch.frame, reason="; ".join(reasons), window_m=window)
        candidates = [
            self._candidate(patch, *found) for found in believed[: self.config.candidates]
        ]
        first = candidates[0]
        height = self._height(patch, first.x_m, first.y_m)
        return AbsoluteFix(
            patch.frame,
            tuple(candidates),
            believed[0][1].second_best_ratio,
            height,
            None if height is None else self.config.dem_sigma_m,
            window,
        )

    def _doubt(self, proposal: Proposal) -> str:
        """Why a proposal is not believed; empty when it is."""
        peak = proposal.peak
        if peak is None:
            return proposal.reason
        if peak.false_alarm > self.config.false_alarm:
            return (
                f"ambiguous: the best place stands out by {peak.standing:.1f} sigma, another "
                f"by {peak.second:.1f}"
            )
        if peak.at_edge:
            return "the best place lies at the border of the window"
        if not np.isfinite(peak.covariance).all():
            return "no clear peak"
        return ""

    def _agree(self, first: Peak, second: Peak) -> bool:
        sigma = 3.0 * max(self.orbital.gsd_m, _sigma_m(first), _sigma_m(second))
        return math.hypot(first.x_m - second.x_m, first.y_m - second.y_m) < sigma

    def _candidate(self, patch: ReliefPatch, proposal: Proposal, peak: Peak) -> FixCandidate:
        of_map = self.config.map_sigma_pixels * proposal.pixel_m
        turn = np.eye(3)
        cosine, sine = math.cos(peak.yaw_rad), math.sin(peak.yaw_rad)
        turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
        covariance = proposal.inflation**2 * peak.covariance + turn @ patch.bending @ turn.T
        covariance = covariance + np.diag([of_map**2, of_map**2, (of_map / self.length_m) ** 2])
        yaw = math.remainder(patch.yaw_rad + peak.yaw_rad, 2.0 * math.pi)
        return FixCandidate(
            peak.x_m, peak.y_m, yaw, 0.5 * (covariance + covariance.T), peak.value,
            proposal.proposer, proposal.inliers,
        )  # fmt: skip

    def _height(self, patch: ReliefPatch, x_m: float, y_m: float) -> float | None:
        """Rover's height: the model's at the place, plus how the rover stands on the ground."""
        cell = self.cell_m
        model = self.orbital.height_on(Grid(x_m - cell, y_m + cell, cell, 3, 3))
        column, row = patch.grid.pixel(np.array(patch.x_m), np.array(patch.y_m))
        reach = max(1, round(1.0 / cell))
        i, j = round(float(row)), round(float(column))
        near = patch.height_m[max(0, i - reach) : i + reach + 1, max(0, j - reach) : j + reach + 1]
        if model is None or not np.isfinite(model.values).all() or not np.isfinite(near).any():
            return None
        ground = float(np.nanmedian(near))
        return float(model.values.mean()) + patch.z_m - ground


def _sigma_m(peak: Peak) -> float:
    """1-sigma of the place, both axes together."""
    return math.sqrt(float(np.trace(peak.covariance[:2, :2])))
