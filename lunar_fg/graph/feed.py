"""The same measurements again, in the order in which they came."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from frontends.measurements import AbsoluteFix, Estimate
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.graph.ledger import (
    FixDecision,
    Height,
    LedgerEntry,
    LoopClosure,
    MapMeasurement,
    Ruling,
)


def feed(
    smoother: IncrementalSmoother, keyframes: Iterable[Keyframe], ledger: Iterable[LedgerEntry]
) -> Iterator[tuple[Estimate, tuple[FixDecision, ...]]]:
    """Feed a smoother with logged keyframes and map measurements, and a person's words.

    Verdicts are reached anew: with the same configuration the same ones.

    Parameters
    ----------
    smoother
        An empty one.
    keyframes
        In order.
    ledger
        Of the run; each entry goes in after the keyframe at which it came.

    Yields
    ------
    tuple
        Of each keyframe its estimate, before the map measurements that came with it, and what
        was decided on these.

    Raises
    ------
    InputError, EstimationError
        As the smoother's own methods.
    """
    events: list[tuple[Ruling, MapMeasurement | None, LedgerEntry]] = []
    for entry in ledger:
        events.append((entry.history[0], entry.measurement, entry))
        events += [(ruling, None, entry) for ruling in entry.history if ruling.by_person]
    events.sort(key=lambda event: event[0].number)
    at = 0
    for keyframe in keyframes:
        estimate, decisions = smoother.add(keyframe), []
        while at < len(events) and events[at][0].at_frame <= keyframe.index:
            decisions.append(_enter(smoother, *events[at]))
            at += 1
        yield estimate, tuple(decisions)


def _enter(
    smoother: IncrementalSmoother, ruling: Ruling, what: MapMeasurement | None, of: LedgerEntry
) -> FixDecision:
    if isinstance(what, AbsoluteFix):
        return smoother.add_fix(what)
    if isinstance(what, LoopClosure):
        return smoother.add_relative(what.base, what.frame, what.a_T_b, what.covariance)
    if isinstance(what, Height):
        return smoother.add_height(what.frame, what.z_m, what.sigma_m)
    if ruling.candidate is None:
        return smoother.reject(of.frame, of.base)
    return smoother.accept(of.frame, of.base, ruling.candidate)
