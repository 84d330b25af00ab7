"""Calibration files of other tools; all describe the same pair."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_files import refusal_of

from frontends.distortion import Lens, LensCamera
from frontends.errors import InputError
from frontends.geometry import inverse, pose, so3_exp
from frontends.undistort import StereoCalibration
from lunar_fg.datasets.calibrations import read_calibration

SIZE = (640, 480)
LENS = (-0.28, 0.07, 0.0002, -0.0001)
LEFT = LensCamera(*SIZE, 460.0, 461.0, 320.5, 241.0, Lens.RADTAN, LENS)
RIGHT = LensCamera(*SIZE, 458.0, 459.5, 318.0, 239.0, Lens.RADTAN, tuple(0.9 * v for v in LENS))
LEFT_T_RIGHT = pose(so3_exp([0.01, -0.02, 0.003]), [0.12, 0.001, -0.002])
BODY_T_LEFT = pose(so3_exp([0.3, 1.2, -0.5]), [0.1, -0.2, 0.05])


def rows(matrix: np.ndarray) -> str:
    return "[" + ", ".join(f"{float(value)!r}" for value in np.ravel(matrix)) + "]"


def kalibr(path: Path, lens: str = "radtan", scale: float = 1.0) -> list[Path]:
    text = ""
    for number, eye in enumerate((LEFT, RIGHT)):
        text += (
            f"cam{number}:\n  camera_model: pinhole\n  distortion_model: {lens}\n"
            f"  distortion_coeffs: {rows(np.array(eye.coefficients))}\n"
            f"  intrinsics: {rows(np.array([eye.fx, eye.fy, eye.cx, eye.cy]))}\n"
            f"  resolution: [{eye.width}, {eye.height}]\n  rostopic: /cam{number}/image_raw\n"
        )
        if number:
            cells = inverse(LEFT_T_RIGHT)
            text += "  T_cn_cnm1:\n" + "".join(f"  - {rows(scale * row)}\n" for row in cells)
    (path / "camchain.yaml").write_text(text)
    return [path / "camchain.yaml"]


def euroc(path: Path) -> list[Path]:
    for number, (eye, left_T_eye) in enumerate(((LEFT, np.eye(4)), (RIGHT, LEFT_T_RIGHT))):
        folder = path / f"cam{number}"
        folder.mkdir(exist_ok=True)
        (folder / "sensor.yaml").write_text(
            "%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
            f"  data: {rows(BODY_T_LEFT @ left_T_eye)}\n"
            f"resolution: [{eye.width}, {eye.height}]\ncamera_model: pinhole\n"
            f"intrinsics: {rows(np.array([eye.fx, eye.fy, eye.cx, eye.cy]))}\n"
            "distortion_model: radial-tangential\n"
            f"distortion_coefficients: {rows(np.array(eye.coefficients))}\n"
        )
    return [path / "cam0" / "sensor.yaml"]


def stereo_rectify() -> tuple[np.ndarray, ...]:
    right_T_left = inverse(LEFT_T_RIGHT)
    found = cv2.stereoRectify(
        LEFT.matrix, np.array(LEFT.coefficients), RIGHT.matrix, np.array(RIGHT.coefficients),
        SIZE, right_T_left[:3, :3], right_T_left[:3, 3:], alpha=0,
    )  # fmt: skip
    return tuple(np.asarray(value) for value in found[:4])


def camera_info(path: Path) -> list[Path]:
    r1, r2, p1, p2 = stereo_rectify()
    for name, eye, turn, projection in (("left", LEFT, r1, p1), ("right", RIGHT, r2, p2)):
        (path / f"{name}.yaml").write_text(
            f"image_width: {eye.width}\nimage_height: {eye.height}\ncamera_name: {name}\n"
            f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {rows(eye.matrix)}\n"
            "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
            f"  data: {rows(np.array([*eye.coefficients, 0.0]))}\n"
            f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: {rows(turn)}\n"
            f"projection_matrix:\n  rows: 3\n  cols: 4\n  data: {rows(projection)}\n"
        )
    return [path / "left.yaml"]


def opencv_storage(path: Path, name: str = "stereo.yml", mode: int = 0) -> list[Path]:
    storage = cv2.FileStorage(str(path / name), cv2.FILE_STORAGE_WRITE | mode)
    right_T_left = inverse(LEFT_T_RIGHT)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    for key, value in (
        ("M1", LEFT.matrix), ("D1", np.array([LEFT.coefficients])),
        ("M2", RIGHT.matrix), ("D2", np.array([RIGHT.coefficients])),
        ("R", right_T_left[:3, :3]), ("T", right_T_left[:3, 3:]),
    ):  # fmt: skip
        storage.write(key, value)
    storage.release()
    return [path / name]


def opencv_xml(path: Path) -> list[Path]:
    return opencv_storage(path, "stereo.xml")


def opencv_two_files(path: Path) -> list[Path]:
    """As OpenCV's stereo sample writes: intrinsics.yml and extrinsics.yml."""
    text = opencv_storage(path)[0].read_text()
    head, body = text.split("M1:", 1)
    inner, outer = body.split("\nR:", 1)
    (path / "intrinsics.yml").write_text(f"{head}M1:{inner}\n")
    (path / "extrinsics.yml").write_text(f"%YAML:1.0\n---\nR:{outer}")
    (path / "stereo.yml").unlink()
    return [path / "intrinsics.yml"]


