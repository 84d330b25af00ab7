"""Labels of Mars rover images: PDS3 (attached or detached) and bare VICAR, to what is needed.

Rover axes in labels are x forward, y right, z down, site axes x north, y east, z down. Here
the rover's are x forward, y left, z up, and the map's x east, y north, z up.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from frontends.cahv import CahvCamera
from frontends.errors import InputError
from frontends.geometry import pose
from frontends.measurements import SunDirection
from lunar_fg.datasets.label_text import LabelGroup, read_label_text

FloatArray = NDArray[np.float64]

MAX_SIDE = 20_000
_CAMERA_GROUPS = ("GEOMETRIC_CAMERA_MODEL", "GEOMETRIC_CAMERA_MODEL_PARMS")
_ROVER_GROUPS = ("ROVER_COORDINATE_SYSTEM", "ROVER_COORDINATE_SYSTEM_PARMS")
_SITE_GROUPS = ("SITE_DERIVED_GEOMETRY_PARMS",)
_COMPONENTS = {"CAHV": "CAHV", "CAHVOR": "CAHVOR"}
#: Forward-right-down to forward-left-up, and its own inverse.
FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
#: North-east-down to east-north-up.
ENU_T_NED = np.array(
    [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True, slots=True)
class RoverLabel:
    """What the label of a rover image says.

    Attributes
    ----------
    path, image
        File of the label, and file that holds the pixels, in the same folder.
    driver
        GDAL's name for the format.
    width, height, bits
        Of the image; `bits` in use of each sample.
    missing
        Values that stand for no data.
    companded
        Whether 12 bits were brought to 8 by a look-up table on board.
    instrument, eye, linearised
        Camera name without its side, ``"left"``, ``"right"`` or ``""``, and whether the lens
        was taken out.
    sol, site, drive
        Where and when the rover was; None where the label does not say.
    clock_s
        Spacecraft clock at the start of the exposure.
    camera
        In label rover axes; None without a camera model.
    site_T_rover
        (4, 4) rover pose in the site frame (east, north, up), or None.
    fine_attitude
        Whether the attitude was measured with the Sun, not only carried along.
    sun
        In the site frame.
    """

    path: Path
    image: Path
    driver: str
    width: int
    height: int
    bits: int
    missing: tuple[float, ...]
    companded: bool
    instrument: str
    eye: str
    linearised: bool
    sol: int | None
    site: int | None
    drive: int | None
    clock_s: float
    camera: CahvCamera | None
    site_T_rover: FloatArray | None
    fine_attitude: bool
    sun: SunDirection | None

    @property
    def identity(self) -> str:
        """Sol, site and drive in words."""
        parts = (("sol", self.sol), ("site", self.site), ("drive", self.drive))
        return " ".join(f"{name} {value}" for name, value in parts if value is not None)

    def rover_T_camera(self) -> FloatArray | None:
        """(4, 4) pose of the camera axes in the rover (x forward, y left, z up)."""
        if self.camera is None:
            return None
        return np.asarray(FLIP_YZ @ self.camera.reference_T_camera())


def read_label(path: Path) -> RoverLabel:
    """Read the label of a rover image.

    Parameters
    ----------
    path
        Image with its label attached, or a detached label.

    Raises
    ------
    InputError
        When it cannot be read or is no such label; when it names a file outside its folder;
        when the image would be too large, or the camera model is one that is not supported
        (CAHVORE).
    """
    label, vicar = read_label_text(path)
    if vicar:
        return _build(path, path, "VICAR", label)
    return _build(path, _pixels_of(path, label), "PDS", label)


def _pixels_of(path: Path, values: LabelGroup) -> Path:
    """File of the pixels: the label's own, or one that it names beside itself."""
    pointer = values.values.get("^IMAGE")
    if isinstance(pointer, list | tuple) and pointer:
        pointer = pointer[0]
    if pointer is None:
        raise InputError(
            "points to no image", source=path, field="^IMAGE", remedy="give a label of an image"
        )
    if not isinstance(pointer, str):
        return path
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,200}", pointer):
        raise InputError(
            f"{pointer[:100]!a} is not the name of a file beside the label",
            source=path,
            field="^IMAGE",
            remedy="labels from untrusted places may name anything: it is not opened",
        )
    for name in (pointer, pointer.lower(), pointer.upper()):
        if (path.parent / name).is_file():
            return path.parent / name
    raise InputError(
        f"{pointer} does not exist", source=path, field="^IMAGE", remedy="copy it beside the label"
    )


