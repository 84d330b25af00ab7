"""The look of the report's figures: axes, lines, colours."""

from __future__ import annotations

from html import escape

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from lunar_fg.evaluation.figure import BASELINE, ESTIMATE, TRUTH

FloatArray = NDArray[np.float64]

ON_THE_WAY = "#5b8c5a"
ALARM = "#b3261e"
ROUTE = "#8b5fa0"
_MOST_POINTS = 4000


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


def right_axis(figure: go.Figure, title: str, highest: float | None = None) -> None:
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
