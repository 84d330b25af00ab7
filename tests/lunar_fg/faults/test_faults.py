"""Every fault does what its name says, at the frames it is told to, by its seed."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from synthetic import CAMERA, arc, rover_T_camera

from frontends.errors import InputError
from frontends.measurements import Attitude, StartPrior, StereoFrame, UnusableFrame, WheelOdometry
from lunar_fg.datasets.base import GroundTruth, OrbitalFiles
from lunar_fg.faults import FAULTS, FaultyDataset, parse_fault

COUNT = 12
SPAN = range(4, 8)


def frames():
    rng = np.random.default_rng(0)
    made = []
    for k in range(COUNT):
        left = rng.integers(60, 120, (CAMERA.height, CAMERA.width), dtype=np.uint8)
        right = np.roll(left, -5, axis=1)
        made.append(
            StereoFrame(
                k,
                float(k),
                left,
                right,
                CAMERA,
                WheelOdometry(0.1, 0.0, 0.01),
                Attitude(0.0, 0.0, 0.0, 0.002, 0.5),
            )
        )
    return made


FRAMES = frames()


@dataclass
class Recorded:
    orbital: OrbitalFiles | None = None
    name: str = "recorded"
    path: Path = Path("recorded")
    camera = CAMERA
    rover_T_camera = rover_T_camera()
    start = StartPrior()
    map_reference = None
    notes = ()
    ground_truth = GroundTruth.of_poses(np.arange(COUNT, dtype=float), arc(COUNT))

    def __len__(self):
        return COUNT

    def frames(self):
        return iter(FRAMES)


def with_fault(name, tmp_path, seed=5, recorded=None):
    fault = parse_fault(f"{name}@{SPAN.start}-{SPAN.stop - 1}")
    return FaultyDataset(recorded or Recorded(), [fault], seed, tmp_path)


def same(a, b):
    return (
        type(a) is type(b)
        and (a.index, a.stamp_s, a.odometry, a.attitude)
        == (b.index, b.stamp_s, b.odometry, b.attitude)
        and (
            isinstance(a, UnusableFrame)
            or (np.array_equal(a.left, b.left) and np.array_equal(a.right, b.right))
        )
    )


CHANGES_FRAMES_IN_SPAN = [
    "frozen", "eye-lost", "dust", "exposure", "blur", "misalignment", "slip", "attitude-bias",
    "wheels-only", "clock-back",
]  # fmt: skip


@pytest.mark.parametrize("name", CHANGES_FRAMES_IN_SPAN)
def test_only_frames_of_the_span_change(name, tmp_path):
    changed = list(with_fault(name, tmp_path).frames())
    assert [not same(a, b) for a, b in zip(FRAMES, changed, strict=True)] == [
        k in SPAN for k in range(COUNT)
    ]


@pytest.mark.parametrize("name", [name for name in FAULTS if not name.startswith("map")])
def test_a_seed_gives_the_same_fault_again(name, tmp_path):
    dataset = with_fault(name, tmp_path)
    first, second = list(dataset.frames()), list(dataset.frames())
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    assert any("injected fault" in note for note in dataset.notes)
    assert len(dataset) == COUNT


def test_frozen_cameras_repeat_the_last_image(tmp_path):
    changed = list(with_fault("frozen", tmp_path).frames())
    assert all(np.array_equal(changed[k].left, FRAMES[3].left) for k in SPAN)


def test_a_lost_eye_is_black(tmp_path):
    changed = list(with_fault("eye-lost", tmp_path).frames())
    assert not any(changed[k].right.any() for k in SPAN)
    assert all(np.array_equal(changed[k].left, FRAMES[k].left) for k in SPAN)


def test_misalignment_grows_to_its_end(tmp_path):
    changed = list(with_fault("misalignment", tmp_path).frames())
    assert np.array_equal(changed[7].right[:-6], FRAMES[7].right[6:])
    middle = np.abs(changed[5].right[:-3].astype(int) - FRAMES[5].right[3:]).max()
    assert middle == 0


def test_slip_adds_five_metres_in_all(tmp_path):
    driven = sum(f.odometry.d_forward_m for f in with_fault("slip", tmp_path).frames())
    assert driven == pytest.approx(0.1 * COUNT + 5.0)


def test_dropped_frames_leave_their_wheel_motion_to_the_next(tmp_path):
    arrived = list(with_fault("dropped", tmp_path).frames())
    assert [f.index for f in arrived] == [0, 1, 2, 3, 8, 9, 10, 11]
    assert arrived[4].odometry.d_yaw_rad == pytest.approx(0.05)
    assert arrived[4].odometry.d_forward_m == pytest.approx(0.5, abs=1e-3)


def test_a_kidnapped_rover_has_not_turned_its_wheels(tmp_path):
    arrived = list(with_fault("kidnapped", tmp_path).frames())
    assert [f.index for f in arrived] == [0, 1, 2, 3, 8, 9, 10, 11]
    assert arrived[4].odometry.d_forward_m == pytest.approx(0.1)


def test_swapped_frames(tmp_path):
    assert [f.index for f in with_fault("swapped", tmp_path).frames()] == [
        0, 1, 2, 3, 5, 4, 7, 6, 8, 9, 10, 11,
    ]  # fmt: skip


def test_wheels_only(tmp_path):
    arrived = list(with_fault("wheels-only", tmp_path).frames())
    for k in SPAN:
        assert isinstance(arrived[k], UnusableFrame)
        assert arrived[k].attitude is None
        assert arrived[k].odometry == FRAMES[k].odometry


def test_the_truth_keeps_the_clock_that_jumps(tmp_path):
    dataset = with_fault("clock-jump", tmp_path)
    assert [f.stamp_s for f in dataset.frames()] == dataset.ground_truth.stamp_s.tolist()
    assert dataset.ground_truth.stamp_s[4] - dataset.ground_truth.stamp_s[3] > 1000.0


def test_a_wrong_baseline_is_wrong_everywhere(tmp_path):
    dataset = with_fault("baseline", tmp_path)
    assert dataset.camera.baseline_m == pytest.approx(1.02 * CAMERA.baseline_m)
    assert all(f.camera == dataset.camera for f in dataset.frames())


@pytest.mark.parametrize("name", ["map-place", "map-scale", "map-rotated", "map-seam"])
def test_wrong_maps(name, tmp_path):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (60, 80)).astype(np.uint8)
    path = tmp_path / "ortho.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=80, height=60, count=1, dtype="uint8",
        transform=from_origin(1000.0, 2000.0, 0.5, 0.5),
    ) as sink:  # fmt: skip
        sink.write(image, 1)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    recorded = Recorded(orbital=OrbitalFiles(path, None, None))
    dataset = with_fault(name, scratch, recorded=recorded)
    assert dataset.orbital.ortho != path
    with rasterio.open(path) as true, rasterio.open(dataset.orbital.ortho) as wrong:
        assert wrong.transform == true.transform
        assert not np.array_equal(wrong.read(1), true.read(1))
    assert with_fault(name, scratch).orbital is None


def test_faults_add_up(tmp_path):
    faults = [parse_fault("blur@2-5"), parse_fault("wheels-only@4-6")]
    arrived = list(FaultyDataset(Recorded(), faults, 1, tmp_path).frames())
    assert [isinstance(f, UnusableFrame) for f in arrived] == [k in (4, 5, 6) for k in range(12)]
    assert not same(arrived[2], FRAMES[2])


def test_frames_without_the_sensor_pass(tmp_path):
    bare = [replace(f, odometry=None, attitude=None) for f in FRAMES]

    class Bare(Recorded):
        def frames(self):
            return iter(bare)

    for name in ("slip", "attitude-bias", "dropped"):
        assert list(with_fault(name, tmp_path, recorded=Bare()).frames())


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("blurr@3-5", "blur"),
        ("blur", "NAME@FIRST-LAST"),
        ("blur@5-3", "ends before"),
        ("blur@-1", "cannot be read"),
    ],
)
def test_what_cannot_be_read_is_named(text, names):
    with pytest.raises(InputError, match=names):
        parse_fault(text)


def test_one_frame_is_a_span():
    assert len(parse_fault("blur@7").span) == 1
