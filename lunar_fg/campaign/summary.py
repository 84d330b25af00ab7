"""The summary page of a campaign: distributions by group, and every failure with its seed."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2
import numpy as np
import plotly.graph_objects as go

from lunar_fg.campaign.study import Study
from lunar_fg.campaign.trial import Outcome

#: Figures shown: attribute of `Outcome`, title.
FIGURES = (
    ("final_error_m", "final error, m"),
    ("ate_m", "ATE, m"),
    ("drift_percent", "drift, %"),
    ("nees", "NEES a degree of freedom"),
    ("coverage", "poses within 3 sigma"),
    ("cpu_s", "CPU, s"),
)


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of one figure in one group; None where no run has it."""

    median: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, outcomes: Sequence[Outcome], figure: str) -> Spread:
        """Median and the 5th and 95th percentile."""
        values = [getattr(outcome, figure) for outcome in outcomes]
        known = [value for value in values if value is not None and np.isfinite(value)]
        if not known:
            return cls(None, None, None)
        low, median, high = np.percentile(known, [5, 50, 95])
        return cls(float(median), float(low), float(high))


@dataclass(frozen=True, slots=True)
class Group:
    """Runs that differ by their seed alone."""

    name: str
    outcomes: tuple[Outcome, ...]

    @property
    def failures(self) -> int:
        """How many did not run to their end."""
        return sum(bool(outcome.error) for outcome in self.outcomes)

    def spread(self, figure: str) -> Spread:
        """Distribution of a figure."""
        return Spread.of(self.outcomes, figure)


def groups_of(outcomes: Sequence[Outcome]) -> list[Group]:
    """Outcomes by group, in the study's order."""
    names = list(dict.fromkeys(outcome.group for outcome in outcomes))
    return [Group(name, tuple(o for o in outcomes if o.group == name)) for name in names]


def write_summary(path: Path, study: Study, outcomes: Sequence[Outcome]) -> None:
    """Write the page: self-contained, no network."""
    groups = groups_of(outcomes)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lunar_fg.campaign", "templates"), autoescape=True
    )
    plots = [
        _plot(groups, figure, title).to_html(
            full_html=False, include_plotlyjs="inline" if k == 0 else False
        )
        for k, (figure, title) in enumerate(FIGURES)
    ]
    text = environment.get_template("summary.html").render(
        study=study,
        groups=groups,
        figures=FIGURES,
        plots=plots,
        failures=[outcome for outcome in outcomes if outcome.error],
        runs=len(outcomes),
    )
    path.write_text(text, encoding="utf-8")


def _plot(groups: Sequence[Group], figure: str, title: str) -> go.Figure:
    plot = go.Figure()
    for group in groups:
        values = [getattr(outcome, figure) for outcome in group.outcomes]
        plot.add_trace(
            go.Box(
                x=values,
                name="<br>".join(textwrap.wrap(html.escape(group.name), 34)),
                orientation="h",
                boxpoints="all",
                pointpos=0,
                jitter=0.4,
                text=[f"seed {outcome.seed}" for outcome in group.outcomes],
                showlegend=False,
            )
        )
    plot.update_layout(
        title=title,
        margin={"l": 10, "r": 20, "t": 40, "b": 30},
        height=110 + 48 * len(groups),
        template="plotly_white",
        yaxis={"autorange": "reversed", "automargin": True},
    )
    return plot
