"""The page of the graph's benchmark, made from its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]

_TEXTS = {
    "cost": (
        "Cost of a keyframe",
        "CPU milliseconds a keyframe over the last tenth of the run (at least 50 keyframes), "
        "about 100 stereo landmarks a keyframe, wheels and tilt. Plain iSAM2 is GTSAM's ISAM2 "
        "with all landmarks and default parameters. All ways take each keyframe in turn: the "
        "first one in a row pays for cold caches after the last, as long as the others go on. "
        "Medians are flat; the mean grows with iSAM2's update of the poses, once in ten "
        "keyframes, which walks over every pose, and with the copy before a fix. The rows of "
        "50,000 keyframes are of a run of segments alone (`--most 50000 --most-fixed 50000 "
        "--most-plain 1 --most-full 1`), with warm caches: there the mean was 0.72 ms at 1,000 and "
        "1.18 at 10,000, with fixes 0.83 and 1.11. Full landmarks are feasible to some thousand.",
    ),
    "agreement": (
        "Three ways on the same factors",
        "Largest gap of any pose from batch. One run each: which of the three is nearer to the "
        "truth in one run is chance.",
    ),
    "segment length": (
        "What segments lose, by their length",
        "KITTI-00's landmarks, gaps from batch. Tracks are cut where a segment ends, and of more "
        "landmarks than the limit the longest tracks are taken: short segments lose by the "
        "former, long ones by the latter.",
    ),
    "over seeds": (
        "Segments and batch over seeds",
        "Error against the truth of simulated traverses with stereo, wheels and tilt, the mean "
        "square over all runs: single runs differ by half either way.",
    ),
    "fix cost": (
        "A fix against batch",
        "A fix with its vote over the last 40, against optimising everything from scratch.",
    ),
    "taken back": (
        "A false fix taken back",
        "Wheels and tilt only, a fix every 200 keyframes: a false one is believed on a person's "
        "word and rejected again, at once or so many keyframes and another fix later, with the "
        "copy of iSAM2 from before it and without one. The milliseconds hold the vote on the "
        "other fixes, too; those of the graph are without it. What is left is linearisation: poses "
        "that moved by less than 0.1 m and 0.1 mrad stay as they were linearised, before as "
        "after; how far both are from the optimum stands beside it. Where keyframes came between, "
        "it is the distance between what the two ways lead to.",
    ),
    "false fixes": (
        "False fixes",
        "Motions of 2 m, a fix of 1 m and 0.02 rad every 10, 100 or 500 m (400 m, 2 km, 10 km), "
        "false ones up to 50 m off. A run has failed when its error is above three times that of "
        "the oracle, which is given the true fixes alone. Shares, not percent. The oracle gate "
        "holds each fix against the path and all true fixes: a false one that passes it, or a run "
        "that fails with it, no gate could have saved. Wrong verdicts are counted when they were "
        "given, at the end, and those at the end that the oracle gate has right: for the product "
        "with wheels and a fix every 500 m see `concepts.md`, absolute adjustment. Kernels have no "
        "verdict but their last one.",
    ),
    "KITTI-00": (
        "KITTI-00's stereo landmarks, fixes from the truth",
        "A fix every 20 m of 1 m, 20 % false; error in x and y without alignment. The landmarks "
        "claim centimetres over this short drive, so true fixes of 1 m change nothing: the error "
        "that is left is systematic, and the landmarks' covariance does not hold it.",
    ),
    "Spirit": (
        "Spirit's whole traverse",
        "7.2 km of telemetry legs as odometry, every k-th position that people corrected from "
        "images as a fix of 0.5 m, the others held out. The telemetry's drift is learnt from the "
        "first tenth, which is not evaluated. An honest Gaussian has 68.3, 95.5 and 99.7 % within "
        "1, 2 and 3 sigmas.",
    ),
}


def page(found: Mapping[str, Sequence[Row]]) -> str:
    """Markdown of all parts that there are figures for."""
    lines = [
        "# The factor graph",
        "",
        "Made by `python -m benchmarks.graph` from `graph.json`. The sections were not all run at "
        "one time: accuracy, false fixes and the rows of 50,000 keyframes are of earlier commits "
        "than the other costs; between them the code became faster, and verdicts were the same "
        "where they were run again.",
    ]
    for part, (title, text) in _TEXTS.items():
        rows = found.get(part)
        if not rows:
            continue
        names = list(rows[0])
        lines += ["", f"## {title}", "", text, ""]
        if part == "cost":
            lines += [*_against_plain(rows), ""]
        lines.append(f"| {' | '.join(name.replace('_', ' ') for name in names)} |")
        lines.append(f"|{'---|' * len(names)}")
        lines += [f"| {' | '.join(_cell(row[name]) for name in names)} |" for row in rows]
    return "\n".join(lines) + "\n"


def _against_plain(rows: Sequence[Row]) -> list[str]:
    """Totals of plain iSAM2 over those of segments."""
    found = {(row["way"], row["keyframes"]): row for row in rows}
    lines = []
    for way in ("segments", "segments, a fix every 50"):
        totals = ", ".join(
            f"{row['total_s'] / found[way, n]['total_s']:.1f} at {n}"
            for (other, n), row in found.items()
            if other == "plain iSAM2" and (way, n) in found
        )
        lines.append(f"Total of plain iSAM2 over {way}: {totals} keyframes.")
    return lines


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
