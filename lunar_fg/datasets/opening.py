"""Open a dataset of any known format."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from frontends.errors import InputError
from lunar_fg.datasets.bag_file import find_bag
from lunar_fg.datasets.base import Dataset, Reader
from lunar_fg.datasets.calibrated_images import open_calibrated
from lunar_fg.datasets.euroc import EurocReader
from lunar_fg.datasets.folder import TRAVERSE, FolderReader
from lunar_fg.datasets.kitti import PAIRS, KittiReader
from lunar_fg.datasets.pds import PdsReader
from lunar_fg.datasets.raw_pairs import has_pairs
from lunar_fg.datasets.rosbag import BagReader
from lunar_fg.datasets.schema import nearest_known

#: Every format; the first that detects a folder opens it.
READERS: tuple[Reader, ...] = (
    FolderReader(),
    EurocReader(),
    KittiReader(),
    PdsReader(),
    BagReader(),
)


def open_dataset(
    path: Path | str,
    images_root: Path | str | None = None,
    traverse: Path | str | None = None,
    calibration: Sequence[Path | str] = (),
    topics: Sequence[str] = (),
) -> Dataset:
    """Open a dataset, whatever its format.

    Parameters
    ----------
    path
        Folder of the dataset, its ``traverse.yaml``, or a recording (.bag, .mcap, .db3).
    images_root
        Folder that the paths in frames.csv are relative to, where the images lie
        somewhere else (folder format only).
    traverse
        ``traverse.yaml`` that describes a folder of images without one.
    calibration
        Calibration of a folder of raw images: one file, or the left and the right
        camera's, in any format of `lunar_fg.datasets.calibrations`; or of a recording,
        instead of its camera_info.
    topics
        Left and right image topic of a recording, where their names do not tell.

    Returns
    -------
    Dataset
        Checked, as far as that is possible without decoding all images.

    Raises
    ------
    InputError
        When the folder is of no known format (says what was looked for, and the nearest
        thing that is there), or when something in it is wrong.
    """
    folder = Path(path)
    if folder.name == TRAVERSE and os.path.isfile(folder):
        folder = folder.parent
    if not os.path.exists(folder):
        raise InputError(
            "does not exist", source=folder, field="dataset", remedy=_nearest_neighbour(folder)
        )
    if find_bag(folder) is not None and traverse is None and images_root is None:
        return BagReader().open(folder, None, topics, [Path(file) for file in calibration])
    if topics:
        raise InputError(
            "is no ROS recording", source=folder, field="topics", remedy="leave --topic out"
        )
    if not folder.is_dir():
        raise InputError(
            "is a file", source=folder, field="dataset", remedy="give the folder of the dataset"
        )
    if not os.access(folder, os.R_OK | os.X_OK):
        raise InputError(
            "may not be read", source=folder, field="dataset", remedy="check the folder's rights"
        )
    if calibration:
        if traverse is not None or images_root is not None:
            raise InputError(
                "--calibration goes with a folder of raw images, nothing else",
                source=folder,
                field="dataset",
                remedy="leave --traverse and --images out",
            )
        return open_calibrated(folder, [Path(file) for file in calibration])
    if traverse is not None:
        root = None if images_root is None else Path(images_root)
        return FolderReader().open(folder, root, Path(traverse))
    for reader in READERS:
        if reader.detects(folder):
            return reader.open(folder, None if images_root is None else Path(images_root))
    raise InputError(
        "is no dataset of a known format, looked for "
        + "; ".join(f"{reader.looks_for} ({reader.format_name})" for reader in READERS),
        source=folder,
        field="dataset",
        remedy=_nearest_thing(folder),
    )


def _nearest_neighbour(folder: Path) -> str:
    parent = folder.parent
    listable = os.path.isdir(parent) and os.access(parent, os.R_OK)
    names = os.listdir(parent) if listable else []
    remedy = nearest_known(folder.name, names) if names else ""
    return remedy if remedy.startswith("did you mean") else "check the path"


def _nearest_thing(folder: Path) -> str:
    """Say what in a folder comes nearest to a dataset."""
    entries = sorted(os.listdir(folder))
    if not entries:
        return "the folder is empty"
    for name in entries:
        if (folder / name).is_dir() and any(reader.detects(folder / name) for reader in READERS):
            return f"give its sub-folder {name}, which is a dataset"
    if {"left", "right"} <= set(entries):
        return (
            "left and right are there: describe them with --traverse traverse.yaml, or give "
            "--calibration FILE"
        )
    if has_pairs(folder):
        return "stereo images are there: give --calibration FILE"
    known = [TRAVERSE, "frames.csv", "calib.txt", *(name for pair in PAIRS for name in pair[:2])]
    for name in entries:
        if name in known:
            return f"{name} is there, but what goes with it is not"
        remedy = nearest_known(name, known)
        if remedy.startswith("did you mean"):
            return f"{name} is there: {remedy}"
    return f"the folder holds {', '.join(entries[:5])}{' ...' if len(entries) > 5 else ''}"
