"""The report's figures along the way and by frame, as plotly objects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from lunar_fg.evaluation.drift import DriftProfile
from lunar_fg.evaluation.figure import BASELINE, ESTIMATE, QUIET
from lunar_fg.evaluation.plots import STAGES
from lunar_fg.frame_table import FrameTable
from lunar_fg.geo_export import ellipse_axes
from lunar_fg.report.against_truth import AgainstTruth
from lunar_fg.report.style import (
    ALARM,
    ON_THE_WAY,
    ROUTE,
    base_figure,
    line,
    palette,
    right_axis,
)
from lunar_fg.results import RunResults
from lunar_fg.trajectory import Trajectory, travelled_m

FloatArray = NDArray[np.float64]

#: Corrections below this are rounding, m.
_LEAST_MOVED_M = 1e-6


def drift_figure(compared: AgainstTruth) -> go.Figure:
    """Position error against the distance travelled, and what the covariances predict."""
    figure = base_figure("distance travelled (m)", "position error (m)")
    smoothed = compared.profiles["smoothed"]
    if compared.predicted_m is not None:
        line(
            figure, smoothed.distance_m, compared.predicted_m, "predicted by the covariance (rms)",
            "rgba(27,95,170,0.35)", fill="tozeroy", fillcolor="rgba(27,95,170,0.12)",
            line={"width": 1},
        )  # fmt: skip
    styles = {
        "dead reckoning": (BASELINE, "dot"),
        "without fixes": (ON_THE_WAY, "dash"),
        "on the way": ("#69a8dc", "dashdot"),
        "smoothed": (ESTIMATE, "solid"),
    }
    for name, (colour, dash) in styles.items():
        if name in compared.profiles:
            _error_line(figure, compared.profiles[name], name, colour, dash)
    one = 0.01 * smoothed.distance_m
    line(figure, smoothed.distance_m, one, "1 % of the distance", QUIET, line={"width": 1})
    figure.update_yaxes(rangemode="tozero")
    return figure


def drifts_figure(profiles: Mapping[str, DriftProfile]) -> go.Figure:
    """Position error of several runs against the distance travelled."""
    figure = base_figure("distance travelled (m)", "position error (m)")
    for index, (name, profile) in enumerate(profiles.items()):
        _error_line(figure, profile, name, palette(index), "solid")
    figure.update_yaxes(rangemode="tozero")
    return figure


def correction_figure(results: RunResults) -> go.Figure | None:
    """How far later measurements moved each estimate from what was said on the way."""
    before, after = results.on_the_way, results.trajectory
    if before is None:
        return None
    _, i, j = np.intersect1d(before.stamp_s, after.stamp_s, return_indices=True)
    if len(i) < 2:
        return None
    moved = np.linalg.norm(before.positions[i] - after.positions[j], axis=1)
    if moved.max() < _LEAST_MOVED_M:
        return None
    figure = base_figure("distance travelled (m)", "moved by (m)", 280)
    line(
        figure, travelled_m(after.positions)[j], moved, "moved after the fact", ON_THE_WAY,
        fill="tozeroy", fillcolor="rgba(91,140,90,0.15)",
    )  # fmt: skip
    figure.update_yaxes(rangemode="tozero")
    return figure


def sigma_figure(trajectory: Trajectory) -> go.Figure:
    """1-sigma of position and heading along the way."""
    figure = base_figure("distance travelled (m)", "1-sigma position (m)", 320)
    distance = travelled_m(trajectory.positions)
    major, minor, _ = ellipse_axes(trajectory)
    covariance = trajectory.covariance_in("map")
    line(figure, distance, major, "largest in the plane", ESTIMATE)
    line(figure, distance, minor, "smallest in the plane", "#69a8dc")
    line(figure, distance, np.sqrt(covariance[:, 5, 5]), "height", BASELINE)
    yaw = np.rad2deg(np.sqrt(covariance[:, 2, 2]))
    line(figure, distance, yaw, "heading (deg, right)", ROUTE, yaxis="y2", line={"dash": "dot"})
    right_axis(figure, "heading (deg)")
    figure.update_yaxes(rangemode="tozero")
    return figure


def nees_figure(compared: AgainstTruth) -> go.Figure | None:
    """NEES of each pose with the band in which 95 % of honest ones lie."""
    found = compared.consistency
    if found is None:
        return None
    figure = base_figure("distance travelled (m)", "NEES / dof", 320)
    figure.add_hrect(*found.band, fillcolor="rgba(91,140,90,0.18)", line_width=0,
                     annotation_text="95 % of honest poses", annotation_position="top left",
                     annotation_font_size=11)  # fmt: skip
    line(figure, found.distance_m, np.maximum(found.nees, 1e-3), "NEES / dof", ESTIMATE)
    figure.update_yaxes(type="log", dtick=1)
    return figure


def matches_figure(frames: FrameTable) -> go.Figure:
    """Counts of every frame, from keypoints to those that agree with the motion."""
    figure = base_figure("frame", "count", 340)
    rows = np.arange(len(frames), dtype=float)
    for (key, name), colour in zip(
        {
            "keypoints": "keypoints (left)",
            "stereo_matches": "stereo matches",
            "landmarks": "landmarks",
            "tracked": "tracked",
            "inliers": "inliers",
        }.items(),
        ("#c9b1d6", "#69a8dc", "#5b8c5a", "#f2c078", ESTIMATE),
        strict=True,
    ):
        if key in frames.counts:
            line(figure, rows, frames.counts[key], name, colour)
    if "wrong_match_rate" in frames.counts:
        rate = 100.0 * frames.counts["wrong_match_rate"]
        line(figure, rows, rate, "wrong matches (%, right)", ALARM, yaxis="y2",
             line={"width": 1, "dash": "dot"})  # fmt: skip
        right_axis(figure, "wrong (%)", 100.0)
    figure.update_yaxes(rangemode="tozero")
    return figure


def timing_figure(frames: FrameTable) -> go.Figure | None:
    """Time of every frame, stacked by stage; a slow first frame is cut off."""
    stages = {name: ms for name, ms in frames.timing_ms.items() if name != "total"}
    if not stages:
        return None
    figure = base_figure("frame", "time (ms)", 340)
    rows = np.arange(len(frames), dtype=float)
    for index, (name, ms) in enumerate(stages.items()):
        line(figure, rows, np.nan_to_num(ms), name, STAGES[index % len(STAGES)],
             stackgroup="stages", line={"width": 0.5})  # fmt: skip
    total = np.nansum(list(stages.values()), axis=0)
    top = min(1.05 * float(total.max()), 5.0 * float(np.median(total)))
    figure.update_yaxes(range=[0.0, top or 1.0])
    return figure


def route_figure(states: Mapping[str, FloatArray], half_width_m: float) -> go.Figure:
    """Distance from the planned route with 3 sigma, in its corridor."""
    figure = base_figure("along the route (m)", "cross-track, left positive (m)", 320)
    station, cross, sigma = (
        states[name] for name in ("station_m", "cross_track_m", "sigma_cross_m")
    )
    figure.add_hrect(-half_width_m, half_width_m, fillcolor="rgba(139,95,160,0.10)", line_width=0)
    line(figure, station, cross + 3 * sigma, "+3 sigma", "rgba(27,95,170,0.4)", line={"width": 1})
    line(figure, station, cross - 3 * sigma, "-3 sigma", "rgba(27,95,170,0.4)", line={"width": 1},
         fill="tonexty", fillcolor="rgba(27,95,170,0.12)")  # fmt: skip
    line(figure, station, cross, "cross-track", ESTIMATE)
    outside = 100.0 * states["outside_probability"]
    line(figure, station, outside, "outside (%, right)", ALARM, yaxis="y2", line={"dash": "dot"})
    right_axis(figure, "outside (%)", 100.0)
    figure.update_layout(hovermode="closest")
    return figure


def _error_line(
    figure: go.Figure, profile: DriftProfile, name: str, colour: str, dash: str
) -> None:
    line(figure, profile.distance_m, profile.position_m, name, colour, line={"dash": dash})
