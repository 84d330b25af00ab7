"""Warming up is a drive through the whole navigator."""

from __future__ import annotations

import pytest

from lunar_fg.navigator import Navigator
from lunar_fg.warmup import warmup


def test_every_stage_is_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Navigator] = []
    finish = Navigator.finish

    def finished(self: Navigator) -> None:
        finish(self)
        seen.append(self)

    monkeypatch.setattr(Navigator, "finish", finished)
    assert warmup() > 0.0
    assert seen[0].frames_lost == 0
    assert {"stereo", "tracking", "relative pose", "graph"} <= set(seen[0].stopwatch.milliseconds())
