"""Navigate through a dataset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from lunar_fg import runs, sittings
from lunar_fg.commands.follow import follow as follow_command
from lunar_fg.commands.progress import navigating
from lunar_fg.commands.resume import route_of
from lunar_fg.commands.shared import Overwrite, out
from lunar_fg.config import Config, read_config
from lunar_fg.console import run_summary
from lunar_fg.datasets import open_dataset
from lunar_fg.faults import FaultyDataset, parse_fault
from lunar_fg.follow import Policy
from lunar_fg.live import open_live_view
from lunar_fg.log_entries import Sitting
from lunar_fg.route_file import watch
from lunar_fg.run_folder import RunFolder
from lunar_fg.run_source import RunSource


def run(
    dataset: Annotated[Path, typer.Argument(help="Folder of the dataset (folder format, KITTI).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")],
    config: Annotated[Path | None, typer.Option(help="YAML with settings that differ.")] = None,
    traverse: Annotated[
        Path | None, typer.Option(help="traverse.yaml for a folder of images without one.")
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder that frames.csv's paths are relative to.")
    ] = None,
    route: Annotated[
        Path | None, typer.Option(help="Planned route, GeoJSON, to watch the drive against.")
    ] = None,
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            help="Calibration of a folder of raw images: OpenCV, Kalibr, EuRoC, ROS, .tsai, "
            "KITTI; twice for left and right."
        ),
    ] = None,
    topic: Annotated[
        list[str] | None,
        typer.Option(help="Image topic of a ROS recording; twice for left and right."),
    ] = None,
    inject: Annotated[
        list[str] | None,
        typer.Option(help="Fault to inject, NAME@FIRST-LAST, e.g. frozen@40-60; repeatable."),
    ] = None,
    ortho: Annotated[
        Path | None,
        typer.Option("--map", help="Orbital image of the place: absolute fixes remove the drift."),
    ] = None,
    dem: Annotated[Path | None, typer.Option(help="Orbital elevation model of the place.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random choices.")] = None,
    overwrite: Overwrite = False,
    append: Annotated[
        bool, typer.Option("--append", help="Go on with the run there: a further sitting.")
    ] = False,
    gap: Annotated[
        float | None, typer.Option(help="Seconds before that sitting, if stamps do not tell.")
    ] = None,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Live view in Rerun; headless into RUN/run.rrd.")
    ] = False,
    follow: Annotated[
        bool, typer.Option("--follow", help="Take image pairs as they arrive in left/ and right/.")
    ] = False,
    policy: Annotated[
        Policy, typer.Option(help="With --follow: every pair, or the newest when they pile up.")
    ] = Policy.EVERY,
    quiet_s: Annotated[
        float | None, typer.Option("--quiet", help="With --follow: end after so many s without.")
    ] = None,
    estimates: Annotated[
        Path | None, typer.Option(help="With --follow: JSON lines into a file, not to stdout.")
    ] = None,
) -> None:
    """Navigate through a stereo sequence.

    Example: lunar-fg run my-traverse -o runs/first
    """
    if follow:
        settings = _settings(config, seed)
        follow_command(dataset, traverse, output, settings, overwrite, policy, quiet_s, estimates)
        return
    opened = open_dataset(dataset, images, traverse, calibration or (), topic or ())
    faults = [parse_fault(text) for text in inject or ()]
    sitting = Sitting(
        str(dataset.resolve()),
        _absolute(images),
        _absolute(traverse),
        calibration=tuple(
            str(path.resolve() if path.exists() else path) for path in calibration or ()
        ),
        topics=tuple(topic or ()),
        faults=tuple(inject or ()),
    )
    if append:
        _refuse_with_append(
            inject=inject,
            config=config,
            seed=seed,
            overwrite=overwrite or None,
            route=route,
            map=ortho,
            dem=dem,
        )
        folder = RunFolder.open(output)
        with navigating(folder, opened.name, len(opened)) as advance:
            planned = route_of(folder, opened)
            metrics = sittings.append(opened, folder, sitting, gap, advance, planned)
    else:
        settings = _settings(config, seed)
        if ortho is not None or dem is not None:
            named = replace(settings.map, ortho=_resolved(ortho), dem=_resolved(dem), use=True)
            settings = settings.model_copy(update={"map": named})
        monitor = None if route is None else watch(route, opened, settings.route)
        folder = RunFolder.create(output, settings, overwrite=overwrite)
        RunSource.of(opened, images, traverse, ortho, dem, calibration or ()).write(folder)
        if route is not None:
            folder.route_path.write_bytes(route.read_bytes())
        if faults:
            opened = FaultyDataset(opened, faults, settings.seed, folder.path)
        live = open_live_view(opened, folder.path / "run.rrd") if rerun else None
        with navigating(folder, opened.name, len(opened)) as advance:
            metrics = runs.run(opened, folder, settings, advance, monitor, sitting, live)
        if live is not None:
            live.close()
    out.print(run_summary(opened.name, metrics, output), markup=False)


def _settings(config: Path | None, seed: int | None) -> Config:
    settings = Config() if config is None else read_config(config)
    return settings if seed is None else settings.model_copy(update={"seed": seed})


def _resolved(path: Path | None) -> Path | None:
    return None if path is None else path.resolve()


def _absolute(path: Path | None) -> str | None:
    return None if path is None else str(path.resolve())


def _refuse_with_append(**given: object) -> None:
    for name, value in given.items():
        if value is not None:
            raise typer.BadParameter(
                f"--append goes on with the run's own settings: leave out --{name}"
            )
