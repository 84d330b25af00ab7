"""Keypoints as arrays: no Python object a keypoint on the hot path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.errors import InputError

_COLUMNS = {
    "xy": np.float32,
    "size": np.float32,
    "angle": np.float32,
    "response": np.float32,
    "octave": np.int32,
    "laplacian": np.int8,
}


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """N keypoints, strongest first when they come from a detector.

    Parameters
    ----------
    xy : ndarray (N, 2) float32
        Pixels; (0, 0) is the centre of the top-left pixel.
    size : ndarray (N,) float32
        Side of the box filter in pixels, as OpenCV's SURF: s = 1.2 / 9 size.
    angle : ndarray (N,) float32
        Radians in [0, 2 pi), from the x axis towards the y axis (down, so clockwise as
        seen); 0 when upright.
    response : ndarray (N,) float32
        Determinant of the Hessian in OpenCV's unit.
    octave : ndarray (N,) int32
        0 for the finest.
    laplacian : ndarray (N,) int8
        Sign of the trace: +1 for a dark blob, -1 for a bright one, 0 if unknown.
    """

    xy: NDArray[np.float32]
    size: NDArray[np.float32]
    angle: NDArray[np.float32]
    response: NDArray[np.float32]
    octave: NDArray[np.int32]
    laplacian: NDArray[np.int8]

    def __post_init__(self) -> None:
        """Coerce the dtypes and check the shapes."""
        n = len(self.xy)
        for name, dtype in _COLUMNS.items():
            column = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            expected = (n, 2) if name == "xy" else (n,)
            if column.shape != expected:
                raise InputError(
                    f"shape {column.shape}, expected {expected}", source="keypoints", field=name
                )
            object.__setattr__(self, name, column)

    def __len__(self) -> int:
        """Count the keypoints."""
        return len(self.xy)

    def __getitem__(self, index: slice | NDArray[Any] | Sequence[int]) -> Keypoints:
        """Subset by slice, index array or mask."""
        if not isinstance(index, slice):
            index = np.asarray(index)
            if index.ndim != 1:
                raise InputError(
                    "the index must be a slice, a mask or a 1-D index array", source="keypoints"
                )
            if index.size == 0:
                index = index.astype(np.intp)
        return Keypoints(*(getattr(self, field.name)[index] for field in fields(self)))

    @classmethod
    def empty(cls) -> Keypoints:
        """No keypoints."""
        return cls(*(np.zeros((0, 2) if name == "xy" else 0, t) for name, t in _COLUMNS.items()))

    def to_cv2(self) -> list[cv2.KeyPoint]:
        """As OpenCV objects: angle in degrees, Laplacian's sign in ``class_id``."""
        degrees = np.degrees(self.angle)
        return [
            cv2.KeyPoint(
                float(x),
                float(y),
                float(size),
                float(angle),
                float(response),
                int(octave),
                int(sign),
            )
            for (x, y), size, angle, response, octave, sign in zip(
                self.xy, self.size, degrees, self.response, self.octave, self.laplacian, strict=True
            )
        ]

    @classmethod
    def from_cv2(cls, keypoints: Sequence[cv2.KeyPoint]) -> Keypoints:
        """From OpenCV objects of any detector.

        Parameters
        ----------
        keypoints : sequence of cv2.KeyPoint
            Angles in degrees (negative, OpenCV's "none", becomes 0); ``class_id`` is taken as
            the Laplacian's sign where it is -1, 0 or 1; only the low byte of ``octave`` counts
            (SIFT packs its layer above it).
        """
        angle = np.array([k.angle for k in keypoints], np.float64)
        signs = np.array([k.class_id for k in keypoints], np.int64)
        octave = np.array([k.octave for k in keypoints], np.int64) & 255
        return cls(
            np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2),
            np.array([k.size for k in keypoints], np.float32),
            np.radians(np.where(angle < 0, 0, angle % 360)).astype(np.float32),
            np.array([k.response for k in keypoints], np.float32),
            np.where(octave > 127, octave - 256, octave).astype(np.int32),
            np.where(np.abs(signs) <= 1, signs, 0).astype(np.int8),
        )
