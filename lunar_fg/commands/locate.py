"""Find a run's ground in an orbital map."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import Progress

from frontends.errors import InputError
from frontends.measurements import SunDirection
from lunar_fg.commands.shared import err, out
from lunar_fg.fix_pictures import FixPictures
from lunar_fg.locate import ground_of, locate, map_of
from lunar_fg.results import read_results
from lunar_fg.run_folder import RunFolder
from lunar_fg.runs import settings_of


def locate_command(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
    ortho: Annotated[
        Path | None, typer.Option("--map", help="Orbital image; the run's own by default.")
    ] = None,
    dem: Annotated[Path | None, typer.Option(help="Orbital elevation model.")] = None,
    sun: Annotated[
        str | None, typer.Option(help="AZIMUTH,ELEVATION of the image's light, deg.")
    ] = None,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="Lost: do not trust the trajectory.")
    ] = False,
    within: Annotated[float, typer.Option(help="Half width of that search, m.")] = 50.0,
    yaw: Annotated[float, typer.Option(help="Half width of its yaw, deg; 180: any.")] = 180.0,
    pictures: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for pictures of the fixes.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the fixes as JSON.")] = False,
) -> None:
    """Find the ground of a finished run in an orbital map; the run stays as it is.

    Exit code 1 when no stretch of the drive is found, with the reasons.

    Example: lunar-fg locate runs/first --map orbital.tif -o fixes
    """
    folder = RunFolder.open(run_folder)
    results = read_results(folder)
    orbital = map_of(results, ortho, dem, _sun(sun))
    with Progress(console=err, transient=True) as progress:
        task = progress.add_task("dense stereo", total=len(results.estimates))
        terrain = ground_of(results, lambda: progress.advance(task))
    search = (within, math.radians(yaw)) if everywhere else None
    found = []
    for adjustment in locate(results, terrain, orbital, settings_of(folder).absolute, search):
        found.append(adjustment.fix)
        if not json:
            out.print(str(adjustment), markup=False)
        if pictures is not None:
            FixPictures(pictures).draw(adjustment)
    if json:
        sys.stdout.write(dumps([asdict(fix) for fix in found], default=_plain) + "\n")
    if not any(fix.candidates for fix in found):
        raise typer.Exit(1)


def _sun(text: str | None) -> SunDirection | None:
    if text is None:
        return None
    try:
        azimuth, elevation = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"is {text!r}", source="--sun", remedy="e.g. --sun 285,35") from error
    return SunDirection(azimuth, elevation)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
