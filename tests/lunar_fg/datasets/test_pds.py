"""Mars rover images with labels: Spirit's own, and rendered pairs with exact truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archive_files import BASELINE_M, SIZE, label_text, navcams, render, texture, write_product
from dataset_files import refusal_of
from typer.testing import CliRunner

from frontends.errors import InputError
from frontends.geometry import inverse, pose, so3_exp, so3_log
from frontends.measurements import StereoFrame, UnusableFrame, WheelOdometry
from lunar_fg.cli import app
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.pds import PdsDataset
from lunar_fg.datasets.pds_image import read_pixels, read_rover_image
from lunar_fg.datasets.pds_label import FLIP_YZ, read_label
from lunar_fg.navigator import Navigator
from lunar_fg.pointing import compare_pointings

RAW = "2n292280938effb100p0703l0m1.img"
TURNED = "2n292280989effb100p0703l0m1.img"
LINEAR = "2n295663162fflb1dnp1902l0m1.img"
#: Rover steps in label axes: forward and turn.
STEPS = [(0.0, 0.0, 0.0), (0.18, 0.01, 0.02), (0.37, 0.03, 0.05)]
PANS = [0.0, 0.0, 0.12]


@pytest.fixture
def spirit(shared_data: Path) -> Path:
    return shared_data / "mer-navcam-spirit"


def test_spirits_label(spirit: Path) -> None:
    label = read_label(spirit / RAW)
    assert (label.sol, label.site, label.drive) == (1869, 137, 0)
    assert (label.width, label.height, label.bits, label.eye) == (1024, 1024, 12, "left")
    assert label.clock_s == 292280938.496
    assert label.camera is not None
    assert label.camera.focal_px == pytest.approx(1188.3, abs=0.1)
    assert label.sun is not None
    assert label.sun.elevation_deg == pytest.approx(78.801)
    mount = label.rover_T_camera()
    assert mount is not None
    assert mount[2, 3] == pytest.approx(1.233, abs=1e-3)  # 1.2 m above the deck, z up
    assert label.site_T_rover is not None
    assert label.site_T_rover[2, 2] > 0.9  # upright


def test_spirits_pixels_are_12_bits(spirit: Path) -> None:
    label = read_label(spirit / RAW)
    pixels = read_pixels(label)
    assert (np.nanmin(pixels), np.nanmax(pixels)) == (514.0, 4047.0) or np.nanmax(pixels) <= 4095
    grey, missing = read_rover_image(label)
    assert missing == 0.0
    row, column = 300, 700
    expected = 255.0 * np.sqrt(pixels[row, column] / 4095.0)
    assert grey[row, column] == pytest.approx(expected, abs=0.6)


def test_the_linearised_product_has_missing_data_that_is_filled(spirit: Path) -> None:
    label = read_label(spirit / LINEAR)
    assert label.linearised
    assert label.camera is not None
    assert label.camera.o is None
    hole = ~np.isfinite(read_pixels(label))
    grey, share = read_rover_image(label)
    assert share == pytest.approx(hole.mean())
    assert share > 0.001
    assert grey[hole].min() > 30  # not black: no edges to make landmarks of


def test_the_vicar_image_inside_gives_the_same(spirit: Path, tmp_path: Path) -> None:
    for name in (RAW, LINEAR):
        bare = tmp_path / f"{name}.vic"
        bare.write_bytes((spirit / name).read_bytes()[13 * 2048 :])
        inner, outer = read_label(bare), read_label(spirit / name)
        assert (inner.sol, inner.site, inner.drive) == (outer.sol, outer.site, outer.drive)
        assert inner.camera is not None
        assert outer.camera is not None
        np.testing.assert_allclose(inner.camera.h, outer.camera.h)
        np.testing.assert_allclose(inner.site_T_rover, outer.site_T_rover)
        np.testing.assert_array_equal(read_rover_image(inner)[0], read_rover_image(outer)[0])


def test_spirits_two_pointings_turn_as_the_labels_say(spirit: Path) -> None:
    labels = [read_label(spirit / name) for name in (RAW, TURNED)]
    images = [read_rover_image(label)[0] for label in labels]
    a, b = (label.camera for label in labels)
    assert a is not None
    assert b is not None
    found = compare_pointings((images[0], images[1]), (a, b))
    assert found.labelled_deg == pytest.approx(37.30, abs=0.01)
    assert found.matches > 150
    assert found.residual_px < 0.5
    assert found.difference_deg < 0.3  # what the mast's gears leave
    assert found.sigma_deg.max() < 0.1


def test_the_command_says_it_in_degrees(spirit: Path) -> None:
    result = CliRunner().invoke(app, ["pointing", str(spirit / RAW), str(spirit / TURNED)])
    assert result.exit_code == 0
    assert "rotation by the labels 37.30" in result.output


def test_left_eyes_alone_are_no_dataset(spirit: Path) -> None:
    with pytest.raises(InputError, match="no stereo pairs"):
        open_dataset(spirit)


def site_T_rover(step: tuple[float, ...]) -> np.ndarray:
    return pose(so3_exp([0.0, 0.0, step[2]]), [step[0], step[1], 0.0])


@pytest.fixture(scope="module")
def traverse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three stops; the mast has turned before the last."""
    folder, ground = tmp_path_factory.mktemp("pds"), texture()
    for number, (step, pan) in enumerate(zip(STEPS, PANS, strict=True)):
        for eye, camera in zip(("left", "right"), navcams(pan), strict=True):
            half = step[2] / 2
            text = label_text(
                camera, eye, 1000.0 + 60 * number + (0.4 if eye == "right" else 0.0), drive=number,
                offset=(step[0], step[1], 0.0), quaternion=(np.cos(half), 0, 0, np.sin(half)),
            )  # fmt: skip
            pixels = render(camera, site_T_rover(step), ground)
            if number == 1:
                pixels[40:60, 100:140] = 0  # lost packets
            write_product(folder / f"n{eye[0]}_{number}.img", text, pixels)
    return folder


