"""Write docs/reliability.md from the results of campaigns, the fuzzing and the long traverses.

python benchmarks/reliability.py --monte-carlo DIR --faults DIR --fuzz FILE --long FILE

Every part is kept in docs/benchmarks/reliability.json; parts that are not given stay as they are.
The studies are benchmarks/studies/*.yaml.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

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
    """Median and the range of 80 % of the runs; the value alone of a single one."""
    values = [getattr(o, figure) for o in outcomes if getattr(o, figure) is not None]
    if not values:
        return "-"
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    low, middle, high = np.percentile(values, [10, 50, 90])
    return f"{middle:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"


def monte_carlo(outcomes: Sequence[Outcome]) -> list[str]:
    lines = [
        "## Monte Carlo of the whole chain, with images",
        "",
        f"{len(outcomes)} rendered drives of 42 m at 320 px with an orbital map "
        "(`benchmarks/studies/monte_carlo.yaml`): terrain, rocks, drive, sensor noise and start "
        "all follow the seed. Median over the seeds, in brackets the 10th and 90th percentile. "
        "A fix is right within half a metre of the truth or three of its own sigmas; precision is "
        "the share of the believed ones that are "
        "right, recall the share of the right ones that are believed.",
        "",
        "| terrain, sun | runs | failed | drift % | final error m | ATE m | NEES | within 3 sigma "
        "| lost | fixes tried | precision | recall |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups = groups_of(outcomes)
    for group in [*groups, Group("all", tuple(outcomes))] if len(groups) > 1 else groups:
        runs = group.outcomes
        accepted = sum(o.fixes_accepted for o in runs)
        right = sum(o.fixes_right for o in runs)
        hits = sum(o.fixes_accepted_right for o in runs)
        lines.append(
            f"| {_short(group.name)} | {len(runs)} | {group.failures} "
            f"| {spread(runs, 'drift_percent')} | {spread(runs, 'final_error_m')} "
            f"| {spread(runs, 'ate_m')} | {spread(runs, 'nees')} "
            f"| {spread(runs, 'coverage')} | {sum(o.frames_lost for o in runs)} "
            f"| {sum(o.fixes_tried for o in runs)} "
            f"| {f'{hits / accepted:.2f}' if accepted else '-'} "
            f"| {f'{hits / right:.2f}' if right else '-'} |"
        )
    poor = [o for o in outcomes if not o.error and ((o.coverage or 0.0) < 0.95 or o.frames_lost)]
    lines += ["", "Runs with less than 95 % of the poses within 3 sigma, or with lost frames:", ""]
    lines += [
        f"- {_short(o.group)}, seed {o.seed}: {o.coverage:.2f} within 3 sigma, NEES {o.nees:.1f}, "
        f"final error {o.final_error_m:.2f} m, {o.frames_lost} lost"
        for o in poor
    ] or ["- none"]
    alarmed = [o for o in outcomes if any("nothing in common" in w for w in o.warnings)]
    lines += [
        "",
        "None of these rovers was carried; taken for carried: "
        + ("; ".join(f"{_short(o.group)}, seed {o.seed}" for o in alarmed) or "none")
        + ".",
    ]
    return [*lines, ""]


def _short(name: str) -> str:
    """A group's varied settings in few words."""
    terrain = "highland" if "0.007" in name else "mare" if "0.004" in name else ""
    found = re.search(r"elevation_deg'?: ([0-9.]+)", name)
    if not terrain or found is None:
        return name
    return f"{terrain}, {float(found[1]):g} deg"


