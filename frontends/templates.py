"""The patch around a landmark as it was first seen, followed into later images.

A feature that is detected anew in each image walks over the surface as the rover comes nearer;
the patch around it does not. With p from the patch's middle,

    image(A p / (1 + g p) + c) = gain * template(p) + bias,

least squares for the position c, the warp A, gain and bias, with the Jacobian taken from
the template (inverse compositional Gauss-Newton, Baker and Matthews 2004). It starts from the
detected feature and from the warp of the last sighting, turned as the motion and the slope of the
ground say. So is g, which is not estimated: perspective magnifies the near side of the patch more.
Without it the position would err to that side by some hundredths of a pixel, always in the same
sense, and so would the length of the way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import Image
from frontends.patch_sampling import MIDDLE
from frontends.patch_window import PATCH
from frontends.rows import joined_rows, replaced_rows, selected_rows
from frontends.template_alignment import TEMPLATE_SIDE, cut_all, follow_all

FloatArray = NDArray[np.float64]

#: A patch serves while the image shows it by no more than this larger or smaller.
_LARGEST_STRETCH = 1.5


@dataclass(frozen=True, slots=True)
class Templates:
    """Patches of N landmarks.

    Attributes
    ----------
    pixels
        (N, 324) uint8, 18 x 18 of the image where each was first seen.
    offset
        (N, 2) the landmark from the middle of its patch, px.
    warp, bend
        (N, 2, 2) px per px and (N, 2) per px, A and g above, for the image where it was last seen.
    sigma_px
        (N,) 1-sigma of the landmark's place in the patch: 0 where the patch defines it.
    """

    pixels: NDArray[np.uint8]
    offset: FloatArray
    warp: FloatArray
    bend: FloatArray
    sigma_px: FloatArray

    @classmethod
    def cut(cls, image: Image, uv: FloatArray) -> Self:
        """Patches around features at (N, 2) px, moved to lie within the image (H, W) uint8."""
        n = len(uv)
        if min(image.shape) < TEMPLATE_SIDE:
            image = np.zeros((TEMPLATE_SIDE, TEMPLATE_SIDE), np.uint8)  # nothing to be followed
        corner = np.floor(uv + 0.5 - MIDDLE).astype(np.int64) - 1
        corner = np.clip(corner, 0, np.array(image.shape[::-1]) - TEMPLATE_SIDE)
        pixels = np.empty((n, TEMPLATE_SIDE**2), np.uint8)
        cut_all(np.ascontiguousarray(image), corner, pixels)
        return cls(
            pixels,
            uv - (corner + 1 + MIDDLE),
            np.tile(np.eye(2), (n, 1, 1)),
            np.zeros((n, 2)),
            np.zeros(n),
        )

    def __len__(self) -> int:
        return len(self.sigma_px)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Templates:
        """The patches at a mask or an index array."""
        return selected_rows(self, keep)

    def joined(self, other: Templates) -> Templates:
        """These patches and those."""
        return joined_rows(self, other)

    def replaced(self, rows: NDArray[np.int64], other: Templates) -> Templates:
        """These patches with others in the place of some rows."""
        return replaced_rows(self, rows, other)

    def moved(self, shift: FloatArray, sigma_px: FloatArray) -> Templates:
        """The same patches for landmarks (N, 2) px beside the ones they were cut for.

        Parameters
        ----------
        shift
            In the image they were cut from.
        sigma_px
            (N,) how well the landmarks' places in the patches are known.
        """
        return replace(self, offset=self.offset + shift, sigma_px=sigma_px)

    def turned(self, warp: FloatArray, bend: FloatArray) -> Templates:
        """The same patches as a motion since the last sighting makes them look.

        Parameters
        ----------
        warp, bend
            (N, 2, 2) and (N, 2), of the image of each landmark's surroundings.
        """
        further = np.einsum("nji,nj->ni", self.warp, bend)
        return replace(self, warp=warp @ self.warp, bend=self.bend + further)

    def warped(self, rows: NDArray[np.int64], warp: FloatArray, bend: FloatArray) -> Templates:
        """The same patches with the warps that some rows were found with."""
        all_warps, all_bends = self.warp.copy(), self.bend.copy()
        all_warps[rows], all_bends[rows] = warp, bend
        return replace(self, warp=all_warps, bend=all_bends)

    def useful(self) -> NDArray[np.bool_]:
        """Which are not stretched so much by now that they would alias, (N,)."""
        stretch2 = np.abs(np.linalg.det(self.warp))
        return np.asarray((stretch2 < _LARGEST_STRETCH**2) & (stretch2 > _LARGEST_STRETCH**-2))

    def follow(self, image: Image, start: FloatArray, reach_px: FloatArray) -> Followed:
        """Find the landmarks in a later image.

        Parameters
        ----------
        image
            (H, W) uint8.
        start
            (N, 2) where they are expected, px.
        reach_px
            (N,) how far from there they may be found.
        """
        n = len(self)
        warp, result, found = self.warp.copy(), np.zeros((n, 3)), np.zeros(n, dtype=np.bool_)
        pixels, offset = np.ascontiguousarray(self.pixels), np.ascontiguousarray(self.offset)
        follow_all(
            np.ascontiguousarray(image), pixels, offset, np.ascontiguousarray(start), warp,
            np.ascontiguousarray(self.bend), np.ascontiguousarray(reach_px), PATCH, result, found,
        )  # fmt: skip
        return Followed(
            np.where(found[:, None], result[:, :2], start),
            np.where(found, np.hypot(result[:, 2], self.sigma_px), np.inf),
            warp,
            found,
        )


@dataclass(frozen=True, slots=True)
class Followed:
    """Landmarks looked for in a later image; those not found stay where they were expected.

    Attributes
    ----------
    uv
        (N, 2) px.
    sigma_px
        (N,) 1-sigma per axis beside the place where each was first seen; infinite where not found.
    warp
        (N, 2, 2) from the patch to the image, A above.
    found
        (N,) bool.
    """

    uv: FloatArray
    sigma_px: FloatArray
    warp: FloatArray
    found: NDArray[np.bool_]
