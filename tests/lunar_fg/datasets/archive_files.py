"""Rover images as archives hold them: rendered through CAHVOR, written with PDS3 labels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from frontends.cahv import CahvCamera
from frontends.geometry import pose, so3_exp

SIZE = 384
BASELINE_M = 0.2


def navcams(pan_rad: float = 0.0) -> tuple[CahvCamera, CahvCamera]:
    """Left and right CAHVOR Navcams on a mast, in label rover axes (x fwd, y right, z down)."""
    mast = pose(so3_exp([0.0, 0.0, pan_rad]), [0.3, 0.0, -1.3])
    axes = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    found = []
    for side, turn in ((-0.5, [0.003, 0.01, -0.004]), (0.5, [-0.002, -0.008, 0.005])):
        place = mast @ pose(axes @ so3_exp([-0.45, 0.0, 0.0]) @ so3_exp(turn),
                            [0.05, side * BASELINE_M, 0.0])  # fmt: skip
        linear = CahvCamera.linear(
            (SIZE, SIZE), place, (450.0, 449.0), (0.5 * SIZE + 3 * side, 0.5 * SIZE - 4 * side)
        )
        optical = place[:3, :3] @ np.array([0.005 * side, 0.004, 1.0])
        found.append(
            CahvCamera(
                SIZE, SIZE, linear.c, linear.a, linear.h, linear.v,
                o=optical / np.linalg.norm(optical), r=np.array([0.0, -0.05, 0.02]),
            )
        )  # fmt: skip
    return found[0], found[1]


def texture() -> np.ndarray:
    """Ground of 20 m x 20 m at 1 cm, 0 to 1."""
    rng = np.random.default_rng(2)
    layers = [cv2.GaussianBlur(rng.normal(size=(2000, 2000)), (0, 0), s) * s for s in (1.5, 4, 12)]
    found = np.sum(layers, axis=0)
    return np.asarray(np.clip(0.5 + 0.5 * found / (3.0 * found.std()), 0.0, 1.0), dtype=np.float32)


def render(camera: CahvCamera, site_T_rover: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """12-bit image of a bumpy ground; both poses in label axes (z down)."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    rays = rays @ site_T_rover[:3, :3].T
    origin = camera.c @ site_T_rover[:3, :3].T + site_T_rover[:3, 3]
    depth = np.zeros(len(rays))
    for _ in range(30):  # fixed point on z = height(x, y)
        x, y = origin[:2, None] + depth * rays[:, :2].T
        height = -0.15 * np.sin(1.3 * x) * np.cos(1.7 * y)
        depth = np.where(rays[:, 2] > 0.02, (height - origin[2]) / np.maximum(rays[:, 2], 0.02), 0)
    x, y = origin[:2, None] + depth * rays[:, :2].T
    seen = cv2.remap(
        ground, (100.0 * (x + 5.0)).reshape(u.shape).astype(np.float32),
        (100.0 * (y + 10.0)).reshape(u.shape).astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    rng = np.random.default_rng(int(1e3 * abs(origin[0]) + 1e5 * abs(origin[1])))
    return np.clip(400 + 2600 * seen + rng.normal(0, 12, seen.shape), 1, 4095).astype(np.uint16)


def label_text(
    camera: CahvCamera, eye: str, clock_s: float, *, drive: int = 0, site: int = 3,
    offset: tuple[float, ...] = (0.0, 0.0, 0.0), quaternion: tuple[float, ...] = (1.0, 0, 0, 0),
    bits: int = 16, pointer: str = "2", extra: str = "",
) -> str:  # fmt: skip
    """A label like the archive's, one record."""

    def vector(values: np.ndarray) -> str:
        return "(" + ",".join(f"{value:.9g}" for value in values) + ")"

    kind = "CAHV" if camera.o is None else "CAHVOR"
    vectors = [camera.c, camera.a, camera.h, camera.v]
    if camera.o is not None and camera.r is not None:
        vectors += [camera.o, camera.r]
    model = "".join(f" MODEL_COMPONENT_{n} = {vector(c)}\n" for n, c in enumerate(vectors, 1))
    mask = "2#0000111111111111#" if bits == 16 else "2#11111111#"
    return (
        "PDS_VERSION_ID = PDS3\nRECORD_TYPE = FIXED_LENGTH\nRECORD_BYTES = 4096\n"
        f"FILE_RECORDS = 99\nLABEL_RECORDS = 1\n^IMAGE = {pointer}\n"
        f'INSTRUMENT_ID = "NAVCAM_{eye.upper()}"\nFRAME_ID = "{eye.upper()}"\n'
        f"PLANET_DAY_NUMBER = 12\nROVER_MOTION_COUNTER = ({site},{drive},0,1,2)\n"
        f'SPACECRAFT_CLOCK_START_COUNT = "{clock_s:.3f}"\nGEOMETRY_PROJECTION_TYPE = RAW\n'
        f"GROUP = GEOMETRIC_CAMERA_MODEL\n MODEL_TYPE = {kind}\n{model}"
        "END_GROUP = GEOMETRIC_CAMERA_MODEL\n"
        "GROUP = ROVER_COORDINATE_SYSTEM\n"
        f" ORIGIN_OFFSET_VECTOR = {vector(np.array(offset))}\n"
        f" ORIGIN_ROTATION_QUATERNION = {vector(np.array(quaternion))}\n"
        " QUATERNION_MEASUREMENT_METHOD = FINE\nEND_GROUP = ROVER_COORDINATE_SYSTEM\n"
        "GROUP = SITE_DERIVED_GEOMETRY_PARMS\n SOLAR_AZIMUTH = 131.5 <deg>\n"
        " SOLAR_ELEVATION = 48.8 <deg>\nEND_GROUP = SITE_DERIVED_GEOMETRY_PARMS\n"
        f"{extra}OBJECT = IMAGE\n LINES = {camera.height}\n LINE_SAMPLES = {camera.width}\n"
        f" SAMPLE_TYPE = {'MSB_INTEGER' if bits == 16 else 'UNSIGNED_INTEGER'}\n"
        f" SAMPLE_BITS = {bits}\n BANDS = 1\n MISSING_CONSTANT = 0\n INVALID_CONSTANT = 0\n"
        f" SAMPLE_BIT_MASK = {mask}\nEND_OBJECT = IMAGE\nEND\n"
    )


def write_product(path: Path, text: str, pixels: np.ndarray) -> Path:
    """Label, padded to a record of 4096 bytes, then the pixels, most significant byte first."""
    assert len(text) <= 4096
    data = pixels.astype(">i2" if pixels.dtype != np.uint8 else np.uint8).tobytes()
    path.write_bytes(text.replace("\n", "\r\n").encode().ljust(4096)[:4096] + data)
    return path
