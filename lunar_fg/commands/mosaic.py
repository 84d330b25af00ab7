"""Merge overlapping images."""

from __future__ import annotations

import sys
from json import dumps
from pathlib import Path
from typing import Annotated

import typer

from frontends.errors import InputError
from frontends.mosaic import merge
from lunar_fg.commands.shared import out
from lunar_fg.pictures import read_picture, write_picture


def mosaic(
    images: Annotated[
        list[Path], typer.Argument(help="Images: PNG, JPEG, or what GDAL reads (PDS .img).")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Picture to write.")],
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Merge overlapping images into one; those that do not fit are named, with the reason.

    Example: lunar-fg mosaic navcam1.img navcam2.img navcam3.img -o merged.png
    """
    if not output.parent.is_dir():
        raise InputError("its folder does not exist", source=output, remedy="create it first")
    result = merge([read_picture(path) for path in images])
    write_picture(output, result.picture)
    merged = [images[i].name for i in sorted(result.canvas_H_image)]
    refused = {images[i].name: reason for i, reason in sorted(result.refused.items())}
    height, width = result.covered.shape
    if json:
        figures = {
            "size_px": [width, height],
            "reference": images[result.reference].name,
            "merged": merged,
            "refused": refused,
            "error_px": result.error_px,
            "canvas_H_image": {
                images[i].name: matrix.tolist()
                for i, matrix in sorted(result.canvas_H_image.items())
            },
        }
        sys.stdout.write(dumps(figures) + "\n")
        return
    out.print(
        f"{len(merged)} of {len(images)} images merged in the plane of "
        f"{images[result.reference].name}: {width}x{height} px, "
        f"median error of the matches {result.error_px:.2f} px",
        markup=False,
    )
    for name, reason in refused.items():
        out.print(f"refused: {name}: {reason}", markup=False)
