"""What every proposer takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from frontends.absolute.patch import ReliefPatch
from frontends.absolute.peak import Peak
from frontends.absolute.search import Search, Volume
from frontends.orbital import MapWindow, OrbitalMap

Layer = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Proposal:
    """A place found by one method, or why there is none.

    Attributes
    ----------
    proposer
        Name of the method.
    peak
        The place.
    reason
        Why there is none.
    inliers
        Matches that agree, where it was found from matches.
    window
        Part of the map that was compared, high-passed or not as the method has it.
    template
        The patch as the method compared it, at its own yaw.
    volume
        Coefficients of all places, where there are any.
    pixel_m
        Of the map that was compared; 0 where none was.
    inflation
        Factor on the peak's 1-sigma: what the method's own account of its noise leaves out.
    """

    proposer: str
    peak: Peak | None = None
    reason: str = ""
    inliers: int = 0
    window: MapWindow | None = None
    template: Layer | None = None
    volume: Volume | None = None
    pixel_m: float = 0.0
    inflation: float = 1.0


class Proposer(Protocol):
    """A method that finds the patch in the map."""

    @property
    def name(self) -> str:
        """Name, for the result."""
        ...

    def propose(self, patch: ReliefPatch, orbital: OrbitalMap, search: Search) -> Proposal:
        """Look for the patch within the search window."""
        ...


def map_pixel(orbital: OrbitalMap, patch: ReliefPatch) -> float:
    """The map's pixel in cells of the patch; at least one."""
    return max(1.0, orbital.gsd_m / patch.grid.cell_m)


def radius_m(patch: ReliefPatch) -> float:
    """Distance of the farthest known cell from the anchor."""
    rows, columns = np.nonzero(patch.mask)
    x, y = patch.grid.place(columns.astype(np.float64), rows.astype(np.float64))
    return float(np.hypot(x - patch.x_m, y - patch.y_m).max()) if len(rows) else 0.0


def window_bounds(patch: ReliefPatch, search: Search) -> tuple[float, float, float, float]:
    """Part of the map that holds the patch wherever the anchor may be, whatever its yaw."""
    reach = radius_m(patch) + 4.0 * patch.grid.cell_m
    return (
        patch.x_m - search.half_x_m - reach,
        patch.y_m - search.half_y_m - reach,
        patch.x_m + search.half_x_m + reach,
        patch.y_m + search.half_y_m + reach,
    )
