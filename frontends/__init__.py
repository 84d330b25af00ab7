"""Stereo perception, matching, positioning: images to measurements, no graph."""

from frontends.surf import SURF, Keypoints

__all__ = ["SURF", "Keypoints"]
