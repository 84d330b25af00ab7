"""How an optimisation ended: cost, chi-square of each kind of factor, the worst ones by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from frontends.measurements import FloatArray

_WORST = 10
_KINDS = {
    gtsam.GenericStereoFactor3D: "stereo landmarks",
    gtsam.BetweenFactorPose3: "motions",
    gtsam.AttitudeFactorPose3: "tilt",
    gtsam.PriorFactorPose3: "start",
}


@dataclass(frozen=True, slots=True)
class FactorKind:
    """All factors of one kind.

    Attributes
    ----------
    name
        What they measure.
    factors, residuals
        How many, and how many numbers they hold; the unknowns they determine are not
        subtracted.
    chi_square_before, chi_square_after
        Robust where the factor is.
    """

    name: str
    factors: int
    residuals: int
    chi_square_before: float
    chi_square_after: float


@dataclass(frozen=True, slots=True)
class WorstFactor:
    """A factor that fits badly: its name, chi-square and how many numbers it holds."""

    name: str
    chi_square: float
    residuals: int


@dataclass(frozen=True, slots=True)
class ConvergenceReport:
    """How the optimiser ended.

    Attributes
    ----------
    iterations
        Of Levenberg-Marquardt.
    cost_before, cost_after
        Half the robust chi-square.
    converged
        Whether it stopped because nothing improved any more.
    reason
        Why it stopped.
    factors, landmarks
        Size of the graph.
    landmarks_set_aside
        Landmarks left out: they had no place in front of the cameras that saw them.
    kinds
        Chi-square of each kind of factor.
    worst
        The ten factors with the largest chi-square a residual, the worst first.
    fixes_accepted, fixes_refused
        Map measurements that are in the graph, and that are not.
    """

    iterations: int
    cost_before: float
    cost_after: float
    converged: bool
    reason: str
    factors: int
    landmarks: int
    landmarks_set_aside: int = 0
    kinds: tuple[FactorKind, ...] = ()
    worst: tuple[WorstFactor, ...] = ()
    fixes_accepted: int = 0
    fixes_refused: int = 0


def factor_kinds(
    graph: gtsam.NonlinearFactorGraph,
    before: gtsam.Values,
    after: gtsam.Values,
    frames: Sequence[int],
    named: Mapping[int, str],
) -> tuple[tuple[FactorKind, ...], tuple[WorstFactor, ...]]:
    """Chi-square by kind, and the worst factors.

    Parameters
    ----------
    graph, before, after
        What was optimised, from where, and to where.
    frames
        Frame number of each keyframe.
    named
        Names of factors by their index, for those that their kind does not name.
    """
    count = graph.size()
    kinds: dict[str, list[int]] = {}
    squares, dims = np.zeros((count, 2)), np.zeros(count, dtype=np.int64)
    for i in range(count):
        factor = graph.at(i)
        kinds.setdefault(_kind(factor, named.get(i)), []).append(i)
        squares[i] = 2.0 * factor.error(before), 2.0 * factor.error(after)
        dims[i] = factor.dim()
    found = []
    for name, rows in kinds.items():
        total: FloatArray = squares[rows].sum(axis=0)
        found.append(
            FactorKind(name, len(rows), int(dims[rows].sum()), float(total[0]), float(total[1]))
        )
    worst = np.argsort(-squares[:, 1] / np.maximum(dims, 1), kind="stable")[:_WORST]
    return tuple(found), tuple(
        WorstFactor(
            named.get(int(i)) or _name(graph.at(int(i)), frames),
            float(squares[i, 1]),
            int(dims[i]),
        )
        for i in worst
    )


def _kind(factor: gtsam.NonlinearFactor, name: str | None) -> str:
    if name is not None:
        return {"fix": "fixes", "closure": "loop closures"}.get(name.split()[0], "heights")
    return _KINDS.get(type(factor), type(factor).__name__)


def _name(factor: gtsam.NonlinearFactor, frames: Sequence[int]) -> str:
    symbols = [gtsam.Symbol(key) for key in list(factor.keys())]
    poses = [str(frames[s.index()]) for s in symbols if s.chr() == ord("x")]
    tracks = [str(s.index()) for s in symbols if s.chr() == ord("l")]
    kind = _KINDS.get(type(factor), type(factor).__name__)
    if tracks:
        return f"stereo landmark, track {tracks[0]} at keyframe {poses[0]}"
    return f"{kind}, keyframe {' to '.join(poses)}"
