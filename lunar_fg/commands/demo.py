"""Show the whole on data that come along."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_fg.commands.progress import navigating
from lunar_fg.commands.shared import out
from lunar_fg.commands.simulate import RenderProgress, adapted
from lunar_fg.config import Config
from lunar_fg.console import accuracy_table
from lunar_fg.datasets import open_dataset
from lunar_fg.demo_kitti import demo as run_kitti_demo
from lunar_fg.evaluation import Accuracy
from lunar_fg.run_folder import RunFolder

#: Where the KITTI demo looks for the truth when none is named.
DEMO_TRUTH = Path("../shared/data/kitti-gt-poses/gt/00.txt")
#: Distance between the stereo pairs of the demo.
STEP_M = 1.6


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")] = Path(
        "runs/demo"
    ),
    size: Annotated[int, typer.Option(help="Image width and height, px.")] = 512,
    seed: Annotated[int, typer.Option(help="Seed of the place, the drive and all noise.")] = 0,
    sun: Annotated[str, typer.Option(help="Azimuth,elevation during the drive, deg.")] = "150,18",
    length: Annotated[float, typer.Option(help="Length of the drive, m.")] = 100.0,
    kitti: Annotated[
        bool, typer.Option("--kitti", help="Smooth real stereo landmarks of KITTI 00 instead.")
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option(help=f"With --kitti: poses/00.txt; {DEMO_TRUTH} is used where it is."),
    ] = None,
) -> None:
    """Drive over a simulated Moon: render, navigate, smooth, evaluate, report. No download.

    The rendered traverse is kept in the user's cache folder: a second demo starts at once.

    Example: lunar-fg demo
    """
    if kitti:
        _kitti(output, truth)
        return
    # the ray caster is heavy to import, and only the simulator needs it
    from lunar_fg.demo import demo as run_demo
    from lunar_fg.simulation.cache import cached_dataset
    from lunar_fg.simulation.spec import SimulationSpec

    spec = adapted(
        SimulationSpec(), seed=seed, size=size, sun=sun, length=length, step=STEP_M, wrong_map=False
    )
    with RenderProgress() as progress:
        path = cached_dataset(spec, on_progress=progress.tell)
    opened = open_dataset(path)
    folder = RunFolder.create(output, Config(), overwrite=True)
    with navigating(folder, "navigating", len(opened)) as advance:
        result = run_demo(opened, folder, advance)
    out.print(
        f"simulated traverse, seed {seed}: {result.frames} stereo pairs, "
        f"{result.frames_lost} lost; dataset in {path}",
        markup=False,
    )
    out.print(
        accuracy_table(
            {
                "wheels": result.wheels,
                "vision": result.vision,
                "with fixes": result.fixed,
                "batch": result.batch,
            }
        )
    )
    out.print(_drift("by wheels", result.wheels), markup=False)
    out.print(_drift("by vision", result.vision), markup=False)
    out.print(
        f"{_drift('with fixes', result.fixed)}, {result.fixes_believed} of {result.fixes} fixes "
        "on the map believed",
        markup=False,
    )
    out.print(f"report: {result.report}", markup=False)


def _drift(name: str, accuracy: Accuracy) -> str:
    distance, error = accuracy.distance_m, accuracy.final_error_m
    if not distance or error is None:
        return f"drift {name}: unknown"
    percent = 100.0 * error / distance
    return f"drift {name}: {error:.2f} m after {distance:.0f} m ({percent:.2f} %)"


def _kitti(output: Path, truth: Path | None) -> None:
    """Smooth real stereo landmarks of a KITTI drive that come with gtsam."""
    if truth is None and DEMO_TRUTH.is_file():
        truth = DEMO_TRUTH
    folder = RunFolder.create(output, Config(), overwrite=True)
    result = run_kitti_demo(folder, truth)
    out.print(
        f"KITTI 00, real stereo landmarks: {result.observations} observations, "
        f"{result.keyframes} keyframes, {result.distance_m:.0f} m",
        markup=False,
    )
    out.print(
        accuracy_table(
            {
                "iSAM2, segments": result.segments,
                "iSAM2, all landmarks": result.full,
                "batch (LM)": result.batch,
            }
        )
    )
    if truth is None:
        out.print("no truth here: --truth poses/00.txt of KITTI adds the errors", markup=False)
    out.print(
        f"largest distance to the batch: iSAM2 with all landmarks {1e3 * result.gap_m:.2f} mm, "
        f"with segments {1e3 * result.gap_segments_m:.0f} mm",
        markup=False,
    )
    out.print(f"trajectory, covariances and plots in {result.folder}", markup=False)
