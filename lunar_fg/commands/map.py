"""Terrain maps of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import Progress

from frontends.errors import InputError
from frontends.terrain import DenseStereoConfig, RoverLimits, TerrainMap
from lunar_fg.commands.shared import err, out
from lunar_fg.results import read_results
from lunar_fg.run_folder import RunFolder
from lunar_fg.terrain_points import POINTS, measure_points, read_points, write_points
from lunar_fg.terrain_products import make_products, write_geotiffs, write_ply

_DEFAULT = RoverLimits()


def terrain_map(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
    cell: Annotated[float, typer.Option(help="Side of a cell, m.")] = 0.1,
    spacing: Annotated[float, typer.Option(help="Way between stereo pairs used, m.")] = 0.5,
    ply: Annotated[bool, typer.Option("--ply", help="Write a coloured point cloud too.")] = False,
    measure: Annotated[
        bool, typer.Option("--measure", help="Measure the ground anew, not only place it anew.")
    ] = False,
    length: Annotated[float, typer.Option(help="Length of the rover, m.")] = _DEFAULT.length_m,
    width: Annotated[float, typer.Option(help="Width of the rover, m.")] = _DEFAULT.width_m,
    max_slope: Annotated[
        float, typer.Option(help="Steepest slope that it drives over, deg.")
    ] = _DEFAULT.max_slope_deg,
    max_step: Annotated[
        float, typer.Option(help="Largest step that it drives over, m.")
    ] = _DEFAULT.max_step_m,
) -> None:
    """Map the ground that a run has seen: elevation, ortho, slope, roughness, obstacles.

    Cloud-optimised GeoTIFFs in the run's folder `map`, in the map's coordinate reference
    system where the dataset names one. The ground is measured once, from the images; after a
    correction of the trajectory the same command only places it anew.

    Example: lunar-fg map runs/first --cell 0.05 --ply
    """
    limits = _limits(length, width, max_slope, max_step)
    finest = DenseStereoConfig().cell_m
    if not cell >= finest or not spacing >= 0.0:
        raise InputError(
            f"{cell:g} m, {spacing:g} m", source="--cell, --spacing",
            remedy=f"cells of {finest:g} m or more: finer ones are not measured",
        )  # fmt: skip
    results = read_results(RunFolder.open(run_folder))
    folder = run_folder / "map"
    folder.mkdir(exist_ok=True)
    kept = folder / POINTS
    if measure or not kept.is_file():
        with Progress(console=err, transient=True) as progress:
            task = progress.add_task("dense stereo", total=len(results.estimates))
            points = measure_points(results, spacing, lambda: progress.advance(task))
        if not points:
            raise InputError("has no frame that could be used", source=run_folder)
        write_points(kept, points)
    terrain = TerrainMap()
    terrain.replace(read_points(kept))
    products = make_products(results, terrain, cell, limits)
    written = write_geotiffs(folder, products, results.georeference)
    seen = products.terrain
    out.print(
        f"{seen.observed_m2:.0f} m2 of ground from {len(terrain)} keyframes, "
        f"height 1-sigma {np.nanmedian(seen.sigma_m):.3f} m (median)",
        markup=False,
    )
    if ply:
        count = write_ply(folder / "cloud.ply", products, results.georeference)
        out.print(f"{count} points in {folder / 'cloud.ply'}", markup=False)
    out.print(f"{', '.join(path.stem for path in written)} in {folder}", markup=False)


def _limits(length: float, width: float, max_slope: float, max_step: float) -> RoverLimits:
    if min(length, width, max_slope, max_step) <= 0.0:
        raise InputError("must be above 0", source="--length, --width, --max-slope, --max-step")
    return RoverLimits(length, width, max_slope, max_step)
