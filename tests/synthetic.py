"""Rendered stereo images of textured planes, with exact geometry.

The texture is a sum of periodic band-limited noises. It is evaluated where each pixel's ray
meets a plane, so that both images of a pair, and all frames of a sequence, show one scene
to a few hundredths of a pixel.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.geometry import inverse, pose, so3_exp, transform_points, yaw_pitch_roll
from frontends.measurements import StereoFrame
from lunar_fg.trajectory import Trajectory
from lunar_fg.trajectory_io import write_tum

FloatArray = NDArray[np.float64]

#: A small rover camera: 320 x 240 px, 68 degrees wide.
CAMERA = StereoCamera(320, 240, 240.0, 240.0, 161.3, 118.6, 0.12)

_WAVES = 16  # wavelengths across a tile
_TILE = 512  # px across a tile: 32 a wavelength
_WAVELENGTHS_M = 0.03 * 1.7 ** np.arange(12)


def _tile(seed: int) -> NDArray[np.float32]:
    """Periodic noise of zero mean, unit spread, wavelengths about `_TILE / _WAVES`."""
    rng = np.random.default_rng(seed)
    wave = np.fft.fftfreq(_TILE, 1.0 / _TILE)
    radius = np.hypot(wave[:, None], wave[None, :])
    ring = np.exp(-0.5 * ((radius - _WAVES) / (0.2 * _WAVES)) ** 2)
    tile = np.fft.ifft2(np.fft.fft2(rng.standard_normal((_TILE, _TILE))) * ring).real
    tile /= tile.std()
    return np.pad(tile, ((0, 1), (0, 1)), mode="wrap").astype(np.float32)


_TILES = [_tile(seed) for seed in range(len(_WAVELENGTHS_M))]


@dataclass(frozen=True)
class Plane:
    """A textured rectangle: ``centre + a axis_a + b axis_b`` with |a|, |b| limited, m."""

    centre: tuple[float, float, float]
    axis_a: tuple[float, float, float]
    axis_b: tuple[float, float, float]
    half_a: float = np.inf
    half_b: float = np.inf

    def hit(
        self, origin: FloatArray, rays: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distance along each ray (inf where it misses) and the place a, b on the plane."""
        a_axis, b_axis = np.array(self.axis_a), np.array(self.axis_b)
        normal = np.cross(a_axis, b_axis)
        slope = rays @ normal
        slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        distance = ((np.array(self.centre) - origin) @ normal) / slope
        place = origin + distance[..., None] * rays - np.array(self.centre)
        a, b = place @ a_axis, place @ b_axis
        seen = (distance > 1e-3) & (np.abs(a) <= self.half_a) & (np.abs(b) <= self.half_b)
        return np.where(seen, distance, np.inf), a, b


