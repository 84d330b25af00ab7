"""Image merging (paper, figure 5c): overlapping images in the plane of one of them.

Pairs are matched by SURF and related by homographies, exact for a turning camera or a flat
scene. The accepted pairs are a graph; each image is carried to the reference along the
graph's strongest tree, and where the graph has loops all homographies are then fitted to
all matches together. Blending is OpenCV's (`frontends.blending`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_array, lil_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree, shortest_path

from frontends.blending import blend
from frontends.errors import InputError
from frontends.matching import find_homography, match_descriptors
from frontends.surf import SURF

FloatArray = NDArray[np.float64]
Picture = NDArray[np.uint8]

#: Parallax and lens distortion let true matches miss a homography by this much, px.
_THRESHOLD_PX = 3.0
#: Largest magnification or reduction of any part of an image.
_MAX_STRETCH = 5.0
_MAX_CANVAS_PX = 100_000_000
#: Matches of a pair that enter the common fit; more hardly change it.
_FIT_MATCHES = 60


@dataclass(frozen=True, slots=True)
class Overlap:
    """Two images that a homography relates: matched pixels of the inliers, (M, 2) each."""

    first: int
    second: int
    second_H_first: FloatArray
    first_xy: FloatArray
    second_xy: FloatArray


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Merged images.

    Attributes
    ----------
    picture
        (H, W, 3) uint8, BGR; black where no image is.
    covered
        (H, W) bool, where an image is.
    reference
        Index of the image in whose plane the mosaic lies.
    canvas_H_image
        (3, 3) homography from image pixels to mosaic pixels, by index of the merged images.
    refused
        Why each of the other images is not in it, by index.
    error_px
        Median distance of matched points from one another, px of the images.
    """

    picture: Picture
    covered: NDArray[np.bool_]
    reference: int
    canvas_H_image: dict[int, FloatArray]
    refused: dict[int, str]
    error_px: float


def merge(pictures: Sequence[Picture], *, max_keypoints: int = 3000, seed: int = 0) -> Mosaic:
    """Merge overlapping pictures into one.

    Parameters
    ----------
    pictures
        (H, W, 3) uint8, BGR.
    max_keypoints
        SURF keypoints an image.
    seed
        Of RANSAC.

    Raises
    ------
    InputError
        When no two pictures overlap, or the mosaic would be absurdly large.
    """
    if len(pictures) < 2:
        raise InputError(f"{len(pictures)} image, a mosaic needs two or more", source="mosaic")
    overlaps, nearest = _overlaps(pictures, max_keypoints, seed)
    reference, order, parents = _tree(overlaps, len(pictures))
    if len(order) < 2:
        raise InputError(
            f"no two of the {len(pictures)} images overlap: {max(nearest.values())}",
            source="mosaic",
            remedy="give images that share a third of their view",
        )
    refused = {i: f"matches no other: {nearest[i]}" for i in nearest if i not in order}
    chained = _chain(overlaps, reference, order, parents)
    reference_H = _fit_together(overlaps, chained, reference)
    for i, homography in list(reference_H.items()):
        stretch = _stretch(homography, pictures[i].shape)
        if stretch > _MAX_STRETCH:
            refused[i] = (
                f"would be stretched {stretch:.0f}-fold in the plane of the reference"
                if np.isfinite(stretch)
                else "reaches behind the camera of the reference"
            )
            del reference_H[i]
    if len(reference_H) < 2:
        raise InputError(
            f"no image fits the reference: {next(iter(refused.values()))}",
            source="mosaic",
            remedy="give images taken in more similar directions",
        )
    origin, size = _canvas([(reference_H[i], pictures[i].shape) for i in reference_H])
    canvas_H = {i: _shift(-origin) @ homography for i, homography in reference_H.items()}
    kept = sorted(canvas_H)
    picture, covered = blend([pictures[i] for i in kept], [canvas_H[i] for i in kept], size)
    return Mosaic(picture, covered, reference, canvas_H, refused, _error(overlaps, reference_H))


