"""Long traverses, soak and spoiled inputs: what docs/reliability.md says beside the campaigns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any


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
