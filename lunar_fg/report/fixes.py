"""The fixes of a run for the report: what was decided, and how it came about."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass

import numpy as np

from frontends.errors import LunarFgError
from frontends.measurements import AbsoluteFix, Verdict
from lunar_fg import replay
from lunar_fg.fix_pictures import FixPictures
from lunar_fg.graph.ledger import LedgerEntry
from lunar_fg.ledger import entry_values
from lunar_fg.report.orbital_image import thumbnail
from lunar_fg.results import RunResults
from lunar_fg.trajectory import Trajectory

#: Side of the ground that a thumbnail shows, m, and how many fixes have one.
_SHOWN_M = 24.0
_MOST = 60


@dataclass(frozen=True, slots=True)
class FixRow:
    """One fix or loop closure.

    Attributes
    ----------
    keyframe
        Its number; of a loop closure both.
    verdict
        ``accepted`` or ``refused``.
    facts
        Proposer, score and the like, as text by name.
    reason, history
        In words; earlier verdicts, if they changed.
    picture
        What the run drew of it (`lunar_fg.fix_pictures`), as a data URI; "" where it did not.
    orbital
        Instead, a thumbnail of the orbital map about it, as a data URI or "".
    """

    keyframe: str
    verdict: str
    facts: dict[str, str]
    reason: str
    history: str
    picture: str
    orbital: str


def fix_rows(results: RunResults) -> list[FixRow]:
    """Every entry of the ledger, in the order of the keyframes."""
    entries = sorted(results.ledger, key=lambda entry: entry.frame)
    return [_row(results, entry, number < _MOST) for number, entry in enumerate(entries)]


def without_fixes(results: RunResults) -> tuple[Trajectory | None, str]:
    """Trajectory from the same log, as it would be without the fixes that were believed.

    Returns
    -------
    tuple
        The trajectory, or None and the reason ("" where no fix was believed).
    """
    if not any(entry.ruling.verdict is Verdict.ACCEPTED for entry in results.ledger):
        return None, ""
    try:
        return replay.without_fixes(results.folder), ""
    except LunarFgError as error:
        return None, f"without fixes: not computed: {error}"


def _row(results: RunResults, entry: LedgerEntry, pictured: bool) -> FixRow:
    values = entry_values(entry)
    measurement = entry.measurement
    picture = orbital = ""
    if pictured and isinstance(measurement, AbsoluteFix):
        drawn = FixPictures(results.folder.fixes_path).path(entry.frame)
        source = results.source
        if drawn.is_file():
            picture = "data:image/jpeg;base64," + b64encode(drawn.read_bytes()).decode()
        elif measurement.candidates and source is not None and source.ortho is not None:
            place = measurement.candidates[entry.ruling.candidate or 0]
            centre = np.array([place.x_m, place.y_m])
            orbital = thumbnail(source.ortho, results.georeference, centre, _SHOWN_M)
    facts = {
        "proposed by": values["proposer"] or {"closure": "an old place"}.get(values["kind"], ""),
        "score": _text(values["score"]),
        "inliers": _text(values["inliers"] or None),
        "second best / best": _text(values["second_best_ratio"]),
        "distance from the expected": _text(values["mahalanobis"], " sigma"),
    }
    past = [f"{old.verdict.value} at {old.at_frame} ({old.reason})" for old in entry.history[:-1]]
    keyframe = str(entry.frame) if entry.base is None else f"{entry.base} - {entry.frame}"
    return FixRow(
        keyframe,
        values["verdict"],
        {name: text for name, text in facts.items() if text},
        values["reason"],
        "; ".join(past),
        picture,
        orbital,
    )


def _text(value: float | None, unit: str = "") -> str:
    return "" if value is None else f"{value:.3g}{unit}"
