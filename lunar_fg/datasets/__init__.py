"""Dataset readers: whatever the format, the same stereo frames."""

from lunar_fg.datasets.base import Dataset, GroundTruth, MapReference, OrbitalFiles
from lunar_fg.datasets.opening import open_dataset

__all__ = ["Dataset", "GroundTruth", "MapReference", "OrbitalFiles", "open_dataset"]
