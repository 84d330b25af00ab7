"""Quality of SURF beside OpenCV SURF's stored output, cv2.SIFT, ORB and AKAZE.

Two groups, one metric for all: the strongest keypoints, mutual nearest neighbours, ratio 0.8.

* graf (known homographies): repeatability at 3 px, correct matches (3 px), matching score;
* stereo pairs: matches within 1 px of the fundamental matrix, with 1,000 keypoints a side.

Run as ``python benchmarks/surf_quality.py [--data DIR] [--json PATH]``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.surf import SURF

GRAF_KEYPOINTS = 1500
STEREO_KEYPOINTS = 1000
RATIO = 0.8
GRAF_RADIUS = 3.0  # px: a match or a repeated keypoint is right within this
EPIPOLAR_RADIUS = 1.0  # px

STEREO = {
    "MSL": [("msl-navcam-pair/NLB_524534514EDR_F0562034NCAM00280M_.jpeg",
             "msl-navcam-pair/NRB_524534514EDR_F0562034NCAM00280M_.jpeg")],
    "K10": [("k10-stereo/left4.png", "k10-stereo/right4.png")],
    "MoonRanger": [
        (f"moonranger-run1/left/{i:06d}.png", f"moonranger-run1/right/{i:06d}.png")
        for i in (0, 40, 80)
    ],
    "KITTI": [
        (f"kitti-06-000-050/image_l/{i:06d}.png", f"kitti-06-000-050/image_r/{i:06d}.png")
        for i in (0, 1)
    ],
}  # fmt: skip
PLANETARY = ("MSL", "K10", "MoonRanger")


@dataclass(frozen=True)
class Features:
    """Strongest-first positions (N, 2), sizes (N,) and descriptors (N, D)."""

    xy: NDArray[np.float64]
    size: NDArray[np.float64]
    descriptors: NDArray[np.generic]

    def top(self, n: int) -> Features:
        """Strongest n."""
        return Features(self.xy[:n], self.size[:n], self.descriptors[:n])


Extractor = Callable[[Path, Path], Features]


def read_grey(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"{path}: no such image")
    return np.asarray(image, np.uint8)


def ours(upright: bool) -> Extractor:
    surf = SURF(hessian_threshold=20, upright=upright, max_keypoints=GRAF_KEYPOINTS)

    def extract(data: Path, image: Path) -> Features:
        keypoints, descriptors = surf.detectAndCompute(read_grey(data / image))
        return Features(keypoints.xy.astype(float), keypoints.size.astype(float), descriptors)

    return extract


def reference(kind: str) -> Extractor:
    """OpenCV SURF's stored keypoints and descriptors (threshold 20, 4 octaves, 2 layers)."""

    def extract(data: Path, image: Path) -> Features:
        name = str(image).replace("/", "__") + ".npz"
        with np.load(data / "surf-reference" / name) as stored:
            keypoints = stored[f"{kind}_keypoints"].astype(float)
            descriptors = stored[f"{kind}_descriptors"].astype(np.float32)
        return Features(keypoints[:, :2], keypoints[:, 2], descriptors)

    return extract


def opencv(detector: cv2.Feature2D, size_scale: float = 1.0) -> Extractor:
    def extract(data: Path, image: Path) -> Features:
        keypoints, descriptors = detector.detectAndCompute(read_grey(data / image), None)
        order = np.argsort([-k.response for k in keypoints], kind="stable")
        return Features(
            np.array([keypoints[i].pt for i in order]),
            np.array([keypoints[i].size for i in order]) * size_scale,
            descriptors[order],
        )

    return extract


def akaze() -> cv2.Feature2D:
    # OpenCV 5 moved it to the contrib modules
    module = cv2 if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d
    return module.AKAZE_create(threshold=1e-4)


def extractors() -> dict[str, Extractor]:
    return {
        "SURF": ours(upright=False),
        "SURF upright": ours(upright=True),
        "OpenCV SURF": reference("oriented"),
        "OpenCV U-SURF": reference("upright"),
        "cv2.SIFT": opencv(cv2.SIFT_create(GRAF_KEYPOINTS)),
        "cv2.ORB": opencv(cv2.ORB_create(GRAF_KEYPOINTS)),
        "cv2.AKAZE": opencv(akaze()),
    }


def match(a: Features, b: Features) -> NDArray[np.intp]:
    """Mutual nearest neighbours that pass the ratio test, as (M, 2) indices."""
    binary = a.descriptors.dtype == np.uint8
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if binary else cv2.NORM_L2)
    forward = matcher.knnMatch(a.descriptors, b.descriptors, 2)
    backward = {m.queryIdx: m.trainIdx for m in matcher.match(b.descriptors, a.descriptors)}
    pairs = [
        (first.queryIdx, first.trainIdx)
        for first, second in forward
        if first.distance < RATIO * second.distance and backward[first.trainIdx] == first.queryIdx
    ]
    return np.array(pairs, np.intp).reshape(-1, 2)


def warp(homography: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.perspectiveTransform(xy[None], homography)[0])


