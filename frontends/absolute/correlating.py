"""Proposers by correlation: the re-lit relief in the image, the relief in the DEM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from frontends.absolute.channels import elevation_channels, rendered_channels
from frontends.absolute.patch import ReliefPatch
from frontends.absolute.peak import find_peak
from frontends.absolute.proposal import Proposal, map_pixel, radius_m, window_bounds
from frontends.absolute.search import Channel, Search, correlate, yaw_steps
from frontends.orbital import MapWindow, OrbitalMap

#: Known share of the map window below which there is nothing to search in.
_LEAST_KNOWN = 0.3
#: Share of a patch in shadow under the map's sun above which it is too dark.
_MOST_DARK = 0.6
#: Pixels of an elevation model that a patch must cover: models resolve some three pixels, and
#: what fewer than some two hundred such blots say is wrong by more than it seems.
_LEAST_DEM_PIXELS = 2000
#: The errors of an elevation model are as long as its relief, and longer than what other ground
#: makes of the correlation: they shift the peak as one. From simulated models against truth.
_DEM_INFLATION = 1.5


@dataclass(frozen=True, slots=True)
class RelitRelief:
    """The rover's relief, lit by the map's sun, in the ortho image."""

    name: str = "relit relief"

    def propose(self, patch: ReliefPatch, orbital: OrbitalMap, search: Search) -> Proposal:
        """See `Proposer`."""
        if orbital.ortho is None or orbital.sun is None:
            what = "no ortho image" if orbital.ortho is None else "the map's sun is not known"
            return Proposal(self.name, reason=what)
        if orbital.sun.elevation_deg <= 0.0:
            return Proposal(self.name, reason="too dark: the map's sun is below the horizon")
        window = orbital.ortho.window(window_bounds(patch, search), patch.grid.cell_m)
        sun, pixel = orbital.sun, map_pixel(orbital, patch)
        found = _correlated(
            self.name, patch, window, search, pixel,
            lambda: rendered_channels(patch, window, sun, pixel),
        )  # fmt: skip
        return replace(found, pixel_m=orbital.ortho.gsd_m)


@dataclass(frozen=True, slots=True)
class ReliefInDem:
    """The rover's slopes in those of the orbital elevation model."""

    name: str = "relief in DEM"

    def propose(self, patch: ReliefPatch, orbital: OrbitalMap, search: Search) -> Proposal:
        """See `Proposer`."""
        if orbital.dem is None:
            return Proposal(self.name, reason="no elevation model")
        pixels = int(patch.area_m2 / orbital.dem.gsd_m**2)
        if pixels < _LEAST_DEM_PIXELS:
            reason = f"too small: {pixels} pixels of the model, {_LEAST_DEM_PIXELS} are needed"
            return Proposal(self.name, reason=reason)
        window = orbital.height(window_bounds(patch, search), patch.grid.cell_m)
        assert window is not None
        pixel = map_pixel(orbital, patch)
        found = _correlated(
            self.name, patch, window, search, pixel,
            lambda: elevation_channels(patch, window, pixel),
        )  # fmt: skip
        return replace(found, pixel_m=orbital.dem.gsd_m, inflation=_DEM_INFLATION)


def _correlated(
    name: str,
    patch: ReliefPatch,
    window: MapWindow,
    search: Search,
    pixel: float,
    make: Callable[[], tuple[list[Channel], tuple[float, float]]],
) -> Proposal:
    known = float(np.isfinite(window.values).mean())
    if known < _LEAST_KNOWN:
        reason = f"the map has no data there ({known:.0%} of the window is known)"
        return Proposal(name, reason=reason, window=window)
    channels, anchor = make()
    template, seen = channels[0].template(0.0)
    if seen.any() and float(np.mean(np.abs(template[seen]) < 1e-6)) > _MOST_DARK:
        return Proposal(name, reason="too dark or flat under the map's sun", window=window)
    yaws = yaw_steps(search.half_yaw_rad, 0.6 * radius_m(patch), patch.grid.cell_m)
    volume = correlate(channels, yaws, window.grid, anchor)
    peak = find_peak(volume, pixel)
    shown = MapWindow(window.grid, np.where(channels[0].mask, channels[0].image, np.nan))
    picture = np.where(seen, template, np.nan).astype(np.float32)
    reason = "" if peak else "the map does not hold the patch anywhere in the window"
    return Proposal(name, peak, reason, window=shown, template=picture, volume=volume)
