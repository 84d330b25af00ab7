"""The real KITTI-00 factors inside the gtsam wheel."""

import shutil

import numpy as np
import pytest

from frontends.errors import InputError
from frontends.geometry import inverse
from lunar_fg.datasets.landmarks import example_folder, read_landmarks
from lunar_fg.graph import GraphConfig, IncrementalSmoother, optimize_batch
from lunar_fg.graph.setup import Setup


@pytest.fixture(scope="module")
def sequence():
    return read_landmarks("00s")


def run(sequence, count, **config):
    smoother = IncrementalSmoother(
        sequence.camera, sequence.rover_T_camera, sequence.start, GraphConfig(**config)
    )
    for keyframe in sequence.keyframes[:count]:
        smoother.add(keyframe)
    smoother.finish()
    return smoother.trajectory()


def truth(sequence, shared_data):
    first_T_camera = np.loadtxt(shared_data / "kitti-gt-poses" / "gt" / "00.txt")
    poses = np.tile(np.eye(4), (len(sequence.index), 1, 1))
    poses[:, :3] = first_T_camera.reshape(-1, 3, 4)[sequence.index]
    rover_T_camera = sequence.rover_T_camera
    return rover_T_camera @ inverse(poses[0]) @ poses @ inverse(rover_T_camera)


def aligned_error(positions, reference):
    a, b = positions - positions.mean(axis=0), reference - reference.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.sqrt(((a @ (u @ flip @ vt).T - b) ** 2).sum(axis=1).mean())


def test_the_sets_have_their_known_sizes(sequence):
    assert len(sequence.keyframes) == 77
    assert sum(len(k.observations) for k in sequence.keyframes) == 52544
    whole = read_landmarks()
    assert len(whole.keyframes) == 135
    assert whole.index[-1] == 153
    assert sequence.camera.baseline_m == pytest.approx(0.5371657189)
    for keyframe in whole.keyframes:
        keyframe.validate()
        assert keyframe.observations.disparity_px.min() > 0.0


def test_full_and_batch_agree_to_a_centimetre(sequence):
    count = 20
    full = run(sequence, count, landmarks="full")
    batch = optimize_batch(
        sequence.camera, sequence.rover_T_camera, sequence.start, sequence.keyframes[:count],
        initial=run(sequence, count),
    )  # fmt: skip
    assert batch.report.converged
    gap = full.map_T_rover[:, :3, 3] - batch.trajectory.map_T_rover[:, :3, 3]
    assert np.linalg.norm(gap, axis=1).max() < 0.01
    # Segments drop what long tracks say across their boundaries: centimetres, not one.
    segments = run(sequence, count, max_landmarks=100_000)
    gap = segments.map_T_rover[:, :3, 3] - batch.trajectory.map_T_rover[:, :3, 3]
    assert np.linalg.norm(gap, axis=1).max() < 0.05


def test_segments_follow_the_truth(shared_data):
    whole = read_landmarks()
    trajectory = run(whole, None)
    reference = truth(whole, shared_data)[:, :3, 3]
    initial = aligned_error(whole.initial_map_T_rover[:, :3, 3], reference)
    error = aligned_error(trajectory.map_T_rover[:, :3, 3], reference)
    assert error < 0.33
    assert error < 1.02 * initial


def test_chi_square_is_about_one(sequence):
    from lunar_fg.graph.segment import Segment

    config = GraphConfig()
    segment = Segment(
        Setup.checked(sequence.camera, sequence.rover_T_camera, config=config),
        sequence.keyframes[0],
    )
    for keyframe in sequence.keyframes[1:11]:
        segment.add(keyframe)
    solution = segment.solve()
    assert 0.5 < solution.chi_square / solution.degrees_of_freedom < 1.5


def test_damaged_files_are_named(tmp_path):
    for name in ("calibration", "camera_poses", "stereo_factors"):
        shutil.copy(example_folder() / f"VO_{name}00s.txt", tmp_path)
    factors = tmp_path / "VO_stereo_factors00s.txt"
    poses = tmp_path / "VO_camera_poses00s.txt"
    calibration = tmp_path / "VO_calibration00s.txt"
    with pytest.raises(InputError, match="calibration00"):
        read_landmarks("00", tmp_path)
    kept = factors.read_text()
    for text, message in (
        ("0 1 2\n", "columns"), ("a b c d e f g h\n", "numbers"), ("", "columns"),
        ("0 1 nan 2 3 4 5 6\n", "finite"), ("500 1 9 2 3 4 5 6\n", "frame 500"),
    ):  # fmt: skip
        factors.write_text(text)
        with pytest.raises(InputError, match=message):
            read_landmarks("00s", tmp_path)
    factors.write_text(kept)
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join([lines[0], lines[2], lines[1], *lines[3:]]))
    with pytest.raises(InputError, match="increase"):
        read_landmarks("00s", tmp_path)
    calibration.write_text("718 718 0.5 607 185 0.5")
    with pytest.raises(InputError, match="skew"):
        read_landmarks("00s", tmp_path)