def test_pairs_are_found_by_their_labels(traverse: Path) -> None:
    dataset = open_dataset(traverse)
    assert isinstance(dataset, PdsDataset)
    assert len(dataset) == 3
    assert dataset.camera.baseline_m == pytest.approx(BASELINE_M, rel=1e-3)
    assert dataset.pairs[2].left.identity == "sol 12 site 3 drive 2"
    frames = list(dataset.frames())
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    assert [frame.stamp_s for frame in frames] == [1000.0, 1060.0, 1120.0]
    assert frames[1].odometry is not None
    assert frames[1].odometry.d_forward_m == pytest.approx(0.18, abs=0.003)
    assert frames[0].attitude is not None
    assert abs(frames[0].attitude.roll_rad) < 1e-6
    assert any("mast turned" in note for note in dataset.notes)
    assert [frame.index for frame in dataset.frames(after=0)] == [1, 2]


def test_the_images_drive_the_camera_to_where_it_was(traverse: Path) -> None:
    """Rendered by CAHVOR, rectified by the labels, navigated: the camera's motion to 1 %."""
    dataset = open_dataset(traverse)
    navigator = Navigator(
        dataset.camera, rover_T_camera=dataset.rover_T_camera, start=dataset.start
    )
    for frame in dataset.frames():
        wheels = frame.odometry
        if wheels is not None:  # wheels that slip: what is right comes from the images
            wrong = (0.9 * wheels.d_forward_m, wheels.d_lateral_m + 0.01, 0.9 * wheels.d_yaw_rad)
            frame = replace(frame, odometry=WheelOdometry(*wrong), attitude=None)
        navigator.step(frame)
    navigator.finish()
    got = navigator.trajectory().map_T_rover
    mounts = [FLIP_YZ @ navcams(pan)[0].reference_T_camera() for pan in PANS]
    rovers = [FLIP_YZ @ site_T_rover(step) @ FLIP_YZ for step in STEPS]
    bodies = [rovers[i] @ mounts[i] @ inverse(mounts[0]) for i in range(3)]
    for i in (1, 2):
        error = inverse(inverse(bodies[0]) @ bodies[i]) @ (inverse(got[0]) @ got[i])
        assert np.linalg.norm(error[:3, 3]) < 0.01
        assert np.linalg.norm(so3_log(error[:3, :3])) < 0.005


