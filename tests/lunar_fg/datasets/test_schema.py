from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_files import refusal_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frontends.camera import level_rover_T_camera
from frontends.errors import InputError
from lunar_fg.datasets.schema import JSON_SCHEMA_PATH, json_schema_text, read_traverse

CAMERA = "camera: {width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, baseline_m: 0.1}"
HEAD = f"schema: lunar-fg/traverse/1\n{CAMERA}\n"
FULL = (
    HEAD
    + """\
rover_T_camera: [[0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 1.2], [0, 0, 0, 1]]
map: {crs: "IAU_2015:30135", origin: [1000, -2000, 15.5]}
start: {map_T_rover: [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]],
        sigma_rot_rad: [1e-2, 0.01, 0.05], sigma_trans_m: [1, 1, 1]}
orbital: {ortho: o.tif, dem: d.tif, sun_azimuth_deg: 290, sun_elevation_deg: 35}
sun: {azimuth_deg: 205, elevation_deg: 18}
"""
)


def read(tmp_path: Path, text: str):
    path = tmp_path / "traverse.yaml"
    path.write_text(text)
    return read_traverse(path)


def message(tmp_path: Path, text: str) -> str:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert "traverse.yaml" in str(caught.value)
    assert caught.value.remedy
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_full_example(tmp_path):
    traverse = read(tmp_path, FULL)
    assert traverse.camera.build().baseline_m == 0.1
    assert traverse.camera_mount()[2, 3] == 1.2
    assert traverse.start_prior().sigma_rot_rad == (0.01, 0.01, 0.05)
    assert traverse.start_prior().map_T_rover[0, 3] == 5.0
    assert traverse.map_reference().origin_m == (1000.0, -2000.0, 15.5)
    assert traverse.sun_direction().azimuth_deg == 205.0
    assert traverse.orbital.sun().elevation_deg == 35.0


def test_the_defaults(tmp_path):
    traverse = read(tmp_path, HEAD)
    np.testing.assert_array_equal(traverse.camera_mount(), level_rover_T_camera())
    np.testing.assert_array_equal(traverse.start_prior().map_T_rover, np.eye(4))
    assert traverse.map_reference() is None
    assert traverse.sun_direction() is None


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (HEAD.replace("baseline_m", "baseline"), ["camera.baseline:", "did you mean 'baseline_m'"]),
        (HEAD + "rover_T_cam: 1\n", ["rover_T_cam:", "did you mean 'rover_T_camera'"]),
        (HEAD + "sun: {azimut_deg: 1, elevation_deg: 2}\n", ["sun.azimut_deg", "azimuth_deg"]),
        (HEAD.replace("fx: 50", "fx: .nan"), ["camera.fx", "nan", "finite"]),
        (HEAD.replace("fx: 50", "fx: .inf"), ["camera.fx", "inf"]),
        (HEAD.replace("fx: 50", "fx: -50"), ["camera.fx", "-50", "greater than 0"]),
        (HEAD.replace("fx: 50", "fx: '50'"), ["camera.fx", "valid number"]),
        (HEAD.replace("fx: 50, ", ""), ["camera.fx", "missing"]),
        (HEAD.replace("width: 64", "width: 64.5"), ["camera.width", "integer"]),
        (HEAD.replace("traverse/1", "traverse/2"), ["schema", "lunar-fg/traverse/1"]),
        (CAMERA, ["schema", "missing"]),
        (
            HEAD + "rover_T_camera: [[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]",
            ["rover_T_camera", "rigid"],
        ),
        (HEAD + "rover_T_camera: [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]", ["rigid"]),
        (HEAD + "rover_T_camera: [[1,0,0],[0,1,0],[0,0,1]]", ["rover_T_camera"]),
        (HEAD + "start: {sigma_rot_rad: [0, 1, 1]}", ["start.sigma_rot_rad[0]", "greater than 0"]),
        (HEAD + "orbital: {sun_azimuth_deg: 1}", ["orbital", "neither"]),
        (HEAD + "orbital: {dem: a, sun_azimuth_deg: 1}", ["orbital", "go together"]),
        (HEAD + CAMERA, ["line 3", "'camera' is there twice"]),
        (HEAD + "sun: &a {azimuth_deg: 1}\nmap: *a\n", ["line 4", "aliases (*a)"]),
        (HEAD + "sun: " + "[" * 5000, ["nested deeper"]),
        (HEAD + "sun: !!python/object/apply:os.system [ls]", ["line 3", "tags", "not allowed"]),
        (HEAD.replace("fx: 50", "fx: !!timestamp 50"), ["line 2", "tags"]),
        (HEAD.replace("fx: 50", "fx: 0x" + "9" * 5000), ["line 2", "longer than"]),
        (HEAD.replace("fx: 50", "fx: " + "9" * 500), ["camera.fx", "999..."]),
        (HEAD + "sun: {a: 1\n", ["line"]),
        (HEAD + "sun: 2001-99-99\n", ["not YAML"]),
        ("", ["holds no keys"]),
        ("- 1\n", ["holds no keys"]),
        ("a: 1\n" * 300_000, ["bytes"]),
    ],
)
def test_one_line_names_field_and_remedy(tmp_path, text, parts):
    text_of_error = message(tmp_path, text)
    for part in parts:
        assert part in text_of_error