def homography_scores(
    a: Features, b: Features, homography: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[float, int, float]:
    """Repeatability, number of correct matches, matching score (correct / common keypoints)."""

    def inside(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        limit = (shape[1] - 1, shape[0] - 1)
        return np.asarray(((xy >= 0) & (xy <= limit)).all(axis=1))

    forward = warp(homography, a.xy)
    backward = warp(np.linalg.inv(homography), b.xy)
    seen_a, seen_b = inside(forward), inside(backward)
    distance = np.linalg.norm(forward[:, None] - b.xy[None], axis=2)
    distance[~seen_a] = np.inf
    distance[:, ~seen_b] = np.inf
    nearest = distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[nearest] == np.arange(len(a.xy))
    repeated = mutual & (distance[np.arange(len(a.xy)), nearest] < GRAF_RADIUS)
    common = max(1, min(int(seen_a.sum()), int(seen_b.sum())))
    pairs = match(a, b)
    error = np.linalg.norm(forward[pairs[:, 0]] - b.xy[pairs[:, 1]], axis=1)
    correct = int((error < GRAF_RADIUS).sum())
    return float(repeated.sum()) / common, correct, correct / common


def undistorted(xy: NDArray[np.float64], camera: Path | None) -> NDArray[np.float64]:
    """Pixels of the ideal camera of a .tsai file (Brown-Conrady); unchanged without one."""
    if camera is None or not len(xy):
        return xy
    values = {
        key.strip(): float(value)
        for key, _, value in (line.partition("=") for line in camera.read_text().splitlines())
        if key.strip() in ("fu", "fv", "cu", "cv", "k1", "k2", "p1", "p2")
    }
    matrix = np.array([[values["fu"], 0, values["cu"]], [0, values["fv"], values["cv"]], [0, 0, 1]])
    distortion = np.array([values[key] for key in ("k1", "k2", "p1", "p2")])
    return np.asarray(cv2.undistortPoints(xy[:, None], matrix, distortion, P=matrix)[:, 0])


def epipolar_distance(
    fundamental: NDArray[np.float64], left: NDArray[np.float64], right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Larger of the two distances from the epipolar lines, in pixels."""
    ones = np.ones((len(left), 1))
    line_right = np.hstack([left, ones]) @ fundamental.T
    line_left = np.hstack([right, ones]) @ fundamental
    algebraic = np.abs(np.sum(np.hstack([right, ones]) * line_right, axis=1))
    return np.maximum(
        algebraic / np.linalg.norm(line_right[:, :2], axis=1),
        algebraic / np.linalg.norm(line_left[:, :2], axis=1),
    )


def graf_table(data: Path, extract: Extractor) -> list[tuple[float, int, float]]:
    folder = Path("homography-pairs/graf")
    first = extract(data, folder / "img1.png").top(GRAF_KEYPOINTS)
    shape = read_grey(data / folder / "img1.png").shape
    rows = []
    for i in range(2, 7):
        homography = np.loadtxt(data / folder / f"H1to{i}p")
        other = extract(data, folder / f"img{i}.png").top(GRAF_KEYPOINTS)
        rows.append(homography_scores(first, other, homography, (shape[0], shape[1])))
    return rows


def stereo_tables(
    data: Path, chosen: dict[str, Extractor]
) -> dict[str, dict[str, tuple[float, float]]]:
    """Mean inliers and mean median distance of each method in each group of pairs.

    One fundamental matrix a pair, fitted robustly to the matches of all methods together: its
    uncertainty is then the same for all.
    """
    result: dict[str, dict[str, tuple[float, float]]] = {name: {} for name in chosen}
    for group, pairs in STEREO.items():
        cameras = [data / f"k10-stereo/black_{side}.tsai" for side in ("left", "right")]
        left_camera, right_camera = cameras if group == "K10" else (None, None)
        scores: dict[str, list[tuple[int, float]]] = {name: [] for name in chosen}
        for left, right in pairs:
            matched = {}
            for name, extract in chosen.items():
                a = extract(data, Path(left)).top(STEREO_KEYPOINTS)
                b = extract(data, Path(right)).top(STEREO_KEYPOINTS)
                indices = match(a, b)
                matched[name] = (
                    undistorted(a.xy[indices[:, 0]], left_camera),
                    undistorted(b.xy[indices[:, 1]], right_camera),
                )
            fundamental, _ = cv2.findFundamentalMat(
                np.vstack([points for points, _ in matched.values()]),
                np.vstack([points for _, points in matched.values()]),
                cv2.USAC_MAGSAC,
                0.5,
                0.9999,
                20000,
            )
            for name, (points, others) in matched.items():
                distance = epipolar_distance(fundamental, points, others)
                good = distance < EPIPOLAR_RADIUS
                scores[name].append((int(good.sum()), float(np.median(distance[good]))))
        for name, rows in scores.items():
            mean = np.mean(rows, axis=0)
            result[name][group] = (float(mean[0]), float(mean[1]))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", help="comma-separated rows, e.g. 'SURF,OpenCV SURF'")
    arguments = parser.parse_args()
    chosen = extractors()
    if arguments.only:
        chosen = {name: chosen[name] for name in arguments.only.split(",")}

    cv2.setRNGSeed(1)
    report: dict[str, object] = {}
    print("graf 1-2 .. 1-6: repeatability | correct matches | matching score; mean of five")
    stereo = stereo_tables(arguments.data, chosen)
    for name, extract in chosen.items():
        rows = graf_table(arguments.data, extract)
        mean = np.mean(rows, axis=0)
        report[name] = {"graf": rows, "stereo": stereo[name]}
        print(
            f"{name:14s} "
            + " ".join(f"{row[0]:.2f}" for row in rows)
            + " | "
            + " ".join(f"{row[1]:4d}" for row in rows)
            + f" | mean {mean[0]:.3f} {mean[1]:6.1f} {mean[2]:.3f}"
        )
    print("\nstereo: inliers < 1 px of 1,000 a side (median px)")
    for name, groups in stereo.items():
        cells = [f"{group} {n:6.1f} ({px:.3f})" for group, (n, px) in groups.items()]
        print(f"{name:14s} " + "  ".join(cells))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
