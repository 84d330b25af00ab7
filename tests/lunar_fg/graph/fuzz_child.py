"""Whatever a caller passes: named errors only. Run by test_fuzz.py in a process of its own.

Usage: ``python fuzz_child.py EXAMPLES``. Ends with 0 and a line, or with an unnamed error, or
by a signal where something reached GTSAM that it cannot take.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontends.errors import EstimationError, InputError
from frontends.measurements import (
    AbsoluteFix,
    FixCandidate,
    Odometry,
    RelativePose,
    StartPrior,
    Tilt,
    Verdict,
)
from lunar_fg.graph import GraphConfig, IncrementalSmoother, optimize_batch
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.simulation.measurements import TraverseSpec, simulate

RUN = simulate(TraverseSpec(keyframes=12, landmarks=16, odometry=True, tilt=True), seed=9)
NAMED = (InputError, EstimationError)

NASTY = st.sampled_from(
    [np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e-300, 1e300, -1e300, 1e20, 1e-12, 1e6]
)
NUMBERS = st.one_of(st.floats(-10.0, 10.0), NASTY)
FRAMES = st.integers(-3, 14)


@st.composite
def spoiled(draw, array):
    """A copy with some values replaced, or of another shape."""
    array = np.array(array, dtype=np.float64)
    for _ in range(draw(st.integers(0, 3))):
        if array.size:
            array.flat[draw(st.integers(0, array.size - 1))] = draw(NUMBERS)
    how = draw(st.integers(0, 9))
    if how == 0:
        return array[..., :-1]
    if how == 1:
        return array.T if array.ndim > 1 else array[None]
    return -array if how == 2 else array


@st.composite
def keyframes(draw):
    """A simulated keyframe with something wrong, or nothing."""
    keyframe = RUN.keyframes[draw(st.integers(0, len(RUN.keyframes) - 1))]
    for what in draw(st.lists(st.sampled_from(WHAT), max_size=2)):
        keyframe = _spoil(draw, keyframe, what)
    return keyframe


WHAT = ("index", "stamp", "observations", "no observations", "ids", "relative", "no relative",
        "odometry", "no odometry", "tilt", "behind")  # fmt: skip


def _spoil(draw, keyframe, what):
    seen, relative, odometry = keyframe.observations, keyframe.relative, keyframe.odometry
    if what == "index":
        return replace(keyframe, index=draw(FRAMES))
    if what == "stamp":
        return replace(keyframe, stamp_s=draw(NUMBERS))
    if what == "no observations":
        return replace(keyframe, observations=None)
    if what == "no relative":
        return replace(keyframe, relative=None)
    if what == "no odometry":
        return replace(keyframe, odometry=None)
    if what == "tilt":
        return replace(keyframe, tilt=Tilt(draw(NUMBERS), draw(NUMBERS), draw(NUMBERS)))
    if what == "observations" and seen is not None:
        name = draw(st.sampled_from(["u_left", "u_right", "v", "sigma_px", "sigma_disparity_px"]))
        values = draw(spoiled(getattr(seen, name)))
        return replace(keyframe, observations=replace(seen, **{name: values}))
    if what == "behind" and seen is not None:
        return replace(
            keyframe, observations=replace(seen, u_left=seen.u_right, u_right=seen.u_left)
        )
    if what == "ids" and seen is not None:
        ids = seen.landmark_id.copy()
        ids[draw(st.integers(0, len(ids) - 1))] = draw(st.sampled_from([0, -1, 2**62, ids[0]]))
        return replace(keyframe, observations=replace(seen, landmark_id=ids))
    if what == "relative" and relative is not None:
        changed = RelativePose(
            draw(spoiled(relative.a_T_b)),
            draw(spoiled(relative.covariance)),
            relative.inlier_ids,
            draw(st.integers(-1, 100)),
            draw(st.sampled_from(list(Verdict))),
        )
        return replace(keyframe, relative=changed)
    if what == "odometry" and odometry is not None:
        changed = Odometry(draw(spoiled(odometry.a_T_b)), draw(spoiled(odometry.covariance)))
        return replace(keyframe, odometry=changed)
    return keyframe


@st.composite
def fixes(draw):
    """An absolute fix of some keyframe."""
    covariance = np.diag([1.0, 1.0, 0.01])
    candidates = tuple(
        FixCandidate(draw(NUMBERS), draw(NUMBERS), draw(NUMBERS), draw(spoiled(covariance)))
        for _ in range(draw(st.integers(0, 3)))
    )
    height = draw(st.one_of(st.none(), NUMBERS))
    sigma = draw(st.one_of(st.none(), NUMBERS))
    return AbsoluteFix(draw(FRAMES), candidates, 0.5, height, sigma)


OPERATIONS = st.one_of(
    st.tuples(st.just("add"), keyframes()),
    st.tuples(st.just("next"), st.none()),
    st.tuples(st.just("next"), st.none()),
    st.tuples(st.just("fix"), fixes()),
    st.tuples(
        st.just("relative"), st.tuples(FRAMES, FRAMES, spoiled(np.eye(4)), spoiled(np.eye(6)))
    ),
    st.tuples(st.just("height"), st.tuples(FRAMES, NUMBERS, NUMBERS)),
    st.tuples(
        st.just("accept"), st.tuples(FRAMES, st.one_of(st.none(), FRAMES), st.integers(-2, 3))
    ),
    st.tuples(st.just("reject"), st.tuples(FRAMES, st.one_of(st.none(), FRAMES))),
    st.tuples(st.just("predicted"), FRAMES),
    st.tuples(st.just("trajectory"), st.none()),
    st.tuples(st.just("finish"), st.none()),
)


def said(error):
    """The error has a text."""
    assert str(error)


def perform(smoother, operation, argument, count):
    """One call; returns the keyframe that went in, if any."""
    if operation in ("add", "next"):
        keyframe = RUN.keyframes[min(count, len(RUN.keyframes) - 1)]
        keyframe = argument if operation == "add" else keyframe
        return keyframe, smoother.add(keyframe)
    if operation == "fix":
        smoother.add_fix(argument)
    elif operation in ("relative", "height", "accept", "reject"):
        name = operation if operation in ("accept", "reject") else f"add_{operation}"
        getattr(smoother, name)(*argument)
    elif operation == "predicted":
        smoother.predicted(argument)
    else:
        getattr(smoother, operation)()
    return None


@st.composite
def starts(draw):
    sigmas = (1e-3,) * 3
    if draw(st.integers(0, 4)):
        return RUN.start
    return StartPrior(
        draw(spoiled(np.eye(4))), (draw(NUMBERS), *sigmas[1:]), (draw(NUMBERS), *sigmas[1:])
    )


@given(
    mode=st.sampled_from(["segments", "full"]),
    start=starts(),
    operations=st.lists(OPERATIONS, min_size=4, max_size=14),
)
def smoother_and_log(mode, start, operations):
    """Any calls in any order; afterwards the trajectory is finite, in the log and in batch."""
    config = GraphConfig(landmarks=mode, segment_keyframes=3, min_tracks=3)
    try:
        smoother = IncrementalSmoother(RUN.camera, RUN.rover_T_camera, start, config)
    except NAMED:
        return
    entered = []
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "run.db"
        with TraverseLog.create(path, RunHeader(RUN.camera, RUN.rover_T_camera, start)) as log:
            for operation, argument in operations:
                try:
                    done = perform(smoother, operation, argument, len(entered))
                    if done is not None:
                        entered.append(done[0])
                        log.append(*done)
                except NAMED as error:
                    said(error)
            assert len(log.keyframes()) == len(entered)
    if not entered:
        return
    trajectory = smoother.trajectory()
    assert np.isfinite(trajectory.map_T_rover).all()
    assert trajectory.index.tolist() == [keyframe.index for keyframe in entered]
    try:
        result = optimize_batch(RUN.camera, RUN.rover_T_camera, start, entered, config)
        assert np.isfinite(result.trajectory.map_T_rover).all()
    except NAMED as error:
        said(error)


if __name__ == "__main__":
    examples = int(sys.argv[1])
    settings(
        max_examples=examples,
        deadline=None,
        derandomize=len(sys.argv) < 3,
        database=None,
        suppress_health_check=list(HealthCheck),
    )(smoother_and_log)()
    print(f"{examples} examples")
