"""Images in which noise hides the texture, smoothed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from frontends.measurements import StereoFrame

#: Sigma, px: little more than the scale of the smallest features.
_SIGMA_PX = 1.5

#: Neighbouring pixels of a smoothed image share their noise, so that a position fitted to a patch
#: errs by more than its residuals say. With noise that was white, and texture as fine as pixels,
#: the spectra of noise and texture are ``exp(-s^2 k^2)`` and a fit to gradients errs ``sqrt(pi) s``
#: times as much as with independent pixels.
SHARED_NOISE = float(np.sqrt(np.pi) * _SIGMA_PX)


def smoothed(frame: StereoFrame) -> StereoFrame:
    """Return the same pair with a fifth of its white noise."""
    left, right = (
        cv2.GaussianBlur(image, (0, 0), _SIGMA_PX) for image in (frame.left, frame.right)
    )
    return replace(frame, left=np.asarray(left, np.uint8), right=np.asarray(right, np.uint8))
