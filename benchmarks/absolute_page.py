"""Page of the absolute-fix benchmark."""

from __future__ import annotations

import json
from dataclasses import asdict
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks.absolute_maps import BENT_OVER_M, BENT_PIXELS
from benchmarks.absolute_trials import GSDS_M, LENGTHS_M, SUN_DIFFERENCES_DEG, Trial


def summary(rows: list[Trial]) -> dict[str, object]:
    fixed = [t for t in rows if t.fixed]
    errors = np.array([t.error_m for t in fixed])
    nees = np.array([t.nees for t in fixed])
    good = [t for t in fixed if t.error_m <= max(0.5, t.gsd_m)]
    return {
        "trials": len(rows),
        "found": sum(t.found for t in rows),
        "fixed": len(fixed),
        "fixed_right": len(good),
        "median_error_m": float(np.median(errors)) if len(errors) else None,
        "error_95_m": float(np.percentile(errors, 95)) if len(errors) else None,
        "mean_nees": float(nees.mean()) if len(nees) else None,
        "coverage_95": float(np.mean(nees <= chi2.ppf(0.95, 3) / 3.0)) if len(nees) else None,
        "within_3_sigma": float(np.mean([t.within_3_sigma for t in fixed])) if fixed else None,
        "cpu_s": float(np.median([t.cpu_s for t in rows])),
    }


def far(rows: list[Trial]) -> str:
    """Fixes that are wrong by a lot, and how many of them do not say so."""
    fixed = [t for t in rows if t.fixed]
    wide = [t for t in fixed if t.error_m > max(0.5, t.gsd_m)]
    silent = sum(t.within_3_sigma < 1.0 for t in wide)
    terrains = ", ".join(sorted({t.terrain for t in wide}))
    where = f" ({terrains}; {silent} of them beyond 3 of their own sigmas)" if wide else ""
    return f"{len(wide)} of {len(fixed)}{where}"


def table(rows: list[Trial]) -> list[str]:
    lines = [
        "| patch, GSD | "
        + " | ".join(f"sun {d:.0f} deg apart" for d in SUN_DIFFERENCES_DEG)
        + " | median / 95 % error of fixes, m | CPU a fix, s |",
        "|---|" + "---|" * (len(SUN_DIFFERENCES_DEG) + 2),
    ]
    right = [t for t in rows if t.kind == "right map"]
    for gsd in GSDS_M:
        for length in LENGTHS_M:
            group = [t for t in right if t.gsd_m == gsd and t.length_m == length]
            if not group:
                continue
            cells = []
            for difference in SUN_DIFFERENCES_DEG:
                part = [t for t in group if t.sun_difference_deg == difference]
                n = max(len(part), 1)
                found, fixed = sum(t.found for t in part), sum(t.fixed for t in part)
                cells.append(f"{100 * found / n:.0f} / {100 * fixed / n:.0f}")
            s = summary(group)
            rest = f"{s['median_error_m']:.2f} / {s['error_95_m']:.2f}" if s["fixed"] else "-"
            lines.append(f"| {length:.0f} m, {gsd:.2f} m | " + " | ".join(cells) +
                         f" | {rest} | {s['cpu_s']:.2f} |")  # fmt: skip
    return lines


