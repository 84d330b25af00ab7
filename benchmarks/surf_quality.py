"""Quality of SURF beside OpenCV SURF's stored output, cv2.SIFT, ORB and AKAZE.

Three groups, one metric for all: the strongest keypoints, mutual nearest neighbours, ratio 0.8.

* graf (known homographies): repeatability at 3 px, correct matches (3 px), matching score,
  repeatability by overlap (`surf_overlap`);
* 20 synthetic warps of real images (rotation, scale, perspective, noise, exposure, blur), the same;
* stereo pairs: matches within 1 px of the fundamental matrix, with 1,000 keypoints a side.

And what of lunar-fg's own matches is wrong after RANSAC (`surf_ransac`).

Run as ``python benchmarks/surf_quality.py [--data DIR] [--json PATH]``; a page of tables
(`surf_tables`) is written beside the JSON.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from surf_features import (
    KEYPOINTS,
    Extractor,
    Features,
    Picture,
    Report,
    extractors,
    match,
    opencv,
    ours,
    read,
    read_grey,
    reference,
)  # fmt: skip
from surf_overlap import repeated_by_overlap
from surf_ransac import of_rendered, wrong_matches
from surf_tables import PLANETARY, markdown
from surf_warps import WARPS, about_centre, degraded, resampled

__all__ = ["PLANETARY", "opencv", "ours", "read_grey", "reference"]  # for the tests

STEREO_KEYPOINTS = 1000
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
WARPED = (STEREO["MSL"][0][0], STEREO["K10"][0][0], "moonranger-run1/left/000040.png",
          STEREO["KITTI"][0][0])  # fmt: skip


def warp(homography: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.perspectiveTransform(xy[None], homography)[0])


class Scores(NamedTuple):
    """Of two images with a known homography; shares are of the keypoints that both see."""

    repeated: float  # a keypoint of the other image lies within GRAF_RADIUS
    correct: int  # matches
    score: float  # correct matches, as a share
    overlapping: float  # repeated by the overlap of regions


def homography_scores(
    a: Features, b: Features, homography: NDArray[np.float64], shape: tuple[int, ...]
) -> Scores:
    """How well keypoints and matches of two images agree with the true homography."""

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
    overlapping = repeated_by_overlap(a, b, homography, seen_a, seen_b)
    return Scores(float(repeated.sum()) / common, correct, correct / common, overlapping)


def warp_table(data: Path, extract: Extractor) -> dict[str, list[Scores]]:
    """Scores of the 20 warps by group; the four images take turns."""
    rows: dict[str, list[Scores]] = {}
    first: dict[str, Features] = {}
    for i, (group, inner, effect, strength) in enumerate(WARPS):
        picture = read(data, WARPED[i % len(WARPED)])
        if picture.name not in first:
            first[picture.name] = extract(data, picture).top(KEYPOINTS)
        homography = about_centre(picture.grey.shape, inner)
        other = Picture(degraded(resampled(picture.grey, homography), effect, strength))
        rows.setdefault(group, []).append(
            homography_scores(
                first[picture.name],
                extract(data, other).top(KEYPOINTS),
                homography,
                picture.grey.shape,
            )
        )
    return rows


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


def graf_table(data: Path, extract: Extractor) -> list[Scores]:
    folder = "homography-pairs/graf"
    picture = read(data, f"{folder}/img1.png")
    first = extract(data, picture).top(KEYPOINTS)
    rows = []
    for i in range(2, 7):
        homography = np.loadtxt(data / folder / f"H1to{i}p")
        other = extract(data, read(data, f"{folder}/img{i}.png")).top(KEYPOINTS)
        rows.append(homography_scores(first, other, homography, picture.grey.shape))
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
                a = extract(data, read(data, left)).top(STEREO_KEYPOINTS)
                b = extract(data, read(data, right)).top(STEREO_KEYPOINTS)
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


def table_of_graf(report: Report, chosen: dict[str, Extractor], data: Path) -> None:
    print("graf 1-2 .. 1-6: repeatability | correct | means; matching score; by overlap")
    for name, extract in chosen.items():
        rows = graf_table(data, extract)
        report[name]["graf"] = rows
        mean = np.mean(rows, axis=0)
        print(
            f"{name:14s} {' '.join(f'{row[0]:.2f}' for row in rows)}"
            f" | {' '.join(f'{row[1]:4d}' for row in rows)}"
            f" | {mean[0]:.3f} {mean[1]:6.1f} {mean[2]:.3f} {mean[3]:.3f}"
        )


def table_of_stereo(report: Report, chosen: dict[str, Extractor], data: Path) -> None:
    print("\nstereo: inliers < 1 px of 1,000 a side (median px)")
    for name, groups in stereo_tables(data, chosen).items():
        report[name]["stereo"] = groups
        cells = [f"{group} {n:6.1f} ({px:.3f})" for group, (n, px) in groups.items()]
        print(f"{name:14s} {'  '.join(cells)}")


def table_of_warps(report: Report, chosen: dict[str, Extractor], data: Path) -> None:
    print("\n20 warps: correct matches (repeatability) by group; all; matching score")
    for name, extract in chosen.items():
        if name.startswith("OpenCV"):
            continue  # its output is stored for the images themselves only
        groups = warp_table(data, extract)
        report[name]["warps"] = groups
        every = [row for rows in groups.values() for row in rows]
        cells = [
            f"{group} {sum(row[1] for row in rows):4d} ({np.mean([row[0] for row in rows]):.2f})"
            for group, rows in groups.items()
        ]
        total, score = sum(row[1] for row in every), np.mean([row[2] for row in every])
        print(f"{name:14s} {'  '.join(cells)}  {total:5d} {score:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--json", type=Path, help="the figures; a page of tables goes beside it")
    parser.add_argument("--only", help="comma-separated rows, e.g. 'SURF,OpenCV SURF'")
    parser.add_argument("--rendered", type=Path, help="from lunar-fg simulate --depth")
    parser.add_argument("--page-only", action="store_true", help="the page anew from the JSON")
    arguments = parser.parse_args()
    if arguments.page_only:
        report = json.loads(arguments.json.read_text())
        if arguments.rendered:
            report["after RANSAC"]["rendered pairs"] = of_rendered(arguments.rendered)
            arguments.json.write_text(json.dumps(report, indent=1) + "\n")
        write_page(arguments.json, report)
        return
    chosen = extractors()
    if arguments.only:
        chosen = {name: chosen[name] for name in arguments.only.split(",")}
    cv2.setRNGSeed(1)
    report: Report = {name: {} for name in chosen}
    table_of_graf(report, chosen, arguments.data)
    table_of_stereo(report, chosen, arguments.data)
    table_of_warps(report, chosen, arguments.data)
    after: dict[str, object] = dict(wrong_matches(arguments.data))
    if arguments.rendered:
        after["rendered pairs"] = of_rendered(arguments.rendered)
    print("\nafter RANSAC")
    for name, counts in after.items():
        print(f"{name:16s} {counts}")
    report["after RANSAC"] = after
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
        write_page(arguments.json, report)


def write_page(path: Path, report: Report) -> None:
    path.with_suffix(".md").write_text(markdown(report))


if __name__ == "__main__":
    main()
