"""The report's figures, as plotly objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from frontends.measurements import AbsoluteFix
from lunar_fg.evaluation.drift import DriftProfile
from lunar_fg.evaluation.figure import BASELINE, ESTIMATE, QUIET, TRUTH
from lunar_fg.evaluation.plots import STAGES
from lunar_fg.evaluation.top_view import LEGIBLE, MAGNIFICATIONS
from lunar_fg.frame_table import FrameTable
from lunar_fg.geo_export import ellipse_axes, ellipse_outlines
from lunar_fg.graph.ledger import LedgerEntry, LoopClosure
from lunar_fg.report.against_truth import AgainstTruth
from lunar_fg.report.orbital_image import MapPicture
from lunar_fg.results import RunResults
from lunar_fg.trajectory import Trajectory, travelled_m

FloatArray = NDArray[np.float64]

ON_THE_WAY = "#5b8c5a"
ALARM = "#b3261e"
ROUTE = "#8b5fa0"
_ELLIPSES = 40
_MOST_POINTS = 4000
#: Corrections below this are rounding, m.
_LEAST_MOVED_M = 1e-6


def base_figure(x: str, y: str, height: int = 360) -> go.Figure:
    """Empty figure in the page's look, with titled axes."""
    figure = go.Figure()
    axis = {
        "gridcolor": "#e8e8e8", "linecolor": "#b8b8b8", "zeroline": False, "ticks": "outside",
        "tickcolor": "#b8b8b8", "title": {"standoff": 8, "font": {"size": 13}},
        "automargin": True,
    }  # fmt: skip
    figure.update_layout(
        template="none",
        height=height,
        margin={"l": 50, "r": 14, "t": 14, "b": 40},
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#333"},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.02, "x": 0, "font_size": 12},
        hovermode="x unified",
        xaxis={**axis, "title_text": x},
        yaxis={**axis, "title_text": y},
    )
    return figure


