"""Stereo perception, matching, positioning: images to measurements, no graph."""
