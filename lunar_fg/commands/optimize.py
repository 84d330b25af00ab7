"""Smooth a finished run offline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_fg import runs
from lunar_fg.commands.shared import out
from lunar_fg.console import accuracy_table
from lunar_fg.run_folder import RunFolder


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
    out.print(accuracy_table({"batch": accuracy}))
    out.print(f"results in {run_folder / 'batch'}", markup=False)
