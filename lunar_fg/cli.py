"""The commands. No logic of their own: they parse, call, and print."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from functools import wraps
from json import dumps
from pathlib import Path
from typing import Annotated, ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from frontends.errors import InputError, LunarFgError
from lunar_fg import __version__, runs
from lunar_fg.config import Config, read_config
from lunar_fg.console import accuracy_table, run_summary
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.images import read_grey
from lunar_fg.demo import demo as run_demo
from lunar_fg.evaluation import evaluate as compare
from lunar_fg.match import MatchModel, draw, match_images, write_picture
from lunar_fg.run_folder import RunFolder
from lunar_fg.trajectory_io import read_track, read_trajectory
from lunar_fg.warmup import warmup as warm_up

P = ParamSpec("P")
R = TypeVar("R")

#: Exit code for input that cannot be used, and for an estimate that cannot be made.
BAD_INPUT = 2

#: Where the demo looks for KITTI's truth when none is named.
DEMO_TRUTH = Path("../shared/data/kitti-gt-poses/gt/00.txt")

app = typer.Typer(
    name="lunar-fg",
    help="Rover navigation from stereo images: SURF, stereo geometry, one GTSAM factor graph.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier run there.")]


def _guarded(command: Callable[P, R]) -> Callable[P, R]:
    """Turn the project's own errors into one line and exit code 2."""

    @wraps(command)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except LunarFgError as error:
            err.print(f"error: {error}", style="red", markup=False)
            raise typer.Exit(BAD_INPUT) from error

    return call


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Rover navigation from stereo images."""
    logging.basicConfig(
        level=logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=err, show_time=False, show_path=False, show_level=False)],
    )
    if version:
        out.print(__version__)
        raise typer.Exit


@app.command()
@_guarded
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
    seed: Annotated[int | None, typer.Option(help="Seed of all random choices.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Navigate through a stereo sequence.

    Example: lunar-fg run my-traverse -o runs/first
    """
    settings = Config() if config is None else read_config(config)
    if seed is not None:
        settings = settings.model_copy(update={"seed": seed})
    opened = open_dataset(dataset, images, traverse)
    folder = RunFolder.create(output, settings, overwrite=overwrite)
    handler = logging.FileHandler(folder.log_path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger("lunar_fg").addHandler(handler)
    try:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=err, transient=True) as progress:
            task = progress.add_task(opened.name, total=len(opened))
            metrics = runs.run(opened, folder, settings, lambda _: progress.advance(task))
    finally:
        logging.getLogger("lunar_fg").removeHandler(handler)
        handler.close()
    out.print(run_summary(opened.name, metrics, output), markup=False)


@app.command()
@_guarded
def optimize(
    run_folder: Annotated[Path, typer.Argument(help="Folder that `lunar-fg run` wrote.")],
) -> None:
    """Smooth a finished run as a whole, all landmarks in one batch.

    Example: lunar-fg optimize runs/first
    """
    report, accuracy = runs.optimize(RunFolder.open(run_folder))
    out.print(
        f"batch: {report.factors} factors, {report.landmarks} landmarks, "
        f"{report.iterations} iterations, cost {report.cost_before:.1f} -> "
        f"{report.cost_after:.1f}, {report.reason}",
        markup=False,
    )
    out.print(accuracy_table({"batch": accuracy}))
    out.print(f"results in {run_folder / 'batch'}", markup=False)


@app.command(name="eval")
@_guarded
def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Trajectory: TUM, KITTI, or EuRoC.")],
    truth: Annotated[Path, typer.Argument(help="Truth: the same, or positions as CSV.")],
    json: Annotated[bool, typer.Option("--json", help="Print the keys of metrics.json.")] = False,
    same_map: Annotated[
        bool, typer.Option("--same-map", help="Both are in the same map: nothing is aligned.")
    ] = False,
) -> None:
    """Compare a trajectory with the truth.

    Example: lunar-fg eval runs/first/trajectory.tum truth.tum
    """
    accuracy = compare(read_trajectory(estimate), read_track(truth), same_map=same_map)
    if json:
        sys.stdout.write(accuracy.to_json() + "\n")
        return
    out.print(accuracy_table({estimate.name: accuracy}))
    for warning in accuracy.warnings:
        out.print(f"note: {warning}", markup=False)


@app.command()
@_guarded
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


@app.command()
@_guarded
def warmup() -> None:
    """Compile all kernels now, so that the first run starts at once.

    Example: lunar-fg warmup
    """
    out.print(f"kernels ready after {warm_up():.1f} s")


@app.command()
@_guarded
def match(
    first: Annotated[Path, typer.Argument(help="Image A: PNG, JPEG, PGM or PPM.")],
    second: Annotated[Path, typer.Argument(help="Image B.")],
    homography: Annotated[
        bool, typer.Option("--homography", help="A plane, or a turn on the spot (default).")
    ] = False,
    stereo: Annotated[bool, typer.Option("--stereo", help="A stereo pair, upright.")] = False,
    similarity: Annotated[
        bool, typer.Option("--similarity", help="Turn, shift and scale, as between maps.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option("--output", "-o", help="Picture of the matches to write.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Match two images; exit code 1 when they are refused, with the reason.

    Example: lunar-fg match left.png right.png --stereo -o matches.png
    """
    if homography + stereo + similarity > 1:
        raise InputError("only one of --homography, --stereo, --similarity", source="match")
    model = MatchModel.HOMOGRAPHY
    if stereo or similarity:
        model = MatchModel.STEREO if stereo else MatchModel.SIMILARITY
    a, b = read_grey(first, 65535), read_grey(second, 65535)
    result = match_images(a, b, model)
    if picture is not None:
        write_picture(picture, draw(a, b, result))
    if json:
        sys.stdout.write(dumps(result.as_dict()) + "\n")
    else:
        out.print(
            f"{result.keypoints[0]} and {result.keypoints[1]} keypoints, "
            f"{len(result.inlier)} matches, {result.inlier.sum()} inliers, "
            f"{result.seconds:.2f} s",
            markup=False,
        )
        if result.reason:
            out.print(f"refused: {result.reason}", markup=False)
        else:
            out.print(
                f"{1.0 - result.inlier.mean():.1%} of the matches wrong, "
                f"median error of the rest {result.error_px:.2f} px",
                markup=False,
            )
    if result.reason:
        raise typer.Exit(1)
