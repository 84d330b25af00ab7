"""The `SURF` class: detector and descriptor behind the call shape of ``cv2.Feature2D``."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.surf.checks import bad_parameter, checked_keypoints, checked_mask, grey_image
from frontends.surf.describe import describe
from frontends.surf.detector import detect
from frontends.surf.keypoints import Keypoints
from frontends.surf.pyramid import Buffers, Pyramid
from frontends.surf.subregions import DESCRIPTOR_SIZE
from frontends.surf.warmup import load

_GUESS_SHARE = 0.8  # of the last image's weakest response: images of a sequence are alike
_GUESS_RISE = 0.1


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
    accurate : bool
        True: for wide baselines and absolute matching, about four times the work. The image is
        doubled first (one octave more below, as in the paper), and the descriptor takes exact
        turned boxes in overlapping subregions. Its descriptors match only among themselves.

    Notes
    -----
    An instance may be used by several threads at once (the kernels release the GIL). It keeps
    its buffers, about 2 bytes a pixel and a thread, between calls.

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
        accurate: bool = False,
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
        self.accurate = bool(accurate)
        self._guess = 0.0
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
        if self.accurate and allowed is not None:
            allowed = allowed.repeat(2, axis=0).repeat(2, axis=1)
        with self._pyramid(grey) as pyramid:
            keypoints = detect(
                pyramid,
                self.octaves + self.accurate,
                self.layers,
                self.hessian_threshold,
                self.max_keypoints,
                allowed,
                self._guess,
            )
            self._learn(keypoints)
            descriptors, angles = describe(
                pyramid, keypoints, upright=self.upright, accurate=self.accurate, assign=True
            )
        keypoints = dataclasses.replace(keypoints, angle=angles)
        return (_resized(keypoints, 0.5) if self.accurate else keypoints), descriptors

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
            return keypoints, describe(
                pyramid,
                _resized(keypoints, 2) if self.accurate else keypoints,
                upright=self.upright,
                accurate=self.accurate,
                assign=False,
            )[0]

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
        load(self.upright, self.accurate)
        try:
            buffers = self._spare.pop()
        except IndexError:
            buffers = Buffers()
        try:
            yield Pyramid(self._working_image(grey), buffers)
        finally:
            self._spare.append(buffers)

    def _learn(self, keypoints: Keypoints) -> None:
        """Guess the weakest response that the next image will need, from this one's."""
        if len(keypoints) != self.max_keypoints:
            self._guess = 0.0
            return
        fresh = _GUESS_SHARE * float(keypoints.response[-1])
        # falls at once and rises slowly: a guess that is too high costs a second look
        rise = 1.0 if self._guess == 0 else _GUESS_RISE
        self._guess += (fresh - self._guess) * (rise if fresh > self._guess else 1.0)

    def _working_image(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Give the image features are looked for in: twice the size in accurate mode."""
        if not self.accurate:
            return grey
        return np.asarray(cv2.resize(grey, None, fx=2, fy=2), np.uint8)


def _resized(keypoints: Keypoints, factor: float) -> Keypoints:
    """Keypoints of the image resized by a factor; pixel centres are at integers."""
    return dataclasses.replace(
        keypoints,
        xy=(keypoints.xy + np.float32(0.5)) * np.float32(factor) - np.float32(0.5),
        size=keypoints.size * np.float32(factor),
        octave=keypoints.octave + round(np.log2(factor)),
    )
