"""Smooth a finished run, or a pose graph from a file, offline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from lunar_fg import offline
from lunar_fg.commands.shared import out
from lunar_fg.console import accuracy_table, convergence_table
from lunar_fg.graph.pose_batch import optimize_poses
from lunar_fg.pose_graph import g2o_text, read_g2o
from lunar_fg.run_folder import RunFolder, write_whole

_WORST_SHOWN = 5


def optimize(
    run_folder: Annotated[
        Path, typer.Argument(help="Folder that `lunar-fg run` wrote, or a pose graph FILE.g2o.")
    ],
) -> None:
    """Smooth a finished run as a whole, all landmarks in one batch; or a g2o pose graph.

    Example: lunar-fg optimize runs/first
    """
    if run_folder.suffix == ".g2o" and not run_folder.is_dir():
        _optimize_file(run_folder)
        return
    report, accuracy = offline.optimize(RunFolder.open(run_folder))
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


def _optimize_file(path: Path) -> None:
    graph = read_g2o(path)
    poses, end = optimize_poses(graph.ids, graph.map_T_body, graph.edges, graph.fixed)
    target = path.with_name(f"{path.stem}.optimized.g2o")
    write_whole(target, g2o_text(replace(graph, map_T_body=poses)).encode())
    out.print(
        f"pose graph: {len(graph.ids)} poses, {len(graph.edges)} motions, "
        f"{end.iterations} iterations, cost {end.cost_before:.6g} -> {end.cost_after:.6g}, "
        f"{end.reason}",
        markup=False,
    )
    out.print(f"results in {target}", markup=False)