GROUND = Plane((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
#: Something like a rover's view: ground, a wall far ahead, a few boards that stand about.
TRAVERSE = (
    GROUND,
    Plane((40.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    Plane((6.0, 1.8, 0.5), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), 0.8, 0.7),
    Plane((9.0, -2.6, 0.8), (0.3, 0.954, 0.0), (0.0, 0.0, 1.0), 1.2, 1.0),
    Plane((14.0, 3.5, 1.0), (-0.2, 0.98, 0.0), (0.0, 0.0, 1.0), 1.5, 1.4),
)


@dataclass(frozen=True)
class Scene:
    """Planes, the camera that looks at them and the errors of its rectification.

    `vertical_px` is ``v_left - v_right``, `disparity_px` the constant in
    ``D = D_true + disparity_px``: what the images show, against what they should.
    """

    planes: tuple[Plane, ...] = TRAVERSE
    camera: StereoCamera = CAMERA
    vertical_px: float = 0.0
    disparity_px: float = 0.0
    noise: float = 1.5
    _grey: float = field(default=14.0)

    def frame(
        self, map_T_camera: FloatArray, index: int = 0, stamp_s: float | None = None
    ) -> StereoFrame:
        """Render the stereo pair that a camera at this pose takes."""
        camera = self.camera
        right = map_T_camera @ pose(np.eye(3), [camera.baseline_m, 0.0, 0.0])
        rng = np.random.default_rng((7, index))
        return StereoFrame(
            index,
            0.5 * index if stamp_s is None else stamp_s,
            self._render(map_T_camera, camera.cx, camera.cy, rng),
            self._render(right, camera.cx - self.disparity_px, camera.cy - self.vertical_px, rng),
            camera,
        )

    def depth(self, map_T_camera: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
        """True z in left-camera axes at left-image pixels, m."""
        distance, _ = self._cast(map_T_camera, u, v, self.camera.cx, self.camera.cy)
        return distance.min(axis=0)

    def _cast(
        self, map_T_camera: FloatArray, u: FloatArray, v: FloatArray, cx: float, cy: float
    ) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
        camera = self.camera
        rays = np.stack([(u - cx) / camera.fx, (v - cy) / camera.fy, np.ones_like(u)], axis=-1)
        hits = [
            plane.hit(map_T_camera[:3, 3], rays @ map_T_camera[:3, :3].T) for plane in self.planes
        ]
        return np.stack([hit[0] for hit in hits]), [hit[1:] for hit in hits]

    def _render(
        self, map_T_camera: FloatArray, cx: float, cy: float, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        camera = self.camera
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        distance, places = self._cast(map_T_camera, u, v, cx, cy)
        nearest, depth = distance.argmin(axis=0), distance.min(axis=0)
        image = np.full(u.shape, 20.0)
        for k, (plane, (a, b)) in enumerate(zip(self.planes, places, strict=True)):
            here = (nearest == k) & np.isfinite(depth)
            if not here.any():
                continue
            rows, columns = np.flatnonzero(here.any(axis=1)), np.flatnonzero(here.any(axis=0))
            box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            here, z = here[box], np.where(here[box], depth[box], 1.0)
            a, b = np.where(here, a[box], 0.0), np.where(here, b[box], 0.0)
            # metres on the plane that one pixel spans where it spans most
            normal = np.cross(plane.axis_a, plane.axis_b)
            to_plane = abs((np.array(plane.centre) - map_T_camera[:3, 3]) @ normal)
            footprint = np.maximum(z**2 / max(to_plane, 1e-3), z) / camera.fx
            finest = float(footprint[here].min())
            texture = np.zeros(here.shape, np.float32)
            for tile, wavelength in zip(_TILES, _WAVELENGTHS_M, strict=True):
                if wavelength <= 2.0 * finest:
                    continue
                weight = np.clip(wavelength / (4.0 * footprint) - 0.5, 0.0, 1.0)
                px = _TILE / (_WAVES * wavelength)
                shift = 137.0 * k
                texture += weight.astype(np.float32) * cv2.remap(
                    tile,
                    np.mod(a * px + shift, _TILE).astype(np.float32),
                    np.mod(b * px + shift, _TILE).astype(np.float32),
                    cv2.INTER_LINEAR,
                )
            image[box][here] = 110.0 + 12.0 * (k % 3) + self._grey * texture[here]
        image += self.noise * rng.standard_normal(image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def rover_T_camera(height_m: float = 1.0, down_rad: float = 0.35) -> FloatArray:
    """Pose of a camera on a mast that looks forward and down."""
    return pose(so3_exp([0.0, down_rad, 0.0]), [0.0, 0.0, height_m]) @ level_rover_T_camera()


def arc(count: int, step_m: float = 0.08, turn_rad: float = 0.01) -> FloatArray:
    """``map_T_rover`` of a rover that drives an arc on level ground, (count, 4, 4)."""
    step = pose(so3_exp([0.0, 0.0, turn_rad]), [step_m, 0.0, 0.0])
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def sequence(
    poses: FloatArray, scene: Scene | None = None, mount: FloatArray | None = None
) -> list[StereoFrame]:
    """Render the frames that the rover takes at these poses."""
    scene = scene or Scene()
    mount = rover_T_camera() if mount is None else mount
    return [scene.frame(map_T_rover @ mount, k) for k, map_T_rover in enumerate(poses)]


def write_drive(
    folder: Path,
    poses: FloatArray,
    *,
    first: int = 0,
    first_s: float = 0.0,
    wheels: bool = False,
    scene: Scene | None = None,
) -> Path:
    """A drive in the folder format: images, truth, and if asked wheels and attitude."""
    folder.mkdir(parents=True)
    rows = ["frame,stamp_s,left,right"]
    stamps = first_s + 0.5 * np.arange(len(poses))
    for k, frame in enumerate(sequence(poses, scene)):
        name = f"{first + k:03d}.png"
        for side, image in (("left", frame.left), ("right", frame.right)):
            (folder / side).mkdir(exist_ok=True)
            assert cv2.imwrite(str(folder / side / name), image)
        rows.append(f"{first + k},{stamps[k]},left/{name},right/{name}")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    camera = {name: getattr(CAMERA, name) for name in CAMERA.__slots__}
    (folder / "traverse.yaml").write_text(
        "schema: lunar-fg/traverse/1\n"
        f"camera: {json.dumps(camera)}\n"
        f"rover_T_camera: {rover_T_camera().tolist()}\n"
    )
    write_tum(folder / "ground_truth.tum", Trajectory(stamps, poses))
    if wheels:
        rng = np.random.default_rng(5)
        steps = ["stamp_s,d_forward_m,d_lateral_m,d_yaw_rad"]
        tilts = ["stamp_s,roll_rad,pitch_rad,yaw_rad,sigma_rp_rad,sigma_yaw_rad"]
        for k in range(len(poses)):
            motion = inverse(poses[max(k - 1, 0)]) @ poses[k]
            yaw, pitch, roll = np.array(yaw_pitch_roll(poses[k])) + 0.002 * rng.normal(size=3)
            x, y, turn = motion[0, 3] * 1.03, motion[1, 3], yaw_pitch_roll(motion)[0]
            steps.append(f"{stamps[k]},{x},{y},{turn}")
            tilts.append(f"{stamps[k]},{roll},{pitch},{yaw},0.002,0.002")
        (folder / "odometry.csv").write_text("\n".join(steps) + "\n")
        (folder / "attitude.csv").write_text("\n".join(tilts) + "\n")
    return folder


@dataclass(frozen=True)
class PointCloud:
    """Landmarks without images: random points that a stereo camera measures with noise."""

    points: FloatArray  # (N, 3), map
    camera: StereoCamera = CAMERA
    sigma_px: float = 0.3
    sigma_disparity_px: float = 0.12

    @classmethod
    def ahead(
        cls, seed: int, count: int = 300, nearest_m: float = 1.0, farthest_m: float = 8.0,
        camera: StereoCamera = CAMERA, **noise: float,
    ) -> PointCloud:  # fmt: skip
        """Points uniform in the image and in inverse depth, in left-camera axes."""
        rng = np.random.default_rng((99, seed))
        u = rng.uniform(10.0, camera.width - 11.0, count)
        v = rng.uniform(10.0, camera.height - 11.0, count)
        z = 1.0 / rng.uniform(1.0 / farthest_m, 1.0 / nearest_m, count)
        disparity = camera.fx * camera.baseline_m / z
        return cls(camera.triangulate(u, v, disparity), camera, **noise)

    def observe(
        self,
        map_T_camera: FloatArray,
        rng: np.random.Generator,
        disparity_error: FloatArray | None = None,
    ):
        """Noisy observations; the row in `points` is the id. `disparity_error`: (3,) field."""
        from frontends.rectification import disparity_basis, observe

        local = transform_points(inverse(map_T_camera), self.points)
        local_ok = local[:, 2] > 0.3
        ids = np.flatnonzero(local_ok)
        u, right, v = self.camera.project(local[ids]).T
        disparity = u - right
        n = len(ids)
        u = u + self.sigma_px * rng.standard_normal(n)
        v = v + self.sigma_px * rng.standard_normal(n)
        if disparity_error is not None:
            disparity = disparity + disparity_basis(self.camera, u, v) @ disparity_error
        disparity = disparity + self.sigma_disparity_px * rng.standard_normal(n)
        keep = (disparity > 4.0 * self.sigma_disparity_px) & self.camera.contains(u, v)
        return observe(
            self.camera,
            ids[keep].astype(np.int64),
            u[keep],
            v[keep],
            disparity[keep],
            np.full(int(keep.sum()), self.sigma_px),
            np.full(int(keep.sum()), self.sigma_disparity_px),
        )
