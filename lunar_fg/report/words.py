"""A run in plain words and a few large figures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frontends.measurements import Estimate, Verdict
from lunar_fg.ledger import verdicts
from lunar_fg.report.against_truth import AgainstTruth
from lunar_fg.results import RunResults

#: Warnings about figures that are missing, not about the run: "nees: not computed: ...".
_ABOUT_FIGURES = re.compile(r"^[a-z0-9_.]+: (not computed|a short path|after SE)")


@dataclass(frozen=True, slots=True)
class Card:
    """One large figure.

    Attributes
    ----------
    value, unit, label
        As shown.
    tone
        ``""``, ``"good"`` or ``"bad"``.
    """

    value: str
    unit: str
    label: str
    tone: str = ""


def cards(results: RunResults, compared: AgainstTruth | None) -> list[Card]:
    """The figures that a reader wants first."""
    found = [Card(f"{results.trajectory.distance_m:.1f}", "m", "driven, by the estimate")]
    frames, lost = results.metrics.get("frames"), results.metrics.get("frames_lost")
    if frames is not None and lost is not None:
        tone = "good" if lost == 0 else "bad"
        found.append(Card(f"{lost}", f"of {frames}", "frames lost", tone))
    if compared is not None:
        profile = compared.profiles["smoothed"]
        end, driven = float(profile.position_m[-1]), float(profile.distance_m[-1])
        found.append(Card(metres(end), "", "error at the end"))
        if driven > 0.0:
            found.append(Card(f"{100.0 * end / driven:.2f}", "%", "of the distance, at the end"))
    for what, given in verdicts(results.ledger).items():
        believed = given.count(Verdict.ACCEPTED)
        found.append(Card(f"{believed}", f"of {len(given)}", f"{what} believed"))
    ate = (results.metrics.get("ate_rmse_m") or {}).get("se3")
    if ate is not None:
        found.append(Card(metres(ate), "", "ATE, SE(3)-aligned"))
    nees = results.metrics.get("nees") or {}
    if nees.get("mean") is not None:
        inside = nees["lower95"] <= nees["mean"] <= nees["upper95"]
        found.append(
            Card(_number(nees["mean"]), "", "NEES / dof, 1 is honest", "good" if inside else "bad")
        )
    total = (results.metrics.get("timing_ms") or {}).get("total")
    if total is not None:
        found.append(Card(f"{total['median']:.0f}", "ms", "a frame, median"))
    return found


def sentences(results: RunResults, compared: AgainstTruth | None) -> list[str]:
    """What a reader must know about the run, one sentence each, the gravest first."""
    found: list[str] = []
    if lost := lost_frames(results.estimates):
        found.append(
            f"The motion was not measured, only predicted, in {_count(lost, 'frame')}: "
            f"{spans(lost)}."
        )
    nees = results.metrics.get("nees") or {}
    if nees.get("mean") is not None and not nees["lower95"] <= nees["mean"] <= nees["upper95"]:
        factor = _number(float(np.sqrt(nees["mean"])))
        wrong = "small" if nees["mean"] > nees["upper95"] else "large"
        found.append(
            f"The covariances are too {wrong}: errors are about {factor} times as large as stated."
        )
    for what, given in verdicts(results.ledger).items():
        if refused := given.count(Verdict.REFUSED):
            share = f"{refused} of {len(given)} {what}"
            found.append(f"{share} were refused; the reasons are below.")
    found += (results.metrics.get("route") or {}).get("alarms", ())
    found += [w for w in _warnings(results) if not _ABOUT_FIGURES.match(w)]
    if results.truth is not None and compared is None:
        found.append("The truth does not fit the run in time or shape: nothing was compared.")
    return [text[:1].upper() + text[1:] for text in found]


def remarks(results: RunResults) -> list[str]:
    """Why figures are missing, and what to know when reading the others."""
    return [w for w in _warnings(results) if _ABOUT_FIGURES.match(w)] + list(results.notes)


def lost_frames(estimates: Sequence[Estimate]) -> list[int]:
    """Frames whose motion was only predicted."""
    return [estimate.index for estimate in estimates if estimate.lost]


def spans(numbers: Sequence[int], most: int = 8) -> str:
    """Numbers as spans: 3, 7-9, 12."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    texts = [f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")


def metres(value: float) -> str:
    """A length with three figures, in the unit that suits it."""
    if abs(value) < 0.1:
        return f"{1e3 * value:.3g} mm"
    return f"{value:.3g} m" if abs(value) < 1000.0 else f"{value:.0f} m"


def _number(value: float) -> str:
    """Two or three figures, no exponent."""
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2f}"


def _count(items: Sequence[object], noun: str) -> str:
    return f"1 {noun}" if len(items) == 1 else f"{len(items)} {noun}s"


def _warnings(results: RunResults) -> list[str]:
    """Of the metrics, without the route's alarms that are said on their own."""
    return [str(warning) for warning in results.metrics.get("warnings") or ()]
