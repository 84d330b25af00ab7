"""Were the right fixes believed? Precision and recall of the verdicts against the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from frontends.measurements import AbsoluteFix, FloatArray
from lunar_fg.graph.ledger import LedgerEntry

#: A place within this of the truth is right, whatever sigma it states, m.
_RIGHT_M = 0.5
_RIGHT_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class FixCounts:
    """Fixes of a run by what they were and what was believed.

    Attributes
    ----------
    tried
        Keyframes at which the map was searched.
    right
        Of these, those with a candidate at the true place.
    accepted, accepted_right
        Those that were believed in the end, and at the true place.
    nees
        Mean squared error of the right places over their stated covariance, a degree of freedom;
        1 is honest. None without any.
    """

    tried: int = 0
    right: int = 0
    accepted: int = 0
    accepted_right: int = 0
    nees: float | None = None

    @property
    def precision(self) -> float | None:
        """Share of the believed ones that are right."""
        return self.accepted_right / self.accepted if self.accepted else None

    @property
    def recall(self) -> float | None:
        """Share of the right ones that were believed."""
        return self.accepted_right / self.right if self.right else None


def count_fixes(ledger: Iterable[LedgerEntry], position_m: Mapping[int, FloatArray]) -> FixCounts:
    """Hold the verdicts on fixes against the truth.

    Parameters
    ----------
    ledger
        Of the run; only fixes are counted.
    position_m
        True position (2,) or (3,) in the map by frame; frames without are left out.

    Returns
    -------
    FixCounts
        A place counts as right within half a metre or three of its own sigmas.
    """
    tried = right = accepted = accepted_right = 0
    squared: list[float] = []
    for entry in ledger:
        fix = entry.measurement
        if not isinstance(fix, AbsoluteFix) or fix.frame not in position_m:
            continue
        truth = position_m[fix.frame][:2]
        places = []
        for place in fix.candidates:
            error = np.array([place.x_m, place.y_m]) - truth
            distance2 = float(error @ np.linalg.solve(place.covariance[:2, :2], error))
            places.append(bool(np.hypot(*error) < _RIGHT_M or distance2 < _RIGHT_SIGMAS**2))
            if places[-1]:
                squared.append(0.5 * distance2)
        believed = entry.ruling.candidate
        tried += 1
        right += any(places)
        accepted += believed is not None
        accepted_right += believed is not None and places[believed]
    nees = float(np.mean(squared)) if squared else None
    return FixCounts(tried, right, accepted, accepted_right, nees)
