"""Real traverses with absolute fixes: KITTI-00's stereo landmarks, and Spirit's whole mission."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.geometry import inverse
from frontends.measurements import (
    AbsoluteFix,
    FixCandidate,
    FloatArray,
    Odometry,
    StartPrior,
    Tilt,
    Verdict,
)
from lunar_fg.datasets.landmarks import LandmarkSequence, read_landmarks
from lunar_fg.datasets.telemetry import Telemetry, read_telemetry
from lunar_fg.graph import GraphConfig, IncrementalSmoother, Keyframe, optimize_batch
from lunar_fg.simulation.fixes import FixSpec, SimulatedFixes, simulate_fixes


@dataclass(frozen=True)
class KittiFixes:
    """One way on KITTI-00 with fixes sampled from the truth."""

    way: str
    fixes: int
    false: int
    ate_before_m: float
    ate_m: float
    ate_true_fixes_only_m: float
    false_accepted: int
    good_missed: int


@dataclass(frozen=True)
class HeldOut:
    """Spirit's traverse with every k-th corrected position used, at the ones held out."""

    every: int
    used: int
    refused: int
    held_out: int
    drift_a_root_metre: float
    raw_rms_m: float
    raw_median_m: float
    fixed_rms_m: float
    fixed_median_m: float
    within_1_sigma: float
    within_2_sigma: float
    within_3_sigma: float


#: Telemetry has no images: the camera is not used.
_CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 0.3)
#: 1-sigma of a corrected position, m, and of the telemetry's heading, rad.
_SIGMA_CORRECTED_M = 0.5
_SIGMA_HEADING_RAD = np.deg2rad(2.0)
#: Heading of the telemetry wanders by this much a root metre, rad.
_HEADING_WALK_RAD = 5e-4
#: Share of the mission that the telemetry's drift is learnt from.
_LEARN_SHARE = 0.1
_COVERAGE = [float(chi2.ppf(share, 2)) for share in (0.6827, 0.9545, 0.9973)]


def kitti_truth(sequence: LandmarkSequence, path: Path) -> FloatArray:
    """Truth (N, 4, 4) of KITTI-00's keyframes in the map of the sequence."""
    rows = np.loadtxt(path)[sequence.index].reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    mount = sequence.rover_T_camera
    start = sequence.start.map_T_rover
    return np.asarray(start @ mount @ inverse(poses[0]) @ poses @ inverse(mount))


def kitti_fixes(truth_path: Path, seed: int = 0) -> list[KittiFixes]:
    """KITTI-00 factors with a fix every 20 m, 1 m of noise, 20 % false: all three ways."""
    sequence = read_landmarks("00")
    truth = kitti_truth(sequence, truth_path)
    travelled = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))]
    )
    places = np.searchsorted(travelled, np.arange(20.0, travelled[-1], 20.0))
    frames = [int(sequence.index[i]) for i in places]
    spec = FixSpec(every=1, sigma_xy_m=1.0, sigma_yaw_rad=0.02, false_share=0.2)
    # One keyframe more: no fix on the first.
    drawn = simulate_fixes([-1, *frames], truth[[0, *places]], spec, seed)
    return [_kitti_way(sequence, truth, drawn, way) for way in ("segments", "full", "batch")]


def _kitti_way(
    sequence: LandmarkSequence, truth: FloatArray, fixes: SimulatedFixes, way: str
) -> KittiFixes:
    config = GraphConfig(landmarks="full" if way == "full" else "segments")

    def solved(which: list[AbsoluteFix]) -> tuple[FloatArray, IncrementalSmoother]:
        smoother = IncrementalSmoother(
            sequence.camera, sequence.rover_T_camera, sequence.start, config
        )
        waiting = {fix.frame: fix for fix in which}
        for keyframe in sequence.keyframes:
            smoother.add(keyframe)
            if keyframe.index in waiting:
                smoother.add_fix(waiting[keyframe.index])
        smoother.finish()
        if way != "batch":
            return smoother.trajectory().map_T_rover, smoother
        result = optimize_batch(
            sequence.camera, sequence.rover_T_camera, sequence.start, sequence.keyframes,
            ledger=smoother.ledger,
        )  # fmt: skip
        return result.trajectory.map_T_rover, smoother

    def ate(poses: FloatArray) -> float:
        gap = poses[:, :2, 3] - truth[:, :2, 3]
        return float(np.sqrt((gap**2).sum(axis=1).mean()))

    poses, smoother = solved(list(fixes.fixes))
    accepted = np.array([e.ruling.verdict is Verdict.ACCEPTED for e in smoother.ledger])
    oracle = [fix for fix, true in zip(fixes.fixes, fixes.true, strict=True) if true]
    return KittiFixes(
        way,
        len(fixes.fixes),
        int((~fixes.true).sum()),
        ate(solved([])[0]),
        ate(poses),
        ate(solved(oracle)[0]),
        int((accepted & ~fixes.true).sum()),
        int((~accepted & fixes.true).sum()),
    )


