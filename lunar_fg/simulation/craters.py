"""Craters: how many of which size and age, and their shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.jit import kernel, njit

FloatArray = NDArray[np.float64]

#: Depth over diameter of a fresh small crater, and of the oldest that is still one.
FRESH_DEPTH, OLD_DEPTH = 0.14, 0.012
#: Ejecta are followed out to so many radii.
REACH = 3.0


@dataclass(frozen=True, slots=True)
class Craters:
    """Craters in map axes.

    Attributes
    ----------
    x, y, diameter
        (N,) m.
    depth
        (N,) depth below the surroundings over diameter; 0.14 is fresh.
    lobes
        (N, 4) cosine and sine amplitudes of the outline's 2nd and 3rd harmonic, as shares
        of the radius: real outlines are not circles.
    """

    x: FloatArray
    y: FloatArray
    diameter: FloatArray
    depth: FloatArray
    lobes: FloatArray

    def __len__(self) -> int:
        return len(self.x)

    def larger_than(self, diameter_m: float) -> Craters:
        """Those at least so large."""
        keep = self.diameter >= diameter_m
        return Craters(
            self.x[keep], self.y[keep], self.diameter[keep], self.depth[keep], self.lobes[keep]
        )

    def add_to(self, height: FloatArray, x0: float, y0: float, spacing_m: float) -> None:
        """Dig into a relief, in place; row 0 is at `y0` (south), column 0 at `x0` (west)."""
        _dig(height, x0, y0, spacing_m, self.x, self.y, self.diameter, self.depth, self.lobes)


def draw_craters(
    rng: np.random.Generator,
    density: float,
    bands: list[tuple[float, float, tuple[float, float, float, float]]],
) -> Craters:
    """Craters by ``N(>D) = density * D**-2`` a square metre, the equilibrium of small ones.

    Depth over diameter is log-uniform between fresh and nearly gone: diffusion by small
    impacts takes a crater through its shallow states ever more slowly.

    Parameters
    ----------
    rng
        Source of randomness.
    density
        See above.
    bands
        Smallest and largest diameter, m, and the area to fill (x0, y0, x1, y1), m: small
        craters need not be drawn where nobody looks.
    """
    parts = []
    for smallest, largest, (x0, y0, x1, y1) in bands:
        most = density * (smallest**-2 - largest**-2)
        n = rng.poisson(most * (x1 - x0) * (y1 - y0))
        share = rng.uniform(0.0, 1.0, n)
        diameter = (smallest**-2 - share * (smallest**-2 - largest**-2)) ** -0.5
        x, y = rng.uniform(x0, x1, n), rng.uniform(y0, y1, n)
        depth = np.exp(rng.uniform(np.log(OLD_DEPTH), np.log(FRESH_DEPTH), n))
        parts.append((x, y, diameter, depth, rng.normal(0.0, 0.03, (n, 4))))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Craters(*columns)


@njit
def _profile(r: float, depth: float, freshness: float) -> float:
    """Height over diameter at r radii from the centre; cf. Pike (1977), McGetchin (1973)."""
    rim = 0.04 * freshness
    bowl = (depth + rim) * r * r - depth
    ejecta = rim / max(r, 0.5) ** 3
    # the sharper the fresher: a smooth minimum of bowl and ejecta blanket
    soft = 0.01 + 0.05 * depth + 0.03 * (1.0 - freshness) * depth
    gap = bowl - ejecta
    inner = 0.5 * (bowl + ejecta - np.sqrt(gap * gap + soft * soft))
    fade = min(max((REACH - r) / (REACH - 1.5), 0.0), 1.0)
    return float(inner * fade * fade * (3.0 - 2.0 * fade))


@kernel
def _dig(
    height: FloatArray,
    x0: float,
    y0: float,
    spacing: float,
    x: FloatArray,
    y: FloatArray,
    diameter: FloatArray,
    depth: FloatArray,
    lobes: FloatArray,
) -> None:
    rows, columns = height.shape
    for k in range(len(x)):
        radius = 0.5 * diameter[k]
        reach = REACH * radius * 1.15
        freshness = depth[k] / FRESH_DEPTH
        first_row = max(int(np.ceil((y[k] - reach - y0) / spacing)), 0)
        last_row = min(int(np.floor((y[k] + reach - y0) / spacing)), rows - 1)
        first_column = max(int(np.ceil((x[k] - reach - x0) / spacing)), 0)
        last_column = min(int(np.floor((x[k] + reach - x0) / spacing)), columns - 1)
        for i in range(first_row, last_row + 1):
            dy = y0 + i * spacing - y[k]
            for j in range(first_column, last_column + 1):
                dx = x0 + j * spacing - x[k]
                distance = np.sqrt(dx * dx + dy * dy)
                stretch = 1.0
                if distance > 0.0:
                    c, s = dx / distance, dy / distance
                    c2, s2 = c * c - s * s, 2.0 * c * s
                    c3, s3 = c2 * c - s2 * s, s2 * c + c2 * s
                    stretch += lobes[k, 0] * c2 + lobes[k, 1] * s2
                    stretch += lobes[k, 2] * c3 + lobes[k, 3] * s3
                r = distance / (radius * stretch)
                if r < REACH:
                    height[i, j] += diameter[k] * _profile(r, depth[k], freshness)
