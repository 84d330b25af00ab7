"""Exports come back as they went; pose graphs from files are optimised."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from frontends.errors import InputError
from frontends.geometry import inverse, se3_exp, se3_log
from lunar_fg.cli import app
from lunar_fg.config import Config
from lunar_fg.graph import IncrementalSmoother
from lunar_fg.graph.pose_batch import optimize_poses
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import RunHeader
from lunar_fg.pose_graph import PoseEdge, PoseGraph, g2o_text, read_g2o
from lunar_fg.run_folder import RunFolder
from lunar_fg.simulation.measurements import TraverseSpec, simulate
from lunar_fg.trajectory_io import read_trajectory
from lunar_fg.truth import as_trajectory


def lunar_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run's folder with a log, from simulated measurements."""
    drive = simulate(TraverseSpec(keyframes=25, landmarks=40, odometry=True, tilt=True), seed=2)
    folder = RunFolder.create(tmp_path_factory.mktemp("runs") / "run", Config())
    header = RunHeader(drive.camera, drive.rover_T_camera, drive.start)
    smoother = IncrementalSmoother(drive.camera, drive.rover_T_camera, drive.start)
    with TraverseLog.create(folder.database_path, header) as log:
        for keyframe in drive.keyframes:
            log.append(keyframe, smoother.add(keyframe))
    smoother.finish()
    folder.write_trajectory(as_trajectory(smoother.trajectory()))
    return folder


def exported(run: RunFolder, name: str, target: Path) -> Path:
    result = lunar_fg("export", run.path, "--format", name, "-o", target)
    assert result.exit_code == 0, result.output
    return target


@pytest.mark.parametrize("name", ["tum", "euroc"])
def test_trajectories_come_back(run: RunFolder, tmp_path: Path, name: str) -> None:
    expected = run.read_trajectory()
    found = read_trajectory(exported(run, name, tmp_path / "out.txt"))
    np.testing.assert_allclose(found.stamp_s, expected.stamp_s, atol=1e-9)
    np.testing.assert_allclose(found.map_T_rover, expected.map_T_rover, atol=1e-8)


def test_kitti_is_of_the_camera_from_its_start(run: RunFolder, tmp_path: Path) -> None:
    found = read_trajectory(exported(run, "kitti", tmp_path / "out.txt"))
    np.testing.assert_allclose(found.map_T_rover[0], np.eye(4), atol=1e-12)
    with TraverseLog.open(run.database_path) as log:
        mount = log.header().rover_T_camera
    back = run.read_trajectory().map_T_rover[0] @ mount @ found.map_T_rover @ inverse(mount)
    np.testing.assert_allclose(back, run.read_trajectory().map_T_rover, atol=1e-8)
    stamps = np.loadtxt(tmp_path / "out.times.txt")
    np.testing.assert_allclose(stamps, run.read_trajectory().stamp_s)


def test_g2o_comes_back_and_says_what_gtsam_reads(run: RunFolder, tmp_path: Path) -> None:
    path = exported(run, "g2o", tmp_path / "run.g2o")
    graph = read_g2o(path)
    expected = run.read_trajectory()
    np.testing.assert_allclose(graph.map_T_body, expected.map_T_rover, atol=1e-8)
    assert len(graph.edges) == 2 * 24  # images and wheels
    again = read_g2o(_write(tmp_path / "again.g2o", g2o_text(graph)))
    for one, other in zip(graph.edges, again.edges, strict=True):
        assert (one.a, one.b) == (other.a, other.b)
        np.testing.assert_allclose(one.a_T_b, other.a_T_b, atol=1e-12)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6)
    theirs, values = gtsam.readG2o(str(path), True)
    ours = sum(
        0.5 * error @ np.linalg.solve(edge.covariance, error)
        for edge in graph.edges
        for error in [
            se3_log(
                inverse(edge.a_T_b)
                @ inverse(graph.map_T_body[graph.ids.index(edge.a)])
                @ graph.map_T_body[graph.ids.index(edge.b)]
            )
        ]
    )
    assert theirs.error(values) == pytest.approx(ours, rel=1e-5)
    priors = json.loads((tmp_path / "run.priors.json").read_text())
    assert len(priors["tilts"]) == len(priors["stamps_s"]) == 25
    assert priors["start"]["keyframe"] == 0


def _write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def ring(noise: float) -> tuple[PoseGraph, np.ndarray]:
    """A round trip of 20 poses that closes, with wrong initial values; and the truth."""
    rng = np.random.default_rng(0)
    step = se3_exp([0.0, 0.02, 2.0 * np.pi / 20, 1.0, 0.0, 0.1])
    truth = [np.eye(4)]
    for _ in range(19):
        truth.append(truth[-1] @ step)
    pairs = [(k, (k + 1) % 20) for k in range(20)] + [(0, 10), (5, 15)]
    covariance = np.diag([0.01] * 3 + [0.05] * 3) ** 2
    edges = tuple(
        PoseEdge(
            7 * a, 7 * b,
            inverse(truth[a]) @ truth[b] @ se3_exp(noise * rng.normal(size=6)),
            covariance,
        )
        for a, b in pairs
    )  # fmt: skip
    initial = [truth[0]]
    for edge in edges[:19]:
        initial.append(initial[-1] @ edge.a_T_b @ se3_exp(0.03 * rng.normal(size=6)))
    return PoseGraph(tuple(7 * k for k in range(20)), np.stack(initial), edges), np.stack(truth)


def test_a_pose_graph_file_is_optimised(tmp_path: Path) -> None:
    graph, truth = ring(0.0)
    path = _write(tmp_path / "ring.g2o", g2o_text(graph))
    result = lunar_fg("optimize", path)
    assert result.exit_code == 0, result.output
    found = read_g2o(tmp_path / "ring.optimized.g2o")
    np.testing.assert_allclose(found.map_T_body, truth, atol=1e-5)
    assert found.ids == graph.ids
    noisy, truth = ring(0.01)
    poses, end = optimize_poses(noisy.ids, noisy.map_T_body, noisy.edges)
    assert end.converged
    assert end.cost_after < 0.01 * end.cost_before
    assert np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.1


VERTEX = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"
EDGE = "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + " ".join(
    "1" if i == j else "0" for i in range(6) for j in range(i, 6)
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no vertex"),
        ("VERTEX_SE2 0 0 0 0\n", "line 1.*not known"),
        (VERTEX + VERTEX, "line 2.*twice"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0\n", "cut off"),
        ("VERTEX_SE3:QUAT 0 0 nan 0 0 0 0 1\n", "finite"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 2\n", "norm"),
        (VERTEX + EDGE, "vertex 1 does not exist"),
        (VERTEX + EDGE.replace(" 0 1 1 ", " 0 0 1 ", 1), "itself"),
        (VERTEX + EDGE[:-1] + "-1", "positive definite"),
        (VERTEX + "FIX 3\n", "vertex 3 does not exist"),
        (VERTEX + VERTEX.replace(" 0 ", " 1 ", 1), "not connected"),
    ],
)  # fmt: skip
def test_bad_pose_graphs_are_named(tmp_path: Path, text: str, says: str) -> None:
    path = _write(tmp_path / "bad.g2o", text)

    def solve() -> None:
        graph = read_g2o(path)
        optimize_poses(graph.ids, graph.map_T_body, graph.edges, graph.fixed)

    with pytest.raises(InputError, match=says):
        solve()


def test_an_unknown_format_is_named(run: RunFolder) -> None:
    result = lunar_fg("export", run.path, "--format", "g20")
    assert result.exit_code == 2
    assert "did you mean 'g2o'?" in result.stderr