def _overlaps(
    pictures: Sequence[Picture], max_keypoints: int, seed: int
) -> tuple[list[Overlap], dict[int, str]]:
    """Pairs that a homography relates; for each image how near its best refused pair was."""
    surf = SURF(1.0, max_keypoints=max_keypoints)
    features = []
    for i, picture in enumerate(pictures):
        try:
            features.append(surf.detectAndCompute(picture))
        except InputError as error:
            raise InputError(error.problem, source=f"image {i + 1}") from error
    overlaps: list[Overlap] = []
    best: dict[int, tuple[int, str]] = dict.fromkeys(range(len(pictures)), (-1, "no matches"))
    for i, j in combinations(range(len(pictures)), 2):
        pairs = match_descriptors(features[i][1], features[j][1])
        first_xy = features[i][0].xy[pairs.query].astype(np.float64)
        second_xy = features[j][0].xy[pairs.train].astype(np.float64)
        found = find_homography(first_xy, second_xy, threshold_px=_THRESHOLD_PX, seed=seed)
        if not found.reason:
            first_xy, second_xy = first_xy[found.inlier], second_xy[found.inlier]
            overlaps.append(Overlap(i, j, found.matrix, first_xy, second_xy))
            continue
        for k in (i, j):
            best[k] = max(best[k], (len(pairs), found.reason))
    return overlaps, {i: reason for i, (_, reason) in best.items()}


def _tree(overlaps: list[Overlap], count: int) -> tuple[int, list[int], NDArray[np.int32]]:
    """Reference, images that reach it in breadth-first order, and their parents.

    The tree takes the overlaps with the most inliers; its centre is the reference, so that
    chains are short.
    """
    weight = np.zeros((count, count))
    for overlap in overlaps:
        weight[overlap.first, overlap.second] = 1.0 / len(overlap.first_xy)
    tree = minimum_spanning_tree(csr_array(weight))
    steps = shortest_path(tree, directed=False, unweighted=True)
    joined = np.isfinite(steps)
    # the largest group first, then the shortest chains, then the smallest sum of them
    keys = [
        (-int(row.sum()), float(far[row].max()), float(far[row].sum()), i)
        for i, (row, far) in enumerate(zip(joined, steps, strict=True))
    ]
    reference = min(keys)[-1]
    order, parents = breadth_first_order(tree, reference, directed=False)
    return reference, [int(i) for i in order], parents


def _chain(
    overlaps: list[Overlap], reference: int, order: list[int], parents: NDArray[np.int32]
) -> dict[int, FloatArray]:
    """``reference_H_image`` along the tree."""
    between = {(o.first, o.second): o.second_H_first for o in overlaps}
    result = {reference: np.eye(3)}
    for i in order[1:]:
        parent = int(parents[i])
        step = between[i, parent] if (i, parent) in between else np.linalg.inv(between[parent, i])
        product = result[parent] @ step
        result[i] = product / product[2, 2]
    return result


def _fit_together(
    overlaps: list[Overlap], start: dict[int, FloatArray], reference: int
) -> dict[int, FloatArray]:
    """Homographies that agree with the matches of all pairs, also around loops.

    Robust least squares (soft L1) on transfer errors in px of the second image.
    """
    used = [o for o in overlaps if o.first in start and o.second in start]
    free = [i for i in start if i != reference]
    if len(used) <= len(free):
        return start  # a tree: the chain is exact already
    column = {i: 8 * k for k, i in enumerate(free)}
    matches = [_thinned(o) for o in used]
    # unknowns of order one: pixels from the middle of the matches, in units of their spread
    points = np.vstack([xy for pair in matches for xy in pair])
    scale = 1.0 / max(float(points.std()), 1.0)
    unit = np.diag([scale, scale, 1.0]) @ _shift(-points.mean(axis=0))
    back = np.linalg.inv(unit)

    def homographies(unknowns: FloatArray) -> dict[int, FloatArray]:
        result = {reference: np.eye(3)}
        for i in free:
            entries = np.append(unknowns[column[i] : column[i] + 8], 1.0)
            result[i] = back @ entries.reshape(3, 3) @ unit
        return result

    def residuals(unknowns: FloatArray) -> FloatArray:
        found = homographies(unknowns)
        return np.concatenate(
            [
                (apply(_between(found, o), a) - b).ravel()
                for o, (a, b) in zip(used, matches, strict=True)
            ]
        )

    rows = np.cumsum([0, *(2 * len(a) for a, _ in matches)])
    pattern = lil_array((int(rows[-1]), 8 * len(free)), dtype=np.int8)
    for o, first, last in zip(used, rows[:-1], rows[1:], strict=True):
        for i in {o.first, o.second} - {reference}:
            pattern[first:last, column[i] : column[i] + 8] = 1
    initial = []
    for i in free:
        normalised = unit @ start[i] @ back
        initial.append((normalised / normalised[2, 2]).ravel()[:8])
    solved = least_squares(
        residuals,
        np.concatenate(initial),
        jac_sparsity=pattern,
        loss="soft_l1",
        f_scale=1.0,
        x_scale="jac",
        max_nfev=50,
    )
    return homographies(solved.x)


