"""A run as MCAP, read back by the mcap library and by our own reader of recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from frontends.errors import InputError
from lunar_fg.cli import app
from lunar_fg.datasets.bag_file import BagFile
from lunar_fg.datasets.rosbag import BagReader
from lunar_fg.mcap_export import export_mcap
from lunar_fg.run_folder import RunFolder


@pytest.fixture(scope="module")
def exported(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunFolder]:
    """EuRoC's eight frames, run and exported by the commands."""
    run = tmp_path_factory.mktemp("run") / "euroc"
    source = shared_data / "euroc-v101-still"
    for arguments in (
        ["run", str(source), "-o", str(run)],
        ["export", str(run), "--mcap"],
    ):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
    return run / "export.mcap", RunFolder.open(run)


def test_foxglove_finds_its_schemas(exported) -> None:
    with exported[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    kinds = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert kinds == {
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/path": "nav_msgs/msg/Path",
        "/landmarks": "sensor_msgs/msg/PointCloud2",
    }
    assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    assert all(schema.data for schema in summary.schemas.values())


def test_poses_and_landmarks_are_the_runs(exported) -> None:
    path, folder = exported
    trajectory = folder.read_trajectory()
    bag = BagFile(path)
    kinds = {topic.name: topic for topic in bag.topics()}
    assert kinds["/tf"].count == len(trajectory) == 8
    messages: dict[str, list] = {name: [] for name in kinds}
    for name, data in bag.raw(set(kinds)):
        messages[name].append(bag.decode(data, kinds[name].kind))
    assert trajectory.covariance is not None
    for row, (tf, pose) in enumerate(zip(messages["/tf"], messages["/pose"], strict=True)):
        transform = tf.transforms[0]
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "rover")
        place, turn = transform.transform.translation, transform.transform.rotation
        expected = trajectory.map_T_rover[row]
        np.testing.assert_allclose([place.x, place.y, place.z], expected[:3, 3], atol=1e-8)
        got = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        np.testing.assert_allclose(got, expected[:3, :3], atol=1e-8)
        covariance = np.reshape(pose.pose.covariance, (6, 6))
        body = trajectory.covariance[row]
        turned = expected[:3, :3] @ body[3:, 3:] @ expected[:3, :3].T
        np.testing.assert_allclose(covariance[:3, :3], turned, rtol=1e-6, atol=1e-14)
    assert len(messages["/path"][0].poses) == 8
    cloud = messages["/landmarks"][0]
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)
    assert len(points) == cloud.width > 500
    assert 1.0 < np.median(np.linalg.norm(points, axis=1)) < 10.0


def test_it_is_no_stereo_recording(exported) -> None:
    with pytest.raises(InputError, match="no two image topics"):
        BagReader().open(exported[0])


def test_a_run_without_a_log(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", {})
    with pytest.raises(InputError):
        export_mcap(folder, tmp_path / "a.mcap")