def spirit(path: Path, every: int) -> HeldOut:
    """Telemetry legs as odometry, every k-th corrected position a fix, the rest held out."""
    telemetry = read_telemetry(path)
    drift = drift_a_root_metre(telemetry, every)
    smoother = IncrementalSmoother(
        _CAMERA,
        level_rover_T_camera(),
        StartPrior(np.eye(4), (0.01, 0.01, _SIGMA_HEADING_RAD), (_SIGMA_CORRECTED_M,) * 3),
    )
    for keyframe in _legs(telemetry, drift):
        smoother.add(keyframe)
        k = keyframe.index
        if k and k % every == 0:
            # A position says nothing on the heading.
            covariance = np.diag([_SIGMA_CORRECTED_M**2, _SIGMA_CORRECTED_M**2, 100.0])
            x, y = telemetry.corrected_m[k]
            smoother.add_fix(
                AbsoluteFix(k, (FixCandidate(x, y, 0.0, covariance, proposer="telemetry"),))
            )
    smoother.finish()
    smoothed = smoother.trajectory()
    used = np.arange(len(telemetry)) % every == 0
    learnt = np.arange(len(telemetry)) < _LEARN_SHARE * len(telemetry)
    # Past the last fix it is dead reckoning again: held out all the same.
    held = np.flatnonzero(~used & ~learnt)
    gap = smoothed.map_T_rover[held, :2, 3] - telemetry.corrected_m[held]
    rotation = smoothed.map_T_rover[held, :2, :3]
    spread = rotation @ smoothed.covariance[held, 3:, 3:] @ rotation.transpose(0, 2, 1)
    spread = spread + _SIGMA_CORRECTED_M**2 * np.eye(2)
    squared = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(spread), gap)
    raw = np.linalg.norm(telemetry.raw_m[held] - telemetry.corrected_m[held], axis=1)
    fixed = np.linalg.norm(gap, axis=1)
    refused = sum(e.ruling.verdict is Verdict.REFUSED for e in smoother.ledger)
    return HeldOut(
        every,
        int(used.sum()) - 1,
        refused,
        len(held),
        drift,
        float(np.sqrt((raw**2).mean())),
        float(np.median(raw)),
        float(np.sqrt((fixed**2).mean())),
        float(np.median(fixed)),
        *(float((squared <= bound).mean()) for bound in _COVERAGE),
    )


def drift_a_root_metre(telemetry: Telemetry, every: int) -> float:
    """How fast telemetry drifts from one used position to the next, m per root metre, an axis.

    From the first tenth of the mission, which is not evaluated, and its used positions alone.
    Slip and heading errors last, so the drift grows faster than the root of the length: it is
    taken at the scale, of one used position or of many, where it is the largest.
    """
    used = np.arange(0, int(_LEARN_SHARE * len(telemetry)), every)
    length = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(telemetry.raw_m, axis=0), axis=1))]
    )
    noise, found = 4.0 * _SIGMA_CORRECTED_M**2, [1e-4]
    while len(used) > 3:
        gap = np.diff(telemetry.raw_m[used] - telemetry.corrected_m[used], axis=0)
        excess = ((gap**2).sum(axis=1) - noise).sum()
        found.append(excess / (2.0 * np.diff(length[used]).sum()))
        used = used[::2]
    return float(np.sqrt(max(found)))


def _legs(telemetry: Telemetry, drift: float) -> list[Keyframe]:
    """Legs in telemetry's own axes: what yaw the graph finds is the telemetry's heading error."""
    level = Tilt(0.0, 0.0, 0.01)
    keyframes = [Keyframe(0, 0.0, tilt=level)]
    for k, leg in enumerate(np.diff(telemetry.raw_m, axis=0), start=1):
        length = max(float(np.linalg.norm(leg)), 0.01)
        sigma, turn = drift * np.sqrt(length), _HEADING_WALK_RAD * np.sqrt(length)
        motion = np.eye(4)
        motion[:2, 3] = leg
        covariance = np.diag(np.square([0.01, 0.01, turn, sigma, sigma, sigma]))
        keyframes.append(Keyframe(k, float(k), odometry=Odometry(motion, covariance), tilt=level))
    return keyframes


if __name__ == "__main__":
    data = Path(__file__).resolve().parents[2] / "shared" / "data"
    for row in kitti_fixes(data / "kitti-gt-poses" / "gt" / "00.txt"):
        print(row)
    for every in (20, 50, 200):
        print(spirit(data / "spirit-traverse" / "MERA-MER2-Spirit_traverse_path.csv", every))
