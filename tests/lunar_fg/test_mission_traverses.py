"""Real traverses as evaluation sets: Spirit's table and Curiosity's waypoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from frontends.errors import InputError
from frontends.geometry import yaw_pitch_roll
from lunar_fg.cli import app
from lunar_fg.evaluation import evaluate
from lunar_fg.trajectory import PositionTrack, Trajectory
from lunar_fg.trajectory_io import read_track, read_trajectory, write_tum


@pytest.fixture
def spirit(shared_data: Path) -> Path:
    return shared_data / "spirit-traverse" / "MERA-MER2-Spirit_traverse_path.csv"


@pytest.fixture
def gale(shared_data: Path) -> Path:
    return shared_data / "gale-hirise-traverse" / "Waypoints.csv"


def test_spirits_telemetry_against_its_localisation(spirit: Path) -> None:
    truth, telemetry = read_track(spirit), read_trajectory(spirit)
    assert isinstance(truth, PositionTrack)
    assert len(truth) == len(telemetry) == 8804
    np.testing.assert_allclose(telemetry.positions[-1], [3104.828, -2034.281, 0.0])
    np.testing.assert_allclose(truth.position_m[-1], [1504.19, -865432.27])
    accuracy = evaluate(telemetry, truth)
    assert accuracy.distance_m == pytest.approx(7_700, rel=0.1)  # the mission's odometry
    assert accuracy.ate_rmse_m.se3 is not None
    assert 5.0 < accuracy.ate_rmse_m.se3 < 200.0


def test_curiositys_waypoints(gale: Path, tmp_path: Path) -> None:
    truth = read_track(gale)
    assert isinstance(truth, Trajectory)
    assert len(truth) > 500
    # row 2: yaw -2.304264 clockwise from north, pitch 0.094495 nose up, roll -0.023199
    yaw, pitch, roll = yaw_pitch_roll(truth.map_T_rover[1])
    assert yaw == pytest.approx(np.pi / 2 + 2.304264 - 2 * np.pi, abs=1e-6)
    assert (pitch, roll) == (pytest.approx(-0.094495), pytest.approx(-0.023199))
    steps = np.diff(truth.positions[:, :2], axis=0)
    far = np.hypot(*steps.T) > 20.0
    course = np.arctan2(steps[far, 1], steps[far, 0])
    headings = np.array([yaw_pitch_roll(pose)[0] for pose in truth.map_T_rover[1:][far]])
    difference = (course - headings + np.pi) % (2 * np.pi) - np.pi
    assert abs(np.median(difference)) < 0.2  # it arrives looking where it went
    write_tum(tmp_path / "shifted.tum", truth)
    accuracy = evaluate(read_trajectory(tmp_path / "shifted.tum"), truth)
    assert accuracy.ate_rmse_m.none == pytest.approx(0.0, abs=1e-6)


def test_the_command_compares_one_table_with_itself(spirit: Path) -> None:
    result = CliRunner().invoke(app, ["eval", str(spirit), str(spirit)])
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("kept", [0.5, 0.9])
def test_a_cut_off_table_is_named(gale: Path, tmp_path: Path, kept: float) -> None:
    data = gale.read_text().splitlines()
    cut = "\n".join(data[: int(kept * len(data))]) + "\n" + data[-1][:150]
    (tmp_path / "w.csv").write_text(cut)
    with pytest.raises(InputError, match="line"):
        read_track(tmp_path / "w.csv")
