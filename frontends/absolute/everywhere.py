"""A lost rover: the patch anywhere in a large map, at any yaw, coarse to fine."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from frontends.absolute.adjustment import AbsoluteAdjustment, Adjustment
from frontends.absolute.channels import padded, rendered_channels
from frontends.absolute.correlating import RelitRelief
from frontends.absolute.patch import ReliefPatch
from frontends.absolute.peak import Peak
from frontends.absolute.proposal import Proposal, map_pixel, radius_m, window_bounds
from frontends.absolute.search import Search, Volume, correlate, turned, yaw_steps
from frontends.orbital import OrbitalMap
from frontends.terrain import Grid

#: Places of the coarse search that are looked at closely.
_PLACES = 12
_APART_PIXELS = 6
#: Half width of the close look: what a place stands out from must be in it too.
_NEAR_PIXELS = 24.0


class EverywhereRelief:
    """`RelitRelief` for windows of hundreds of metres and any yaw.

    The coarser patch is tried everywhere, at every other yaw; its best places are searched as
    usual. A place is believed against the best of all the others.

    Parameters
    ----------
    coarse
        The same ground laid out in larger cells, see `make_patch`.
    """

    def __init__(self, coarse: ReliefPatch) -> None:
        self._coarse = coarse

    @property
    def name(self) -> str:
        """Name, for the result."""
        return "relit relief, everywhere"

    def propose(self, patch: ReliefPatch, orbital: OrbitalMap, search: Search) -> Proposal:
        """See `Proposer`."""
        if orbital.ortho is None or orbital.sun is None:
            return Proposal(self.name, reason="needs an ortho image and its sun")
        coarse = self._coarse
        window = orbital.ortho.window(window_bounds(coarse, search), coarse.grid.cell_m)
        pixel = map_pixel(orbital, coarse)
        channels, anchor = rendered_channels(coarse, window, orbital.sun, pixel)
        yaws = yaw_steps(search.half_yaw_rad, 0.3 * radius_m(coarse), coarse.grid.cell_m)
        volume = correlate(channels, yaws, window.grid, anchor)
        step = float(yaws[1] - yaws[0])
        found: list[Proposal] = []
        for x, y, yaw in _best_places(volume, round(_APART_PIXELS * pixel)):
            moved = _laid_out(patch, x, y, yaw)
            half = _NEAR_PIXELS * orbital.gsd_m
            near = Search(half, half, 1.5 * step)
            proposal = RelitRelief().propose(moved, orbital, near)
            # at the edge of a close look stands what another one has in its middle
            if proposal.peak is not None and not proposal.peak.at_edge:
                peak = replace(
                    proposal.peak, yaw_rad=math.remainder(proposal.peak.yaw_rad + yaw, math.tau)
                )
                found.append(replace(proposal, proposer=self.name, peak=peak))
        return _against_each_other(found, self.name, volume, _APART_PIXELS * orbital.gsd_m)


def locate_everywhere(
    adjustment: AbsoluteAdjustment, patch: ReliefPatch, coarse: ReliefPatch, search: Search
) -> Adjustment:
    """Search a large part of the map without trust in the prior pose."""
    lost = AbsoluteAdjustment(adjustment.orbital, adjustment.config, (EverywhereRelief(coarse),))
    return lost.locate(patch, patch.frame, search)


def _laid_out(patch: ReliefPatch, x: float, y: float, yaw: float) -> ReliefPatch:
    """The patch turned about its anchor and moved to a place."""
    heights, ortho, known, centre = padded(patch)
    high, seen = turned(heights, known, yaw, centre)
    grey, _ = turned(ortho, known, yaw, centre)
    cell = patch.grid.cell_m
    row, column = centre
    grid = Grid(x - column * cell, y + row * cell, cell, *high.shape)
    return replace(
        patch,
        x_m=x,
        y_m=y,
        grid=grid,
        height_m=np.where(seen, high, np.nan).astype(np.float32),
        ortho=np.where(seen, grey, np.nan).astype(np.float32),
    )


def _best_places(volume: Volume, apart: int) -> list[tuple[float, float, float]]:
    """The highest maxima that are apart in x and y."""
    values = np.where(np.isfinite(volume.values), volume.values, -1.0)
    if values.size == 0:
        return []
    best, which = values.max(axis=0), values.argmax(axis=0)
    places = []
    for _ in range(_PLACES):
        i, j = (int(n) for n in np.unravel_index(int(best.argmax()), best.shape))
        if best[i, j] <= 0.0:
            break
        x, y = volume.grid.place(np.array(j), np.array(i))
        places.append((float(x), float(y), float(volume.yaws_rad[which[i, j]])))
        best[
            max(0, i - apart) : i + apart + 1,
            max(0, j - apart) : j + apart + 1,
        ] = -1.0
    return places


def _against_each_other(
    found: list[Proposal], name: str, volume: Volume, apart_m: float
) -> Proposal:
    """The best place, with the best of the others as its second; neighbours find the same one."""
    peaks: list[tuple[Peak, Proposal]] = [(p.peak, p) for p in found if p.peak is not None]
    if not peaks:
        return Proposal(name, reason="no place of the map resembles the patch", volume=volume)
    peaks.sort(key=lambda item: -item[0].standing)
    best, proposal = peaks[0]
    others = [
        peak.standing
        for peak, _ in peaks[1:]
        if math.hypot(peak.x_m - best.x_m, peak.y_m - best.y_m) > apart_m
    ]
    return replace(proposal, peak=replace(best, second=max([best.second, *others])))
