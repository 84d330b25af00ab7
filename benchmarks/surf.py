"""Speed of SURF: CPU time of the process beside cv2.SIFT, ORB, AKAZE, in one interleaved run.

One image, a rectified pair from grey images to triangulated points, sizes, numbers of keypoints,
two threads, a second process. Left and right image take turns, as in a drive: the detector guesses
its threshold from the image before.

Page faults are given beside the times: cv2.SIFT fills 100 MB of buffers a call, and takes half as
long again where the allocator has returned them to the system since the last call, which depends
on what else the process does. `--return-memory` makes the allocator return them always (glibc's
thresholds of a fresh process, held).

Run as ``python benchmarks/surf.py [--data DIR] [--json PATH] [--quick] [--return-memory]``. On a
shared machine only the ratios mean something.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import os
import resource
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from frontends.camera import StereoCamera
from frontends.matching import match_descriptors
from frontends.measurements import StereoFrame
from frontends.stereo import StereoConfig, StereoPerception
from frontends.stereo_features import StereoFeatures
from frontends.surf import SURF, warmup

LEFT = "msl-navcam-pair/NLB_524534514EDR_F0562034NCAM00280M_.jpeg"
RIGHT = "msl-navcam-pair/NRB_524534514EDR_F0562034NCAM00280M_.jpeg"
KEYPOINTS = 1500
Image = NDArray[np.uint8]


def read_grey(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"{path}: no such image")
    return np.asarray(image, np.uint8)


def cpu_ms(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return 1e3 * (time.process_time() - start)


def alternating(run: Callable[[Image], object], images: tuple[Image, ...]) -> Callable[[], object]:
    """Give each call the next image."""
    turn = itertools.cycle(images)
    return lambda: run(next(turn))


def load_average() -> float:
    """Other jobs on the machine during the last minute: above 0.5, wall times mean little."""
    return os.getloadavg()[0]


def interleaved(
    tasks: dict[str, Callable[[], object]], rounds: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Median CPU milliseconds and page faults of each task, all tasks once a round."""
    for run in tasks.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in tasks}
    faults: dict[str, list[int]] = {name: [] for name in tasks}
    for _ in range(rounds):
        for name, run in tasks.items():
            before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            times[name].append(cpu_ms(run))
            faults[name].append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    return (
        {name: float(np.median(values)) for name, values in times.items()},
        {name: float(np.median(values)) for name, values in faults.items()},
    )


def return_memory() -> None:
    """Make glibc's allocator return large blocks to the system as soon as they are freed."""
    trim_threshold, mmap_threshold = -1, -3
    library = ctypes.CDLL(None)
    for threshold in (trim_threshold, mmap_threshold):
        library.mallopt(threshold, 128 * 1024)


def detectors() -> dict[str, Callable[[Image], object]]:
    found: dict[str, Callable[[Image], object]] = {}
    for name, upright, accurate in (
        ("SURF upright", True, False),
        ("SURF", False, False),
        ("SURF accurate", False, True),
    ):
        surf = SURF(20, upright=upright, max_keypoints=KEYPOINTS, accurate=accurate)
        found[name] = surf.detectAndCompute
    akaze = cv2 if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d
    for name, detector in (
        ("cv2.SIFT", cv2.SIFT_create(KEYPOINTS)),
        ("cv2.ORB", cv2.ORB_create(KEYPOINTS)),
        ("cv2.AKAZE", akaze.AKAZE_create(threshold=1e-3)),
    ):
        found[name] = lambda image, detector=detector: detector.detectAndCompute(image, None)
    try:
        from mahotas.features import surf as mahotas_surf
    except ImportError:
        return found
    found["mahotas SURF"] = lambda image: mahotas_surf.surf(image, max_points=KEYPOINTS)
    return found


def resized(image: Image, megapixels: float) -> Image:
    """The image's own texture on another area: tiled by mirroring, so density stays the same."""
    side = round(1024 * megapixels**0.5)
    repeats = max(0, side - image.shape[0])
    return np.ascontiguousarray(np.pad(image, (0, repeats), mode="symmetric")[:side, :side])


