"""Results for a GIS."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_fg.commands.shared import out
from lunar_fg.geo_export import write_geojson, write_geopackage
from lunar_fg.results import read_results
from lunar_fg.run_folder import RunFolder


def geo(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
) -> None:
    """Write the results for a GIS: results.gpkg and results.geojson in the run folder.

    Path, poses, 1-sigma ellipses, fixes with their verdicts, planned route and truth, in the
    map's coordinate reference system where the dataset names one.

    Example: lunar-fg geo runs/first
    """
    results = read_results(RunFolder.open(run_folder))
    for name, write in (("results.gpkg", write_geopackage), ("results.geojson", write_geojson)):
        write(results, run_folder / name)
        out.print(f"wrote {run_folder / name}", markup=False)
    if results.georeference is None:
        out.print("no map reference in traverse.yaml: metres of a local frame", markup=False)
