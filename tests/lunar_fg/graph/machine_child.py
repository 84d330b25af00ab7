"""Any sequence of sound and senseless calls, against a model. Run by test_machine.py.

Usage: ``python machine_child.py EXAMPLES``. The smoother may abort the process: it has one of
its own. What is checked after every call: a refused call has changed nothing, every keyframe
has a finite rigid pose and a positive covariance, a person's word stands, and a smoother fed
from the log ends where this one is.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from frontends.errors import InputError
from frontends.geometry import inverse, is_rigid
from frontends.measurements import AbsoluteFix, FixCandidate, Verdict
from lunar_fg.graph import GraphConfig, IncrementalSmoother
from lunar_fg.graph.feed import feed
from lunar_fg.graph.planar import planar
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.simulation.measurements import TraverseSpec, simulate

RUN = simulate(TraverseSpec(keyframes=60, landmarks=24, odometry=True, tilt=True), seed=4)
SIGMA = np.diag([0.2, 0.2, 0.02]) ** 2
OFFSETS = st.sampled_from([0.0, 0.0, 0.1, -0.3, 4.0, -40.0])
EARLIER = st.integers(-1, 60)


class Traverse(RuleBasedStateMachine):
    """A smoother, its log, and what must be true of both."""

    @initialize(mode=st.sampled_from(["segments", "segments", "full"]))
    def begin(self, mode: str) -> None:
        self.config = GraphConfig(landmarks=mode, segment_keyframes=4)
        self.smoother = self.fresh()
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name) / "run.db"
        header = RunHeader(RUN.camera, RUN.rover_T_camera, RUN.start)
        self.log = TraverseLog.create(self.path, header)
        self.count = 0
        self.words: dict[tuple[int, int | None], Verdict] = {}

    def fresh(self) -> IncrementalSmoother:
        return IncrementalSmoother(RUN.camera, RUN.rover_T_camera, RUN.start, self.config)

    def poses(self) -> np.ndarray:
        return self.smoother.trajectory().map_T_rover if self.count else np.empty((0, 4, 4))

    def asked(self, call, *arguments):
        """Result of a call, or None where it was refused and so changed nothing."""
        before, ledger = self.poses(), self.smoother.ledger
        try:
            return call(*arguments)
        except InputError:
            np.testing.assert_array_equal(self.poses(), before)
            assert self.smoother.ledger == ledger
            return None

    @precondition(lambda self: self.count < len(RUN.keyframes))
    @rule(many=st.integers(1, 6))
    def drive(self, many: int) -> None:
        for keyframe in RUN.keyframes[self.count : self.count + many]:
            self.log.append(keyframe, self.smoother.add(keyframe))
            self.count += 1

    @precondition(lambda self: self.count > 0)
    @rule(number=EARLIER)
    def drive_back(self, number: int) -> None:
        again = RUN.keyframes[min(max(number, 0), self.count - 1)]
        assert self.asked(self.smoother.add, again) is None

    @rule(frame=EARLIER, east=OFFSETS, north=OFFSETS, twice=st.booleans())
    def fix(self, frame: int, east: float, north: float, twice: bool) -> None:
        x, y, yaw = planar(RUN.map_T_rover[min(max(frame, 0), 59)])
        places = [FixCandidate(x + east, y + north, yaw, SIGMA)]
        if twice:
            places.append(FixCandidate(x + 15.0, y - 9.0, yaw + 1.0, SIGMA))
        decision = self.asked(self.smoother.add_fix, AbsoluteFix(frame, tuple(places), 0.4))
        known = 0 <= frame < self.count
        assert decision is None or known
        if decision is not None:
            self.log.append_decisions([decision])

    @rule(base=EARLIER, frame=EARLIER, off=OFFSETS)
    def closure(self, base: int, frame: int, off: float) -> None:
        i, j = (min(max(k, 0), 59) for k in (base, frame))
        motion = inverse(RUN.map_T_rover[i]) @ RUN.map_T_rover[j]
        motion[0, 3] += off
        covariance = np.diag([0.01] * 3 + [0.1] * 3) ** 2
        decision = self.asked(self.smoother.add_relative, base, frame, motion, covariance)
        assert decision is None or 0 <= base < frame < self.count
        if decision is not None:
            self.log.append_decisions([decision])

    @rule(frame=EARLIER, off=OFFSETS)
    def height(self, frame: int, off: float) -> None:
        z = RUN.map_T_rover[min(max(frame, 0), 59), 2, 3] + off
        decision = self.asked(self.smoother.add_height, frame, z, 0.3)
        if decision is not None:
            self.log.append_decisions([decision])

    @rule(data=st.data(), believe=st.booleans())
    def word(self, data: st.DataObject, believe: bool) -> None:
        fixes = [e for e in self.smoother.ledger if isinstance(e.measurement, AbsoluteFix)]
        frame = data.draw(st.sampled_from([e.frame for e in fixes] or [99]))
        call = self.smoother.accept if believe else self.smoother.reject
        decision = self.asked(call, frame)
        assert (decision is None) == (not fixes)
        if decision is not None:
            self.log.append_decisions([decision])
            self.words[frame, None] = decision.verdict
            assert decision.accepted == believe

    @rule(frame=EARLIER)
    def look(self, frame: int) -> None:
        found = self.asked(self.smoother.predicted, frame)
        assert (found is not None) == (0 <= frame < self.count)

    @precondition(lambda self: self.count > 0)
    @rule()
    def resume(self) -> None:
        """A smoother fed from the log is where this one is; go on with it."""
        again = self.fresh()
        with TraverseLog.open(self.path) as log:
            keyframes, ledger = log.keyframes(), log.ledger()
        assert len(keyframes) == self.count
        list(feed(again, keyframes, ledger))
        np.testing.assert_allclose(again.trajectory().map_T_rover, self.poses(), atol=1e-6)
        now = [entry.ruling.verdict for entry in self.smoother.ledger]
        assert [entry.ruling.verdict for entry in again.ledger] == now
        self.smoother = again

    @invariant()
    def sound(self) -> None:
        if not self.count:
            return
        trajectory = self.smoother.trajectory()
        assert len(trajectory) == self.count
        assert all(is_rigid(pose) for pose in trajectory.map_T_rover)
        assert all(np.linalg.eigvalsh(c)[0] > 0.0 for c in trajectory.covariance)
        verdicts = {(e.frame, e.base): e.ruling.verdict for e in self.smoother.ledger}
        for which, verdict in self.words.items():
            assert verdicts[which] is verdict

    def teardown(self) -> None:
        if hasattr(self, "folder"):
            self.log.close()
            self.folder.cleanup()


if __name__ == "__main__":
    examples = int(sys.argv[1])
    run_state_machine_as_test(
        Traverse,
        settings=settings(
            max_examples=examples,
            stateful_step_count=14,
            deadline=None,
            derandomize=len(sys.argv) < 3,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
    print(f"{examples} examples")