def threads_speedup(left: Image, right: Image, rounds: int) -> float:
    """Wall time of two images one after the other over that of two threads, one each.

    Least times of many short rounds: other jobs can only lengthen them. They still must leave
    both cores free for a hundredth of a second now and then.
    """
    surf = SURF(hessian_threshold=20, upright=True, max_keypoints=KEYPOINTS)
    serial, parallel = [], []
    with ThreadPoolExecutor(1) as thread:
        for _ in range(10 * rounds):
            start = time.perf_counter()
            surf.detectAndCompute(left)
            surf.detectAndCompute(right)
            serial.append(time.perf_counter() - start)
            start = time.perf_counter()
            other = thread.submit(surf.detectAndCompute, right)
            surf.detectAndCompute(left)
            other.result()
            parallel.append(time.perf_counter() - start)
    return min(serial[1:]) / min(parallel[1:])


def rectified(left: Image, right: Image) -> tuple[Image, Image, StereoCamera]:
    """The MSL pair rectified by its own matches, with the nominal Navcam calibration."""
    features = [SURF(20, upright=True, max_keypoints=KEYPOINTS).detectAndCompute(i)
                for i in (left, right)]  # fmt: skip
    pairs = match_descriptors(features[0][1], features[1][1], ratio=0.7)
    a, b = features[0][0].xy[pairs.query], features[1][0].xy[pairs.train]
    fundamental, good = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 0.5, 0.9999, 20000)
    size = (left.shape[1], left.shape[0])
    a, b = (np.float32(xy[good.ravel() == 1]) for xy in (a, b))
    _, left_turn, right_turn = cv2.stereoRectifyUncalibrated(a, b, fundamental, size)
    # the rectified right image is shifted so that points at infinity have no disparity
    moved = [cv2.perspectiveTransform(xy[None], turn)[0]
             for xy, turn in ((a, left_turn), (b, right_turn))]  # fmt: skip
    shift = np.eye(3)
    shift[0, 2] = np.percentile(moved[0][:, 0] - moved[1][:, 0], 1) - 5
    turns = (left_turn, shift @ right_turn)
    images = [np.asarray(cv2.warpPerspective(i, h, size), np.uint8)
              for i, h in zip((left, right), turns, strict=True)]  # fmt: skip
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return images[0], images[1], StereoCamera(*size, 1220.0, 1220.0, *centre, 0.424)


def pair_tasks(left: Image, right: Image) -> tuple[dict[str, Callable[[], object]], StereoFeatures]:
    """Two grey images to triangulated points, or to matches with OpenCV."""
    left, right, camera = rectified(left, right)
    perception = StereoPerception(camera, StereoConfig(max_keypoints=KEYPOINTS))
    frame = StereoFrame(0, 0.0, left, right, camera)
    tasks: dict[str, Callable[[], object]] = {"lunar-fg": lambda: perception.perceive(frame)}
    for name, detector, norm in (
        ("2 cv2.SIFT + BFMatcher knn", cv2.SIFT_create(KEYPOINTS), cv2.NORM_L2),
        ("2 cv2.ORB + BFMatcher", cv2.ORB_create(KEYPOINTS), cv2.NORM_HAMMING),
    ):

        def run(detector: cv2.Feature2D = detector, norm: int = norm) -> object:
            first, second = (detector.detectAndCompute(i, None)[1] for i in (left, right))
            return cv2.BFMatcher(norm).knnMatch(first, second, 2)

        tasks[name] = run
    return tasks, perception.perceive(frame)


