"""Stereo perception, matching, positioning: images to measurements, no graph."""

import os

# OpenBLAS starts a thread a core when it is loaded (NumPy's, SciPy's), and each spins for 2**26
# cycles before it sleeps: a fifth of a short program's CPU time. Not where the user has chosen.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")

from frontends.surf import SURF, Keypoints

__all__ = ["SURF", "Keypoints"]
