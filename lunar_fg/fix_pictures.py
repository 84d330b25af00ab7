"""Pictures of a fix: what the rover saw, what was looked for, where it was found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from frontends.absolute import Adjustment
from frontends.terrain import Grid
from lunar_fg.evaluation.figure import BASELINE, ESTIMATE, new_figure, save


def draw_fix(adjustment: Adjustment, path: Path) -> Path:
    """Write one PNG: patch, its relief, the re-lit patch, the map window, the correlation.

    Parameters
    ----------
    adjustment
        From `frontends.absolute` or `lunar_fg.localisation.Localisation.attempts`.
    path
        File to write.
    """
    figure = new_figure(13.0, 8.2)
    axes = figure.subplots(2, 3).ravel()
    fix, patch = adjustment.fix, adjustment.patch
    best = fix.candidates[0] if fix.candidates else None
    # where it was found shows best; else the first method that compared anything
    shown = next(
        (p for p in adjustment.proposals if best is not None and p.proposer == best.proposer),
        next((p for p in adjustment.proposals if p.window is not None), None),
    )
    if patch is not None:
        _image(axes[0], patch.ortho, patch.grid, "what the rover saw")
        _image(axes[1], patch.height_m, patch.grid, "its relief, rocks removed (m)", "terrain")
        axes[0].plot(patch.x_m, patch.y_m, "+", color=BASELINE)
    if shown is not None and shown.template is not None:
        axes[2].imshow(shown.template, cmap="gray", **_limits(shown.template))
        axes[2].set_title("as looked for", fontsize=9)
    if shown is not None and shown.window is not None:
        for ax in axes[3:5]:
            _image(ax, shown.window.values, shown.window.grid, "map window")
        if patch is not None:
            axes[3].plot(patch.x_m, patch.y_m, "+", color=BASELINE, label="predicted")
        if best is not None and patch is not None:
            axes[3].plot(best.x_m, best.y_m, "x", color=ESTIMATE, label="found")
            _outline(axes[4], adjustment, best.x_m, best.y_m, best.yaw_rad)
            axes[4].set_title("map window, outline of the patch where it was found", fontsize=9)
        axes[3].legend(fontsize=8, loc="upper right")
    if shown is not None and shown.volume is not None and shown.volume.values.size:
        surface = np.where(np.isfinite(shown.volume.values), shown.volume.values, -1.0).max(axis=0)
        _image(axes[5], surface, shown.volume.grid, "correlation, best yaw", "viridis")
    for ax in axes:
        ax.tick_params(labelsize=7)
        if not ax.images:
            ax.set_axis_off()
    head = f"keyframe {fix.frame}: "
    if best is None:
        head += f"no fix: {fix.reason}"
    else:
        sigma = np.sqrt(np.diag(best.covariance))
        head += (
            f"{best.proposer}, x {best.x_m:.2f} +- {sigma[0]:.2f} m, "
            f"y {best.y_m:.2f} +- {sigma[1]:.2f} m, "
            f"yaw {np.degrees(best.yaw_rad):.1f} +- {np.degrees(sigma[2]):.1f} deg; "
            f"second place at {fix.second_best_ratio:.0%}"
        )
    figure.suptitle("\n".join(_wrapped(head, 150)), fontsize=10)
    return save(figure, path)


def _image(ax: Any, values: Any, grid: Grid, title: str, colours: str = "gray") -> None:
    west, south, east, north = grid.bounds_m
    ax.imshow(values, cmap=colours, extent=(west, east, south, north), **_limits(values))
    ax.set_title(title, fontsize=9)


def _limits(values: Any) -> dict[str, float]:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return {}
    low, high = np.percentile(known, [1.0, 99.0])
    return {"vmin": float(low), "vmax": float(high)}


def _outline(ax: Any, adjustment: Adjustment, x: float, y: float, yaw: float) -> None:
    """Border of the patch, turned and moved to where it was found."""
    patch = adjustment.patch
    assert patch is not None
    mask = patch.mask
    inner = mask.copy()
    inner[1:-1, 1:-1] &= mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    rows, columns = np.nonzero(mask & ~inner)
    u, v = patch.grid.place(columns.astype(np.float64), rows.astype(np.float64))
    u, v = u - patch.x_m, v - patch.y_m
    c, s = np.cos(yaw - patch.yaw_rad), np.sin(yaw - patch.yaw_rad)
    ax.plot(x + c * u - s * v, y + s * u + c * v, ".", ms=1.5, color=BASELINE)


def _wrapped(text: str, width: int) -> list[str]:
    import textwrap

    return textwrap.wrap(text, width)