def second_process(image: Path, runs: int = 5) -> dict[str, float]:
    """Median CPU seconds of fresh processes: import, load the cached kernels, one image.

    Once with SURF imported first and once with OpenCV and so NumPy, whose BLAS then starts its
    threads before SURF can tell them to sleep.
    """
    ours, theirs = "from frontends.surf import SURF;", "import cv2;"
    rest = (
        f"image = cv2.imread({str(image)!r}, 0); SURF(upright=True).detectAndCompute(image);"
        "import time; print(time.process_time())"
    )
    # what this process was told to do is not the default of a new one
    environment = {k: v for k, v in os.environ.items() if not k.startswith("OPENBLAS")}
    orders = {"SURF first": ours + theirs, "OpenCV first": theirs + ours}
    times: dict[str, list[float]] = {name: [] for name in orders}
    for _ in range(runs):
        for name, imports in orders.items():
            command = [sys.executable, "-c", imports + rest]
            done = subprocess.run(command, capture_output=True, check=True, env=environment)
            times[name].append(float(done.stdout))
    return {name: float(np.median(values)) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--return-memory", action="store_true", help="see above; glibc only")
    parser.add_argument("--quick", action="store_true", help="fewer rounds, no size table")
    arguments = parser.parse_args()
    rounds = 5 if arguments.quick else 11
    cv2.setNumThreads(1)
    if arguments.return_memory:
        return_memory()
    report: dict[str, object] = {"warmup_s": warmup()}
    left, right = read_grey(arguments.data / LEFT), read_grey(arguments.data / RIGHT)

    tasks = {name: alternating(run, (left, right)) for name, run in detectors().items()}
    times, faults = interleaved(tasks, rounds)
    report["image_ms"], report["image_page_faults"] = times, faults
    print(f"one image {left.shape[1]} x {left.shape[0]}, {KEYPOINTS} keypoints: CPU ms, of SIFT")
    for name, value in times.items():
        ratio = f"1/{times['cv2.SIFT'] / value:.1f}"
        print(f"  {name:14s} {value:8.2f}   {ratio:7s} {faults[name]:6.0f} page faults")

    tasks, features = pair_tasks(left, right)
    pair, faults = interleaved(tasks, rounds)
    report["pair_ms"], report["pair_page_faults"] = pair, faults
    report["pair_landmarks"] = len(features)
    print(f"rectified pair to triangulated points ({len(features)} landmarks): CPU ms, of lunar-fg")
    for name, value in pair.items():
        ratio = value / pair["lunar-fg"]
        print(f"  {name:27s} {value:8.2f}   {ratio:5.1f} {faults[name]:6.0f} page faults")

    report["load_before_threads"] = load_average()
    speedup = threads_speedup(left, right, rounds)
    report["two_threads_speedup"] = speedup
    print(
        f"two threads, two images: {speedup:.2f}x (wall, least of many rounds; load"
        f" {report['load_before_threads']:.1f} by other jobs and this one)"
    )
    second = second_process((arguments.data / LEFT).resolve())
    report["second_process_cpu_s"] = second
    cells = ", ".join(f"{seconds:.2f} s CPU with {name}" for name, seconds in second.items())
    print(f"second process, import to first result: {cells}")

    if not arguments.quick:
        upright = {}
        for megapixels in (0.25, 1, 4, 16):
            image = resized(left, megapixels)
            surf = SURF(20, upright=True, max_keypoints=round(KEYPOINTS * megapixels))
            tracemalloc.start()  # numpy reports its arrays to it
            surf.detectAndCompute(image)
            peak = tracemalloc.get_traced_memory()[1] / 2**20
            tracemalloc.stop()
            elapsed = interleaved({"": lambda s=surf, i=image: s.detectAndCompute(i)}, 5)[0][""]
            upright[megapixels] = {"ms": elapsed, "peak_mb": peak}
            print(
                f"  {megapixels:5} Mpx, {surf.max_keypoints:6d} keypoints: {elapsed:8.2f} ms,"
                f" {elapsed / megapixels:6.2f} ms/Mpx, peak of its arrays {peak:.0f} MB"
            )
        report["by_size"] = upright
        image = resized(left, 4)
        tasks = {}
        for count in (500, 1500, 5000, 10000):
            surf = SURF(5, upright=True, max_keypoints=count)
            tasks[count] = lambda s=surf: s.detectAndCompute(image)
        counts, _ = interleaved({str(k): f for k, f in tasks.items()}, 5)
        report["by_keypoints_4mpx_ms"] = counts
        print("  4 Mpx by keypoints: " + ", ".join(f"{k}: {v:.1f} ms" for k, v in counts.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
