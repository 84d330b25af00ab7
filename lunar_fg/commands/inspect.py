"""Say what a path is: a dataset, a labelled image, a map."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated

import typer

from frontends.calibration_check import check_calibration
from frontends.measurements import StereoFrame
from frontends.orbital import Raster, sun_of_tags
from lunar_fg.commands.shared import out
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.bag_file import find_bag
from lunar_fg.datasets.label_text import is_label
from lunar_fg.datasets.pds_image import read_rover_image
from lunar_fg.datasets.pds_label import read_label

_CHECKED_FRAMES = 3


def inspect(
    path: Annotated[Path, typer.Argument(help="Dataset, recording, rover image or map.")],
    calibration: Annotated[
        list[Path] | None, typer.Option(help="Calibration of a folder of raw images.")
    ] = None,
    topic: Annotated[
        list[str] | None, typer.Option(help="Image topic of a recording; twice for left and right.")
    ] = None,
) -> None:
    """Say what a dataset, a rover image or a map is, and what looks wrong with it.

    Example: lunar-fg inspect ../shared/data/hirise-multidate/no_change_before.cub
    """
    if path.is_file() and find_bag(path) is None:
        if is_label(path) and _is_rover_image(path):
            _tell_image(path)
        else:
            _tell_map(path)
        return
    bag = find_bag(path)
    if bag is not None:
        for each in bag.topics():
            _say(f"  {each.name}  {each.kind}  {each.count}")
    dataset = open_dataset(path, calibration=calibration or (), topics=topic or ())
    camera = dataset.camera
    _say(
        f"{dataset.name}: {len(dataset)} frames of {camera.width}x{camera.height} px, "
        f"f {camera.fx:.1f} px, baseline {camera.baseline_m:.4f} m"
    )
    usable = (frame for frame in dataset.frames() if isinstance(frame, StereoFrame))
    check = check_calibration(camera, itertools.islice(usable, _CHECKED_FRAMES))
    _say(check.summary())
    for finding in check.findings:
        _say(f"looks wrong: {finding}")
    for note in dataset.notes:
        if not note.startswith("calibration check"):
            _say(f"note: {note}")


def _is_rover_image(path: Path) -> bool:
    with path.open("rb") as file:
        return b"SPACECRAFT_CLOCK" in file.read(256_000) and path.suffix.lower() != ".cub"


def _tell_image(path: Path) -> None:
    label = read_label(path)
    _, missing = read_rover_image(label)
    _say(
        f"{path.name}: {label.instrument} {label.eye}, {label.identity}, clock {label.clock_s:.3f} "
        f"s, {label.width}x{label.height} px of {label.bits} bits"
        f"{', companded' if label.companded else ''}, {missing:.2%} missing"
    )
    camera = label.camera
    if camera is None:
        _say("no camera model")
    else:
        kind = "CAHV" if camera.o is None else "CAHVOR"
        u, v = camera.principal_point
        _say(
            f"{kind}: f {camera.focal_h_px:.1f} x {camera.focal_v_px:.1f} px, principal point "
            f"({u:.1f}, {v:.1f}) px"
        )
    if label.sun is not None:
        _say(
            f"Sun: azimuth {label.sun.azimuth_deg:.1f} deg, elevation "
            f"{label.sun.elevation_deg:.1f} deg"
        )


def _tell_map(path: Path) -> None:
    raster = Raster.open(path)
    west, south, east, north = raster.bounds_m
    middle = 0.5 * (west + east), 0.5 * (south + north)
    half = 128.0 * raster.gsd_m
    window = raster.window(
        (middle[0] - half, middle[1] - half, middle[0] + half, middle[1] + half)
    )  # fmt: skip
    known = window.values[window.values == window.values]
    _say(
        f"{path.name}: map of {(east - west):.1f} x {(north - south):.1f} m at "
        f"{raster.gsd_m:.4g} m, east {west:.1f} to {east:.1f}, north {south:.1f} to {north:.1f}"
    )
    if known.size:
        _say(
            f"middle: values {known.min():.4g} to {known.max():.4g}, "
            f"{1.0 - known.size / window.values.size:.1%} without data"
        )
    sun = sun_of_tags(raster.tags)
    if sun is not None:
        _say(f"Sun: azimuth {sun.azimuth_deg:.1f} deg, elevation {sun.elevation_deg:.1f} deg")


def _say(text: str) -> None:
    out.print(text, markup=False)
