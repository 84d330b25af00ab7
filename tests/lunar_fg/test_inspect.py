"""lunar-fg inspect says what a path is."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from lunar_fg.cli import app


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["hirise-multidate/no_change_before.cub"], ["map of 154.2 x 154.2 m at 0.257 m"]),
        (["gale-hirise-traverse/missionDEM.tif"], ["348.0 x 337.0 m at 1 m"]),
        (
            ["mer-navcam-spirit/2n292280938effb100p0703l0m1.img"],
            ["sol 1869 site 137 drive 0", "12 bits", "CAHVOR: f 1188.3", "Sun: azimuth 131.5"],
        ),
        (["k10-stereo", "--calibration", "black_left.tsai"], ["baseline 0.1058", "looks wrong"]),
    ],
)
def test_it_says_what_it_is(shared_data: Path, arguments: list[str], parts: list[str]) -> None:
    paths = [str(shared_data / arguments[0]), *arguments[1:]]
    if len(paths) > 1:
        paths[-1] = str(shared_data / "k10-stereo" / paths[-1])
    result = CliRunner().invoke(app, ["inspect", *paths])
    assert result.exit_code == 0, result.output
    for part in parts:
        assert part in result.output


def test_what_is_nothing_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("hello")
    result = CliRunner().invoke(app, ["inspect", str(tmp_path / "a.txt")])
    assert result.exit_code == 2
    assert "no known format" in result.stderr
