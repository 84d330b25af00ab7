"""Text of the commands' results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.table import Table

from lunar_fg.evaluation import Accuracy, Metrics


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
    if "total" in metrics.timing_ms:
        parts.append(f"{metrics.timing_ms['total'].median:.0f} ms a frame")
    return f"{name}: {', '.join(parts)}; results in {folder}"


def accuracy_table(rows: Mapping[str, Accuracy]) -> Table:
    """Accuracy of one or more trajectories, one row each."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for title in ("length m", "ATE SE3 m", "ATE Sim3 m", "scale", "drift %", "deg/m"):
        table.add_column(title, justify="right")
    for title in ("RPE m", "RPE deg", "final m", "NEES"):
        table.add_column(title, justify="right")
    for name, accuracy in rows.items():
        table.add_row(
            name,
            _cell(accuracy.distance_m, 1),
            _cell(accuracy.ate_rmse_m.se3, 4),
            _cell(accuracy.ate_rmse_m.sim3, 4),
            _cell(accuracy.scale_sim3, 4),
            _cell(accuracy.kitti.translation_percent, 2),
            _cell(accuracy.kitti.rotation_deg_per_m, 4),
            _cell(accuracy.rpe.translation_m, 4),
            _cell(accuracy.rpe.rotation_deg, 3),
            _cell(accuracy.final_error_m, 3),
            _cell(accuracy.nees.mean, 1),
        )
    return table


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
