"""A rover that sees itself: its parts neither stop a drive, nor does a moving arm start one."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic import CAMERA, arc, rover_T_camera, sequence

from lunar_fg.config import Config
from lunar_fg.navigator import Navigator

MOUNT = rover_T_camera()
POSES = arc(8, step_m=0.15)
#: A quarter of a metre away: the ground in the picture begins behind.
DISPARITY = 70


def paint(seed=0):
    """Texture wide enough for both images and for moving about."""
    rng = np.random.default_rng(seed)
    grain = cv2.GaussianBlur(rng.standard_normal((CAMERA.height, CAMERA.width + 300)), (0, 0), 1.5)
    return np.clip(128 + 40 * grain / grain.std(), 0, 255).astype(np.uint8)


def covered(frame, share, shift=0):
    """The lower part of both images shows something of the rover's."""
    texture, top = paint(), int((1 - share) * CAMERA.height)
    left, right = frame.left.copy(), frame.right.copy()
    for image, at in ((left, 150), (right, 150 + DISPARITY)):
        image[top:] = texture[top:, at + shift : at + shift + CAMERA.width]
    return replace(frame, left=left, right=right)


def drive(frames):
    navigator = Navigator(CAMERA, Config(), MOUNT)
    for frame in frames:
        navigator.step(frame)
    navigator.finish()
    return navigator


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_deck_in_the_picture_does_not_stop_the_drive(share):
    navigator = drive([covered(frame, share) for frame in sequence(POSES)])
    found = navigator.trajectory().map_T_rover[-1, :3, 3]
    assert navigator.frames_lost == 0
    assert np.linalg.norm(found - POSES[-1][:3, 3]) < 0.03 * np.linalg.norm(POSES[-1][:3, 3])


def test_an_arm_that_moves_does_not_move_a_standing_rover():
    (frame,) = sequence(POSES[:1])
    frames = [
        replace(covered(frame, 0.25, shift=-4 * k), index=k, stamp_s=float(k)) for k in range(6)
    ]
    navigator = drive(frames)
    assert np.abs(navigator.trajectory().map_T_rover[-1, :3, 3]).max() < 2e-3
