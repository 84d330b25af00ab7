"""The `SURF` class: detector and descriptor behind the call shape of ``cv2.Feature2D``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.surf.checks import bad_parameter, checked_keypoints, checked_mask, grey_image
from frontends.surf.describe import describe_level
from frontends.surf.detector import detect
from frontends.surf.integral import PAD
from frontends.surf.keypoints import Keypoints
from frontends.surf.orientation import sample_weights
from frontends.surf.pyramid import Buffers, Pyramid
from frontends.surf.subregions import DESCRIPTOR_SIZE, window_weights
from frontends.surf.warmup import warmup

_SMALLEST_SIZE = 12.0  # size at which a keypoint moves to the next level's descriptor image
_LARGEST_SCALE = 3.6  # s in pixels of a level: what the padding has room for


class SURF:
    """Speeded-up robust features (Bay et al. 2008).

    Parameters
    ----------
    hessian_threshold : float
        Least determinant of the Hessian (eq. 10) of grey values 0..255, with filters
        normalised as in OpenCV, so that thresholds carry over from there.
    octaves : int
        Octaves, each twice the size of the one before; fewer are used where the image is
        too small for more.
    layers : int
        Layers an octave that can hold a maximum; 2 tiles the scales without overlap.
    upright : bool
        True: no orientation (U-SURF), for cameras that hardly roll; faster and more
        distinctive.
    max_keypoints : int, optional
        Keep the strongest.

    Notes
    -----
    An instance may be used by several threads at once (the kernels release the GIL). It keeps
    its buffers, about 12 bytes a pixel (18 unless upright) and a thread, between calls.

    Raises
    ------
    InputError
        A parameter is out of range.
    """

    def __init__(
        self,
        hessian_threshold: float = 100.0,
        octaves: int = 4,
        layers: int = 2,
        upright: bool = False,
        max_keypoints: int | None = None,
    ) -> None:
        if not (np.isfinite(hessian_threshold) and hessian_threshold >= 0):
            raise bad_parameter("hessian_threshold", hessian_threshold, "a finite number >= 0")
        if not 1 <= octaves <= 8:
            raise bad_parameter("octaves", octaves, "1 to 8")
        if not 1 <= layers <= 6:
            raise bad_parameter("layers", layers, "1 to 6")
        if max_keypoints is not None and max_keypoints < 1:
            raise bad_parameter("max_keypoints", max_keypoints, "at least 1, or None for all")
        self.hessian_threshold = float(hessian_threshold)
        self.octaves = int(octaves)
        self.layers = int(layers)
        self.upright = bool(upright)
        self.max_keypoints = max_keypoints
        self._window = window_weights()
        self._samples = sample_weights()
        self._spare: list[Buffers] = []  # pop and append are atomic

    def detectAndCompute(
        self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None
    ) -> tuple[Keypoints, NDArray[np.float32]]:
        """Keypoints, strongest first, and their descriptors.

        Parameters
        ----------
        image : ndarray (H, W) or (H, W, 3) uint8
            Grey, or BGR as OpenCV reads it.
        mask : ndarray (H, W) uint8 or bool, optional
            Keypoints are kept where it is not zero.

        Returns
        -------
        keypoints : Keypoints
            N keypoints.
        descriptors : ndarray (N, 64) float32
            L2-normalised (eq. 11).

        Raises
        ------
        InputError
            The image or the mask cannot be used.
        """
        grey = grey_image(image)
        allowed = checked_mask(mask, grey.shape)
        with self._pyramid(grey) as pyramid:
            keypoints = detect(
                pyramid,
                self.octaves,
                self.layers,
                self.hessian_threshold,
                self.max_keypoints,
                allowed,
            )
            descriptors, angles = self._describe(pyramid, keypoints, assign=True)
        return _with_angle(keypoints, angles), descriptors

    def detect(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None) -> Keypoints:
        """Keypoints only, with their orientation; see `detectAndCompute`."""
        return self.detectAndCompute(image, mask)[0]

    def compute(
        self, image: NDArray[np.uint8], keypoints: Keypoints | Sequence[cv2.KeyPoint]
    ) -> tuple[Keypoints, NDArray[np.float32]]:
        """Descriptors at given keypoints, at their size and (unless upright) angle.

        Parameters
        ----------
        image : ndarray (H, W) or (H, W, 3) uint8
        keypoints : Keypoints or sequence of cv2.KeyPoint

        Returns
        -------
        keypoints : Keypoints
            The same, in the same order.
        descriptors : ndarray (N, 64) float32
        """
        grey = grey_image(image)
        keypoints = checked_keypoints(keypoints, grey.shape)
        with self._pyramid(grey) as pyramid:
            return keypoints, self._describe(pyramid, keypoints, assign=False)[0]

    def descriptorSize(self) -> int:
        """Numbers in a descriptor."""
        return DESCRIPTOR_SIZE

    def descriptorType(self) -> int:
        """OpenCV's element type of the descriptors."""
        return int(cv2.CV_32F)

    def defaultNorm(self) -> int:
        """OpenCV's norm to match the descriptors with."""
        return int(cv2.NORM_L2)

    @contextlib.contextmanager
    def _pyramid(self, grey: NDArray[np.uint8]) -> Iterator[Pyramid]:
        """Lend a set of buffers to one image; threads that run at the same time get their own."""
        warmup()
        try:
            buffers = self._spare.pop()
        except IndexError:
            buffers = Buffers()
        try:
            yield Pyramid(grey, buffers)
        finally:
            self._spare.append(buffers)

    def _describe(
        self, pyramid: Pyramid, keypoints: Keypoints, *, assign: bool
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Descriptors and angles; the angles are computed if `assign`."""
        descriptors = np.empty((len(keypoints), DESCRIPTOR_SIZE), np.float32)
        angles = np.zeros_like(keypoints.angle) if assign else keypoints.angle.copy()
        level_of = np.floor(np.log2(keypoints.size / _SMALLEST_SIZE))
        level_of = np.clip(level_of, 0, pyramid.levels - 1).astype(np.intp)
        for level in np.unique(level_of):
            chosen = np.flatnonzero(level_of == level)
            # neighbours in the image after each other: their pixels are then in the cache
            chosen = chosen[np.argsort(keypoints.xy[chosen, 1], kind="stable")]
            block = np.float32(1 << int(level))
            describe_level(
                pyramid.integral(int(level)),
                _NO_BOXES if self.upright else pyramid.boxes(int(level)),
                self.upright,
                assign,
                (keypoints.xy + np.float32(0.5)) / block + np.float32(PAD),
                np.minimum(
                    keypoints.size * np.float32(1.2 / 9) / block, np.float32(_LARGEST_SCALE)
                ),
                chosen,
                self._window,
                self._samples,
                angles,
                descriptors,
            )
        return descriptors, angles


_NO_BOXES = np.zeros((1, 1), np.uint32)


def _with_angle(keypoints: Keypoints, angles: NDArray[np.float32]) -> Keypoints:
    return Keypoints(
        keypoints.xy,
        keypoints.size,
        angles,
        keypoints.response,
        keypoints.octave,
        keypoints.laplacian,
    )
