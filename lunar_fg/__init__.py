"""Rover navigation from stereo images: datasets, factor graph, navigator, evaluation."""

from lunar_fg.dependencies import check_dependencies

check_dependencies()

__version__ = "0.1.0"
