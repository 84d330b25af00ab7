"""The KITTI-00 stereo landmarks inside the gtsam wheel: real measurements, no download.

Three text files: the calibration (fx fy skew cx cy baseline), the poses of a visual odometry
(frame, then a row-major 4x4 ``first_T_camera``) and the stereo factors (frame, landmark,
u_left, u_right, v, then the point in the camera, which is not read). Frame numbers are those
of KITTI odometry sequence 00; some frames are missing.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.errors import DependencyError, InputError
from frontends.geometry import inverse, is_rigid
from frontends.measurements import (
    FloatArray,
    IntArray,
    RelativePose,
    StartPrior,
    StereoObservations,
    Verdict,
)
from lunar_fg.bounded import check_size
from lunar_fg.graph.keyframe import Keyframe

#: Image size of KITTI's rectified sequence 00, px; the files do not hold it.
_WIDTH, _HEIGHT = 1241, 376
_FRAME_RATE_HZ = 10.0
#: Noise of the pixels: the value that gives these factors a chi-square of 1 a degree of freedom.
_SIGMA_PX = 0.3
_SIGMA_DISPARITY_PX = 0.3
#: How far the file's poses may be off from frame to frame; only the gate uses it.
_SIGMA_ROT_RAD = 2e-3
_SIGMA_TRANS_M = 0.03


@dataclass(frozen=True, slots=True)
class LandmarkSequence:
    """Measurements as the graph takes them.

    Attributes
    ----------
    camera, rover_T_camera, start
        For `IncrementalSmoother`; the map is the first rover pose, levelled with it.
    keyframes
        With stereo observations and initial relative poses; `index` is KITTI's frame number.
    initial_map_T_rover
        (N, 4, 4) the file's own poses.
    """

    camera: StereoCamera
    rover_T_camera: FloatArray
    start: StartPrior
    keyframes: tuple[Keyframe, ...]
    initial_map_T_rover: FloatArray

    @property
    def index(self) -> IntArray:
        """(N,) frame numbers."""
        return np.array([keyframe.index for keyframe in self.keyframes], dtype=np.int64)


def example_folder() -> Path:
    """Folder of the data files inside the installed gtsam.

    Raises
    ------
    DependencyError
        When gtsam is not installed, or without its data.
    """
    spec = importlib.util.find_spec("gtsam")
    if spec is None or spec.origin is None:
        raise DependencyError("gtsam is not installed: pip install 'gtsam>=4.3,<5'")
    folder = Path(spec.origin).parent / "Data"
    if not folder.is_dir():
        raise DependencyError(
            f"gtsam at {folder.parent} came without its data: reinstall its wheel"
        )
    return folder


def read_landmarks(name: str = "00", folder: Path | None = None) -> LandmarkSequence:
    """Read one set of factors.

    Parameters
    ----------
    name
        ``"00"`` (135 keyframes) or ``"00s"`` (its first 77).
    folder
        Where the three files are; default inside the installed gtsam.

    Raises
    ------
    InputError
        A file is missing, or a line in it is not what it should be.
    """
    folder = folder or example_folder()
    camera = _read_camera(folder / f"VO_calibration{name}.txt")
    poses_file = folder / f"VO_camera_poses{name}.txt"
    poses = _read_table(poses_file, 17)
    factors_file = folder / f"VO_stereo_factors{name}.txt"
    factors = _read_table(factors_file, 8)
    frames = poses[:, 0].astype(np.int64)
    first_T_camera = poses[:, 1:].reshape(-1, 4, 4)
    if (np.diff(frames) <= 0).any():
        raise InputError("frame numbers must increase", source=poses_file)
    for frame, pose in zip(frames, first_T_camera, strict=True):
        if not is_rigid(pose, tolerance=1e-3):
            raise InputError("is not a rigid transform", source=poses_file, field=f"frame {frame}")
    unknown = np.setdiff1d(factors[:, 0].astype(np.int64), frames)
    if len(unknown):
        raise InputError(
            f"has no pose in {poses_file.name}", source=factors_file, field=f"frame {unknown[0]}"
        )
    rover_T_camera = level_rover_T_camera()
    first_T_camera = np.stack([_rigid(pose) for pose in first_T_camera])
    keyframes = tuple(_keyframes(camera, frames, first_T_camera, factors))
    camera_T_rover = inverse(rover_T_camera)
    map_T_rover = rover_T_camera @ first_T_camera @ camera_T_rover
    start = StartPrior(map_T_rover[0])
    return LandmarkSequence(camera, rover_T_camera, start, keyframes, map_T_rover)


def _keyframes(
    camera: StereoCamera, frames: IntArray, first_T_camera: FloatArray, factors: FloatArray
) -> list[Keyframe]:
    covariance = np.diag([_SIGMA_ROT_RAD**2] * 3 + [_SIGMA_TRANS_M**2] * 3)
    frame_of = factors[:, 0].astype(np.int64)
    keyframes: list[Keyframe] = []
    for k, frame in enumerate(frames.tolist()):
        rows = factors[frame_of == frame]
        # Factors are unique a frame and landmark; the first of a repeated one is kept.
        _, first = np.unique(rows[:, 1], return_index=True)
        observations = _observations(camera, rows[first])
        relative = None
        if k:
            a_T_b = inverse(first_T_camera[k - 1]) @ first_T_camera[k]
            shared = np.intersect1d(observations.landmark_id, _ids(keyframes[-1]))
            relative = RelativePose(a_T_b, covariance, shared, len(shared), Verdict.ACCEPTED)
        keyframes.append(Keyframe(frame, frame / _FRAME_RATE_HZ, observations, relative))
    return keyframes


def _ids(keyframe: Keyframe) -> IntArray:
    assert keyframe.observations is not None
    return keyframe.observations.landmark_id


def _observations(camera: StereoCamera, rows: FloatArray) -> StereoObservations:
    u_left, u_right, v = rows[:, 2], rows[:, 3], rows[:, 4]
    sigma = np.full(len(rows), _SIGMA_PX)
    sigma_disparity = np.full(len(rows), _SIGMA_DISPARITY_PX)
    disparity = u_left - u_right
    return StereoObservations(
        rows[:, 1].astype(np.int64),
        u_left,
        u_right,
        v,
        sigma,
        sigma_disparity,
        camera.triangulate(u_left, v, disparity),
        camera.triangulation_covariance(u_left, v, disparity, sigma, sigma_disparity),
    )


def _rigid(transform: FloatArray) -> FloatArray:
    """Nearest rigid transform: the file has six digits."""
    u, _, vt = np.linalg.svd(transform[:3, :3])
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = u @ vt, transform[:3, 3]
    return result


def _read_camera(path: Path) -> StereoCamera:
    fx, fy, skew, cx, cy, baseline = _read_table(path, 6)[0]
    if skew != 0.0:
        raise InputError(f"is {skew}", source=path, field="skew", remedy="rectify the images")
    return StereoCamera(_WIDTH, _HEIGHT, fx, fy, cx, cy, baseline)


def _read_table(path: Path, columns: int) -> FloatArray:
    if not path.is_file():
        raise InputError("is missing", source=path, remedy="give the folder of gtsam's Data files")
    if not path.stat().st_size:
        raise InputError(f"is empty, needs {columns} columns", source=path)
    check_size(path)
    try:
        table = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise InputError(f"is not a table of numbers ({error})", source=path) from error
    if not len(table) or table.shape[1] != columns:
        raise InputError(f"has shape {table.shape}, needs {columns} columns", source=path)
    if not np.isfinite(table).all():
        raise InputError("holds a value that is not finite", source=path)
    return np.asarray(table, dtype=np.float64)