def tsai(path: Path) -> list[Path]:
    for name, eye, pose_ in (
        ("rig_left.tsai", LEFT, BODY_T_LEFT),
        ("rig_right.tsai", RIGHT, BODY_T_LEFT @ LEFT_T_RIGHT),
    ):
        k1, k2, p1, p2 = eye.coefficients
        turn = " ".join(repr(float(value)) for value in pose_[:3, :3].ravel())
        centre = " ".join(repr(float(value)) for value in pose_[:3, 3])
        (path / name).write_text(
            f"fu = {eye.fx}\nfv = {eye.fy}\ncu = {eye.cx}\ncv = {eye.cy}\n"
            "u_direction = 1 0 0\nv_direction = 0 1 0\nw_direction = 0 0 1\n"
            f"C = {centre}\nR = {turn}\nk1 = {k1}\nk2 = {k2}\np1 = {p1}\np2 = {p2}\n"
        )
    return [path / "rig_left.tsai"]


@pytest.mark.parametrize(
    "write", [kalibr, euroc, camera_info, opencv_storage, opencv_xml, opencv_two_files, tsai]
)
def test_every_format_gives_the_same_pair(write, tmp_path: Path) -> None:
    found = read_calibration(write(tmp_path), SIZE)
    for got, expected in ((found.left, LEFT), (found.right, RIGHT)):
        assert isinstance(got, LensCamera)
        assert (got.width, got.height) == SIZE
        np.testing.assert_allclose(got.matrix, expected.matrix)
        np.testing.assert_allclose(got.coefficients[:4], expected.coefficients)
    np.testing.assert_allclose(found.left_T_right, LEFT_T_RIGHT, atol=1e-9)


def test_equidistant_lenses_of_kalibr(tmp_path: Path) -> None:
    found = read_calibration(kalibr(tmp_path, "equidistant"), SIZE)
    assert isinstance(found.left, LensCamera)
    assert found.left.lens is Lens.EQUIDISTANT


def test_a_rectified_kitti_calibration(tmp_path: Path) -> None:
    file = tmp_path / "calib.txt"
    file.write_text("P0: 50 0 31 0 0 50 23 0 0 0 1 0\nP1: 50 0 31 -5 0 50 23 0 0 0 1 0\n")
    camera = read_calibration([file], SIZE).rectified_camera()
    assert camera is not None
    assert (camera.fx, camera.cx, camera.baseline_m) == (50.0, 31.0, pytest.approx(0.1))


def test_the_k10_rover_files(shared_data: Path) -> None:
    found = read_calibration([shared_data / "k10-stereo" / "black_left.tsai"], (1024, 768))
    assert found.baseline_m == pytest.approx(0.10575, abs=1e-4)
    assert found.left_T_right[0, 3] == pytest.approx(0.1056, abs=1e-4)


def text_error(path: Path, text: str, name: str = "a.yaml") -> str:
    (path / name).write_text(text)
    problem = refusal_of(lambda file: read_calibration([file], SIZE), path / name)
    assert problem, "was read"
    assert "\n" not in problem
    return problem


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "aliases"),
        ("cam0: !!python/object/apply:os.system ['true']\n", "tags"),
        ("M1: !!opencv-matrix\n  rows: 3\n  data: !!python/name:os.system x\n", "tags"),
        ("hello: 1\n", "no known stereo calibration"),
        ("[1, 2]\n", "no named values"),
        ("cam0: {camera_model: omni}\ncam1: {T_cn_cnm1: [1]}\n", "16"),
        ("cam0: 3\ncam1: 4\n", "cam1"),
        ("T_BS: {rows: 4, cols: 4, data: [1]}\n", "one camera"),
    ],
)
def test_hostile_and_wrong_yaml(tmp_path: Path, text: str, part: str) -> None:
    assert part in text_error(tmp_path, text)


def test_hostile_xml_is_not_expanded(tmp_path: Path) -> None:
    bomb = '<?xml version="1.0"?><!DOCTYPE z [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'
    text = f"{bomb}<opencv_storage><M1>&b;</M1></opencv_storage>"
    assert "document type" in text_error(tmp_path, text, "a.xml")
    assert "not XML" in text_error(tmp_path, "<opencv_storage><M1>", "a.xml")


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("resolution: [640, 480]", "resolution: [640000000, 480]", "resolution"),
        ("resolution: [640, 480]", "resolution: [641, 480]", "the images have 640x480"),
        ("pinhole", "omni", "only pinhole"),
        ("radtan", "fov", "no known lens model"),
        ("460.0", "-460.0", "intrinsics"),
        ("460.0", ".nan", "finite"),
        ("-0.28", "-0.28, 0.1, 0.2", "distortion coefficients"),
    ],
)
def test_wrong_values_are_named(tmp_path: Path, old: str, new: str, part: str) -> None:
    text = kalibr(tmp_path)[0].read_text()
    assert old in text
    assert part in text_error(tmp_path, text.replace(old, new, 1))


def test_a_pose_in_millimetres_or_of_no_rotation(tmp_path: Path) -> None:
    kalibr(tmp_path, scale=2.0)
    assert "not a rigid transform" in text_error(tmp_path, (tmp_path / "camchain.yaml").read_text())


def test_a_truncated_file_is_named(tmp_path: Path) -> None:
    text = opencv_storage(tmp_path)[0].read_text()
    for end in range(0, len(text) - 40, 37):
        text_error(tmp_path, text[:end])


def test_one_file_of_two_says_what_is_missing(tmp_path: Path) -> None:
    first = tsai(tmp_path)[0]
    (tmp_path / "rig_right.tsai").unlink()
    with pytest.raises(InputError, match="calibration of one camera"):
        read_calibration([first], SIZE)


def test_exchanged_eyes_are_said(tmp_path: Path) -> None:
    left = tsai(tmp_path)[0]
    with pytest.raises(InputError, match="exchange the two cameras"):
        read_calibration([left.with_name("rig_right.tsai"), left], SIZE)


def test_a_rectified_pair_needs_no_maps() -> None:
    assert StereoCalibration(LEFT, LEFT, LEFT_T_RIGHT).rectified_camera() is None
