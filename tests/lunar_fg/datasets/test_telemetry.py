"""Spirit's table of raw and corrected positions."""

import numpy as np
import pytest

from frontends.errors import InputError
from lunar_fg.datasets.telemetry import read_telemetry

HEADER = "SITE,RAW_X,RAW_Y,CORRECTED_X,CORRECTED_Y\n"


def test_spirits_whole_mission(shared_data):
    telemetry = read_telemetry(
        shared_data / "spirit-traverse" / "MERA-MER2-Spirit_traverse_path.csv"
    )
    assert 7500 < len(telemetry) < 8804
    raw = np.linalg.norm(np.diff(telemetry.raw_m, axis=0), axis=1).sum()
    assert 7000.0 < raw < 7600.0
    # What telemetry alone is off by in the end.
    assert 100.0 < np.linalg.norm(telemetry.raw_m[-1] - telemetry.corrected_m[-1]) < 200.0


def test_stops_are_counted_once(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(HEADER + "0,5,5,1,1\n0,5,5,1,1\n0,6,5,2,1.5\n")
    telemetry = read_telemetry(path)
    np.testing.assert_allclose(telemetry.raw_m, [[0, 0], [1, 0]])
    np.testing.assert_allclose(telemetry.corrected_m, [[0, 0], [1, 0.5]])


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("SITE,RAW_X\n0,1\n", "column RAW_Y"),
        (HEADER + "0,1,2,three,4\n0,1,2,3,4\n", "numbers"),
        (HEADER + "0,1,2,3,4\n", "too few"),
        (HEADER + "0,1,2,3,nan\n0,1,2,3,4\n", "finite"),
        (HEADER + "0,1,2\n0,1,2\n", "numbers"),
    ],
)
def test_bad_tables_are_named(tmp_path, text, match):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=match):
        read_telemetry(path)
    with pytest.raises(InputError, match="missing"):
        read_telemetry(tmp_path / "none.csv")
