"""Compare the labelled and the seen rotation between two views."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frontends.errors import InputError
from lunar_fg.commands.shared import out
from lunar_fg.datasets.pds_image import read_rover_image
from lunar_fg.datasets.pds_label import read_label
from lunar_fg.pointing import compare_pointings


def pointing(
    first: Annotated[Path, typer.Argument(help="Rover image with a PDS3 or VICAR label.")],
    second: Annotated[Path, typer.Argument(help="Another view of the same camera and stop.")],
) -> None:
    """Rotation between two views of a mast camera: by their labels, and by the images.

    Example: lunar-fg pointing 2n292280938effb100p0703l0m1.img 2n292280989effb100p0703l0m1.img
    """
    labels = [read_label(path) for path in (first, second)]
    cameras = [label.camera for label in labels]
    a, b = cameras
    if a is None or b is None:
        raise InputError(
            "has no camera model", source=first if a is None else second, field="label"
        )
    images = [read_rover_image(label)[0] for label in labels]
    if labels[0].identity != labels[1].identity:
        out.print(
            f"note: {labels[0].identity} and {labels[1].identity}: the rover may have moved",
            markup=False,
        )
    found = compare_pointings((images[0], images[1]), (a, b))
    out.print(
        f"rotation by the labels {found.labelled_deg:.3f} deg, by the images "
        f"{found.measured_deg:.3f} deg, between them {found.difference_deg:.3f} deg "
        f"(sigma {', '.join(f'{value:.3f}' for value in found.sigma_deg)} deg about x, y, z; "
        f"{found.matches} matches, {found.residual_px:.2f} px)",
        markup=False,
    )
