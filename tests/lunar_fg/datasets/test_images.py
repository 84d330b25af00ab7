from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from dataset_files import refusal_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontends.errors import InputError
from lunar_fg.datasets.images import darkness, read_grey, read_header

IMAGE = np.asarray(
    cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 256, (40, 60), dtype=np.uint8), (5, 5), 1.0
    )
)


def encode(image: np.ndarray, suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


@pytest.mark.parametrize(
    ("suffix", "tolerance"), [(".png", 0), (".pgm", 0), (".jpg", 12), (".ppm", 0)]
)
def test_formats(tmp_path, suffix, tolerance):
    path = tmp_path / f"a{suffix}"
    image = cv2.cvtColor(IMAGE, cv2.COLOR_GRAY2BGR) if suffix == ".ppm" else IMAGE
    path.write_bytes(encode(image, suffix))
    assert read_header(path).size == (60, 40)
    grey = read_grey(path, 255)
    assert grey.dtype == np.uint8
    assert np.abs(grey.astype(int) - IMAGE).max() <= tolerance


def test_colour_and_alpha_become_grey(tmp_path):
    for code in (cv2.COLOR_GRAY2BGR, cv2.COLOR_GRAY2BGRA):
        (tmp_path / "a.png").write_bytes(encode(cv2.cvtColor(IMAGE, code), ".png"))
        np.testing.assert_allclose(read_grey(tmp_path / "a.png", 255), IMAGE, atol=1)


def test_sixteen_bits_are_scaled_and_saturate(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(encode(IMAGE.astype(np.uint16) * 16, ".png"))
    assert read_header(path).bits == 16
    np.testing.assert_allclose(read_grey(path, 255 * 16), IMAGE, atol=1)
    assert read_grey(path, 255).max() == 255


def test_a_jpeg_is_not_turned_by_its_exif(tmp_path):
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    data = encode(IMAGE, ".jpg")
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    (tmp_path / "a.jpg").write_bytes(data[:2] + segment + data[2:])
    assert read_grey(tmp_path / "a.jpg", 255).shape == IMAGE.shape


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pgm"])
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(share=st.floats(0.0, 0.999))
def test_every_truncation_is_noticed(tmp_path, suffix, share):
    data = encode(IMAGE, suffix)
    path = tmp_path / "cut"
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=r"cut off|empty|is not a PNG"):
        read_grey(path, 255)


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(at=st.integers(8, 10_000), bit=st.integers(0, 7))
def test_every_flipped_bit_of_a_png_is_noticed(tmp_path, at, bit):
    data = bytearray(encode(IMAGE, ".png"))
    data[at % (len(data) - 8) + 8 if at >= len(data) else at] ^= 1 << bit
    path = tmp_path / "flip"
    path.write_bytes(bytes(data))
    with pytest.raises(InputError):
        read_grey(path, 255)


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    suffix=st.sampled_from([".jpg", ".pgm", ".png"]),
    data=st.binary(max_size=60),
    at=st.integers(0, 700),
)
def test_only_input_errors_escape(tmp_path, suffix, data, at):
    raw = encode(IMAGE, suffix)
    path = tmp_path / "fuzz"
    path.write_bytes(raw[:at] + data + raw[at + len(data) :])
    text = refusal_of(lambda file: read_grey(file, 255), path)
    assert not text or text.startswith(str(path))


def test_a_size_beyond_the_limit_is_refused_before_decoding(tmp_path):
    header = b"IHDR" + struct.pack(">IIBBBBB", 2**31 - 1, 2**31 - 1, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    with pytest.raises(InputError, match="limit"):
        read_grey(tmp_path / "bomb.png", 255)


def test_darkness():
    assert darkness(IMAGE) == ""
    assert "black" in darkness(np.zeros((40, 60), np.uint8))
    assert "black" in darkness((IMAGE // 40).astype(np.uint8))
    assert "no texture" in darkness(np.full((40, 60), 255, np.uint8))
    night = np.full((100, 100), 2, np.uint8)
    night[40:60, 40:60] = IMAGE[:20, :20]
    assert darkness(night) == ""
