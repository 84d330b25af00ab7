"""Write docs/reliability.md from the results of campaigns, the fuzzing and the long traverses.

python -m benchmarks.reliability --monte-carlo DIR --faults DIR --fuzz FILE --long FILE

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

from benchmarks.reliability_campaigns import failures, faults, monte_carlo
from benchmarks.reliability_endurance import (
    CALLS,
    SECURITY,
    fuzzing,
    long_images,
    long_traverse,
    soak,
)
from lunar_fg.campaign.results import Results
from lunar_fg.campaign.trial import Outcome

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
JSON = Path(__file__).parents[1] / "docs" / "benchmarks" / "reliability.json"

HEAD = """# Reliability

Written by `benchmarks/reliability.py` from the results of campaigns
([how to run them](campaigns.md)); the figures behind it are in `docs/benchmarks/reliability.json`.
Everything here is simulated: rendered traverses with exact truth.
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
