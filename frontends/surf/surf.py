"""The `SURF` class: detector and descriptor behind the call shape of ``cv2.Feature2D``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.surf.descriptor import DESCRIPTOR_SIZE, describe_level, window_weights
from frontends.surf.hessian import NEIGHBOURS, detect_pair, refine_all
from frontends.surf.integral import PAD
from frontends.surf.keypoints import Keypoints
from frontends.surf.orientation import sample_weights
from frontends.surf.pyramid import Buffers, Pyramid
from frontends.surf.warmup import warmup

_BASE_LOBE = 5  # of the lowest layer that can hold a maximum (filter 15); 9 lies below it
_SMALLEST_SIZE = 12.0  # size at which a keypoint moves to the next level's descriptor image
_LARGEST_SCALE = 3.6  # s in pixels of a level: what the padding has room for
_LEAST_SIDE = 24  # pixels: below, not even the lowest layer has a place


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
            raise _bad("hessian_threshold", hessian_threshold, "a finite number >= 0")
        if not 1 <= octaves <= 8:
            raise _bad("octaves", octaves, "1 to 8")
        if not 1 <= layers <= 6:
            raise _bad("layers", layers, "1 to 6")
        if max_keypoints is not None and max_keypoints < 1:
            raise _bad("max_keypoints", max_keypoints, "at least 1, or None for all")
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
        grey = _grey(image)
        allowed = _checked_mask(mask, grey.shape)
        with self._pyramid(grey) as pyramid:
            keypoints = self._detect(pyramid, allowed)
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
        grey = _grey(image)
        if not isinstance(keypoints, Keypoints):
            keypoints = Keypoints.from_cv2(keypoints)
        height, width = grey.shape
        x, y = keypoints.xy[:, 0], keypoints.xy[:, 1]
        # written so that NaN fails too
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        if not inside.all():
            raise InputError(f"{np.sum(~inside)} lie outside the image", source="keypoints")
        if not (np.isfinite(keypoints.size) & (keypoints.size > 0)).all():
            raise InputError("sizes must be positive", source="keypoints", field="size")
        if not np.isfinite(keypoints.angle).all():
            raise InputError("angles must be finite", source="keypoints", field="angle")
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

    def _detect(self, pyramid: Pyramid, mask: NDArray[np.bool_] | None) -> Keypoints:
        layers = self._candidates(pyramid)
        if not layers:
            return Keypoints.empty()
        wanted = self.max_keypoints
        responses = np.concatenate([layer.responses for layer in layers])
        # Only the strongest candidates need refining. About half of them survive it; should
        # fewer do, the next share follows, so the result is the same as without this shortcut.
        batch = responses.size if wanted is None else int(2.2 * wanted) + 64
        above = np.inf
        rows = np.empty((0, 6), np.float32)
        while True:
            least = -np.inf
            if batch < responses.size:
                least = float(np.partition(responses, responses.size - batch)[-batch])
            fresh = [layer.refined(least, above) for layer in layers]
            rows = np.concatenate([rows, *fresh])
            if mask is not None:
                column = np.rint(rows[:, 0]).astype(np.intp)
                line = np.rint(rows[:, 1]).astype(np.intp)
                rows = rows[mask[line, column]]
            if least == -np.inf or (wanted is not None and len(rows) >= wanted):
                break
            above = least
            batch *= 2
        # equal responses stay in scan order: the result does not depend on the sort
        rows = rows[np.argsort(-rows[:, 3], kind="stable")[:wanted]]
        return Keypoints(
            rows[:, :2],
            rows[:, 2],
            np.zeros(len(rows), np.float32),
            rows[:, 3],
            rows[:, 5].astype(np.int32),
            np.sign(rows[:, 4]).astype(np.int8),
        )

    def _candidates(self, pyramid: Pyramid) -> list[_Candidates]:
        """Candidates of each pair of layers of each octave."""
        found: list[_Candidates] = []
        for octave in range(self.octaves):
            if min(pyramid.shape(octave)) < _LEAST_SIDE:
                break
            for first in range(0, self.layers, 2):
                single = first + 1 == self.layers
                lobe = _BASE_LOBE + 2 * first
                found.append(_Candidates(pyramid, octave, lobe, self.hessian_threshold, single))
        return found

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


class _Candidates:
    """Candidates of one pair of layers."""

    def __init__(
        self, pyramid: Pyramid, octave: int, lobe: int, threshold: float, single: bool
    ) -> None:
        self._integral = pyramid.integral(octave)
        self._octave = octave
        self._lobe = lobe
        width = pyramid.shape(octave)[1]
        capacity = self._integral.size // 32 + 64
        while True:
            shape = (capacity, NEIGHBOURS)
            name = (octave, lobe)
            buffers = pyramid.buffers
            positions = buffers.get("positions", *name, shape=(capacity, 3), dtype=np.int32)
            neighbours = buffers.get("neighbours", *name, shape=shape, dtype=np.float32)
            responses = buffers.get("responses", *name, shape=(capacity,), dtype=np.float32)
            count = detect_pair(
                self._integral,
                width,
                lobe,
                np.float32(threshold),
                single,
                positions,
                neighbours,
                responses,
            )
            if count <= capacity:
                break
            capacity = count
        self._positions = positions
        self._neighbours = neighbours
        self.responses = responses[:count]

    def refined(self, least: float, above: float) -> NDArray[np.float32]:
        """Refine the candidates with least <= response < above.

        Returns
        -------
        ndarray (M, 6) float32
            x, y, size (pixels of the image), response, trace, octave of those that hold.
        """
        chosen = np.flatnonzero((self.responses >= least) & (self.responses < above))
        rows = np.empty((len(chosen) + 1, 5), np.float32)
        kept = refine_all(
            self._integral, self._lobe, self._positions, self._neighbours, chosen, rows
        )
        out = np.empty((kept, 6), np.float32)
        out[:, :5] = rows[:kept]
        out[:, 5] = self._octave
        block = np.float32(1 << self._octave)
        # the centre of block i is at pixel (i + 1/2) block - 1/2
        out[:, :2] = (out[:, :2] + np.float32(0.5)) * block - np.float32(0.5)
        out[:, 2] *= block
        return out


def _with_angle(keypoints: Keypoints, angles: NDArray[np.float32]) -> Keypoints:
    return Keypoints(
        keypoints.xy,
        keypoints.size,
        angles,
        keypoints.response,
        keypoints.octave,
        keypoints.laplacian,
    )


def _bad(name: str, value: object, expected: str) -> InputError:
    return InputError(f"{value!r}, expected {expected}", source="SURF", field=name)


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Check the image and return it as writable, contiguous grey (what the kernels take)."""
    if not isinstance(image, np.ndarray):
        raise InputError(f"a {type(image).__name__}, expected a numpy array", source="image")
    if image.dtype != np.uint8:
        raise InputError(
            f"dtype {image.dtype}, expected uint8",
            source="image",
            remedy="scale the grey values to 0..255 and convert",
        )
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InputError(f"shape {image.shape}, expected (H, W) or (H, W, 3)", source="image")
    if min(image.shape[:2]) < _LEAST_SIDE:
        raise InputError(
            f"{image.shape[1]} x {image.shape[0]} pixels, at least {_LEAST_SIDE} x {_LEAST_SIDE}"
            " are needed",
            source="image",
        )
    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return np.require(image, requirements=["C", "W"])


def _checked_mask(mask: NDArray[Any] | None, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    if mask is None:
        return None
    if not isinstance(mask, np.ndarray) or mask.dtype not in (np.dtype(np.uint8), np.dtype(bool)):
        raise InputError("expected a numpy array of uint8 or bool", source="mask")
    if mask.shape != shape:
        raise InputError(f"shape {mask.shape}, the image has {shape}", source="mask")
    return np.asarray(mask != 0)