def faults(outcomes: Sequence[Outcome]) -> list[str]:
    lines = [
        "## Faults",
        "",
        "One fault a run, injected into the same rendered drive of 75 m, 101 pairs of 384 px, with "
        "its orbital map and without (`benchmarks/studies/faults.yaml`); and a rover that is "
        "carried along a quarter of a circle, drive of 100 m, 134 pairs of 320 px, by seed "
        "(`benchmarks/studies/kidnapped.yaml`; *full*: `graph: landmarks: full`). The start's own "
        "sigma of 0.3 m is in every error. *After* is the error of the motion from the fault's "
        "end to the drive's, a percentage of that way. *Said* is the run's own warning, without "
        "what the run without a fault says too.",
        "",
        "| fault | map | ran to its end | final error m | within 3 sigma | after % | frames lost "
        "| fixes right/believed/tried | said |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    usual = {w for o in outcomes if o.group.endswith("faults none") for w in o.warnings}
    for o in sorted(outcomes, key=_place):
        told = [w for w in o.warnings if w not in usual and not w.startswith(_NO_FAULT)]
        said = o.error or "; ".join(told[:3]) or "-"
        fixes = f"{o.fixes_accepted_right}/{o.fixes_accepted}/{o.fixes_tried}"
        with_map = "use True" in o.group
        name = o.group.split("faults ")[-1]
        if "landmarks" in o.group:
            full = ", full" if "landmarks full" in o.group else ""
            name = f"{name}, circle, seed {o.seed}{full}"
        lines.append(
            f"| {name} | {'yes' if with_map else 'no'} "
            f"| {'no' if o.error else 'yes'} | {spread([o], 'final_error_m')} "
            f"| {spread([o], 'coverage')} | {spread([o], 'drift_after_percent')} "
            f"| {o.frames_lost} | {fixes if with_map else '-'} | {said} |"
        )
    return [*lines, "", FALLS_SHORT, ""]


def _place(o: Outcome) -> tuple[bool, bool, int]:
    """Sound runs first, the circle last."""
    return not o.group.endswith("faults none"), "landmarks" in o.group, o.number


#: Warnings that every run has, or that tell of the injection itself.
_NO_FAULT = ("injected", "kitti:", "nees:")

FALLS_SHORT = """What falls short, and what the rows do not show:

- The images that are slightly out of line vertically (`misalignment`) are corrected as they
  come; only an offset that is left at the end is told of.
- A baseline that is wrong by 2 % is four times what the covariances allow for
  (`graph: scale_sigma`). Without a map nothing shows it, and the covariances hold it because they
  are wide enough on 75 m. With a map the fixes show it: it is said, and the covariances allow for
  what they show. The estimate itself is not corrected.
- Six of eight fixes fail with the wrong baseline: ground that is 2 % too long no longer lies on
  the map. They are refused, not wrong.
- The 3-sigma coverage of one run tells little: its poses share their errors. Taken over all rows
  it is above what a sound covariance would give; fixes are stated less certain than they are
  (mean squared error 0.2 of the stated variance over the Monte Carlo drives).
- A carried rover without a map is only said to be lost; it says so, and its covariance is 20 m and
  1 rad from there on.
- After a lost view nothing is known of how well landmarks are found again, so that a rover that
  is carried just then is not noticed by the images; the fixes that follow contradict it."""


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    bad = [o for o in outcomes if o.error]
    if not bad:
        return ["No run of these campaigns failed.", ""]
    lines = ["## Failed runs", "", "| group | seed | reason |", "|---|---|---|"]
    return [*lines, *(f"| {o.group} | {o.seed} | {o.error} |" for o in bad), ""]


def _tenths(rows: Sequence[dict[str, float]]) -> list[str]:
    lines = [
        "| keyframes | median ms | mean ms | worst ms | memory MB | log MB |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['keyframes']} | {row['median_ms']:.2f} | {row['mean_ms']:.2f} "
            f"| {row['worst_ms']:.1f} | {row['memory_mb']:.0f} | {row['log_mb']:.0f} |"
        )
    return [*lines, ""]


def long_traverse(result: dict[str, Any]) -> list[str]:
    return [
        "## Long traverse",
        "",
        f"{result['distance_m'] / 1e3:.1f} km of measurements without images, logged; final error "
        f"{result['final_error_m']:.2f} m. Process CPU a keyframe, by tenths of the drive:",
        "",
        *_tenths(result["tenths"]),
    ]


def _with_young(rows: Sequence[dict[str, Any]]) -> list[str]:
    lines = [
        "| keyframes | median ms | mean ms | worst ms | old/young, median | old/young, mean "
        "| landmarks | memory MB | log MB |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        ratios = ("-" if row[k] is None else f"{row[k]:.2f}" for k in ("ratio", "mean_ratio"))
        lines.append(
            f"| {row['keyframes']} | {row['median_ms']:.2f} | {row['mean_ms']:.2f} "
            f"| {row['worst_ms']:.1f} | {' | '.join(ratios)} | {row['landmarks']:.0f} "
            f"| {row['memory_mb']:.0f} | {row['log_mb']:.0f} |"
        )
    return [*lines, ""]


def long_images(result: dict[str, Any]) -> list[str]:
    return [
        "## Long traverse with images",
        "",
        f"{result['frames']} rendered pairs of {result['size_px']} px over "
        f"{result['distance_m']:.0f} m, every one at its own place, without a map "
        f"(`benchmarks/long_images.py`): {result['frames_lost']} lost, final error "
        f"{result['final_error_m']:.2f} m. Process CPU of `Navigator.step`, log included. *Old/"
        "young*: the same frames went through a second navigator too, which had begun one to two "
        "tenths before, in turns and in one process; the machine's load and the ground are in "
        "both, so that the ratio is what the length of the drive does. Memory is the process's, "
        "with the young navigators:",
        "",
        *_with_young(result["tenths"]),
        "CPU time is flat. Memory grows by some 30 kB a keyframe and the log by 60 kB: of the "
        "former 17 kB are what loop closing keeps of each place, 3 kB the solved segments; images "
        "are not kept. Without a map the final error is mostly the heading's, 0.03 rad.",
        "",
    ]


def soak(results: Sequence[dict[str, Any]]) -> list[str]:
    minutes = sum(result["seconds"] for result in results) / 60.0
    spans = ", ".join(f"{r['seeds'][0]}-{r['seeds'][1] - 1}" for r in results)
    lines = [
        "## Soak",
        "",
        f"{minutes:.0f} minutes of runs with everything drawn from the seed: traverse, noise, "
        "settings, fixes of which up to two in five are false, a person's word, the log closed and "
        "read again; a quarter of them with images and up to three faults "
        f"(`benchmarks/soak.py`, seeds {spans}). Each ran in a process of its own and had to end "
        "with every keyframe in a rigid, finite pose and a positive covariance, from the log in "
        "the same place, and nowhere 8 sigma off in silence. *Other* is anything else.",
        "",
        "| kind | tried | ran | named error | other | crash | hang |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in results[0]["kinds"]:
        cells = [
            sum(r["kinds"][kind].get(k, 0) for r in results)
            for k in ("ran", "named", "other", "crash", "hang")
        ]
        lines.append(f"| {kind} | {sum(cells)} | " + " | ".join(map(str, cells)) + " |")
    reasons = {re.sub(r" \(.*", "", reason) for r in results for reason in r["named"]}
    found = [text for r in results for text in r["findings"]]
    lines += ["", "Named errors: " + ("; ".join(sorted(reasons)) or "none") + "."]
    lines += ["", *(f"- {text}" for text in found or ["no finding"])]
    return [*lines, ""]


def fuzzing(result: dict[str, Any]) -> list[str]:
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
    every = [sum(c.get(k, 0) for c in result["files"].values())
             for k in ("ran", "named", "other", "crash", "hang")]  # fmt: skip
    lines.append(f"| **all** | {sum(every)} | " + " | ".join(map(str, every)) + " |")
    lines += ["", *(f"- {text}" for text in result["findings"])]
    return [*lines, ""]


CALLS = """## Calls in any order

Two hypothesis tests call the smoother and its log in processes of their own, which GTSAM may
abort: `tests/lunar_fg/graph/fuzz_child.py` with NaN, infinities, wrong shapes and negative
covariances in every argument, and the state machine `machine_child.py` with sound and senseless
calls in any order (drive on, fixes true and false, loop closures, heights, a person's word,
resume), where after each call a refused one must have changed nothing, all poses must be rigid
and all covariances positive, a person's word must stand, and a smoother fed from the log must end
in the same place. 80 and 25 examples run with every test run; {examples} of the state machine were
run once beyond that, {findings}.
"""

SECURITY = """## Security

- No pickle, no `eval`, no `exec`; YAML is read by a strict loader of plain values, XML without
  document types, arrays without Python objects, SQL with bound values. ruff's security rules
  (`S`) are on; each exception is explained where it stands (`pyproject.toml`, `noqa`).
- Reads are bounded: image and raster sizes, tables, routes, trajectories and telemetry in bytes,
  depth and size of YAML. What NumPy raises on damaged archives becomes a named error.
- The report escapes every name. Dask's protocol carries code: give campaigns to clusters of your
  own only.
- The lock file has **not** been audited by a vulnerability service: none can be reached from
  where it was made. Do it where you deploy: `pip install pip-audit`, then
  `pip-audit -r requirements.lock --no-deps --disable-pip` (with `--vulnerability-service osv`
  it asks OSV instead of PyPI). Every version in the lock file is pinned, without hashes.
"""


def read(folders: Sequence[Path]) -> list[dict[str, Any]]:
    return [asdict(o) for folder in folders for o in Results(folder).read()]


def read_round(path: Path) -> dict[str, Any]:
    """A round of soak or fuzzing, without the paths of the machine it ran on."""
    return dict(json.loads(re.sub(r"(?<![\w.])(/[\w.+-]+){2,}(: )?", "", path.read_text())))


def joined(before: dict[str, Any] | None, more: dict[str, Any]) -> dict[str, Any]:
    """Counts of two rounds of fuzzing."""
    if before is None:
        return more
    files = {name: dict(counts) for name, counts in before["files"].items()}
    for name, counts in more["files"].items():
        held = files.setdefault(name, {})
        for outcome, count in counts.items():
            held[outcome] = held.get(outcome, 0) + count
    return {
        "seconds": before["seconds"] + more["seconds"],
        "files": files,
        "findings": [*before["findings"], *more["findings"]],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--monte-carlo", type=Path, nargs="*", default=[])
    parser.add_argument("--faults", type=Path, nargs="*", default=[])
    parser.add_argument("--fuzz", type=Path)
    parser.add_argument(
        "--more-fuzz", type=Path, nargs="*", default=[], help="further rounds: counts are added"
    )
    parser.add_argument("--soak", type=Path, nargs="*", default=[])
    parser.add_argument("--long", type=Path)
    parser.add_argument("--long-images", type=Path)
    parser.add_argument("--machine", type=int, help="examples of the state machine, none failed")
    arguments = parser.parse_args()
    parts: dict[str, Any] = json.loads(JSON.read_text()) if JSON.exists() else {}
    for name in ("monte_carlo", "faults"):
        if getattr(arguments, name):
            parts[name] = read(getattr(arguments, name))
    if arguments.soak:
        parts["soak"] = [read_round(path) for path in arguments.soak]
    if arguments.more_fuzz:
        parts.setdefault("fuzz", None)
        for path in arguments.more_fuzz:
            parts["fuzz"] = joined(parts["fuzz"], read_round(path))
    for name in ("fuzz", "long", "long_images"):
        path = getattr(arguments, name)
        if path is not None:
            parts[name] = json.loads(path.read_text())
    if arguments.machine is not None:
        parts["machine"] = arguments.machine
    JSON.write_text(json.dumps(parts, indent=1) + "\n")
    chain, faulty = (
        [Outcome(**{**row, "warnings": tuple(row["warnings"])}) for row in parts.get(name, [])]
        for name in ("monte_carlo", "faults")
    )
    lines = [HEAD]
    if chain:
        lines += monte_carlo(chain)
    if faulty:
        lines += faults(faulty)
    if chain or faulty:
        lines += failures([*chain, *faulty])
    for name, section in (
        ("long", long_traverse), ("long_images", long_images), ("soak", soak), ("fuzz", fuzzing),
    ):  # fmt: skip
        if name in parts:
            lines += section(parts[name])
    if "machine" in parts:
        lines += [CALLS.format(examples=parts["machine"], findings="none failed")]
    PAGE.write_text("\n".join([*lines, SECURITY]))
    print(f"{PAGE} and {JSON} written")


if __name__ == "__main__":
    main()
