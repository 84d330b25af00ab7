"""The demo as a newcomer runs it, only smaller."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lunar_fg.cli import app
from lunar_fg.simulation import cache


def test_the_demo_drives_reports_and_keeps_its_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "user_cache_path", lambda _name: tmp_path / "cache")
    out = tmp_path / "demo"
    arguments = ["demo", "--size", "256", "--length", "12", "--seed", "2", "-o", str(out)]
    first = CliRunner().invoke(app, arguments)
    assert first.exit_code == 0, first.output
    assert "8 stereo pairs, 0 lost" in first.stdout
    last = first.stdout.strip().splitlines()[-4:]
    wheels, vision, fixed = (
        float(re.search(r"([\d.]+) %", line).group(1))  # type: ignore[union-attr]
        for line in last[:3]
    )
    for name, line in zip(("wheels", "vision", "fixes"), last, strict=False):
        assert name in line
    # over so short a drive the start's own heading counts
    assert vision < 5.0
    assert wheels > 0.0
    assert fixed < 5.0
    page = out / "report.html"
    assert last[3] == f"report: {page}"
    assert page.stat().st_size > 10_000
    assert (out / "batch" / "trajectory.tum").is_file()

    def never(*_: object, **__: object) -> None:
        raise AssertionError("rendered again")

    monkeypatch.setattr(cache, "simulate", never)
    second = CliRunner().invoke(app, arguments)
    assert second.exit_code == 0, second.output
    assert second.stdout.strip().splitlines()[-4:] == last


@pytest.mark.parametrize("arguments", [["--sun", "noon"], ["--length", "0"], ["--size", "10"]])
def test_senseless_demos_are_refused(arguments: list[str]) -> None:
    result = CliRunner().invoke(app, ["demo", *arguments])
    assert result.exit_code == 2
    assert "error:" in result.output
