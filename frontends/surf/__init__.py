"""SURF (Bay et al. 2008) in numba: integral image, fast-Hessian detector, 64-d descriptor."""

from frontends.surf.keypoints import Keypoints
from frontends.surf.surf import SURF
from frontends.surf.warmup import warmup

__all__ = ["SURF", "Keypoints", "warmup"]
