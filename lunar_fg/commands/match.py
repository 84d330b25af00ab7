"""Match two images."""

from __future__ import annotations

import sys
from json import dumps
from pathlib import Path
from typing import Annotated

import typer

from frontends.errors import InputError
from lunar_fg.commands.shared import out
from lunar_fg.match import MatchModel, draw, match_images
from lunar_fg.pictures import grey, read_picture, write_picture


def match(
    first: Annotated[
        Path, typer.Argument(help="Image A: PNG, JPEG, or what GDAL reads (PDS .img, GeoTIFF).")
    ],
    second: Annotated[Path, typer.Argument(help="Image B.")],
    homography: Annotated[
        bool, typer.Option("--homography", help="A plane, or a turn on the spot (default).")
    ] = False,
    stereo: Annotated[
        bool, typer.Option("--stereo", help="A rectified pair, left then right, upright.")
    ] = False,
    similarity: Annotated[
        bool, typer.Option("--similarity", help="Turn, shift and scale, as between maps.")
    ] = False,
    fundamental: Annotated[
        bool, typer.Option("--fundamental", help="Two views of a scene with depth.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option("--output", "-o", help="Picture of the matches to write.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Match two images; exit code 1 when they are refused, with the reason.

    Example: lunar-fg match left.png right.png --stereo -o matches.png
    """
    asked = {
        MatchModel.HOMOGRAPHY: homography,
        MatchModel.STEREO: stereo,
        MatchModel.SIMILARITY: similarity,
        MatchModel.FUNDAMENTAL: fundamental,
    }
    models = [model for model, chosen in asked.items() if chosen] or [MatchModel.HOMOGRAPHY]
    if len(models) > 1:
        options = ", ".join(f"--{model}" for model in asked)
        raise InputError(f"only one of {options}", source="match")
    pictures = [read_picture(path) for path in (first, second)]
    result = match_images(grey(pictures[0]), grey(pictures[1]), models[0])
    if picture is not None:
        write_picture(picture, draw(pictures, result))
    if json:
        sys.stdout.write(dumps(result.as_dict()) + "\n")
    else:
        out.print(
            f"{result.keypoints[0]} and {result.keypoints[1]} keypoints, "
            f"{result.matches} matches, {result.inliers} inliers, {result.seconds:.2f} s",
            markup=False,
        )
        if result.reason:
            out.print(f"refused: {result.reason}", markup=False)
        else:
            out.print(
                f"{result.rejected_share:.1%} of the matches rejected, "
                f"median error of the rest {result.error_px:.2f} px",
                markup=False,
            )
    if result.reason:
        raise typer.Exit(1)
