"""A rover that comes back to where it was, blind in between."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from synthetic import CAMERA, Scene, rover_T_camera

from frontends.disparity_check import DisparityCheckConfig
from frontends.geometry import inverse, pose, se3_log, so3_exp
from frontends.measurements import StartPrior, UnusableFrame, Verdict, WheelOdometry
from lunar_fg.config import Config
from lunar_fg.graph.incremental import IncrementalSmoother
from lunar_fg.graph.ledger import LoopClosure
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.loop_closing import LoopClosingConfig
from lunar_fg.navigator import Navigator

MOUNT = rover_T_camera(1.0, 0.6)
STEP_M, OUT = 0.12, 34
QUIET = Config(disparity_check=DisparityCheckConfig(mode="off"))
NO_LOOPS = QUIET.model_copy(update={"loop_closing": LoopClosingConfig(use=False)})
#: The cameras see the first and the last frames; on the way back the light is weaker.
SEEN_FIRST, SEEN_LAST = 10, 2 * OUT - 9


def poses():
    """Out and, in reverse, back, a little beside the tracks."""
    way = np.concatenate([np.arange(OUT), np.arange(OUT - 1, -1, -1)]) * STEP_M
    beside = np.where(np.arange(len(way)) < OUT, 0.0, 0.06)
    turned = np.where(np.arange(len(way)) < OUT, 0.0, 0.05)
    return np.stack(
        [
            pose(so3_exp([0.0, 0.0, yaw]), [x, y, 0.0])
            for x, y, yaw in zip(way, beside, turned, strict=True)
        ]
    )


POSES = poses()


def wheels(k):
    """The wheels slip more on the way out, and turn more than they count."""
    if k == 0:
        return WheelOdometry(0.0, 0.0, 0.0)
    motion = inverse(POSES[k - 1]) @ POSES[k]
    share = 1.05 if k < OUT else 0.98
    return WheelOdometry(share * motion[0, 3], motion[1, 3], 0.0)


@pytest.fixture(scope="module")
def frames():
    taken = []
    for k, map_T_rover in enumerate(POSES):
        if SEEN_FIRST < k < SEEN_LAST:
            taken.append(UnusableFrame(k, 0.5 * k, "dark", wheels(k)))
        else:
            scene = Scene() if k < OUT else Scene(_grey=9.0)
            taken.append(replace(scene.frame(map_T_rover @ MOUNT, k), odometry=wheels(k)))
    return taken


def navigate(frames, config=QUIET, log=None):
    navigator = Navigator(CAMERA, config, MOUNT, log=log)
    estimates = [navigator.step(frame) for frame in frames]
    return navigator, estimates


@pytest.fixture(scope="module")
def closed(frames):
    navigator, estimates = navigate(frames)
    navigator.finish()
    return navigator, estimates


def errors(trajectory):
    return np.linalg.norm(trajectory.map_T_rover[:, :2, 3] - POSES[:, :2, 3], axis=1)


def test_a_closed_loop_takes_the_drift_out(frames, closed):
    navigator, estimates = closed
    without, _ = navigate(frames, NO_LOOPS)
    without.finish()
    assert without.ledger == ()
    before, after = errors(without.trajectory()), errors(navigator.trajectory())
    assert before[-1] > 0.1
    assert after[-1] < 0.1 * before[-1]
    assert after.mean() < 0.5 * before.mean()
    spread = [np.trace(n.trajectory().covariance[-1][3:, 3:]) for n in (without, navigator)]
    assert spread[1] < 0.05 * spread[0]
    assert any("loop closure" in estimate.used for estimate in estimates)


def test_what_closes_it_is_true_and_says_how_well(closed):
    entries = closed[0].ledger
    assert entries
    for entry in entries:
        closure = entry.measurement
        assert isinstance(closure, LoopClosure)
        assert entry.ruling.verdict is Verdict.ACCEPTED
        true = inverse(POSES[closure.base]) @ POSES[closure.frame]
        off = se3_log(inverse(closure.a_T_b) @ true)
        assert off @ np.linalg.solve(closure.covariance, off) < chi2.ppf(0.999, 6)


def test_poses_hold_the_truth_within_their_covariance(closed):
    trajectory = closed[0].trajectory()
    for k in (0, 5, 60, len(POSES) - 1):
        off = se3_log(inverse(trajectory.map_T_rover[k]) @ POSES[k])
        assert off @ np.linalg.solve(trajectory.covariance[k], off) < chi2.ppf(0.999, 6)


def test_no_keyframe_is_in_two_loops(closed):
    used = [k for e in closed[0].ledger for k in (e.measurement.base, e.measurement.frame)]
    assert len(used) == len(set(used))


def test_nothing_is_closed_that_is_known(frames):
    """While the rover drives on, and when it stands where it knows to be."""
    seen = [frame for frame in frames if not isinstance(frame, UnusableFrame)][: SEEN_FIRST + 1]
    back = [
        replace(Scene().frame(POSES[k] @ MOUNT, 100 + n), odometry=None, index=100 + n,
                stamp_s=50.0 + 0.5 * n)
        for n, k in enumerate(range(SEEN_FIRST, -1, -1))
    ]  # fmt: skip
    plain = [replace(frame, odometry=None) for frame in seen]
    navigator, _ = navigate([*plain, *back])
    assert navigator.ledger == ()


def test_a_drive_that_returns_nowhere_asks_the_graph_for_nothing(monkeypatch):
    asked = []
    monkeypatch.setattr(IncrementalSmoother, "between", lambda *_: asked.append(1))
    way = [pose(np.eye(3), [0.3 * k, 0.0, 0.0]) for k in range(24)]
    frames = [Scene().frame(map_T_rover @ MOUNT, k) for k, map_T_rover in enumerate(way)]
    navigator, _ = navigate(frames)
    table = navigator.loops._kept._table
    assert np.ptp(table[:, 6]) > 3.0 * table[0, 5] + 1.0, "long enough to look back"
    assert not asked


def test_the_kept_places_are_bounded(frames):
    small = LoopClosingConfig(memory_mb=0.06)
    navigator, _ = navigate(frames, QUIET.model_copy(update={"loop_closing": small}))
    plain, _ = navigate(frames[: SEEN_FIRST + 1])
    assert len(plain.loops.places) >= 3
    kept = navigator.loops.places
    assert sum(place.nbytes for place in kept) <= 60_000
    assert kept[0].frame == 0


def recorded(path, frames, config=QUIET):
    header = RunHeader(CAMERA, MOUNT, StartPrior(), config.model_dump_json())
    with TraverseLog.create(path, header) as log:
        navigator, _ = navigate(frames, config, log)
        navigator.finish()
        return navigator.trajectory()


@pytest.mark.parametrize("until", [5, SEEN_LAST, SEEN_LAST + 4])
def test_an_interrupted_run_closes_the_same_loops(frames, tmp_path, until):
    whole = recorded(tmp_path / "whole.db", frames)
    header = RunHeader(CAMERA, MOUNT, StartPrior(), QUIET.model_dump_json())
    with TraverseLog.create(tmp_path / "part.db", header) as log:
        navigate(frames[:until], QUIET, log)
    with TraverseLog.reopen(tmp_path / "part.db") as log:
        navigator = Navigator(CAMERA, QUIET, MOUNT, log=log)
        navigator.resume()
        for frame in frames[until:]:
            navigator.step(frame)
        navigator.finish()
    found = navigator.trajectory()
    np.testing.assert_array_equal(found.map_T_rover, whole.map_T_rover)
    with TraverseLog.open(tmp_path / "whole.db") as a, TraverseLog.open(tmp_path / "part.db") as b:
        assert repr(a.ledger()) == repr(b.ledger())
        assert [repr(p) for p in a.places()] == [repr(p) for p in b.places()]
        assert a.ledger()


def test_a_frame_is_in_the_log_with_its_loop_or_not_at_all(frames, tmp_path, monkeypatch):
    header = RunHeader(CAMERA, MOUNT, StartPrior(), QUIET.model_dump_json())
    path = tmp_path / "run.db"
    with TraverseLog.create(path, header) as log:
        navigator = Navigator(CAMERA, QUIET, MOUNT, log=log)
        navigator.step(frames[0])

        def fails(_):
            raise KeyboardInterrupt

        monkeypatch.setattr(log, "append_place", fails)
        for frame in frames[1:]:
            try:
                navigator.step(frame)
            except KeyboardInterrupt:
                break
    with TraverseLog.open(path) as log:
        assert [keyframe.index for keyframe in log.keyframes()] == list(range(frame.index))
        assert len(log.places()) == 1
