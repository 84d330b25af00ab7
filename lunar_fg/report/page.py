"""Puts figures and words into one HTML page that needs no network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from frontends.errors import InputError
from lunar_fg import __version__
from lunar_fg.report import figures, maps
from lunar_fg.report.against_truth import AgainstTruth, against_truth
from lunar_fg.report.fixes import FixRow, fix_rows, without_fixes
from lunar_fg.report.orbital_image import MapPicture, map_picture
from lunar_fg.report.words import Card, cards, metres, remarks, sentences
from lunar_fg.results import RunResults, read_results
from lunar_fg.route import route_columns
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.trajectory import Trajectory

#: What JSON may hold that HTML would read as markup.
_MARKUP = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"}


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the page: plotly's JSON, with a title and what to see in it."""

    id: str
    title: str
    caption: str
    data: Markup


@dataclass(frozen=True, slots=True)
class Table:
    """A table: head, rows of text, first column left, the others right."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class RunSection:
    """What the page says about one run."""

    id: str
    name: str
    folder: str
    cards: list[Card]
    sentences: list[str]
    remarks: list[str]
    figures: list[Figure]
    fixes: list[FixRow]
    timing: Table | None
    config: str


@dataclass(frozen=True, slots=True)
class Comparison:
    """What the page says about several runs side by side."""

    table: Table
    figures: list[Figure] = field(default_factory=list)


def write_report(folders: Sequence[RunFolder], path: Path) -> None:
    """Write the report of one run, or of several side by side.

    Raises
    ------
    InputError
        A folder holds no trajectory, or the page cannot be written.
    """
    if not folders:
        raise InputError("needs at least one run", source="report")
    runs = [read_results(folder) for folder in folders]
    fixless = [without_fixes(results) for results in runs]
    compared = [
        against_truth(results, track) for results, (track, _) in zip(runs, fixless, strict=True)
    ]
    names = _distinct(runs)
    sections = [
        _section(f"run{number}", *run)
        for number, run in enumerate(zip(names, runs, compared, fixless, strict=True))
    ]
    environment = Environment(
        loader=PackageLoader("lunar_fg.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("page.html.j2").render(
        title=" / ".join(names) if len(names) < 4 else f"{len(names)} runs",
        version=__version__,
        plotly=Markup(get_plotlyjs()),  # noqa: S704  # code of the library
        sections=sections,
        comparison=_comparison(names, runs, compared) if len(runs) > 1 else None,
    )
    write_whole(path, page.encode())


def _section(
    key: str,
    name: str,
    results: RunResults,
    compared: AgainstTruth | None,
    fixless: tuple[Trajectory | None, str],
) -> RunSection:
    picture, notes = map_picture(results, _everything(results, compared))
    return RunSection(
        id=key,
        name=name,
        folder=str(results.folder.path),
        cards=cards(results, compared),
        sentences=sentences(results, compared),
        remarks=[*remarks(results), *notes, *filter(None, fixless[1:])],
        figures=list(_figures(key, results, compared, picture, fixless[0])),
        fixes=fix_rows(results),
        timing=_timing(results),
        config=yaml.safe_dump(results.config, sort_keys=False, allow_unicode=True),
    )


def _figures(
    key: str,
    results: RunResults,
    compared: AgainstTruth | None,
    picture: MapPicture | None,
    fixless: Trajectory | None,
) -> Iterable[Figure]:
    over = "" if picture is None else f" Over the {picture.what}."
    truth = "" if compared is None else f" Truth: {compared.how}."
    yield _figure(
        f"{key}-map", "Trajectory", "From above, to scale; drag to pan, wheel to zoom, tap a name "
        f"to hide it.{over}{truth}", maps.map_figure(results, compared, picture, fixless),
    )  # fmt: skip
    if compared is not None:
        yield _figure(
            f"{key}-drift", "Drift", f"Distance from the truth, {compared.how}. An honest "
            "covariance predicts about the error that is seen.", figures.drift_figure(compared),
        )  # fmt: skip
    correction = figures.correction_figure(results)
    if correction is not None:
        yield _figure(
            f"{key}-correction", "Before and after", "How far later measurements moved each "
            "position from where it was said to be at the time.", correction,
        )  # fmt: skip
    if results.route is not None:
        states = route_columns(results.folder.path / "route.csv")
        half_width = (results.metrics.get("route") or {}).get("half_width_m")
        if states is not None and half_width is not None:
            yield _figure(
                f"{key}-route", "Planned route", f"Corridor of +-{half_width:g} m about "
                f"{results.route.name}, as the rover knew it on the way.",
                figures.route_figure(states, float(half_width)),
            )  # fmt: skip
    if results.trajectory.covariance is not None:
        yield _figure(
            f"{key}-sigma", "Uncertainty", "1-sigma of each pose, all measurements of the run "
            "considered.", figures.sigma_figure(results.trajectory),
        )  # fmt: skip
    nees = None if compared is None else figures.nees_figure(compared)
    if nees is not None:
        yield _figure(
            f"{key}-nees", "Consistency", "Squared error over stated variance (NEES), a pose. "
            "Above the band the covariance is too small.", nees,
        )  # fmt: skip
    if results.frames is not None and len(results.frames):
        yield _figure(
            f"{key}-matches", "Matches", "Features and landmarks of every frame.",
            figures.matches_figure(results.frames),
        )  # fmt: skip
        timing = figures.timing_figure(results.frames)
        if timing is not None:
            yield _figure(
                f"{key}-timing", "Timing", "Wall time of every frame by stage. The first frame "
                "may hold compilation and is cut off.", timing,
            )  # fmt: skip


def _comparison(
    names: list[str], runs: list[RunResults], compared: list[AgainstTruth | None]
) -> Comparison:
    rows = [
        (title, *(_cell(_value(results.metrics, keys), unit) for results in runs))
        for title, keys, unit in _COMPARED
    ]
    rows = [row for row in rows if any(cell != "-" for cell in row[1:])]
    tracks = {name: results.trajectory for name, results in zip(names, runs, strict=True)}
    found = [result for result in compared if result is not None]
    picture, _ = map_picture(runs[0], np.concatenate([r.trajectory.positions for r in runs]))
    shown = [
        _figure(
            "all-map", "Trajectories", "All runs in their own map frames, one over the other.",
            maps.overview_figure(tracks, found[0].truth_in_map if found else None, picture),
        )
    ]  # fmt: skip
    profiles = {
        name: result.profiles["smoothed"]
        for name, result in zip(names, compared, strict=True)
        if result is not None
    }
    if profiles:
        drifts = figures.drifts_figure(profiles)
        shown.append(_figure("all-drift", "Drift", "Distance from the truth of each run.", drifts))
    return Comparison(Table(("", *names), tuple(rows)), shown)


_COMPARED: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("frames", ("frames",), ""),
    ("frames lost", ("frames_lost",), ""),
    ("distance", ("distance_m",), "m"),
    ("error at the end", ("final_error_m",), "m"),
    ("ATE, SE(3)-aligned", ("ate_rmse_m", "se3"), "m"),
    ("ATE, Sim(3)-aligned", ("ate_rmse_m", "sim3"), "m"),
    ("scale (Sim3)", ("scale_sim3",), ""),
    ("drift, %", ("kitti", "translation_percent"), ""),
    ("drift, deg/m", ("kitti", "rotation_deg_per_m"), ""),
    ("RPE", ("rpe", "translation_m"), "m"),
    ("NEES / dof", ("nees", "mean"), ""),
    ("inliers, median", ("matches", "inliers"), ""),
    ("ms a frame, median", ("timing_ms", "total", "median"), ""),
)


def _timing(results: RunResults) -> Table | None:
    stages = results.metrics.get("timing_ms") or {}
    if not stages:
        return None
    rows = [(name, f"{t['median']:.1f}", f"{t['p95']:.1f}") for name, t in stages.items()]
    return Table(("stage", "median, ms", "95 %, ms"), tuple(rows))


def _value(metrics: dict[str, Any], keys: tuple[str, ...]) -> Any:
    value: Any = metrics
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _cell(value: Any, unit: str) -> str:
    if value is None:
        return "-"
    return metres(float(value)) if unit == "m" else f"{value:.4g}"


def _figure(key: str, title: str, caption: str, figure: go.Figure) -> Figure:
    text = str(figure.to_json())
    for sign, code in _MARKUP.items():
        text = text.replace(sign, code)
    return Figure(key, title, caption, Markup(text))  # noqa: S704  # escaped above


def _everything(results: RunResults, compared: AgainstTruth | None) -> Any:
    """All positions that the map should show."""
    points = [results.trajectory.positions]
    if compared is not None:
        points.append(compared.truth_in_map)
    return np.concatenate(points)


def _distinct(runs: Sequence[RunResults]) -> list[str]:
    """Names by dataset, by folder where these are equal."""
    names = [results.name for results in runs]
    if len(set(names)) == len(names):
        return names
    folders = [results.folder.path.resolve() for results in runs]
    short = [folder.name for folder in folders]
    return short if len(set(short)) == len(short) else [str(folder) for folder in folders]
