"""Image files to grey arrays: bounded, and nothing half-decoded passes.

OpenCV decodes a truncated PNG or JPEG to a partly black image without an error, so the
file's own structure is checked first: PNG chunks with their checksums up to the end
mark, JPEG segments up to the end mark, the byte count of PGM and PPM.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.measurements import Image

MAX_PIXELS = 100_000_000
MAX_BYTES = 700_000_000
SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm")

#: A pixel above this grey level counts as lit.
DARK_LEVEL = 10
#: An image with a smaller share of lit pixels is black.
MIN_LIT_SHARE = 1e-3
#: An image with a smaller standard deviation (grey levels) has no texture.
MIN_DEVIATION = 1.0

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 1 << 20
#: Start-of-frame markers of JPEG: all of C0-CF but the tables C4, C8 and CC.
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PNM = re.compile(rb"P([56])(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})"
                  rb"(?:\s|#[^\n]*\n)+(\d{1,5})\s")  # fmt: skip


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Size in pixels and bits a channel, as the file's header states them."""

    kind: str
    width: int
    height: int
    bits: int
    data_offset: int
    """Where the pixel data or the chunks after the header begin, bytes."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.width, self.height


def read_header(path: Path) -> ImageHeader:
    """Header of an image file, without decoding it.

    Raises
    ------
    InputError
        When the file cannot be read or has no header of a known format.
    """
    return _parse_header(_read_bytes(path, _HEADER_BYTES), path)


def read_grey(path: Path, white_level: int) -> Image:
    """Decode an image to grey, uint8, (height, width).

    Parameters
    ----------
    path
        PNG, JPEG, PGM or PPM; colour is converted.
    white_level
        16-bit values are scaled so that this one becomes 255; larger ones saturate.

    Raises
    ------
    InputError
        When the file is missing, unknown, truncated, corrupt or too large.
    """
    return _to_8_bits(_decode(_read_bytes(path), path), white_level)


def decode_grey(data: bytes, name: str, white_level: int) -> Image:
    """`read_grey` for the bytes of an image file that came some other way, e.g. in a message."""
    if not 0 < len(data) <= MAX_BYTES:
        raise InputError(f"holds {len(data)} bytes", source=name)
    return _to_8_bits(_decode(data, Path(name)), white_level)


def _to_8_bits(grey: NDArray[Any], white_level: int) -> Image:
    if grey.dtype == np.uint16:
        return np.asarray(cv2.convertScaleAbs(grey, alpha=255.0 / white_level), dtype=np.uint8)
    return np.ascontiguousarray(grey, dtype=np.uint8)


def read_peak(path: Path) -> int:
    """Largest grey value of an image as it is stored."""
    return int(_decode(_read_bytes(path), path).max())


def darkness(image: Image) -> str:
    """Why an image shows nothing (black, or without any texture); empty when it does."""
    lit = np.count_nonzero(image > DARK_LEVEL) / image.size
    if lit < MIN_LIT_SHARE:
        return f"is black: {100.0 * lit:.2f} % of the pixels are above grey {DARK_LEVEL} of 255"
    deviation = float(cv2.meanStdDev(image)[1].item())
    if deviation < MIN_DEVIATION:
        return f"has no texture: its grey levels spread by {deviation:.2f} of 255"
    return ""


def _read_bytes(path: Path, limit: int | None = None) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1 if limit is None else limit)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", source=path) from error
    if len(data) > MAX_BYTES:
        raise InputError(f"has more than {MAX_BYTES} bytes", source=path)
    if not data:
        raise InputError("is an empty file", source=path)
    return data


def _parse_header(data: bytes, path: Path) -> ImageHeader:
    header: ImageHeader | None = None
    if data.startswith(_PNG_SIGNATURE):
        if len(data) >= 33 and data[12:16] == b"IHDR":
            width, height, bits = struct.unpack_from(">IIB", data, 16)
            header = ImageHeader("PNG", width, height, bits, len(_PNG_SIGNATURE))
    elif data.startswith(b"\xff\xd8"):
        header = _jpeg_header(data)
    elif match := _PNM.match(data):
        kind = {b"5": "PGM", b"6": "PPM"}[match[1]]
        bits = 8 if int(match[4]) < 256 else 16
        header = ImageHeader(kind, int(match[2]), int(match[3]), bits, match.end())
    else:
        raise InputError("is not a PNG, JPEG, PGM or PPM image", source=path)
    if header is None:
        raise InputError("is cut off or corrupt in its header", source=path)
    if not 0 < header.width * header.height <= MAX_PIXELS:
        raise InputError(
            f"states a size of {header.width}x{header.height} px; the limit is {MAX_PIXELS} pixels",
            source=path,
        )
    return header


def _jpeg_header(data: bytes) -> ImageHeader | None:
    position, header = 2, None
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4])
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker in _JPEG_FRAME_MARKERS and position + 9 <= len(data):
            bits, height, width = struct.unpack_from(">BHH", data, position + 4)
            header = ImageHeader("JPEG", width, height, bits, 0)
        if marker == 0xDA and header is not None:  # start of scan
            return ImageHeader("JPEG", header.width, header.height, header.bits, position)
        position += 2 + max(length, 2)
    return header


def _check_complete(data: bytes, header: ImageHeader, path: Path) -> None:
    if header.kind == "PNG":
        _check_png(data, path)
    elif header.kind == "JPEG":
        # 0xFF in a scan is followed by 0x00, so the end mark cannot be pixel data.
        if data.find(b"\xff\xd9", header.data_offset) < 0:
            raise InputError("is cut off: the JPEG end mark is missing", source=path)
    else:
        channels = 3 if header.kind == "PPM" else 1
        needed = header.width * header.height * channels * (header.bits // 8)
        given = len(data) - header.data_offset
        if given < needed:
            raise InputError(f"is cut off: {given} of {needed} pixel bytes", source=path)


def _check_png(data: bytes, path: Path) -> None:
    position, view = len(_PNG_SIGNATURE), memoryview(data)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        kind, end = data[position + 4 : position + 8], position + 12 + length
        if end > len(data):
            break
        (stated,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(view[position + 4 : end - 4]) != stated:
            name = kind.decode("ascii", "replace")
            raise InputError(f"is corrupt: wrong checksum in PNG chunk {name!a}", source=path)
        if kind == b"IEND":
            return
        position = end
    raise InputError("is cut off: the PNG end mark is missing", source=path)


def _decode(data: bytes, path: Path) -> NDArray[Any]:
    header = _parse_header(data, path)
    _check_complete(data, header, path)
    try:
        # UNCHANGED keeps 16 bits, and pixels where the calibration has them (no EXIF turn).
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError("cannot be decoded", source=path) from error
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError("cannot be decoded to 8 or 16 bits", source=path)
    if image.shape[:2] != (header.height, header.width):
        raise InputError("decodes to another size than its header states", source=path)
    if image.ndim == 3:
        conversions = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
        channels = image.shape[2]
        image = (
            cv2.cvtColor(image, conversions[channels]) if channels in conversions else image[..., 0]
        )
    return image
