"""The look that all pictures share.

Figures are built on matplotlib's objects, without pyplot: nothing global is touched and no
window or display is needed.
"""

from __future__ import annotations

import os
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ESTIMATE, TRUTH, BASELINE, QUIET = "#1b5faa", "#2b2b2b", "#d9792b", "#8a8a8a"
DPI = 160


def new_figure(width: float, height: float) -> Figure:
    """Make a figure of a size in inches."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def finish(figure: Figure, ax: Axes, title: str) -> None:
    """Put the title above and the legend of `ax` below the figure."""
    ax.grid(alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=12)
    handles, labels = ax.get_legend_handles_labels()
    room = 8.5 * float(figure.get_size_inches()[0])
    columns = len(labels)
    while columns > 1 and _legend_width(labels, columns) > room:
        columns -= 1
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=9,
        handlelength=1.6,
        columnspacing=1.4,
    )


def _legend_width(labels: list[str], columns: int) -> int:
    """Width of a legend that is filled column by column, in letters."""
    rows = -(-len(labels) // columns)
    starts = range(0, len(labels), rows)
    return sum(max(map(len, labels[i : i + rows])) + 6 for i in starts)


def save(figure: Figure, path: Path) -> Path:
    """Write a PNG so that it is never seen half-written."""
    beside = path.with_name(f".{path.stem}.{os.getpid()}.tmp.png")
    figure.savefig(beside)
    os.replace(beside, path)
    return path