def honesty(rows: list[Trial], held_out: list[str]) -> list[str]:
    """How large errors are against the stated covariances, by group and by map."""
    lines = [
        "| group | maps as rendered: fixes | NEES | 95 % | within 3 sigma "
        f"| maps bent by {BENT_PIXELS} px: fixes | NEES | 95 % | within 3 sigma |",
        "|---|" + "---|" * 8,
    ]
    groups: dict[str, list[Trial]] = {}
    for gsd, length in product(GSDS_M, LENGTHS_M):
        name = f"{length:.0f} m, {gsd:.2f} m"
        groups[name] = [t for t in rows if (t.gsd_m, t.length_m) == (gsd, length)]
    for difference in SUN_DIFFERENCES_DEG:
        name = f"sun {difference:.0f} deg apart"
        groups[name] = [t for t in rows if t.sun_difference_deg == difference]
    for terrain in dict.fromkeys(t.terrain for t in rows):
        name = f"{terrain}, held out" if terrain in held_out else terrain
        groups[name] = [t for t in rows if t.terrain == terrain]
    groups["all held out"] = [t for t in rows if t.terrain in held_out]
    groups["all"] = rows
    for name, group in groups.items():
        cells = []
        for kind in ("right map", "bent map"):
            s = summary([t for t in group if t.kind == kind])
            cells.append("0 | - | - | -")
            if s["fixed"]:
                cells[-1] = (f"{s['fixed']} | {s['mean_nees']:.2f} | {100 * s['coverage_95']:.0f} "
                             f"% | {s['within_3_sigma']:.3f}")  # fmt: skip
        if any(not cell.startswith("0 ") for cell in cells):
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def write(
    rows: list[Trial], drives: list[dict[str, object]], held_out: list[str], out: Path
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    right = [t for t in rows if t.kind == "right map"]
    warped = [t for t in rows if t.kind == "bent map"]
    wrong = [t for t in rows if t.kind == "wrong map"]
    blank = [t for t in rows if t.kind == "featureless"]
    content = {
        "right map": summary(right),
        "bent map": summary(warped),
        "wrong map": summary(wrong),
        "featureless": summary(blank),
        "runs": drives,
        # of the others the counts are enough, as long as none is believed
        "trials": [
            {k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(t).items()}
            for t in rows
            if t.kind == "right map" or t.fixed
        ],
    }
    text = json.dumps(content).replace("NaN", "null").replace("}, {", "},\n {")
    (out / "absolute.json").write_text(text + "\n", encoding="utf-8")
    s = summary(right)
    lines = [
        "# Absolute fixes: benchmark",
        "",
        "Made by `benchmarks/absolute.py`; see its text for the set-up. Simulated traverses, "
        f"{len({t.terrain for t in rows})} terrains, relief from dense stereo on rendered images, "
        "laid out by estimated poses.",
        "",
        "Per cent of places *found* (best place within max(0.5 m, 1 px)) / *fixed* (believed). "
        "Patches refused beforehand as too small (fewer than 800 cells) count as not found.",
        "",
        *table(rows),
        "",
        f"Fixes further than max(0.5 m, 1 px) from the truth: {far(right)} on the right map, "
        f"{far(warped)} on the same map bent (see below): strips that a lost motion has "
        f"torn, and errors just beyond that. In {s['trials']} trials on the right map {s['fixed']} "
        "were believed; "
        f"{sum(t.fixed for t in wrong)} accepted "
        f"of {len(wrong)} on a map of another place; {sum(t.fixed for t in blank)} of "
        f"{len(blank)} on featureless ground. The graph's own gate and vote come after this.",
        "",
        "## Are the covariances honest?",
        "",
        "Mean of the squared error over the stated covariance (NEES, a degree of freedom; 1 is "
        "honest), the share of fixes within their 95 % region, and the share of x, y and yaw "
        "within 3 sigma. Maps as rendered have no error of their own; real ones have, which "
        "`absolute.map_sigma_pixels` stands for: the same maps with their ground moved by "
        f"{BENT_PIXELS} px (1-sigma per axis, smooth over {BENT_OVER_M:.0f} m). Terrains that are "
        "held out had no part in setting anything.",
        "",
        *honesty(rows, held_out),
        "",
        "## Whole runs",
        "",
        "Horizontal error against truth without any alignment, m; the start prior is wrong by "
        "some decimetres, which only fixes can remove. Map sun 135 deg from the rover's.",
        "",
        "| terrain | length | wheels final | vision final / median | with fixes final / median "
        "| with fixes, medians of the thirds | fixes |",
        "|---|---|---|---|---|---|---|",
    ]
    for d in drives:
        wheels, vision, fixes = d.get("wheels"), d["vision"], d["vision + fixes"]
        w = "-" if wheels is None else f"{wheels['final_m']:.2f}"
        lines.append(
            f"| {d['terrain']} | {d['length_m']:.0f} m | {w} | "
            f"{vision['final_m']:.2f} / {vision['median_m']:.2f} | "
            f"{fixes['final_m']:.2f} / {fixes['median_m']:.2f} | "
            f"{', '.join(f'{m:.2f}' for m in fixes['thirds_m'])} | "
            f"{d['fixes'].count('accepted')} of {len(d['fixes'])} |"
        )
    (out / "absolute.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