def _thinned(overlap: Overlap) -> tuple[FloatArray, FloatArray]:
    rows = slice(None, None, max(1, len(overlap.first_xy) // _FIT_MATCHES))
    return overlap.first_xy[rows], overlap.second_xy[rows]


def _error(overlaps: list[Overlap], reference_H: dict[int, FloatArray]) -> float:
    errors = [
        np.hypot(*(apply(_between(reference_H, o), o.first_xy) - o.second_xy).T)
        for o in overlaps
        if o.first in reference_H and o.second in reference_H
    ]
    return float(np.median(np.concatenate(errors))) if errors else float("nan")


def _between(reference_H: dict[int, FloatArray], overlap: Overlap) -> FloatArray:
    """``second_H_first`` of an overlap by way of the reference."""
    product = np.linalg.inv(reference_H[overlap.second]) @ reference_H[overlap.first]
    return np.asarray(product, dtype=np.float64)


def apply(homography: FloatArray, xy: FloatArray) -> FloatArray:
    """Points (N, 2) moved by a homography."""
    return np.asarray(cv2.perspectiveTransform(xy[None], homography)[0], dtype=np.float64)


def _shift(xy: FloatArray) -> FloatArray:
    return np.array([[1.0, 0.0, xy[0]], [0.0, 1.0, xy[1]], [0.0, 0.0, 1.0]])


def _border(shape: tuple[int, ...]) -> FloatArray:
    """Nine points of an image: corners, middles of the sides, centre."""
    u, v = np.meshgrid([0.0, (shape[1] - 1) / 2, shape[1] - 1.0],
                       [0.0, (shape[0] - 1) / 2, shape[0] - 1.0])  # fmt: skip
    return np.column_stack([u.ravel(), v.ravel()])


def _stretch(homography: FloatArray, shape: tuple[int, ...]) -> float:
    """Largest factor by which a homography magnifies or shrinks; infinite past its horizon.

    The local scale is the root of the Jacobian's determinant, ``det H / w^3``.
    """
    points = _border(shape)
    w = points @ homography[2, :2] + homography[2, 2]
    determinant = float(np.linalg.det(homography))
    if not np.isfinite(determinant) or (determinant / w**3 <= 0.0).any() or np.ptp(np.sign(w)):
        return float("inf")
    scale = np.sqrt(determinant / w**3)
    return float(max(scale.max(), 1.0 / scale.min()))


def _canvas(placed: list[tuple[FloatArray, tuple[int, ...]]]) -> tuple[FloatArray, tuple[int, int]]:
    """Upper left corner of all images together, and the size (width, height), px."""
    points = np.vstack([apply(homography, _border(shape)) for homography, shape in placed])
    least = np.floor(points.min(axis=0))
    width, height = (int(n) for n in np.ceil(points.max(axis=0)) - least + 1)
    if width * height > _MAX_CANVAS_PX:
        raise InputError(
            f"would be {width}x{height} px, more than {_MAX_CANVAS_PX} pixels",
            source="mosaic",
            remedy="merge fewer images",
        )
    return least, (width, height)
