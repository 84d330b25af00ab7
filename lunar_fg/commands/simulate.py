"""Render a traverse."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from frontends.errors import InputError
from lunar_fg.commands.shared import err, out
from lunar_fg.simulation.spec import SimulationSpec, checked_spec, read_spec


def parse_sun(text: str) -> dict[str, float]:
    """Read "azimuth,elevation" in degrees.

    Raises
    ------
    InputError
        When it is anything else.
    """
    try:
        azimuth, elevation = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(
            f"is {text!r}", source="--sun", remedy="give azimuth,elevation in degrees: 150,18"
        ) from error
    return {"azimuth_deg": azimuth, "elevation_deg": elevation}


def adapted(
    spec: SimulationSpec,
    *,
    seed: int | None = None,
    size: int | None = None,
    length: float | None = None,
    step: float | None = None,
    sun: str | None = None,
    map_sun: str | None = None,
    gsd: float | None = None,
    dem: Path | None = None,
    depth: bool = False,
    wrong_map: bool = True,
) -> SimulationSpec:
    """Spec with what the command line gives, checked again.

    Raises
    ------
    InputError
        When a value is out of its range.
    """
    changes: tuple[tuple[tuple[str, ...], object], ...] = (
        (("seed",), seed),
        (("camera", "width"), size),
        (("camera", "height"), size),
        (("path", "length_m"), length),
        (("path", "step_m"), step),
        (("sun",), None if sun is None else parse_sun(sun)),
        (("orbital", "sun"), None if map_sun is None else parse_sun(map_sun)),
        (("orbital", "gsd_m"), gsd),
        (("terrain", "dem"), dem),
        (("depth",), depth or None),
        (("orbital", "wrong_map"), None if wrong_map else False),
    )
    data = spec.model_dump()
    for place, value in changes:
        if value is not None:
            group = data
            for name in place[:-1]:
                group = group[name]
            group[place[-1]] = value
    return checked_spec(data, "command line")


def simulate(
    folder: Annotated[Path, typer.Argument(help="New folder for the dataset.")],
    spec: Annotated[Path | None, typer.Option(help="YAML with settings that differ.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random choices.")] = None,
    size: Annotated[int | None, typer.Option(help="Image width and height, px.")] = None,
    length: Annotated[float | None, typer.Option(help="Length of the drive, m.")] = None,
    step: Annotated[float | None, typer.Option(help="Distance between stereo pairs, m.")] = None,
    sun: Annotated[
        str | None, typer.Option(help="Azimuth,elevation during the drive, deg.")
    ] = None,
    map_sun: Annotated[
        str | None, typer.Option(help="Azimuth,elevation of the orbital image, deg.")
    ] = None,
    gsd: Annotated[float | None, typer.Option(help="Pixel of the orbital image, m.")] = None,
    dem: Annotated[Path | None, typer.Option(help="GeoTIFF with the base relief.")] = None,
    depth: Annotated[bool, typer.Option("--depth", help="Write each left image's depth.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: cores.")] = None,
) -> None:
    """Render a lunar traverse with exact truth and an orbital map, as a dataset.

    Example: lunar-fg simulate my-moon --length 50
    """
    wanted = adapted(
        SimulationSpec() if spec is None else read_spec(spec),
        seed=seed,
        size=size,
        length=length,
        step=step,
        sun=sun,
        map_sun=map_sun,
        gsd=gsd,
        dem=dem,
        depth=depth,
    )
    # the ray caster is heavy to import, and no other command needs it
    from lunar_fg.simulation.simulate import simulate as run_simulation

    with RenderProgress() as progress:
        run_simulation(wanted, folder, workers=workers, on_progress=progress.tell)
    out.print(f"dataset in {folder}; navigate it: lunar-fg run {folder} -o runs/NAME", markup=False)


class RenderProgress(Progress):
    """A bar for each part of the simulation."""

    def __init__(self) -> None:
        super().__init__(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=err,
            transient=True,
        )

    def tell(self, what: str, done: int, total: int) -> None:
        """Show that `done` of `total` of a part are there."""
        known = {task.description: task.id for task in self.tasks}
        if what not in known:
            known[what] = self.add_task(what, total=total)
        self.update(known[what], completed=done)
