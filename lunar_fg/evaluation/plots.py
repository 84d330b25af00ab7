"""The pictures of a run: top view, drift against distance, time a step."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from lunar_fg.evaluation.alignment import align, common_frame
from lunar_fg.evaluation.association import TOLERANCE_S, associate
from lunar_fg.evaluation.drift import DriftProfile, drift_profile
from lunar_fg.evaluation.figure import (
    BASELINE,
    ESTIMATE,
    QUIET,
    TRUTH,
    finish,
    new_figure,
    save,
)
from lunar_fg.evaluation.top_view import top_view
from lunar_fg.trajectory import Trajectory, Truth

FloatArray = NDArray[np.float64]

STAGES = ("#1b5faa", "#69a8dc", "#d9792b", "#f2c078", "#5b8c5a", "#a9c99a", "#8b5fa0", "#c9b1d6")


def drift_plot(
    profile: DriftProfile,
    baseline: DriftProfile | None = None,
    *,
    sigma_m: FloatArray | None = None,
    title: str = "Drift against distance",
    baseline_label: str = "odometry only",
) -> Figure:
    """Position error, and below it orientation error, over the distance travelled.

    Parameters
    ----------
    profile, baseline
        Of the estimate, and of something to compare it with.
    sigma_m
        (N,) the rms position error that the covariances of the estimate predict, m.
    title, baseline_label
        Texts.
    """
    oriented = profile.orientation_deg is not None
    figure = new_figure(8.0, 5.4 if oriented else 3.8)
    panels = figure.subplots(2 if oriented else 1, 1, sharex=True, squeeze=False)[:, 0]
    ax = panels[0]
    if sigma_m is not None:
        label = "predicted by the covariance (rms)"
        ax.fill_between(
            profile.distance_m, 0.0, sigma_m, color=ESTIMATE, alpha=0.16, lw=0, label=label
        )
    if baseline is not None:
        ax.plot(
            baseline.distance_m, baseline.position_m, color=BASELINE, ls="--", label=baseline_label
        )
    ax.plot(profile.distance_m, profile.position_m, color=ESTIMATE, label="estimate")
    top = ax.get_ylim()[1]
    ax.plot(
        profile.distance_m,
        0.01 * profile.distance_m,
        color=QUIET,
        lw=0.9,
        ls=":",
        label="1 % of the distance",
    )
    ax.set_ylim(0.0, top)
    ax.set_ylabel("position error (m)")
    if profile.orientation_deg is not None:
        below = panels[1]
        if baseline is not None and baseline.orientation_deg is not None:
            below.plot(baseline.distance_m, baseline.orientation_deg, color=BASELINE, ls="--")
        below.plot(profile.distance_m, profile.orientation_deg, color=ESTIMATE)
        below.set_ylim(bottom=0.0)
        below.set_ylabel("orientation error (deg)")
        below.grid(alpha=0.25)
        below.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("distance travelled (m)")
    panels[-1].set_xlim(0.0, max(float(profile.distance_m[-1]), 1e-6))
    finish(figure, ax, title)
    return figure


def timing_plot(timing_ms: Mapping[str, ArrayLike], *, title: str = "Time a step") -> Figure:
    """Time of each step, stacked by stage, ms; equally long samples, NaN counts as 0."""
    samples = {name: np.nan_to_num(np.asarray(ms, float)) for name, ms in timing_ms.items()}
    total = np.sum(list(samples.values()), axis=0)
    figure = new_figure(8.0, 4.0)
    ax = figure.add_subplot()
    edges = np.arange(len(total) + 1) - 0.5
    bottom = np.zeros(len(total))
    for i, (name, ms) in enumerate(samples.items()):
        label = f"{name} ({np.median(ms):.3g})"
        colour = STAGES[i % len(STAGES)]
        top = bottom + ms
        # One filled outline a stage: thousands of bars would take many seconds to draw.
        low, high = np.append(bottom, bottom[-1]), np.append(top, top[-1])
        ax.fill_between(edges, low, high, step="post", color=colour, lw=0, label=label)
        bottom = top
    median, p95 = float(np.median(total)), float(np.percentile(total, 95))
    ax.axhline(median, color=TRUTH, lw=1.0, label=f"median {median:.3g}")
    ax.axhline(p95, color=TRUTH, lw=1.0, ls=":", label=f"95 % {p95:.3g}")
    ax.set_xlim(-0.5, len(total) - 0.5)
    # One slow first step (compilation, caches) must not flatten all others.
    ax.set_ylim(0.0, min(1.05 * float(total.max()), 2.0 * p95) or 1.0)
    ax.set_xlabel("step")
    ax.set_ylabel("time (ms)")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    cut = int((total > 2.0 * p95).sum())
    note = f"; {cut} cut off, longest {total.max():.0f} ms" if cut else ""
    finish(figure, ax, f"{title} (stage medians in ms{note})")
    return figure


def write_plots(
    folder: str | Path,
    estimate: Trajectory,
    truth: Truth | None = None,
    baseline: Trajectory | None = None,
    *,
    timing_ms: Mapping[str, ArrayLike] | None = None,
    same_map: bool = False,
    tolerance_s: float = TOLERANCE_S,
    name: str = "",
) -> list[Path]:
    """Write ``top_view.png``, ``drift.png`` and ``timing.png``, those there are data for.

    Parameters
    ----------
    folder
        Exists already.
    estimate, truth, baseline
        Estimate and baseline are brought into the truth's frame by the alignment that
        `common_frame` chooses; the title names it.
    timing_ms
        See `timing_plot`.
    same_map, tolerance_s
        See `lunar_fg.evaluation.evaluate`.
    name
        Of the run, for the titles.
    """
    folder = Path(folder)
    start = f"{name}: " if name else ""
    written = []
    if truth is not None and len(estimate):
        view, drift = _against_truth(estimate, truth, baseline, same_map, tolerance_s, start)
        written += [save(view, folder / "top_view.png"), save(drift, folder / "drift.png")]
    elif len(estimate):
        length = f"{estimate.distance_m:.1f} m, {len(estimate)} poses"
        view = top_view(estimate, None, baseline, title=f"{start}{length}")
        written.append(save(view, folder / "top_view.png"))
    if timing_ms and all(np.size(ms) for ms in timing_ms.values()):
        written.append(
            save(timing_plot(timing_ms, title=f"{start}time a step"), folder / "timing.png")
        )
    return written


def _against_truth(
    estimate: Trajectory,
    truth: Truth,
    baseline: Trajectory | None,
    same_map: bool,
    tolerance_s: float,
    start: str,
) -> tuple[Figure, Figure]:
    pair = associate(estimate, truth, tolerance_s)
    kind = common_frame(pair, same_map=same_map)
    alignment = align(kind, pair)
    profile = drift_profile(pair, alignment)
    shown, base_profile = None, None
    if baseline is not None:
        base_pair = associate(baseline, truth, tolerance_s)
        base_alignment = align(kind, base_pair)
        shown = base_alignment.trajectory(baseline)
        base_profile = drift_profile(base_pair, base_alignment)
    sigma = None
    if pair.estimate.covariance is not None:
        variance = np.einsum("nii->n", pair.estimate.covariance[:, 3:, 3:])
        sigma = np.sqrt(variance)
    how = {"none": "same map", "origin": "same start", "se3": "SE(3)-aligned"}[kind]
    rmse = float(np.sqrt(np.mean(profile.position_m**2)))
    path = float(profile.distance_m[-1])
    view = top_view(
        alignment.trajectory(estimate),
        pair.truth,
        shown,
        title=f"{start}{path:.1f} m, ATE {rmse:.3g} m ({how})",
    )
    drift = drift_plot(profile, base_profile, sigma_m=sigma, title=f"{start}drift ({how})")
    return view, drift