def test_not_text_and_not_there(tmp_path):
    (tmp_path / "traverse.yaml").write_bytes(b"\xff\xfe\x00a")
    with pytest.raises(InputError, match="UTF-8"):
        read_traverse(tmp_path / "traverse.yaml")
    with pytest.raises(InputError, match=r"none\.yaml.*cannot be read"):
        read_traverse(tmp_path / "none.yaml")


def test_the_shipped_json_schema_is_up_to_date():
    assert JSON_SCHEMA_PATH.read_text() == json_schema_text(), (
        "write json_schema_text() to lunar_fg/datasets/traverse.schema.json"
    )


fuzz = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


tokens = st.sampled_from(
    [
        "{",
        "]",
        ": ",
        ", ",
        "\n",
        "- ",
        "? ",
        "&a ",
        "*a",
        "!!int ",
        "!!timestamp ",
        "!x ",
        "<<: ",
        "'",
        '"',
        "|\n",
        "%YAML 1.1\n",
        "---\n",
        "0x" + "9" * 5000,
        "2001-01-01",
        "1_0",
        "\0",
        "\t",
    ]
).map(str.encode)


@fuzz
@given(data=st.binary(max_size=80) | tokens, at=st.integers(0, len(FULL)), drop=st.integers(0, 30))
def test_only_input_errors_escape_from_bytes(tmp_path, data, at, drop):
    path = tmp_path / "traverse.yaml"
    path.write_bytes(FULL.encode()[:at] + data + FULL.encode()[at + drop :])
    assert "\n" not in refusal_of(read_traverse, path)


scalars = st.sampled_from(
    ["1", "1e400", "-0", "null", "~", "true", ".nan", "{}", "[]", "'x'", "0x", "1:2:3", "<<"]
)


@fuzz
@given(values=st.lists(scalars, min_size=8, max_size=8))
def test_only_input_errors_escape_from_values(tmp_path, values):
    keys = ["fx", "width", "baseline_m", "cx"]
    text = "schema: lunar-fg/traverse/1\ncamera: {" + ", ".join(
        f"{key}: {value}" for key, value in zip(keys, values, strict=False)
    )
    text += f"}}\nstart: {values[4]}\nmap: {values[5]}\nrover_T_camera: {values[6]}\n{values[7]}: 1"
    path = tmp_path / "traverse.yaml"
    path.write_text(text)
    text_of_error = refusal_of(read_traverse, path)
    assert text_of_error
    assert "\n" not in text_of_error