def _build(path: Path, image: Path, driver: str, label: LabelGroup) -> RoverLabel:
    pixels = label.group("IMAGE")
    if not pixels.values:  # detached labels of MSL wrap it
        pixels = label.group("UNCOMPRESSED_FILE").group("IMAGE")
    width, height, bits = (
        pixels.whole(name) or 0 for name in ("LINE_SAMPLES", "LINES", "SAMPLE_BITS")
    )
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE) or bits not in (8, 16, 32):
        raise InputError(
            f"states {width}x{height} px of {bits} bits",
            source=path,
            field="IMAGE",
            remedy=f"8, 16 or 32 bits and at most {MAX_SIDE} px a side can be read",
        )
    missing = {
        value
        for name in ("MISSING_CONSTANT", "INVALID_CONSTANT")
        for value in pixels.numbers(name) or []
    }
    counter = label.numbers("ROVER_MOTION_COUNTER") or []
    rover = label.group(*_ROVER_GROUPS)
    names = f"{label.text('INSTRUMENT_ID')} {label.text('FRAME_ID')}".lower()
    eye = next((side for side in ("left", "right") if side in names), "")
    modes = [
        label.group(group).text("SAMPLE_BIT_MODE_ID")
        for group in ("INSTRUMENT_STATE_PARMS", "INSTRUMENT_STATE", "IMAGE_REQUEST_PARMS")
    ]
    clock = re.match(r"(?:\d/)?(\d+(?:\.\d+)?)", label.text("SPACECRAFT_CLOCK_START_COUNT"))
    if clock is None:
        raise InputError(
            "is missing", source=path, field="SPACECRAFT_CLOCK_START_COUNT",
            remedy="give products of a rover's archive",
        )  # fmt: skip
    return RoverLabel(
        path=path,
        image=image,
        driver=driver,
        width=width,
        height=height,
        bits=_bits_used(pixels, bits),
        missing=tuple(sorted(missing)) or (0.0,),
        companded=bits == 8 and any("LUT" in mode.upper() for mode in modes),
        instrument=re.sub(r"_?(left|right)", "", label.text("INSTRUMENT_ID").lower()),
        eye=eye,
        linearised="LINEAR" in label.text("GEOMETRY_PROJECTION_TYPE").upper(),
        sol=label.whole("PLANET_DAY_NUMBER"),
        site=int(counter[0]) if counter else None,
        drive=int(counter[1]) if len(counter) > 1 else None,
        clock_s=float(clock[1]),
        camera=_camera(path, label.group(*_CAMERA_GROUPS), (width, height)),
        site_T_rover=_rover_pose(path, rover),
        fine_attitude=rover.text("QUATERNION_MEASUREMENT_METHOD").upper() in ("FINE", "SUNFIND"),
        sun=_sun(label.group(*_SITE_GROUPS)),
    )


def _bits_used(pixels: LabelGroup, bits: int) -> int:
    """Bits of a sample that are in use, by ``SAMPLE_BIT_MASK`` (``2#0000111111111111#``)."""
    mask = pixels.values.get("SAMPLE_BIT_MASK")
    if isinstance(mask, int) and 0 < mask < 1 << bits:
        return mask.bit_length()
    if isinstance(mask, str) and (match := re.match(r"2#([01]{1,32})#", mask)):
        return max(1, int(match[1], 2).bit_length())
    return 12 if bits == 16 else bits


def _camera(path: Path, model: LabelGroup, size: tuple[int, int]) -> CahvCamera | None:
    kind = model.text("MODEL_TYPE").upper()
    if not kind or kind in ("NONE", "N/A", "UNK"):
        return None
    if kind not in _COMPONENTS:
        raise InputError(
            f"camera model {kind[:20]!a} is not supported",
            source=path,
            field="MODEL_TYPE",
            remedy="CAHV and CAHVOR are; a CAHVORE camera has no single centre: give the "
            "linearised product (FFL, LINEARIZED)",
        )
    vectors = []
    for number, letter in enumerate(kind, start=1):
        vector = model.numbers(f"MODEL_COMPONENT_{number}", 3)
        if vector is None:
            raise InputError(
                "is missing", source=path, field=f"MODEL_COMPONENT_{number} ({letter})",
                remedy="the label is damaged: fetch the product again",
            )  # fmt: skip
        vectors.append(np.array(vector))
    try:
        return CahvCamera(*size, *vectors)
    except InputError as error:
        raise InputError(error.problem, source=path, field=error.field) from error


def _rover_pose(path: Path, group: LabelGroup) -> FloatArray | None:
    offset = group.numbers("ORIGIN_OFFSET_VECTOR", 3)
    quaternion = group.numbers("ORIGIN_ROTATION_QUATERNION", 4)
    if offset is None or quaternion is None:
        return None
    if abs(math.hypot(*quaternion) - 1.0) > 1e-2:
        raise InputError(
            f"has norm {math.hypot(*quaternion):.3g}, must be 1",
            source=path,
            field="ORIGIN_ROTATION_QUATERNION",
        )
    w, x, y, z = quaternion
    ned_T_frd = pose(Rotation.from_quat([x, y, z, w]).as_matrix(), offset)
    return np.asarray(ENU_T_NED @ ned_T_frd @ FLIP_YZ)


def _sun(group: LabelGroup) -> SunDirection | None:
    azimuth, elevation = (group.numbers(f"SOLAR_{name}", 1) for name in ("AZIMUTH", "ELEVATION"))
    if azimuth is None or elevation is None:
        return None
    return SunDirection(azimuth[0], elevation[0])
