"""Calibration files of other tools: whatever the format, the same `StereoCalibration`."""

from lunar_fg.datasets.calibrations.reading import FORMATS, read_calibration

__all__ = ["FORMATS", "read_calibration"]
