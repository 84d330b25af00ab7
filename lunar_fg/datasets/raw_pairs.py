"""Stereo image files without a description: which belong together, and when they were taken."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path

from frontends.errors import InputError
from lunar_fg.datasets.images import SUFFIXES
from lunar_fg.datasets.stereo_files import StereoPair

#: Folders of the left and the right images.
FOLDERS = (
    ("left", "right"),
    ("cam0", "cam1"),
    ("cam0/data", "cam1/data"),
    ("image_0", "image_1"),
    ("image_l", "image_r"),
    ("image_2", "image_3"),
)
#: How a right image is named after the left one in the same folder; MSL's Navcams among them.
_EYES = (
    ("left", "right"),
    ("Left", "Right"),
    ("NLA_", "NRA_"),
    ("NLB_", "NRB_"),
    ("cam0", "cam1"),
    ("_l.", "_r."),
    ("_L.", "_R."),
    ("_l_", "_r_"),
    ("_L_", "_R_"),
)
#: Time between images that are only numbered.
PERIOD_S = 1.0
_MOST_IMAGES = 1_000_000
_NANOSECOND_DIGITS = (18, 19)
#: Spacecraft clock in the names of Mars rover images: seconds.
_SPACECRAFT_CLOCK = re.compile(r"^N[LR][AB]_(\d{9})")


def find_pairs(folder: Path) -> tuple[tuple[StereoPair, ...], tuple[str, ...]]:
    """Pairs of a folder, by sub-folders of equal names or by left and right in the names.

    Returns
    -------
    pairs, notes
        In the order of time, numbered from 0; what was assumed.

    Raises
    ------
    InputError
        When there are no pairs, or two have the same time.
    """
    files = _by_folders(folder) or _by_names(folder)
    if not files:
        raise InputError(
            "holds no stereo pairs",
            source=folder,
            field="images",
            remedy="put equal names into left/ and right/, or name them ..left.. and ..right..",
        )
    notes: tuple[str, ...] = ()
    stamps = [_stamp(left) for left, _ in files]
    if any(stamp is None for stamp in stamps):
        stamps = [PERIOD_S * order for order in range(len(files))]
        notes = (f"frames are taken to be {PERIOD_S:g} s apart",)
    dated = sorted(zip(stamps, files, strict=True), key=lambda item: (item[0] or 0.0, item[1]))
    for (before, _), (after, (left, _)) in itertools.pairwise(dated):
        if before == after:
            raise InputError(
                f"{left.name[:100]} has the time of another pair",
                source=folder,
                field="images",
                remedy="keep one of the two, or write a frames.csv",
            )
    return tuple(
        StereoPair(order, float(stamp or 0.0), left, right)
        for order, (stamp, (left, right)) in enumerate(dated)
    ), notes


def has_pairs(folder: Path) -> bool:
    """Whether there is at least one pair."""
    return bool(_by_folders(folder) or _by_names(folder))


def image_names(folder: Path) -> list[str]:
    """Names of the images in a folder, sorted; empty where there is no folder."""
    if not folder.is_dir():
        return []
    names = [name for name in os.listdir(folder) if name.lower().endswith(SUFFIXES)]
    if len(names) > _MOST_IMAGES:
        raise InputError(f"holds more than {_MOST_IMAGES} images", source=folder)
    return sorted(names, key=_natural)


def _by_folders(folder: Path) -> list[tuple[Path, Path]]:
    for left, right in FOLDERS:
        both = set(image_names(folder / right))
        if names := [name for name in image_names(folder / left) if name in both]:
            return [(folder / left / name, folder / right / name) for name in names]
    return []


def _by_names(folder: Path) -> list[tuple[Path, Path]]:
    names = image_names(folder)
    known = set(names)
    partners = ((name, next(_partners(name, known), None)) for name in names)
    return [(folder / left, folder / right) for left, right in partners if right is not None]


def _partners(name: str, known: set[str]) -> Iterator[str]:
    for left, right in _EYES:
        if left in name and (partner := name.replace(left, right)) in known:
            yield partner


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key by which 10 follows 9."""
    return [
        (int(part[:30]), "") if part.isdecimal() and part.isascii() else (0, part)
        for part in re.split(r"(\d+)", name)
    ]


def _stamp(file: Path) -> float | None:
    """Time in a file's name, s: nanoseconds, or the spacecraft clock of Mars rovers."""
    if match := _SPACECRAFT_CLOCK.match(file.name):
        return float(match[1])
    if file.stem.isascii() and file.stem.isdecimal() and len(file.stem) in _NANOSECOND_DIGITS:
        return 1e-9 * int(file.stem)
    return None
