"""What the traverse log holds once a run or once a sitting, as rows."""

from __future__ import annotations

import json
from dataclasses import asdict, astuple
from typing import Any

from frontends.camera import StereoCamera
from frontends.measurements import StartPrior
from lunar_fg.log_entries import RunHeader, Sitting
from lunar_fg.log_rows import RowReader, pack

HEADER_QUERY = "SELECT * FROM run"
SITTING_QUERY = "SELECT * FROM sitting ORDER BY number"


def row_of_header(header: RunHeader) -> tuple[str, tuple[object, ...]]:
    """Table and row of a run's header."""
    start = header.start
    sigmas = {"rot_rad": start.sigma_rot_rad, "trans_m": start.sigma_trans_m}
    return "run", (
        1,
        json.dumps(asdict(header.camera)),
        pack(header.rover_T_camera),
        json.dumps(sigmas),
        pack(start.map_T_rover),
        header.config_json,
    )


def header_of(row: tuple[Any, ...], reader: RowReader) -> RunHeader:
    """Build a run's header from its row.

    Raises
    ------
    InputError
        The row is damaged.
    """
    _, camera, rover_T_camera, start, start_pose, config = row
    sigmas = json.loads(start)
    start_pose = reader.array(start_pose, "run")
    prior = StartPrior(start_pose, tuple(sigmas["rot_rad"]), tuple(sigmas["trans_m"]))
    rover_T_camera = reader.array(rover_T_camera, "run")
    return RunHeader(StereoCamera(**json.loads(camera)), rover_T_camera, prior, config)


def row_of_sitting(number: int, sitting: Sitting) -> tuple[str, tuple[object, ...]]:
    """Table and row of a run's dataset, counted from 0."""
    values = astuple(sitting)
    # calibration, topics, faults
    return "sitting", (number, *values[:5], json.dumps(values[5:]))


def sitting_of(row: tuple[Any, ...]) -> Sitting:
    """Build a sitting from its row."""
    _, dataset, images, traverse, index, stamp_s, given = row
    return Sitting(dataset, images, traverse, index, stamp_s, *map(tuple, json.loads(given)))
