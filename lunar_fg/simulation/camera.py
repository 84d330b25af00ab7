"""Stereo pictures of a scene: rays of a pair, exposure, blur, noise, eight bits."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.geometry import pose, so3_exp
from frontends.measurements import Image, SunDirection
from lunar_fg.simulation.sampling import View
from lunar_fg.simulation.scene import Scene
from lunar_fg.simulation.spec import CameraSpec

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]

#: The brightest share of the lit ground that auto-exposure looks at.
_BRIGHT_PERCENTILE = 99.0


@dataclass(frozen=True, slots=True)
class StereoPicture:
    """One rendered pair.

    Attributes
    ----------
    left, right
        uint8, (height, width).
    depth
        (height, width) float32: z in the left camera at the pixel centres, m, NaN in the
        sky; None unless asked for.
    """

    left: Image
    right: Image
    depth: Float32 | None


def stereo_camera(spec: CameraSpec) -> StereoCamera:
    """The ideal rectified pair that a spec describes."""
    focal = 0.5 * spec.width / np.tan(np.deg2rad(0.5 * spec.field_of_view_deg))
    return StereoCamera(
        spec.width,
        spec.height,
        float(focal),
        float(focal),
        0.5 * (spec.width - 1),
        0.5 * (spec.height - 1),
        spec.baseline_m,
    )


def camera_mount(spec: CameraSpec) -> FloatArray:
    """``rover_T_camera`` of the left camera, (4, 4)."""
    tilt = np.deg2rad(spec.down_tilt_deg)
    s, c = np.sin(tilt), np.cos(tilt)
    rotation = [[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]]
    return pose(rotation, [spec.forward_m, 0.5 * spec.baseline_m, spec.up_m])


def take_pair(
    scene: Scene,
    map_T_camera: FloatArray,
    spec: CameraSpec,
    sun: SunDirection,
    rng: np.random.Generator,
    *,
    depth: bool = False,
) -> StereoPicture:
    """Render one stereo pair.

    Parameters
    ----------
    scene
        What to look at.
    map_T_camera
        (4, 4) pose of the left camera.
    spec
        The cameras.
    sun
        The light.
    rng
        Of the noise.
    depth
        Whether to find the left depth as well.
    """
    map_T_right = map_T_camera @ pose(np.eye(3), [spec.baseline_m, 0.0, 0.0])
    if spec.vertical_misalignment_px:
        # the right camera looks up: what it sees appears lower
        focal = stereo_camera(spec).fy
        nod = np.arctan(spec.vertical_misalignment_px / focal)
        map_T_right = map_T_right @ pose(so3_exp([nod, 0.0, 0.0]), np.zeros(3))
    middles, rays = _unit_rays(spec, 1), _unit_rays(spec, spec.supersampling)
    views = [_radiance(scene, eye, middles, rays, spec, sun) for eye in (map_T_camera, map_T_right)]
    gain = _exposure(views[0], spec)
    left, right = (_expose(view, gain, spec, rng) for view in views)
    return StereoPicture(left, right, _depth(scene, map_T_camera, spec) if depth else None)


def pixel_rays(spec: CameraSpec, oversampling: int) -> FloatArray:
    """Camera-frame rays with z = 1, (height * k, width * k, 3), of k x k points a pixel."""
    camera, k = stereo_camera(spec), oversampling
    u = (np.arange(spec.width * k) + 0.5) / k - 0.5
    v = (np.arange(spec.height * k) + 0.5) / k - 0.5
    grid_u, grid_v = np.meshgrid(u, v)
    if spec.k1 or spec.k2:
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        distortion = np.array([spec.k1, spec.k2, 0.0, 0.0])
        pixels = np.stack([grid_u.ravel(), grid_v.ravel()], axis=1)[:, None, :]
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        ideal = cv2.undistortPoints(pixels, matrix, distortion, R=None, P=None, criteria=criteria)
        x, y = ideal[:, 0, 0].reshape(grid_u.shape), ideal[:, 0, 1].reshape(grid_u.shape)
    else:
        x, y = (grid_u - camera.cx) / camera.fx, (grid_v - camera.cy) / camera.fy
    rays = np.ones((*x.shape, 3))
    rays[..., 0], rays[..., 1] = x, y
    return rays


def _unit_rays(spec: CameraSpec, oversampling: int) -> Float32:
    """`pixel_rays` of unit length."""
    rays = pixel_rays(spec, oversampling)
    x, y = rays[..., 0], rays[..., 1]
    rays *= (1.0 / np.sqrt(1.0 + x * x + y * y))[..., None]
    return rays.astype(np.float32)


def _radiance(
    scene: Scene,
    map_T_camera: FloatArray,
    middles: Float32,
    rays: Float32,
    spec: CameraSpec,
    sun: SunDirection,
) -> Float32:
    """Radiance factor in each pixel, blurred by the optics, (height, width)."""
    k = spec.supersampling
    turn = map_T_camera[:3, :3].T.astype(np.float32)
    origin = (map_T_camera[:3, 3] - scene.middle).astype(np.float32)
    view = View.of(scene, sun, spec.fill_light, origin, middles @ turn)
    picture = view.radiance(rays @ turn, k, 1.0 / (stereo_camera(spec).fx * k))
    if spec.psf_sigma_px > 0.0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), spec.psf_sigma_px * k), np.float32)
    blocks = picture.reshape(spec.height, k, spec.width, k)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def _depth(scene: Scene, map_T_camera: FloatArray, spec: CameraSpec) -> Float32:
    rays = _unit_rays(spec, 1).reshape(-1, 3)
    origins = np.empty(rays.shape, dtype=np.float32)
    origins[:] = map_T_camera[:3, 3] - scene.middle
    hits = scene.trace(origins, rays @ map_T_camera[:3, :3].T.astype(np.float32))
    depth = np.where(hits.part >= 0, hits.distance * rays[:, 2], np.float32(np.nan))
    return depth.astype(np.float32).reshape(spec.height, spec.width)


def _exposure(picture: Float32, spec: CameraSpec) -> float:
    """Electrons a unit of radiance, so that the brightest ground is near white."""
    seen = picture[picture > 0.0]
    bright = float(np.percentile(seen, _BRIGHT_PERCENTILE)) if len(seen) else 0.0
    return spec.exposure * spec.full_well_e / max(bright, 1e-6)


def _expose(picture: Float32, gain: float, spec: CameraSpec, rng: np.random.Generator) -> Image:
    """Electrons with shot and read noise, clipped at white, as eight bits."""
    electrons = gain * picture.astype(np.float64)
    sigma = np.sqrt(electrons + spec.read_noise_e**2)
    electrons += sigma * rng.standard_normal(picture.shape)
    return np.clip(np.rint(electrons * (255.0 / spec.full_well_e)), 0, 255).astype(np.uint8)
