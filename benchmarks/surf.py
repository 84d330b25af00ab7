"""Speed of SURF: CPU time of the process beside cv2.SIFT, ORB, AKAZE, in one interleaved run.

Run as ``python benchmarks/surf.py [--data DIR] [--json PATH] [--quick]``. On a shared machine
only the ratios mean something.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

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


def interleaved(tasks: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median CPU milliseconds of each task, all tasks once a round."""
    for run in tasks.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(rounds):
        for name, run in tasks.items():
            times[name].append(cpu_ms(run))
    return {name: float(np.median(values)) for name, values in times.items()}


def detectors() -> dict[str, Callable[[Image], object]]:
    found: dict[str, Callable[[Image], object]] = {}
    for name, upright in (("SURF upright", True), ("SURF", False)):
        surf = SURF(hessian_threshold=20, upright=upright, max_keypoints=KEYPOINTS)
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
    """Wall time of two images one after the other over that of two threads, one each."""
    surf = SURF(hessian_threshold=20, upright=True, max_keypoints=KEYPOINTS)
    repeat = 10

    def work(image: Image) -> None:
        for _ in range(repeat):
            surf.detectAndCompute(image)

    ratios = []
    for _ in range(rounds):
        start = time.perf_counter()
        work(left)
        work(right)
        serial = time.perf_counter() - start
        threads = [threading.Thread(target=work, args=(image,)) for image in (left, right)]
        start = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        ratios.append(serial / (time.perf_counter() - start))
    return float(np.median(ratios))


def second_process(image: Path) -> float:
    """CPU seconds of a fresh process: import, load the cached kernels, one image."""
    code = (
        "import cv2, time; from frontends.surf import SURF;"
        f"image = cv2.imread({str(image)!r}, 0); SURF(upright=True).detectAndCompute(image);"
        "print(time.process_time())"
    )
    return float(
        subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--quick", action="store_true", help="fewer rounds, no size table")
    arguments = parser.parse_args()
    rounds = 5 if arguments.quick else 11
    cv2.setNumThreads(1)
    report: dict[str, object] = {"warmup_s": warmup()}
    left, right = read_grey(arguments.data / LEFT), read_grey(arguments.data / RIGHT)

    times = interleaved(
        {name: (lambda f=f: f(left)) for name, f in detectors().items()}, rounds
    )  # fmt: skip
    report["image_ms"] = times
    print(f"one image {left.shape[1]} x {left.shape[0]}, {KEYPOINTS} keypoints: CPU ms, of SIFT")
    for name, value in times.items():
        print(f"  {name:14s} {value:8.2f}   1/{times['cv2.SIFT'] / value:.1f}")

    speedup = threads_speedup(left, right, rounds)
    report["two_threads_speedup"] = speedup
    print(f"two threads, two images: {speedup:.2f}x (wall; meaningless while other jobs run)")
    report["second_process_cpu_s"] = second_process(arguments.data / LEFT)
    print(f"second process, import to first result: {report['second_process_cpu_s']:.2f} s CPU")

    if not arguments.quick:
        upright = {}
        for megapixels in (0.25, 1, 4, 16):
            image = resized(left, megapixels)
            surf = SURF(20, upright=True, max_keypoints=round(KEYPOINTS * megapixels))
            tracemalloc.start()  # numpy reports its arrays to it
            surf.detectAndCompute(image)
            peak = tracemalloc.get_traced_memory()[1] / 2**20
            tracemalloc.stop()
            elapsed = interleaved({"": lambda s=surf, i=image: s.detectAndCompute(i)}, 5)[""]
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
        counts = interleaved({str(k): f for k, f in tasks.items()}, 5)
        report["by_keypoints_4mpx_ms"] = counts
        print("  4 Mpx by keypoints: " + ", ".join(f"{k}: {v:.1f} ms" for k, v in counts.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
