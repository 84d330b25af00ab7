"""Show which absolute fixes a run believed, and overrule it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from frontends.errors import InputError
from lunar_fg.commands.shared import out
from lunar_fg.graph.ledger import LedgerEntry
from lunar_fg.ledger import entry_values, ledger_json, overrule, read_ledger
from lunar_fg.run_folder import RunFolder

_WIDEST = 1000


def fixes(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
    accept: Annotated[
        int | None, typer.Option(help="Believe the fix of this keyframe, whatever the vote says.")
    ] = None,
    reject: Annotated[
        int | None, typer.Option(help="Refuse the fix of this keyframe, whatever the vote says.")
    ] = None,
    base: Annotated[
        int | None, typer.Option(help="Mean the loop closure from this keyframe, not the fix.")
    ] = None,
    candidate: Annotated[
        int, typer.Option(help="Which of the fix's places to believe, 0 is the best.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print the ledger as JSON.")] = False,
) -> None:
    """Show every absolute fix of a run with its verdicts; accept or reject one.

    Example: lunar-fg fixes runs/first --reject 120
    """
    if accept is not None and reject is not None:
        raise InputError("give one of them", source="--accept, --reject")
    folder = RunFolder.open(run_folder)
    frame = accept if accept is not None else reject
    changed = 0
    if frame is not None:
        decision = overrule(folder, frame, base, None if accept is None else candidate)
        changed = len(decision.changes)
    ledger = read_ledger(folder)
    if json:
        sys.stdout.write(ledger_json(ledger) + "\n")
        return
    if not ledger:
        out.print("no absolute fixes in this run", markup=False)
        return
    # Lines are as long as they are, also in a pipe.
    Console(file=sys.stdout, width=_WIDEST, highlight=False).print(_table(ledger))
    if frame is not None:
        out.print(
            f"keyframe {frame}: decided by a person, {changed} other verdicts changed; "
            f"trajectory written anew in {run_folder}",
            markup=False,
        )


def _table(ledger: list[LedgerEntry]) -> Table:
    table = Table(box=None, pad_edge=False)
    for title in ("keyframe", "proposer", "score", "inliers", "2nd/best", "sigma"):
        table.add_column(title, justify="left" if title == "proposer" else "right", no_wrap=True)
    for title in ("verdict", "reason", "history"):
        table.add_column(title, no_wrap=True)
    for entry in sorted(ledger, key=lambda entry: entry.frame):
        values = entry_values(entry)
        keyframe = str(entry.frame) if entry.base is None else f"{entry.base}-{entry.frame}"
        history = ", ".join(f"{past.at_frame} {past.verdict.value}" for past in entry.history[:-1])
        cells = (
            keyframe,
            values["proposer"] or values["kind"],
            _cell(values["score"], 2),
            _cell(values["inliers"], 0),
            _cell(values["second_best_ratio"], 2),
            _cell(values["mahalanobis"], 1),
            values["verdict"],
            values["reason"],
            history,
        )
        table.add_row(*(Text(cell) for cell in cells))
    return table


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
