"""Smooth a finished run offline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_fg import runs
from lunar_fg.commands.shared import out
from lunar_fg.console import accuracy_table, convergence_table
from lunar_fg.run_folder import RunFolder

_WORST_SHOWN = 5


def optimize(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
) -> None:
    """Smooth a finished run as a whole, all landmarks in one batch.

    Example: lunar-fg optimize runs/first
    """
    report, accuracy = runs.optimize(RunFolder.open(run_folder))
    out.print(
        f"batch: {report.factors} factors, {report.landmarks} landmarks, "
        f"{report.iterations} iterations, cost {report.cost_before:.1f} -> "
        f"{report.cost_after:.1f}, {report.reason}",
        markup=False,
    )
    out.print(convergence_table(report))
    if report.fixes_accepted or report.fixes_refused:
        out.print(
            f"map measurements: {report.fixes_accepted} accepted, {report.fixes_refused} refused",
            markup=False,
        )
    out.print("worst factors, chi-square:", markup=False)
    for worst in report.worst[:_WORST_SHOWN]:
        out.print(f"  {worst.chi_square:8.1f} of {worst.residuals}  {worst.name}", markup=False)
    out.print(accuracy_table({"batch": accuracy}))
    out.print(f"results in {run_folder / 'batch'}", markup=False)
