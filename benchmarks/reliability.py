"""Write docs/reliability.md from the results of campaigns, the fuzzing and the long traverse.

python benchmarks/reliability.py --monte-carlo DIR --faults DIR --fuzz FILE --long FILE
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lunar_fg.campaign.results import Results
from lunar_fg.campaign.summary import Group, groups_of
from lunar_fg.campaign.trial import Outcome

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
JSON = Path(__file__).parents[1] / "docs" / "benchmarks" / "reliability.json"

HEAD = """# Reliability

Written by `benchmarks/reliability.py` from the results of campaigns
([how to run them](campaigns.md)); the figures behind it are in `docs/benchmarks/reliability.json`.
Everything here is simulated: rendered traverses with exact truth.
"""


def spread(outcomes: Sequence[Outcome], figure: str, digits: int = 2) -> str:
    values = [getattr(o, figure) for o in outcomes if getattr(o, figure) is not None]
    if not values:
        return "-"
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return (
        f"{np.median(values):.{digits}f} ({np.min(values):.{digits}f}-{np.max(values):.{digits}f})"
    )


def monte_carlo(groups: Sequence[Group]) -> list[str]:
    lines = [
        "## Monte Carlo of the whole chain, with images",
        "",
        "Terrain, rocks, drive, sensor noise and start all follow the seed. Median (least to "
        "largest) over the seeds.",
        "",
        "| | runs | failed | final error m | drift % | NEES | within 3 sigma | lost | fixes tried |"
        " precision | recall |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for group in groups:
        runs = group.outcomes
        accepted = sum(o.fixes_accepted for o in runs)
        right = sum(o.fixes_right for o in runs)
        hits = sum(o.fixes_accepted_right for o in runs)
        lines.append(
            f"| {group.name} | {len(runs)} | {group.failures} | {spread(runs, 'final_error_m')} "
            f"| {spread(runs, 'drift_percent')} | {spread(runs, 'nees')} "
            f"| {spread(runs, 'coverage')} | {sum(o.frames_lost for o in runs)} "
            f"| {sum(o.fixes_tried for o in runs)} "
            f"| {f'{hits / accepted:.3f}' if accepted else '-'} "
            f"| {f'{hits / right:.3f}' if right else '-'} |"
        )
    return [*lines, ""]


def faults(groups: Sequence[Group]) -> list[str]:
    lines = [
        "## Faults",
        "",
        "One fault a run, injected into the same traverse of 60 m (81 pairs), without an orbital "
        "map; the start's own sigma of 0.3 m is in every error. *Said* is the run's own warning. A "
        "rover that is carried, and a baseline that is wrong, are known gaps: nothing that it "
        "measures without a map contradicts either.",
        "",
        "| fault | ran to its end | final error m | within 3 sigma | frames lost | said |",
        "|---|---|---|---|---|---|",
    ]
    for group in groups:
        for o in group.outcomes:
            told = [w for w in o.warnings if w.startswith("frame")]
            said = o.error or "; ".join(told[:2]) or "-"
            lines.append(
                f"| {group.name.removeprefix('faults ')} | {'no' if o.error else 'yes'} "
                f"| {spread([o], 'final_error_m')} | {spread([o], 'coverage')} "
                f"| {o.frames_lost} | {said} |"
            )
    return [*lines, ""]


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    bad = [o for o in outcomes if o.error]
    if not bad:
        return ["No run of these campaigns failed.", ""]
    lines = ["## Failed runs", "", "| group | seed | reason |", "|---|---|---|"]
    return [*lines, *(f"| {o.group} | {o.seed} | {o.error} |" for o in bad), ""]


def long_traverse(path: Path) -> list[str]:
    result = json.loads(path.read_text())
    lines = [
        "## Long traverse",
        "",
        f"{result['distance_m'] / 1e3:.1f} km of measurements without images, logged; final error "
        f"{result['final_error_m']:.2f} m. Process CPU a keyframe, by tenths of the drive:",
        "",
        "| keyframes | median ms | mean ms | worst ms | memory MB | log MB |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["tenths"]:
        lines.append(
            f"| {row['keyframes']} | {row['median_ms']:.2f} | {row['mean_ms']:.2f} "
            f"| {row['worst_ms']:.1f} | {row['memory_mb']:.0f} | {row['log_mb']:.0f} |"
        )
    return [*lines, ""]


def fuzzing(path: Path) -> list[str]:
    result = json.loads(path.read_text())
    lines = [
        "## Spoiled inputs",
        "",
        f"{result['seconds'] / 60:.0f} minutes of runs over files with random bytes changed, cut "
        "off, repeated or removed, each in a process of its own. *Other* is an exception that is "
        "not lunar-fg's own; *crash* a process that died; *hang* one that did not end.",
        "",
        "| file | tried | ran | named error | other | crash | hang |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, counts in result["files"].items():
        cells = (counts.get(k, 0) for k in ("ran", "named", "other", "crash", "hang"))
        total = sum(counts.values())
        lines.append(f"| {name} | {total} | " + " | ".join(map(str, cells)) + " |")
    lines += ["", *(f"- {text}" for text in result["findings"])]
    return [*lines, ""]


def read(folder: Path) -> list[Outcome]:
    return Results(folder).read()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--monte-carlo", type=Path, nargs="*", default=[])
    parser.add_argument("--faults", type=Path, nargs="*", default=[])
    parser.add_argument("--fuzz", type=Path)
    parser.add_argument("--long", type=Path)
    arguments = parser.parse_args()
    lines = [HEAD]
    chain = [o for folder in arguments.monte_carlo for o in read(folder)]
    faulty = [o for folder in arguments.faults for o in read(folder)]
    if chain:
        lines += monte_carlo(groups_of(chain))
    if faulty:
        lines += faults(groups_of(faulty))
    if chain or faulty:
        lines += failures([*chain, *faulty])
    if arguments.long is not None:
        lines += long_traverse(arguments.long)
    if arguments.fuzz is not None:
        lines += fuzzing(arguments.fuzz)
    PAGE.write_text("\n".join(lines))
    rows = {
        name: [{"group": o.group, "seed": o.seed, **_figures(o)} for o in outcomes]
        for name, outcomes in (("monte_carlo", chain), ("faults", faulty))
    }
    JSON.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"{PAGE} and {JSON} written")


def _figures(outcome: Outcome) -> dict[str, object]:
    names = (
        "error", "frames", "frames_lost", "distance_m", "ate_m", "final_error_m",
        "drift_percent", "nees", "coverage", "fixes_tried", "fixes_right", "fixes_accepted",
        "fixes_accepted_right", "cpu_s", "warnings",
    )  # fmt: skip
    return {name: getattr(outcome, name) for name in names}


if __name__ == "__main__":
    main()
