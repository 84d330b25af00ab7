"""The fix ledger of a run, and a person's word on it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from frontends.measurements import AbsoluteFix, Verdict
from lunar_fg.config import Config
from lunar_fg.evaluation.metrics import to_json
from lunar_fg.graph.feed import feed
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.ledger import FixDecision, Height, LedgerEntry, LoopClosure
from lunar_fg.log import TraverseLog
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.trajectory import Trajectory
from lunar_fg.truth import as_trajectory, compare


def read_ledger(folder: RunFolder) -> list[LedgerEntry]:
    """Read every map measurement of a run with all verdicts on it, as they came.

    Raises
    ------
    InputError
        The folder holds no log.
    """
    with TraverseLog.open(folder.database_path) as log:
        return log.ledger()


def verdicts(ledger: Iterable[LedgerEntry]) -> dict[str, list[Verdict]]:
    """Verdicts that hold, by what was judged: ``fixes`` (and heights), ``loop closures``."""
    found: dict[str, list[Verdict]] = {}
    for entry in ledger:
        loop = isinstance(entry.measurement, LoopClosure)
        found.setdefault("loop closures" if loop else "fixes", []).append(entry.ruling.verdict)
    return found


def overrule(
    folder: RunFolder, frame: int, base: int | None = None, candidate: int | None = 0
) -> FixDecision:
    """Believe a place of a fix, or with None refuse the fix; the trajectory follows.

    The run is solved anew from its log. The log keeps the word for good; ``trajectory.tum``,
    ``trajectory.kitti``, ``covariance.npz`` and what ``metrics.json`` says of the accuracy are
    written anew.

    Parameters
    ----------
    folder
        Of a finished run.
    frame, base
        Keyframe of the fix; with `base`, of the loop closure from that keyframe.
    candidate
        Which of its places, or None.

    Raises
    ------
    InputError
        There is no such measurement or place, or the log cannot be written.
    """
    with TraverseLog.reopen(folder.database_path) as log:
        header, keyframes, ledger = log.header(), log.keyframes(), log.ledger()
        config = Config.model_validate_json(header.config_json)
        smoother = IncrementalSmoother(
            header.camera, header.rover_T_camera, header.start, config.graph
        )
        list(feed(smoother, keyframes, ledger))
        if candidate is None:
            decision = smoother.reject(frame, base)
        else:
            decision = smoother.accept(frame, base, candidate)
        smoother.finish()
        trajectory = as_trajectory(smoother.trajectory())
        log.replace_ledger(smoother.ledger)
    _write_accuracy(folder, trajectory)
    folder.write_trajectory(trajectory, rover_T_camera=header.rover_T_camera)
    return decision


def _write_accuracy(folder: RunFolder, trajectory: Trajectory) -> None:
    """Bring the metrics to a new trajectory; counts, times and the run's warnings stay."""
    if not folder.metrics_path.is_file():
        return
    figures, truth = folder.read_metrics(), folder.read_truth()
    before, now = compare(folder.read_trajectory(), truth), compare(trajectory, truth)
    of_run = [text for text in figures.get("warnings", ()) if text not in before.warnings]
    figures |= {**asdict(now), "warnings": [*of_run, *now.warnings]}
    write_whole(folder.metrics_path, to_json(figures).encode())


def entry_values(entry: LedgerEntry) -> dict[str, Any]:
    """An entry as plain values, for JSON and for tables."""
    measurement, ruling = entry.measurement, entry.ruling
    fix = measurement if isinstance(measurement, AbsoluteFix) else None
    told = fix.candidates[ruling.candidate or 0] if fix and fix.candidates else None
    kind = "fix" if fix else "height" if isinstance(measurement, Height) else "closure"
    return {
        "kind": kind,
        "keyframe": entry.frame,
        "base": entry.base,
        "proposer": told.proposer if told else None,
        "score": told.score if told else None,
        "inliers": told.inliers if told else None,
        "second_best_ratio": fix.second_best_ratio if fix else None,
        "candidates": len(fix.candidates) if fix else None,
        "candidate": ruling.candidate,
        "mahalanobis": _number(ruling.mahalanobis),
        "verdict": ruling.verdict.value,
        "reason": ruling.reason,
        "history": [
            {
                "at_keyframe": past.at_frame,
                "verdict": past.verdict.value,
                "candidate": past.candidate,
                "mahalanobis": _number(past.mahalanobis),
                "reason": past.reason,
                "by_person": past.by_person,
            }
            for past in entry.history
        ],
    }


def ledger_json(ledger: list[LedgerEntry]) -> str:
    """All entries as JSON."""
    return json.dumps([entry_values(entry) for entry in ledger], indent=1, allow_nan=False)


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
