"""Pictures of any kind become 8-bit BGR, pixel for pixel where they are stored."""

import warnings

import cv2
import numpy as np
import pytest

from frontends.errors import InputError
from lunar_fg.pictures import grey, read_picture, write_picture


def test_colour_and_grey_pass_unchanged(tmp_path):
    colour = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    write_picture(tmp_path / "colour.png", colour)
    np.testing.assert_array_equal(read_picture(tmp_path / "colour.png"), colour)
    cv2.imwrite(str(tmp_path / "grey.png"), colour[..., 0])
    read = read_picture(tmp_path / "grey.png")
    assert read.shape == (20, 30, 3)
    np.testing.assert_array_equal(grey(read), colour[..., 0])


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_more_bits_are_scaled_to_the_bright_end_not_to_the_brightest_pixel(tmp_path, suffix):
    stored = np.tile(np.arange(4096, dtype=np.uint16), (16, 1))
    stored[0, 0] = 65535  # a glint
    path = tmp_path / f"deep.{suffix}"
    assert cv2.imwrite(str(path), stored)
    read = grey(read_picture(path))
    assert read[0, 0] == 255
    np.testing.assert_allclose(read[8], stored[8] * (255 / 4095), atol=1.0)


def test_a_navcam_product_of_the_archive_is_read(shared_data):
    path = shared_data / "mer-navcam-spirit" / "2n292280989effb100p0703l0m1.img"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = grey(read_picture(path))
    assert read.shape == (1024, 1024)
    assert 40 < np.median(read) < 160, "12 bits are scaled to 8"


def test_what_is_no_image_is_refused(tmp_path):
    path = tmp_path / "label.img"
    path.write_text("PDS_VERSION_ID = PDS3\nEND\n")
    with pytest.raises(InputError, match=r"label\.img.*cannot be read"):
        read_picture(path)
    with pytest.raises(InputError, match=r"absent\.img"):
        read_picture(tmp_path / "absent.img")
    (tmp_path / "cut.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(InputError, match=r"cut\.png"):
        read_picture(tmp_path / "cut.png")
