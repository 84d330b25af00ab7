"""Show the whole on data that come along."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_fg.commands.shared import out
from lunar_fg.config import Config
from lunar_fg.console import accuracy_table
from lunar_fg.demo import demo as run_demo
from lunar_fg.run_folder import RunFolder

#: Where the demo looks for KITTI's truth when none is named.
DEMO_TRUTH = Path("../shared/data/kitti-gt-poses/gt/00.txt")


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")] = Path(
        "runs/demo"
    ),
    truth: Annotated[
        Path | None,
        typer.Option(help=f"KITTI's poses/00.txt; {DEMO_TRUTH} is used where it is."),
    ] = None,
) -> None:
    """Smooth real stereo landmarks of a KITTI drive that come with gtsam; no download.

    Example: lunar-fg demo
    """
    if truth is None and DEMO_TRUTH.is_file():
        truth = DEMO_TRUTH
    folder = RunFolder.create(output, Config(), overwrite=True)
    result = run_demo(folder, truth)
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
