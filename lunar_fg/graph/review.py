"""Map measurements in the whole graph: which are in it, each held against all the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.stats import chi2

from frontends.geometry import adjoint, inverse, se3_log
from frontends.measurements import AbsoluteFix, FixCandidate, FloatArray, Verdict
from lunar_fg.graph.anchors import Anchor, fix_factor, height_factor, relative_factor
from lunar_fg.graph.config import GraphConfig
from lunar_fg.graph.factors import pose_key
from lunar_fg.graph.keyframe import floored
from lunar_fg.graph.ledger import Height, LedgerEntry, LoopClosure, Ruling
from lunar_fg.graph.planar import Planar, planar, planar_jacobian, wrapped

_REST_FLOOR = 1e-9

JointCovariance = Callable[[int, int], FloatArray]


class Review:
    """The verdicts that the batch optimiser works with.

    Parameters
    ----------
    frames
        Frame number of each keyframe.
    ledger
        The verdicts so far.
    config
        The gate.
    """

    def __init__(
        self, frames: Sequence[int], ledger: Sequence[LedgerEntry], config: GraphConfig
    ) -> None:
        self._frames = frames
        self._ordinal = {frame: i for i, frame in enumerate(frames)}
        self._ledger = list(ledger)
        self._barrier = float(chi2.ppf(config.fix_gate_probability, 3))
        self._closure_barrier = float(chi2.ppf(config.fix_gate_probability, 6))
        self._height_gate = float(chi2.ppf(config.fix_gate_probability, 1))
        self._rulings = 1 + max((r.number for e in ledger for r in e.history), default=-1)

    @property
    def ledger(self) -> tuple[LedgerEntry, ...]:
        """The verdicts now."""
        return tuple(self._ledger)

    @property
    def accepted(self) -> tuple[LedgerEntry, ...]:
        """Those that are in."""
        return tuple(e for e in self._ledger if e.ruling.verdict is Verdict.ACCEPTED)

    def factors(self, map_T_rover: FloatArray) -> tuple[gtsam.NonlinearFactorGraph, list[str]]:
        """Factors of all that is accepted, and their names.

        Parameters
        ----------
        map_T_rover
            (N, 4, 4) about where the keyframes are.
        """
        graph, names = gtsam.NonlinearFactorGraph(), []
        for entry in self.accepted:
            here, what = self._ordinal[entry.frame], entry.measurement
            anchor, pose = Anchor((pose_key(here),)), map_T_rover[here]
            if isinstance(what, LoopClosure):
                base = Anchor((pose_key(self._ordinal[what.base]),))
                names.append(f"closure {what.base} to {what.frame}")
                noise = floored(what.covariance)
                graph.add(relative_factor(base, anchor, what.a_T_b, noise, names[-1]))
                continue
            if isinstance(what, Height):
                names.append(f"height {what.frame}")
                graph.add(height_factor(anchor, what.z_m, what.sigma_m, pose))
                continue
            choice = entry.ruling.candidate or 0
            names.append(f"fix {what.frame}")
            graph.add(fix_factor(anchor, _place(what.candidates[choice]), pose, names[-1]))
            if choice == 0 and what.height_m is not None and what.sigma_height_m is not None:
                off = (what.height_m - pose[2, 3]) / what.sigma_height_m
                if off * off <= self._height_gate:
                    names.append(f"height of fix {what.frame}")
                    graph.add(height_factor(anchor, what.height_m, what.sigma_height_m, pose))
        return graph, names

    def revise(
        self, map_T_rover: FloatArray, covariance: FloatArray, joint: JointCovariance
    ) -> bool:
        """Hold every fix and closure against what all others say, and change the worst verdict.

        Parameters
        ----------
        map_T_rover, covariance
            (N, 4, 4) and (N, 6, 6) of the solved graph, with what is accepted now.
        joint
            Of two keyframes by ordinal, (12, 12).

        Returns
        -------
        bool
            False where every verdict stands.
        """
        most = 0.0
        worst: tuple[int, int | None, float] = (0, None, 0.0)
        for i, entry in enumerate(self._ledger):
            what, chosen = entry.measurement, entry.ruling.candidate
            if entry.ruling.by_person or isinstance(what, Height):
                continue
            here = self._ordinal[what.frame]
            if isinstance(what, LoopClosure):
                base, barrier = self._ordinal[what.base], self._closure_barrier
                ends = (map_T_rover[base], map_T_rover[here])
                distance = _closure_distance(what, chosen is not None, *ends, joint(base, here))
            elif what.candidates:
                barrier = self._barrier
                distance = _distances(what, chosen, map_T_rover[here], covariance[here])
            else:
                continue
            nearest = int(np.argmin(distance))
            choice = nearest if distance[nearest] <= barrier else None
            now = barrier if chosen is None else distance[chosen]
            gain = float(now - min(distance[nearest], barrier))
            if choice != chosen and gain > most:
                most, worst = gain, (i, choice, float(np.sqrt(distance[nearest])))
        if most > 0.0:
            self._change(*worst)
        return most > 0.0

    def _change(self, entry: int, choice: int | None, sigmas: float) -> None:
        word = "taken back" if choice is None else "let in"
        ruling = Ruling(
            self._frames[-1],
            Verdict.REFUSED if choice is None else Verdict.ACCEPTED,
            choice,
            sigmas,
            f"{word}: {sigmas:.1f} sigma from what all else says in the whole graph",
            self._rulings,
        )
        self._rulings += 1
        old = self._ledger[entry]
        self._ledger[entry] = replace(old, history=(*old.history, ruling))


def _place(candidate: FixCandidate) -> Planar:
    xyyaw = np.array([candidate.x_m, candidate.y_m, wrapped(candidate.yaw_rad)])
    return Planar(xyyaw, np.asarray(candidate.covariance))


def _distances(
    fix: AbsoluteFix, chosen: int | None, pose: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Squared innovations of all places against everything but this fix."""
    jacobian = planar_jacobian(pose)
    marginal, here = jacobian @ covariance @ jacobian.T, planar(pose)
    if chosen is not None:
        place = _place(fix.candidates[chosen])
        here, marginal = _without(here, marginal, place.xyyaw, place.covariance, yaw=2)
    result = np.empty(len(fix.candidates))
    for i, candidate in enumerate(fix.candidates):
        place = _place(candidate)
        off = place.xyyaw - here
        off[2] = wrapped(off[2])
        result[i] = off @ np.linalg.solve(place.covariance + marginal, off)
    return result


def _closure_distance(
    closure: LoopClosure, inside: bool, base: FloatArray, here: FloatArray, joint: FloatArray
) -> FloatArray:
    """Squared innovation of a loop closure against everything but itself, (1,)."""
    a_T_b, noise = inverse(base) @ here, floored(closure.covariance)
    by_ends = np.hstack([-adjoint(inverse(a_T_b)), np.eye(6)])
    marginal, off = by_ends @ joint @ by_ends.T, se3_log(inverse(closure.a_T_b) @ a_T_b)
    if inside:
        off, marginal = _without(off, marginal, np.zeros(6), noise)
    return np.array([off @ np.linalg.solve(noise + marginal, off)])


def _without(
    estimate: FloatArray,
    covariance: FloatArray,
    measured: FloatArray,
    noise: FloatArray,
    yaw: int | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Take a direct measurement out of an estimate that it went into."""
    rest = noise - covariance + _REST_FLOOR * noise
    off = estimate - measured
    if yaw is not None:
        off[yaw] = wrapped(off[yaw])
    return (
        estimate + covariance @ np.linalg.solve(rest, off),
        covariance + covariance @ np.linalg.solve(rest, covariance),
    )
