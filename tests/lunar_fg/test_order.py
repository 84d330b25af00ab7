"""Frames in order, each once, all from one camera."""

import math
from dataclasses import replace

import numpy as np
import pytest
from synthetic import CAMERA

from frontends.errors import InputError
from frontends.measurements import StereoFrame, UnusableFrame, WheelOdometry
from lunar_fg.order import FrameOrder, InOrder

IMAGE = np.zeros((CAMERA.height, CAMERA.width), np.uint8)


def stereo(index, stamp_s, camera=CAMERA):
    return StereoFrame(index, stamp_s, IMAGE, IMAGE, camera)


def unusable(index, stamp_s):
    return UnusableFrame(index, stamp_s, "left image missing")


def order_after(*frames):
    order = FrameOrder(CAMERA)
    for frame in frames:
        order.check(frame)
        order.accept(frame)
    return order


@pytest.mark.parametrize("make", [stereo, unusable])
def test_frames_in_order_pass_with_gaps_and_any_first_stamp(make):
    order_after(make(0, -3.5), make(1, -3.4999), make(2, 0.0), make(40, 1e9))
    order_after(make(7, 0.0))


@pytest.mark.parametrize("make", [stereo, unusable])
@pytest.mark.parametrize(
    ("index", "stamp_s", "field"),
    [
        (4, 9.0, "index"),
        (5, 9.0, "index"),
        (-1, 9.0, "index"),
        (6, 2.5, "stamp_s"),
        (6, 2.4, "stamp_s"),
        (6, -np.inf, "stamp_s"),
        (6, np.inf, "stamp_s"),
        (6, np.nan, "stamp_s"),
    ],
)
def test_what_does_not_follow_is_named(make, index, stamp_s, field):
    order = order_after(stereo(5, 2.5))
    with pytest.raises(InputError) as caught:
        order.check(make(index, stamp_s))
    assert caught.value.field == field
    assert caught.value.source == f"frame {index}"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("make", [stereo, unusable])
def test_the_first_frame_too_must_have_a_number_and_a_time(make):
    for index, stamp_s in ((-1, 0.0), (0, np.nan), (0, np.inf), (0, -np.inf)):
        with pytest.raises(InputError):
            FrameOrder(CAMERA).check(make(index, stamp_s))


@pytest.mark.parametrize(
    "change",
    [{"baseline_m": 0.2}, {"width": 640}, {"fx": 240.5}, {"cy": 0.0}],
    ids=lambda change: next(iter(change)),
)
def test_another_camera_is_named(change):
    order = FrameOrder(CAMERA)
    with pytest.raises(InputError, match="navigator") as caught:
        order.check(stereo(0, 0.0, replace(CAMERA, **change)))
    assert caught.value.field == "camera"
    order.check(stereo(0, 0.0, replace(CAMERA)))  # equal, not the same object


def test_looking_is_not_taking_in():
    """A frame that was checked and then failed may come again, or another in its place."""
    order = order_after(stereo(0, 0.0))
    for _ in range(2):
        order.check(stereo(8, 8.0))
    order.check(stereo(1, 0.5))


def test_a_refused_frame_changes_nothing():
    order = order_after(stereo(3, 1.0))
    for bad in (stereo(2, 5.0), stereo(9, 0.5), stereo(9, np.nan)):
        with pytest.raises(InputError):
            order.check(bad)
    order.check(stereo(4, 1.5))
    with pytest.raises(InputError):
        order.check(stereo(3, 1.5))


def test_unusable_frames_count():
    order = order_after(stereo(0, 0.0), unusable(1, 0.5))
    for bad in (stereo(1, 1.0), stereo(2, 0.5)):
        with pytest.raises(InputError):
            order.check(bad)
    order.check(stereo(2, 1.0))


def test_late_frames_are_left_out_and_their_wheels_counted():
    def at(index, stamp_s):
        return replace(unusable(index, stamp_s), odometry=WheelOdometry(1.0, 0.0, math.pi / 2))

    frames = InOrder([at(0, 0.0), at(2, 2.0), at(1, 1.0), at(3, 1.5), at(4, 4.0), at(5, 5.0)])
    kept = list(frames)
    assert [frame.index for frame in kept] == [0, 2, 4, 5]
    # three quarter turns of a metre each: back to one metre left of the start
    turned = kept[2].odometry
    assert (turned.d_forward_m, turned.d_lateral_m) == pytest.approx((0.0, 1.0), abs=1e-9)
    assert turned.d_yaw_rad == pytest.approx(1.5 * math.pi)
    assert kept[3].odometry.d_forward_m == 1.0
    assert frames.warnings == (
        "frames 1 to 3: came after a later one, or with an earlier stamp: left out",
    )


def test_wheels_that_were_not_all_read_are_not_made_up():
    first, late, last = unusable(1, 1.0), unusable(0, 0.5), unusable(2, 2.0)
    last = replace(last, odometry=WheelOdometry(1.0, 0.0, 0.0))
    assert list(InOrder([first, late, last]))[1].odometry is None


def test_frames_that_never_came_and_pauses_are_told_of():
    indices = [0, 2, 4, 12, 14, 16, 18]
    stamps = [0.0, 1.0, 2.0, 6.0, 7.0, 900.0, 901.0]
    frames = InOrder([stereo(i, t) for i, t in zip(indices, stamps, strict=True)])
    assert len(list(frames)) == 7
    missing, pause = frames.warnings
    assert missing.startswith("frames 6 to 10: never came")
    assert pause.startswith("frame 16: 893 s after the frame before")


def test_a_frame_that_comes_late_has_come():
    frames = InOrder([stereo(i, float(i)) for i in (0, 1, 3, 2, 4)])
    assert [frame.index for frame in frames] == [0, 1, 3, 4]
    [late] = frames.warnings
    assert "came after a later one" in late


def test_a_dataset_without_gaps_is_not_told_of():
    frames = InOrder([stereo(5 * i, 3.0 * i + 0.5 * (i % 3)) for i in range(20)])
    assert len(list(frames)) == 20
    assert frames.warnings == ()
