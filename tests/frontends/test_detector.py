"""Other detectors in SURF's place."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from synthetic import CAMERA, arc, rover_T_camera, sequence

from frontends.detector import OpenCVDetector
from lunar_fg.config import Config
from lunar_fg.navigator import Navigator


@pytest.mark.parametrize("feature2d", [cv2.SIFT_create(1500), cv2.ORB_create(1500)])
def test_a_detector_of_opencv_can_take_the_place_of_surf(feature2d):
    poses = arc(6)
    config = Config.model_validate({"disparity_check": {"mode": "off"}})
    navigator = Navigator(CAMERA, config, rover_T_camera(), detector=OpenCVDetector(feature2d))
    for frame in sequence(poses):
        assert not navigator.step(frame).lost
    navigator.finish()
    error = navigator.trajectory().positions - poses[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.02


def test_descriptors_are_of_unit_length_and_an_empty_image_has_none():
    detector = OpenCVDetector(cv2.ORB_create(100))
    image = np.random.default_rng(0).integers(0, 256, (120, 160), dtype=np.uint8)
    keypoints, descriptors = detector.detectAndCompute(image)
    assert len(keypoints) == len(descriptors) > 0
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=1e-5)
    keypoints, descriptors = detector.detectAndCompute(np.zeros((120, 160), np.uint8))
    assert len(keypoints) == len(descriptors) == 0
