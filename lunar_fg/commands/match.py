"""Match two images."""

from __future__ import annotations

import sys
from json import dumps
from pathlib import Path
from typing import Annotated

import typer

from frontends.errors import InputError
from lunar_fg.commands.shared import out
from lunar_fg.datasets.images import read_grey
from lunar_fg.match import MatchModel, draw, match_images, write_picture


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
