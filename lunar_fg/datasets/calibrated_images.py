"""Raw stereo images and a calibration file of another tool: ``lunar-fg run --calibration``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from frontends.errors import InputError
from lunar_fg.datasets.calibrations import read_calibration
from lunar_fg.datasets.images import read_header
from lunar_fg.datasets.raw_pairs import find_pairs
from lunar_fg.datasets.rectified import RectifiedDataset, open_rectified
from lunar_fg.datasets.stereo_files import StereoPair

#: Calibrations that come along, by the name that stands for a file.
NOMINAL = {"msl-navcam": "msl_navcam.yaml"}


def open_calibrated(path: Path, calibration: Sequence[Path]) -> RectifiedDataset:
    """Open a folder of stereo images with a calibration that lies anywhere.

    Parameters
    ----------
    path
        Folder of the images; see `find_pairs` for how they may lie.
    calibration
        One file, or the left and the right camera's; or the name of a nominal one
        (`NOMINAL`).

    Raises
    ------
    InputError
        When there are no pairs, or the calibration is not theirs.
    """
    pairs, notes = find_pairs(path)
    files = tuple(_file(name) for name in calibration)
    if any(str(name) in NOMINAL for name in calibration):
        notes = (*notes, f"{calibration[0]} is the nominal model of the camera, not a calibration")
    return open_rectified(
        path, pairs, read_calibration(files, _first_size(pairs)), files[0], notes=notes
    )


def _file(name: Path) -> Path:
    if str(name) in NOMINAL and not name.exists():
        return Path(__file__).with_name("calibrations") / NOMINAL[str(name)]
    return name


def _first_size(pairs: Sequence[StereoPair]) -> tuple[int, int]:
    """Size of the first image whose header can be read."""
    problem = ""
    for pair in pairs:
        try:
            return read_header(pair.left).size
        except InputError as error:
            problem = problem or str(error)
    raise InputError(
        f"none of the {len(pairs)} left images can be read, the first because {problem}",
        source=pairs[0].left.parent,
        field="images",
        remedy="check that the images were copied completely",
    )