def line(
    figure: go.Figure, x: FloatArray, y: FloatArray, name: str, colour: str, **more: object
) -> None:
    """Add a line, thinned to what a screen can show; `more` goes to the trace."""
    step = max(1, len(x) // _MOST_POINTS)
    style = {"color": colour, "width": 2, **dict(more.pop("line", {}))}  # type: ignore[call-overload]
    figure.add_scatter(
        x=x[::step], y=y[::step], name=escape(name), mode="lines", line=style, **more
    )


def map_figure(
    results: RunResults,
    compared: AgainstTruth | None,
    picture: MapPicture | None,
    fixless: Trajectory | None,
) -> go.Figure:
    """The drive from above, over the orbital map where there is one."""
    figure = _plane(results.trajectory.positions, picture)
    light = picture is not None
    if results.route is not None:
        points = results.route.points_m
        line(figure, points[:, 0], points[:, 1], "planned route", ROUTE, line={"dash": "dash"})
    if compared is not None:
        truth = compared.truth_in_map
        colour = "#ffd75e" if light else "#b0b0b0"
        line(figure, truth[:, 0], truth[:, 1], "truth", colour, line={"width": 6})
    if results.dead_reckoning is not None:
        xy = results.dead_reckoning.positions
        line(figure, xy[:, 0], xy[:, 1], "dead reckoning", BASELINE, line={"dash": "dot"})
    if fixless is not None:
        xy = fixless.positions
        line(figure, xy[:, 0], xy[:, 1], "without fixes", ON_THE_WAY, line={"dash": "dash"})
    track = results.trajectory
    xy = track.positions
    line(figure, xy[:, 0], xy[:, 1], "estimate", "#4fa3ff" if light else ESTIMATE)
    if track.covariance is not None and len(track) > 1:
        _ellipses(figure, track)
    lost = [estimate.stamp_s for estimate in results.estimates if estimate.lost]
    if lost:
        at = xy[np.isin(track.stamp_s, lost)]
        figure.add_scatter(
            x=at[:, 0], y=at[:, 1], mode="markers", name="motion not measured",
            marker={"symbol": "x", "color": ALARM, "size": 8},
        )  # fmt: skip
    _closures(figure, results)
    _fixes(figure, results.ledger)
    ends = xy[[0, -1]]
    figure.add_scatter(
        x=ends[:, 0], y=ends[:, 1], mode="markers+text", text=["start", "end"],
        textposition="top center", showlegend=False, hoverinfo="skip",
        textfont={"color": "#fff" if light else "#333"},
        marker={"size": 10, "color": ["#fff", ESTIMATE], "line": {"color": ESTIMATE, "width": 2}},
    )  # fmt: skip
    return figure


def overview_figure(
    tracks: Mapping[str, Trajectory], truth: FloatArray | None, picture: MapPicture | None
) -> go.Figure:
    """Several runs from above."""
    figure = _plane(np.concatenate([track.positions for track in tracks.values()]), picture)
    if truth is not None:
        line(figure, truth[:, 0], truth[:, 1], "truth", "#b0b0b0", line={"width": 6})
    for index, (name, track) in enumerate(tracks.items()):
        xy = track.positions
        line(figure, xy[:, 0], xy[:, 1], name, palette(index))
    return figure


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
    _right_axis(figure, "heading (deg)")
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
        _right_axis(figure, "wrong (%)", 100.0)
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
    _right_axis(figure, "outside (%)", 100.0)
    figure.update_layout(hovermode="closest")
    return figure


def _right_axis(figure: go.Figure, title: str, highest: float | None = None) -> None:
    """Add an axis at the right, from 0, with ticks of its own."""
    span = {"rangemode": "tozero"} if highest is None else {"range": [0.0, highest]}
    figure.update_layout(
        yaxis2={
            "overlaying": "y", "side": "right", "title": {"text": title, "font": {"size": 13}},
            "showgrid": False, "tickmode": "auto", "nticks": 5, "automargin": True, **span,
        }
    )  # fmt: skip


def palette(index: int) -> str:
    """Colour of the run of this number."""
    colours = (ESTIMATE, BASELINE, ON_THE_WAY, ROUTE, ALARM, "#69a8dc", TRUTH)
    return colours[index % len(colours)]


def _plane(positions: FloatArray, picture: MapPicture | None) -> go.Figure:
    """Figure of the map's plane, about as high as what it shows."""
    size = np.ptp(positions[:, :2], axis=0)
    if picture is not None:
        size = np.array([np.ptp(picture.x_m), np.ptp(picture.y_m)])
    height = int(np.clip(140.0 + 1150.0 * size[1] / max(float(size[0]), 1e-6), 340.0, 660.0))
    figure = base_figure("x, east (m)", "y, north (m)", height)
    figure.update_yaxes(scaleanchor="x", scaleratio=1)
    figure.update_layout(dragmode="pan", hovermode="closest")
    if picture is not None:
        _underlay(figure, picture)
    return figure


def _underlay(figure: go.Figure, picture: MapPicture) -> None:
    (left, right), (bottom, top) = picture.x_m, picture.y_m
    figure.add_layout_image(
        source=picture.uri, xref="x", yref="y", x=left, y=top, sizex=right - left,
        sizey=top - bottom, sizing="stretch", layer="below",
    )  # fmt: skip
    figure.update_xaxes(range=[left, right], showgrid=False, constrain="domain")
    figure.update_yaxes(range=[bottom, top], showgrid=False, constrain="domain")


def _ellipses(figure: go.Figure, track: Trajectory) -> None:
    """1-sigma ellipses along the path, magnified where they would not be seen."""
    distance = travelled_m(track.positions)
    marks = np.linspace(0.0, distance[-1], _ELLIPSES + 1)[1:]
    rows = np.unique(np.minimum(np.searchsorted(distance, marks), len(track) - 1))
    chosen = track.select(rows)
    major, _, _ = ellipse_axes(chosen)
    extent = float(np.ptp(track.positions[:, :2], axis=0).max())
    factor = next((m for m in MAGNIFICATIONS if 2 * major.max() * m >= LEGIBLE * extent), 1)
    outlines = ellipse_outlines(chosen, float(factor))
    gaps = np.full((len(outlines), 1, 2), np.nan)
    points = np.concatenate([outlines, gaps], axis=1).reshape(-1, 2)
    name = "1-sigma ellipses" if factor == 1 else f"1-sigma ellipses, {factor} x enlarged"
    figure.add_scatter(
        x=points[:, 0], y=points[:, 1], name=name, mode="lines", hoverinfo="skip",
        line={"color": ESTIMATE, "width": 1}, fill="toself", fillcolor="rgba(27,95,170,0.14)",
    )  # fmt: skip


def _closures(figure: go.Figure, results: RunResults) -> None:
    """Loop closures as lines between the keyframes that they tie, by verdict."""
    row = {estimate.index: k for k, estimate in enumerate(results.estimates)}
    xy = results.trajectory.positions
    for verdict, colour in (("accepted", "#3b8a5a"), ("refused", ALARM)):
        ends: list[list[float]] = []
        for entry in results.ledger:
            closure = entry.measurement
            if isinstance(closure, LoopClosure) and entry.ruling.verdict.value == verdict:
                ends += [*(xy[row[k], :2].tolist() for k in (closure.base, closure.frame))]
                ends.append([np.nan, np.nan])
        if ends:
            x, y = np.array(ends).T
            name = f"loop closure {verdict}"
            figure.add_scatter(
                x=x, y=y, mode="lines+markers", name=name, line={"color": colour, "width": 2},
                marker={"size": 5},
            )  # fmt: skip


def _fixes(figure: go.Figure, ledger: Sequence[LedgerEntry]) -> None:
    """Places of the fixes, by verdict."""
    for verdict, colour, symbol in (("accepted", "#3b8a5a", "circle"), ("refused", ALARM, "x")):
        places, texts = [], []
        for entry in ledger:
            fix = entry.measurement
            if entry.ruling.verdict.value == verdict and isinstance(fix, AbsoluteFix):
                for place in fix.candidates[entry.ruling.candidate or 0 :][:1]:
                    places.append((place.x_m, place.y_m))
                    texts.append(escape(f"keyframe {entry.frame}: {entry.ruling.reason}"))
        if places:
            x, y = np.array(places).T
            figure.add_scatter(
                x=x, y=y, mode="markers", name=f"fix {verdict}", hovertext=texts,
                marker={"symbol": symbol, "color": colour, "size": 10,
                        "line": {"color": "#fff", "width": 1.5}},
            )  # fmt: skip


def _error_line(
    figure: go.Figure, profile: DriftProfile, name: str, colour: str, dash: str
) -> None:
    line(figure, profile.distance_m, profile.position_m, name, colour, line={"dash": dash})
