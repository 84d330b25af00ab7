"""Feature matching: nearest neighbours, search windows, RANSAC between images."""

from frontends.matching.epipolar import EpipolarGeometry, find_fundamental
from frontends.matching.homography import ImageTransform, find_homography, find_similarity
from frontends.matching.nearest import Matches, match_descriptors
from frontends.matching.windows import SearchWindows, match_in_windows

__all__ = [
    "EpipolarGeometry",
    "ImageTransform",
    "Matches",
    "SearchWindows",
    "find_fundamental",
    "find_homography",
    "find_similarity",
    "match_descriptors",
    "match_in_windows",
]