def test_companded_8_bits_are_kept_and_said(tmp_path: Path) -> None:
    extra = "GROUP = INSTRUMENT_STATE_PARMS\n SAMPLE_BIT_MODE_ID = LUT2\n"
    extra += "END_GROUP = INSTRUMENT_STATE_PARMS\n"
    ground = texture()
    for eye, camera in zip(("left", "right"), navcams(), strict=True):
        text = label_text(camera, eye, 5.0, bits=8, extra=extra)
        pixels = render(camera, np.eye(4), ground)
        write_product(tmp_path / f"{eye}.IMG", text, (pixels // 16).astype(np.uint8))
    dataset = open_dataset(tmp_path)
    assert any("companded" in note for note in dataset.notes)
    label = read_label(tmp_path / "left.IMG")
    assert (label.bits, label.companded) == (8, True)
    np.testing.assert_allclose(
        read_rover_image(label)[0][200], np.maximum(read_pixels(label)[200], 1)
    )


def product(path: Path, change=lambda text: text, pixels: int = SIZE * SIZE) -> Path:
    text = change(label_text(navcams()[0], "left", 1.0))
    return write_product(path / "a.img", text, np.full(pixels, 700, np.uint16))


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        (f"LINES = {SIZE}", "LINES = 2000000000", "states"),
        (f"LINES = {SIZE}", "LINES = -5", "states"),
        ("SAMPLE_BITS = 16", "SAMPLE_BITS = 4096", "bits"),
        ("^IMAGE = 2", '^IMAGE = ("../../../etc/passwd", 1)', "not the name of a file"),
        ("^IMAGE = 2", '^IMAGE = "/vsicurl/http://example.org/x"', "not the name of a file"),
        ("^IMAGE = 2", '^IMAGE = "gone.img"', "does not exist"),
        ("MODEL_TYPE = CAHVOR", "MODEL_TYPE = CAHVORE", "linearised product"),
        ("MODEL_COMPONENT_3 = (", "MODEL_COMPONENT_3 = (1,", "has 4 values"),
        ("MODEL_COMPONENT_2 = (", "OTHER = (", "MODEL_COMPONENT_2 (A)"),
        ("END\n", "", "no END"),
        ("GROUP = GEO", "GROUP = ((((", "no PDS3 label"),
    ],
)
def test_hostile_labels(tmp_path: Path, old: str, new: str, part: str) -> None:
    def change(text: str) -> str:
        assert old in text
        head, _, tail = text.rpartition(old) if old == "END\n" else text.partition(old)
        return head + new + tail

    assert part in refusal_of(read_label, product(tmp_path, change))


def test_a_label_that_never_ends_is_bounded(tmp_path: Path) -> None:
    file = tmp_path / "a.img"
    file.write_bytes(b"PDS_VERSION_ID = PDS3\r\n" + b"A = (" * 400_000)
    assert "no END" in refusal_of(read_label, file)
    file.write_bytes(b"PDS_VERSION_ID = PDS3\r\nA = " + b"(" * 20_000 + b"\r\nEND\r\n")
    assert "no PDS3 label" in refusal_of(read_label, file)


@pytest.mark.parametrize("kept", [1000, 20_000])
def test_a_truncated_image_is_said(tmp_path: Path, kept: int) -> None:
    file = product(tmp_path, pixels=kept)
    assert "cut off" in refusal_of(lambda path: read_rover_image(read_label(path)), file)


def test_an_image_that_is_mostly_missing_costs_its_frame_only(
    traverse: Path, tmp_path: Path
) -> None:
    for file in traverse.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    data = bytearray((tmp_path / "nl_1.img").read_bytes())
    data[4096 : 4096 + len(data) * 2 // 3] = bytes(len(data) * 2 // 3)
    (tmp_path / "nl_1.img").write_bytes(data[: 4096 + 2 * SIZE * SIZE])
    frames = list(open_dataset(tmp_path).frames())
    assert isinstance(frames[1], UnusableFrame)
    assert "sol 12 site 3 drive 1, nl_1.img" in frames[1].reason
    assert "missing" in frames[1].reason


def test_damaged_labels_come_to_an_end(spirit: Path, tmp_path: Path) -> None:
    """Parsers that go on after errors took hours over some of these."""
    data = (spirit / RAW).read_bytes()[:27_000]
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(8):
        broken = bytearray(data)
        for place in rng.integers(0, 14_000, 6):
            broken[place : place + 3] = rng.integers(33, 127, 5, dtype=np.uint8).tobytes()
        (tmp_path / "a.img").write_bytes(bytes(broken))
        refused += bool(refusal_of(read_label, tmp_path / "a.img"))
    assert refused > 0


def test_a_detached_label_of_msl(tmp_path: Path) -> None:
    """MSL writes its groups as ..._PARMS and its labels into files of their own."""
    camera = navcams()[0]
    text = label_text(camera, "left", 77.0, pointer='("NLB_1.IMG", 1)')
    for group in ("GEOMETRIC_CAMERA_MODEL", "ROVER_COORDINATE_SYSTEM"):
        text = text.replace(f"= {group}\n", f"= {group}_PARMS\n")
    (tmp_path / "NLB_1.LBL").write_text(text.replace("\n", "\r\n"))
    pixels = render(camera, np.eye(4), texture())
    (tmp_path / "NLB_1.IMG").write_bytes(pixels.astype(">i2").tobytes())
    label = read_label(tmp_path / "NLB_1.LBL")
    assert label.image.name == "NLB_1.IMG"
    assert label.camera is not None
    assert label.site_T_rover is not None
    np.testing.assert_array_equal(np.nan_to_num(read_pixels(label)), pixels)
