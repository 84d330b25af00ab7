"""Compare a trajectory with the truth."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from lunar_fg.commands.shared import out
from lunar_fg.console import accuracy_table
from lunar_fg.evaluation import evaluate as compare
from lunar_fg.trajectory_io import read_track, read_trajectory


def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Trajectory: TUM, KITTI, or EuRoC.")],
    truth: Annotated[Path, typer.Argument(help="Truth: the same, or positions as CSV.")],
    json: Annotated[bool, typer.Option("--json", help="Print the keys of metrics.json.")] = False,
    same_map: Annotated[
        bool, typer.Option("--same-map", help="Both are in the same map: nothing is aligned.")
    ] = False,
) -> None:
    """Compare a trajectory with the truth.

    Example: lunar-fg eval runs/first/trajectory.tum truth.tum
    """
    accuracy = compare(read_trajectory(estimate), read_track(truth), same_map=same_map)
    if json:
        sys.stdout.write(accuracy.to_json() + "\n")
        return
    out.print(accuracy_table({estimate.name: accuracy}))
    for warning in accuracy.warnings:
        out.print(f"note: {warning}", markup=False)
