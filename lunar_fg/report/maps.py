"""The report's maps: drives from above, over the orbital image where there is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from frontends.measurements import AbsoluteFix
from lunar_fg.evaluation.figure import BASELINE, ESTIMATE
from lunar_fg.evaluation.top_view import LEGIBLE, MAGNIFICATIONS
from lunar_fg.geo_export import ellipse_axes, ellipse_outlines
from lunar_fg.graph.ledger import LedgerEntry, LoopClosure
from lunar_fg.report.against_truth import AgainstTruth
from lunar_fg.report.orbital_image import MapPicture
from lunar_fg.report.style import ALARM, ON_THE_WAY, ROUTE, base_figure, line, palette
from lunar_fg.results import RunResults
from lunar_fg.trajectory import Trajectory, travelled_m

FloatArray = NDArray[np.float64]

_ELLIPSES = 40


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
