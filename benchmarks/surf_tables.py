"""The readable page of `surf_quality`, from its JSON alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

PLANETARY = ("MSL", "K10", "MoonRanger")
_COMMAND = "python benchmarks/surf_quality.py --json docs/benchmarks/surf_quality.json"


def markdown(report: Mapping[str, Any]) -> str:
    """Tables of all groups, methods as rows."""
    methods = {name: groups for name, groups in report.items() if name != "after RANSAC"}
    warped = {name: groups for name, groups in methods.items() if "warps" in groups}
    parts = [
        "# SURF: quality",
        f"Made by `{_COMMAND}`. One metric for all: the strongest keypoints, mutual nearest "
        "neighbours, ratio 0.8. OpenCV SURF is its stored output, which exists for the images "
        "themselves only, not for their warps.",
        "## graf: a wall from six sides",
        "Correct matches of 1,500 keypoints, means of repeatability and of the matching score. "
        "The homographies are known; a match or a repeated keypoint is right within 3 px. "
        "Within a fixed distance neighbours are found by chance, too: with one image shifted by "
        "25 px SURF has .12 to .24, OpenCV SURF .13 to .23 (1-2 to 1-6). Overlap has no such "
        "chance: regions (circles with the keypoints' radii, scaled to 30 px) overlap with an "
        "error below .4, one to one.",
        _table(
            ["", "all", "repeated", "overlap", "score", *(f"1-{i}" for i in range(2, 7))],
            (_graf(name, groups["graf"]) for name, groups in methods.items()),
        ),
        "## 20 warps of real images",
        "Four images in turn; correct matches by group, means of repeatability and of the "
        "matching score over all.",
        _table(
            ["", "all", "repeated", "overlap", "score", *next(iter(warped.values()))["warps"]],
            (_warps(name, groups["warps"]) for name, groups in warped.items()),
        ),
        "## Stereo pairs",
        "Matches within 1 px of the epipolar lines, 1,000 keypoints a side (their median "
        "distance, px). The last column is the mean ratio to OpenCV SURF of the same kind "
        "over the planetary pairs.",
        _table(
            ["", *next(iter(methods.values()))["stereo"], "of OpenCV's"],
            (_stereo(name, methods) for name in methods),
        ),
    ]
    if "after RANSAC" in report:
        parts += ["## Wrong matches after RANSAC", _after_ransac(report["after RANSAC"])]
    return "\n\n".join(parts) + "\n"


def _graf(name: str, rows: list[list[float]]) -> list[str]:
    repeatability, correct, score, overlapping = np.array(rows).T
    return [
        name,
        f"{correct.sum():.0f}",
        f"{repeatability.mean():.3f}",
        f"{overlapping.mean():.3f}",
        f"{score.mean():.3f}",
        *(f"{count:.0f}" for count in correct),
    ]


def _warps(name: str, groups: Mapping[str, list[list[float]]]) -> list[str]:
    every = np.array([row for rows in groups.values() for row in rows])
    repeatability, correct, score, overlapping = every.T
    cells = [f"{sum(row[1] for row in rows):.0f}" for rows in groups.values()]
    means = [f"{mean:.3f}" for mean in (repeatability.mean(), overlapping.mean(), score.mean())]
    return [name, f"{correct.sum():.0f}", *means, *cells]


def _stereo(name: str, methods: Mapping[str, Any]) -> list[str]:
    own = methods[name]["stereo"]
    rival = "OpenCV U-SURF" if name in ("SURF upright", "OpenCV U-SURF") else "OpenCV SURF"
    cells = [f"{count:.0f} ({px:.3f})" for count, px in own.values()]
    if rival not in methods:
        return [name, *cells, ""]
    ratio = np.mean([own[g][0] / methods[rival]["stereo"][g][0] for g in PLANETARY])
    return [name, *cells, f"{ratio:.2f}"]


def _after_ransac(found: Mapping[str, Mapping[str, int]]) -> str:
    warps, pairs = found["homographies"], found["rectified pairs"]
    along = pairs["beyond infinity"]
    rendered = ""
    if "rendered pairs" in found:
        seen = found["rendered pairs"]
        rendered = (
            f"\n- Stereo perception itself (epipolar band, sub-pixel refinement; no RANSAC) on "
            f"{seen['pairs']} rendered pairs with exact depth (`lunar-fg simulate DIR --size 512 "
            f"--length 8 --step 0.4 --depth`, then `--rendered DIR`): {seen['refined wrong']} of "
            f"{seen['refined']:,} refined landmarks are wrong, "
            f"{_percent(seen['refined wrong'], seen['refined'])}; with those kept unrefined, at "
            f"their larger sigma, {seen['wrong']} of {seen['landmarks']:,}, "
            f"{_percent(seen['wrong'], seen['landmarks'])}."
        )
    return (
        "An inlier of RANSAC (at 2 px) is wrong when it is farther than 3 px from the truth.\n\n"
        f"- Homographies (the 20 warps of five real images, 3,000 keypoints): "
        f"{warps['wrong']} of {warps['inliers']:,} in {warps['pairs']} pairs, "
        f"{_percent(warps['wrong'], warps['inliers'])}; {warps['refused']} pairs refused.\n"
        f"- Rectified pairs, RANSAC not told so ({pairs['pairs']} real pairs): "
        f"{pairs['off row']} of {pairs['inliers']:,} off their row, "
        f"{_percent(pairs['off row'], pairs['inliers'])}, and {along} nearer than infinity by "
        f"more than 3 px, {_percent(along, pairs['inliers'])}. A fundamental matrix cannot see "
        "an error along its lines; that its neighbours are others there tells most of them. "
        "Stereo perception searches the epipolar band between the nearest depth and infinity "
        "instead, and the motion between frames is a second check." + rendered
    )


def _percent(part: int, whole: int) -> str:
    return f"{100.0 * part / max(whole, 1):.4f} %"


def _table(head: list[str], rows: Iterable[list[str]]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
