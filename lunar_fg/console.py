"""Text of the commands' results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from rich.table import Table

from frontends.measurements import Verdict
from lunar_fg.evaluation import Accuracy, Metrics
from lunar_fg.graph.convergence import ConvergenceReport
from lunar_fg.run_folder import RunFolder


def run_summary(name: str, metrics: Metrics, folder: Path) -> str:
    """One line on a run: length, losses, error, time, and where the results are."""
    parts = [f"{metrics.frames} frames"]
    if metrics.distance_m is not None:
        parts.append(f"{metrics.distance_m:.1f} m")
    parts.append(f"{metrics.frames_lost} lost")
    if metrics.ate_rmse_m.se3 is not None:
        parts.append(f"ATE {metrics.ate_rmse_m.se3:.3f} m (SE3)")
    if metrics.ate_rmse_m.sim3 is not None:
        parts.append(f"{metrics.ate_rmse_m.sim3:.3f} m (Sim3)")
    if metrics.kitti.translation_percent is not None:
        parts.append(f"drift {metrics.kitti.translation_percent:.2f} %")
    parts += _believed(folder)
    if "total" in metrics.timing_ms:
        parts.append(f"{metrics.timing_ms['total'].median:.0f} ms a frame")
    return f"{name}: {', '.join(parts)}; results in {folder}"


def _believed(folder: Path) -> list[str]:
    """How many of the fixes and loop closures in a run's log are believed."""
    # brings in the graph, which tables alone do not need
    from lunar_fg.ledger import read_ledger, verdicts

    run = RunFolder.open(folder)
    if not run.database_path.is_file():
        return []
    return [
        f"{given.count(Verdict.ACCEPTED)} of {len(given)} {what} believed"
        for what, given in verdicts(read_ledger(run)).items()
    ]


def accuracy_table(trajectories: Mapping[str, Accuracy]) -> Table:
    """Accuracy of one or more trajectories, a column each."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for name in trajectories:
        table.add_column(name, justify="right")
    rows: tuple[tuple[str, Callable[[Accuracy], float | None], int], ...] = (
        ("length, m", lambda a: a.distance_m, 1),
        ("ATE, SE3-aligned, m", lambda a: a.ate_rmse_m.se3, 4),
        ("ATE, Sim3-aligned, m", lambda a: a.ate_rmse_m.sim3, 4),
        ("scale (Sim3)", lambda a: a.scale_sim3, 4),
        ("drift, %", lambda a: a.kitti.translation_percent, 2),
        ("drift, deg/m", lambda a: a.kitti.rotation_deg_per_m, 4),
        ("RPE, m", lambda a: a.rpe.translation_m, 4),
        ("RPE, deg", lambda a: a.rpe.rotation_deg, 3),
        ("final error, m", lambda a: a.final_error_m, 3),
        ("NEES / dof", lambda a: a.nees.mean, 1),
    )
    for title, value, digits in rows:
        values = [value(accuracy) for accuracy in trajectories.values()]
        if any(figure is not None for figure in values):
            table.add_row(title, *(_cell(figure, digits) for figure in values))
    return table


def convergence_table(report: ConvergenceReport) -> Table:
    """Chi-square of each kind of factor before and after an optimisation."""
    table = Table(box=None, pad_edge=False)
    table.add_column("factors")
    for title in ("count", "numbers", "chi-square before", "after"):
        table.add_column(title, justify="right")
    for kind in report.kinds:
        before, after = f"{kind.chi_square_before:.1f}", f"{kind.chi_square_after:.1f}"
        table.add_row(kind.name, str(kind.factors), str(kind.residuals), before, after)
    return table


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
