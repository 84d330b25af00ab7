"""Block means of one image, in buffers that outlive it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from frontends.surf.integral import FRACTION_BITS, half_image

_NO_GREY = np.empty((0, 0), np.uint8)
_NO_BLOCKS = np.empty((0, 0), np.uint16)


class Buffers:
    """Arrays kept between calls, by name: fresh memory costs more than the work in it.

    One owner at a time; the contents are whatever the last use left.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple[object, ...], NDArray[Any]] = {}

    def get(self, *key: object, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """Give the array of that name, shape and type, made if it is not there."""
        array = self._arrays.get(key)
        if array is None or array.shape != shape or array.dtype != dtype:
            array = np.empty(shape, dtype)
            self._arrays[key] = array
        return array


class Pyramid:
    """Block means of one image, made when first asked for.

    Parameters
    ----------
    grey : ndarray (H, W) uint8
    buffers : Buffers
        Where they are stored; to be used for nothing else meanwhile.
    """

    def __init__(self, grey: NDArray[np.uint8], buffers: Buffers) -> None:
        self._images: list[NDArray[Any]] = [grey]
        self.buffers = buffers
        self.levels = max(1, min(grey.shape).bit_length() - 3)  # the last is 4 to 7 pixels

    def shape(self, level: int) -> tuple[int, int]:
        """Height and width of a level."""
        height, width = self._images[0].shape
        return height >> level, width >> level

    def image(self, level: int) -> NDArray[Any]:
        """Give the block means: uint8 grey at level 0, uint16 grey*4 above."""
        while len(self._images) <= level:
            below = len(self._images)
            out = self.buffers.get("image", below, shape=self.shape(below), dtype=np.uint16)
            half_image(self._images[-1], out)
            self._images.append(out)
        return self._images[level]

    def level(self, level: int) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Give the block means as the kernels take them, see `frontends.surf.integral`."""
        image = self.image(level)
        return (image, _NO_BLOCKS) if level == 0 else (_NO_GREY, image)

    def scaled(self, level: int) -> NDArray[np.uint16]:
        """Give the block means in grey*4, also at level 0."""
        image = self.image(level)
        if level > 0:
            return image
        out = self.buffers.get("scaled", shape=image.shape, dtype=np.uint16)
        np.multiply(image, 1 << FRACTION_BITS, out=out, dtype=np.uint16)
        return out
