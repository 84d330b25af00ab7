"""The path from above, with the uncertainty of its positions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.stats import chi2

from lunar_fg.evaluation.figure import BASELINE, ESTIMATE, TRUTH, finish, new_figure
from lunar_fg.trajectory import Trajectory, Truth, travelled_m

FloatArray = NDArray[np.float64]

#: Ellipses drawn along the path, and the size of the largest, over the picture's width,
#: below which they are magnified.
ELLIPSES = 14
LEGIBLE = 0.015
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def top_view(
    estimate: Trajectory,
    truth: Truth | None = None,
    baseline: Trajectory | None = None,
    *,
    title: str = "Top view",
    baseline_label: str = "odometry only",
    axes: tuple[int, int] = (0, 1),
) -> Figure:
    """Path from above with 95 % ellipses; all three in the same frame.

    Parameters
    ----------
    estimate
        With covariances for the ellipses. Where these are too small to be seen they are
        magnified, and the legend says how much.
    truth, baseline
        Drawn beside it when given.
    title, baseline_label
        Texts.
    axes
        Which two coordinates are drawn: (0, 2) for poses of a camera.
    """
    tracks = [
        track.positions[:, axes] for track in (estimate, truth, baseline) if track is not None
    ]
    low, high = _window(np.concatenate(tracks))
    size = high - low
    width = 8.0 if size[0] >= 0.8 * size[1] else 6.0
    height = float(np.clip((width - 0.7) * size[1] / size[0], 1.5, 9.0)) + 1.25
    figure = new_figure(width, height)
    ax = figure.add_subplot()
    if truth is not None:
        xy = truth.positions[:, axes]
        ax.plot(xy[:, 0], xy[:, 1], color=TRUTH, lw=4.5, alpha=0.28, label="truth")
    if baseline is not None:
        xy = baseline.positions[:, axes]
        ax.plot(xy[:, 0], xy[:, 1], color=BASELINE, lw=1.4, ls="--", label=baseline_label)
    xy = estimate.positions[:, axes]
    ax.plot(xy[:, 0], xy[:, 1], color=ESTIMATE, lw=1.6, label="estimate")
    if estimate.covariance is not None:
        _draw_ellipses(ax, estimate, axes, float(size.max()))
    ax.plot(*xy[0], "o", color=ESTIMATE, ms=7, mfc="white", mew=1.6, zorder=5, label="start")
    ax.plot(*xy[-1], "s", color=ESTIMATE, ms=7, mec="white", zorder=5, label="end")
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    names = "xyz"
    ax.set_xlabel(f"{names[axes[0]]} (m)")
    ax.set_ylabel(f"{names[axes[1]]} (m)")
    ax.yaxis.set_major_locator(MaxNLocator(nbins=max(3, int(height)), steps=[1, 2, 5, 10]))
    finish(figure, ax, title)
    return figure


def _draw_ellipses(ax: Axes, track: Trajectory, axes: tuple[int, int], extent: float) -> None:
    block = track.covariance_in("map")[:, 3:, 3:]
    planar = block[np.ix_(range(len(track)), axes, axes)]
    values, vectors = np.linalg.eigh(planar)
    widths = 2.0 * np.sqrt(np.maximum(values, 0.0) * chi2.ppf(0.95, 2))
    angles = np.rad2deg(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    distance = travelled_m(track.positions)
    marks = np.linspace(0.0, distance[-1], ELLIPSES + 1)[1:]
    rows = np.unique(np.minimum(np.searchsorted(distance, marks), len(track) - 1))
    largest = float(widths[rows].max())
    legible = (m for m in MAGNIFICATIONS if largest * m >= LEGIBLE * extent)
    factor = next(legible, MAGNIFICATIONS[-1])
    label = "95 % ellipse" if factor == 1 else f"95 % ellipse, {factor} x enlarged"
    ellipses = EllipseCollection(
        (widths[rows, 1] * factor).tolist(),
        (widths[rows, 0] * factor).tolist(),
        angles[rows].tolist(),
        units="xy",
        offsets=track.positions[rows][:, axes],
        offset_transform=ax.transData,
        facecolor=to_rgba(ESTIMATE, 0.16),
        edgecolor=to_rgba(ESTIMATE, 0.75),
        linewidth=0.8,
    )
    ax.add_collection(ellipses)
    face = to_rgba(ESTIMATE, 0.16)
    ax.plot([], [], marker="o", ls="none", ms=9, mfc=face, mec=ESTIMATE, label=label)


def _window(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of the picture: everything, a margin, and not thinner than about 1 : 4."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = max(float((high - low).max()), 1e-3)
    half = np.maximum((high - low) / 2 + 0.06 * extent, 0.14 * extent)
    centre = (low + high) / 2
    return centre - half, centre + half
