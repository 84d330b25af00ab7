from __future__ import annotations

import numpy as np
import pytest
from dataset_files import refusal_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontends.errors import InputError
from lunar_fg.datasets.tables import (
    FrameRow,
    read_attitude_csv,
    read_frames_csv,
    read_odometry_csv,
    read_position_csv,
    read_tum,
)

FRAMES = "frame,stamp_s,left,right\n0,1.0,l/0.png,r/0.png\n1,2.0,l/1.png,r/1.png\n"
POSITION = "stamp_s,x_m,y_m\n1,2,3\n2,4,5\n"
ATTITUDE = (
    "stamp_s,roll_rad,pitch_rad,yaw_rad,sigma_rp_rad,sigma_yaw_rad\n"
    "0,0.1,0.2,0.3,0.01,0.02\n1,0.1,0.2,0.3,0.01,0.02\n"
)
ODOMETRY = "stamp_s,d_forward_m,d_lateral_m,d_yaw_rad\n0,0,0,0\n1,0.5,0.1,0.2\n"
TUM = "# stamp x y z qx qy qz qw\n1 2 3 4 0 0 0 1\n2 3 4 5 0 0 0.70710678 0.70710678\n"


def test_what_is_read(tmp_path):
    path = tmp_path / "table"
    path.write_text("\ufeff" + FRAMES.replace("\n", "\r\n") + "\n")
    row = read_frames_csv(path)[1]
    assert row == FrameRow(3, 1, 2.0, "l/1.png", "r/1.png")
    path.write_text(POSITION)
    truth = read_position_csv(path)
    assert truth.map_T_rover is None
    assert not truth.has_height
    np.testing.assert_array_equal(truth.position_m, [[2, 3, 0], [4, 5, 0]])
    path.write_text("y_m,z_m,stamp_s,x_m\n3,9,1,2\n")
    np.testing.assert_array_equal(read_position_csv(path).position_m, [[2, 3, 9]])
    path.write_text(ATTITUDE)
    np.testing.assert_array_equal(read_attitude_csv(path).sigmas[0], [0.01, 0.02])
    path.write_text(ODOMETRY)
    np.testing.assert_array_equal(read_odometry_csv(path).increments[1], [0.5, 0.1, 0.2])
    path.write_text(TUM)
    poses = read_tum(path).map_T_rover
    assert poses is not None
    np.testing.assert_allclose(poses[1] @ [1, 0, 0, 1], [3, 5, 5, 1], atol=1e-7)


@pytest.mark.parametrize(
    ("reader", "text", "parts"),
    [
        (
            read_frames_csv,
            FRAMES.replace("stamp_s", "stamp"),
            ["header", "'stamp'", "did you mean 'stamp_s'"],
        ),
        (
            read_frames_csv,
            FRAMES.replace(",right\n", "\n").replace(",r/0.png", "").replace(",r/1.png", ""),
            ["header", "'right' is missing"],
        ),
        (
            read_frames_csv,
            FRAMES.replace("2.0", "1.0"),
            ["line 3", "stamp_s 1 repeats", "of line 2"],
        ),
        (read_frames_csv, FRAMES.replace("2.0", "0.5"), ["line 3", "goes back"]),
        (read_frames_csv, FRAMES.replace("\n1,", "\n0,"), ["line 3", "frame 0 repeats"]),
        (read_frames_csv, FRAMES.replace("\n1,", "\n1.5,"), ["line 3", "whole number"]),
        (read_frames_csv, FRAMES.replace("2.0", "nan"), ["line 3", "stamp_s", "finite"]),
        (read_frames_csv, FRAMES.replace("2.0", "1403715273262142976"), ["line 3", "seconds"]),
        (read_frames_csv, FRAMES.replace("2.0", "x"), ["line 3", "'x'"]),
        (read_frames_csv, FRAMES.replace(",r/1.png", ""), ["line 3", "has 3 cells, the header 4"]),
        (read_frames_csv, FRAMES.replace("left", "right"), ["header", "'left' is missing"]),
        (read_frames_csv, "", ["no rows"]),
        (read_frames_csv, "frame,stamp_s,left,right\n", ["no rows"]),
        (read_frames_csv, '"' + "x" * 10, ["line 1", "not CSV"]),
        (read_position_csv, POSITION.replace("x_m", "x"), ["'x'", "did you mean 'x_m'"]),
        (
            read_position_csv,
            POSITION.replace("y_m", "y_m,y_m").replace(",3", ",3,3").replace(",5", ",5,5"),
            ["twice"],
        ),
        (read_attitude_csv, ATTITUDE.replace("1,0.1", "1,20"), ["line 3", "roll_rad", "radians"]),
        (
            read_attitude_csv,
            ATTITUDE.replace("0.02\n1", "0\n1"),
            ["line 2", "sigma_yaw_rad", "positive"],
        ),
        (read_odometry_csv, ODOMETRY.replace("0.5", "inf"), ["line 3", "d_forward_m", "finite"]),
        (read_tum, TUM.replace("2 3 4 5 0", "2 3 4 5"), ["line 3", "has 7 values, must have 8"]),
        (read_tum, TUM.replace("0 0 0 1\n", "0 0 0 2\n"), ["line 2", "quaternion"]),
        (read_tum, TUM.replace("\n2 3", "\n1 3"), ["line 3", "repeats"]),
        (read_tum, "# nothing\n", ["no rows"]),
    ],
)
def test_one_line_names_line_and_remedy(tmp_path, reader, text, parts):
    path = tmp_path / "table.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        reader(path)
    for part in ["table.csv", *parts]:
        assert part in str(caught.value)
    assert caught.value.remedy
    assert "\n" not in str(caught.value)


def test_not_text_and_not_there(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="UTF-8"):
        read_frames_csv(tmp_path / "a.csv")
    with pytest.raises(InputError, match=r"b\.csv: cannot be read"):
        read_frames_csv(tmp_path / "b.csv")


@pytest.mark.parametrize(
    ("reader", "text"),
    [
        (read_frames_csv, FRAMES),
        (read_position_csv, POSITION),
        (read_attitude_csv, ATTITUDE),
        (read_odometry_csv, ODOMETRY),
        (read_tum, TUM),
    ],
)
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_only_input_errors_escape(tmp_path, reader, text, data):
    raw = text.encode()
    at = data.draw(st.integers(0, len(raw)))
    drop = data.draw(st.integers(0, 20))
    insert = data.draw(
        st.binary(max_size=20)
        | st.sampled_from(
            [b"1e308", b"-1e308", b"nan", b"1_0", b'"', b"\0", b",", b"\n", b"9" * 30]
        )
    )
    path = tmp_path / "table"
    path.write_bytes(raw[:at] + insert + raw[at + drop :])
    assert "\n" not in refusal_of(reader, path)
