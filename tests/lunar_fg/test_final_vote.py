"""The last vote of a sitting changes verdicts: the next sitting goes on from before it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from frontends.camera import StereoCamera
from frontends.measurements import (
    AbsoluteFix,
    Attitude,
    FixCandidate,
    StartPrior,
    UnusableFrame,
    Verdict,
    WheelOdometry,
)
from lunar_fg.config import Config
from lunar_fg.graph import FixDecision, IncrementalSmoother
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.navigator import Navigator

CAMERA = StereoCamera(320, 240, 240.0, 240.0, 159.5, 119.5, 0.1)
CONFIG = Config.model_validate({"disparity_check": {"mode": "off"}, "graph": {"fix_window": 1}})
STEP_M, SIGMA_M = 0.5, 0.05
FRAMES, FIRST = 60, 48
#: Metres east of the dead-reckoned place: the first agrees with it, the others with each other.
PLACES = {30: 0.0, 36: 1.6, 42: 1.6, 47: 1.6, 52: 1.6, 58: 1.6}


class Scheduled:
    """A localisation that knows its fixes beforehand."""

    def fix(self, smoother: IncrementalSmoother, *, last: bool = False) -> FixDecision | None:
        frame = smoother.trajectory().index[-1]
        if last or frame not in PLACES:
            return None
        covariance = np.diag([SIGMA_M**2, SIGMA_M**2, 1e-4])
        place = FixCandidate(STEP_M * frame + PLACES[frame], 0.0, 0.0, covariance)
        return smoother.add_fix(AbsoluteFix(int(frame), (place,)))

    def observe(self, *_: object) -> bool:
        return True

    def restore(self, *_: object) -> None:
        return None


def frames(first: int, last: int) -> Iterator[UnusableFrame]:
    for k in range(first, last):
        wheels = WheelOdometry(STEP_M, 0.0, 0.0) if k else None
        yield UnusableFrame(k, float(k), "dark", wheels, Attitude(0.0, 0.0, 0.0, 0.01, 0.02))


def drive(path: Path, parts: Iterable[range]) -> Navigator:
    """One sitting a part; each begins from the log of the one before."""
    for number, part in enumerate(parts):
        header = RunHeader(CAMERA, np.eye(4), StartPrior(), CONFIG.model_dump_json())
        with TraverseLog.reopen(path) if number else TraverseLog.create(path, header) as log:
            navigator = Navigator(CAMERA, CONFIG, np.eye(4), StartPrior(), log)
            navigator.localisation = Scheduled()
            if number:
                navigator.resume()
            for frame in frames(part.start, part.stop):
                navigator.step(frame)
            navigator.finish()
    return navigator


@pytest.mark.parametrize("cuts", [(48,), (48, 48), (48, 53)])
def test_the_next_sitting_ends_as_one_run_would(tmp_path: Path, cuts: tuple[int, ...]) -> None:
    first = drive(tmp_path / "first.db", [range(FIRST)])
    (changed,) = (entry for entry in first.ledger if entry.frame == 30)
    assert [r.verdict for r in changed.history] == [Verdict.ACCEPTED, Verdict.REFUSED]
    assert changed.ruling.at_frame == FIRST - 1
    whole = drive(tmp_path / "whole.db", [range(FRAMES)])
    ends = (*cuts, FRAMES)
    parts = [range(a, b) for a, b in zip((0, *cuts), ends, strict=True)]
    resumed = drive(tmp_path / "parts.db", parts)
    np.testing.assert_allclose(
        resumed.trajectory().map_T_rover, whole.trajectory().map_T_rover, atol=1e-9
    )
    assert [entry.history for entry in resumed.ledger] == [entry.history for entry in whole.ledger]
    with TraverseLog.open(tmp_path / "parts.db") as log:
        assert [entry.history for entry in log.ledger()] == [e.history for e in whole.ledger]
    assert [entry.frame for entry in whole.ledger] == list(PLACES)
