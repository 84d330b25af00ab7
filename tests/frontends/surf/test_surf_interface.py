"""Keypoints, converters, the cv2.Feature2D call shape, and errors for bad input."""

from __future__ import annotations

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from surf_images import textured

from frontends.errors import InputError
from frontends.surf import SURF, Keypoints, warmup


@pytest.fixture(scope="module")
def features() -> tuple[np.ndarray, Keypoints, np.ndarray]:
    image = textured(21)
    return image, *SURF(50, max_keypoints=120).detectAndCompute(image)


def test_converters_round_trip(features: tuple[np.ndarray, Keypoints, np.ndarray]) -> None:
    _, keypoints, _ = features
    objects = keypoints.to_cv2()
    assert all(isinstance(k, cv2.KeyPoint) for k in objects)
    assert objects[0].angle == pytest.approx(np.degrees(keypoints.angle[0]), abs=1e-3)
    back = Keypoints.from_cv2(objects)
    for name in ("xy", "size", "response", "octave", "laplacian"):
        np.testing.assert_array_equal(getattr(back, name), getattr(keypoints, name))
    np.testing.assert_allclose(back.angle, keypoints.angle, atol=1e-5)
    assert len(Keypoints.from_cv2([])) == 0


def test_compute_repeats_detect_and_compute(
    features: tuple[np.ndarray, Keypoints, np.ndarray],
) -> None:
    image, keypoints, descriptors = features
    same, again = SURF().compute(image, keypoints)
    np.testing.assert_array_equal(same.xy, keypoints.xy)
    np.testing.assert_allclose(again, descriptors, atol=1e-6)
    _, through_cv2 = SURF().compute(image, keypoints.to_cv2())
    np.testing.assert_allclose(through_cv2, descriptors, atol=1e-4)
    detected = SURF(50, max_keypoints=120).detect(image)
    np.testing.assert_array_equal(detected.angle, keypoints.angle)


def test_keypoints_of_another_detector_are_described() -> None:
    """Any position inside the image and any size, also beyond the largest octave."""
    image = textured(22, 120, 130)
    found = cv2.SIFT_create(200).detect(image, None)
    _, descriptors = SURF().compute(image, found)
    assert descriptors.shape == (len(found), 64)
    corner = [cv2.KeyPoint(0, 0, s, 33) for s in (1, 9, 30, 5000)]
    corner += [cv2.KeyPoint(129, 119, s, 77) for s in (1, 9, 30, 5000)]
    for upright in (False, True):
        _, descriptors = SURF(upright=upright).compute(image, corner)
        assert np.isfinite(descriptors).all()


def test_indexing() -> None:
    n = 5
    keypoints = Keypoints(
        np.arange(2 * n).reshape(n, 2), np.arange(n), np.zeros(n), np.arange(n), np.zeros(n),
        np.ones(n),
    )  # fmt: skip
    assert keypoints.xy.dtype == np.float32
    assert keypoints.laplacian.dtype == np.int8
    np.testing.assert_array_equal(keypoints[1:3].size, [1, 2])
    np.testing.assert_array_equal(keypoints[np.array([4, 0])].size, [4, 0])
    np.testing.assert_array_equal(keypoints[keypoints.size > 2].size, [3, 4])
    assert len(keypoints[[]]) == 0
    assert len(Keypoints.empty()) == 0
    with pytest.raises(InputError, match="index"):
        keypoints[2]  # type: ignore[index]
    with pytest.raises(AttributeError):
        keypoints.xy = keypoints.xy  # type: ignore[misc]
    with pytest.raises(InputError, match="size"):
        Keypoints(np.zeros((3, 2)), np.zeros(2), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))


def test_opencv_calls() -> None:
    surf = SURF()
    assert surf.descriptorSize() == 64
    assert surf.descriptorType() == cv2.CV_32F
    assert surf.defaultNorm() == cv2.NORM_L2


GOOD = np.zeros((50, 60), np.uint8)


@pytest.mark.parametrize(
    ("image", "word"),
    [
        (GOOD.astype(np.float32), "float32"),
        (np.full((50, 60), np.nan), "float64"),
        (GOOD.astype(np.uint16), "uint16"),
        (np.zeros((0, 0), np.uint8), "0 x 0"),
        (np.zeros((10, 300), np.uint8), "300 x 10"),
        (np.zeros((50, 60, 4), np.uint8), "shape"),
        (np.zeros(50, np.uint8), "shape"),
        (None, "NoneType"),
        ([[1, 2], [3, 4]], "list"),
    ],
)
def test_bad_images(image: object, word: str) -> None:
    with pytest.raises(InputError, match="image") as caught:
        SURF().detectAndCompute(image)  # type: ignore[arg-type]
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "mask", [np.ones((60, 50), np.uint8), np.ones((50, 60), np.float32), "mask"]
)
def test_bad_masks(mask: object) -> None:
    with pytest.raises(InputError, match="mask"):
        SURF().detectAndCompute(GOOD, mask)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "parameters",
    [
        {"hessian_threshold": -1},
        {"hessian_threshold": float("nan")},
        {"octaves": 0},
        {"layers": 0},
        {"max_keypoints": 0},
    ],
)
def test_bad_parameters(parameters: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(parameters))):
        SURF(**parameters)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("column", "value"),
    [("xy", [[60, 5]]), ("xy", [[5, -1]]), ("xy", [[np.nan, 5]]), ("size", [0]),
     ("size", [np.nan]), ("angle", [np.inf])],
)  # fmt: skip
def test_bad_keypoints(column: str, value: list[object]) -> None:
    columns: dict[str, object] = {
        "xy": [[5, 5]], "size": [9], "angle": [0], "response": [0], "octave": [0], "laplacian": [0]
    }  # fmt: skip
    columns[column] = value
    keypoints = Keypoints(**{name: np.array(v) for name, v in columns.items()})
    with pytest.raises(InputError, match="keypoints"):
        SURF().compute(GOOD, keypoints)


def test_warmup_gives_seconds() -> None:
    assert warmup() >= 0


def test_cold_compile_announces_itself_once(tmp_path: object) -> None:
    """With an empty cache the first process says so in one line, the second is silent."""
    code = (
        "import logging, sys\n"
        "logging.basicConfig(stream=sys.stdout, format='%(name)s %(message)s')\n"
        "from frontends.jit import load_kernels\n"
        "from frontends.surf.integral import halve\n"
        "load_kernels([(halve, 'void(uint8[:,::1], int64, uint16[:,::1])')] * 2)\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    lines = [
        subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        for _ in range(2)
    ]
    assert len(lines[0]) == 1
    assert "lunar_fg.surf compiling" in lines[0][0]
    assert lines[1] == []


@pytest.mark.parametrize(("chosen", "expected"), [(None, "4"), ("20", "20")])
def test_blas_threads_sleep_unless_the_user_says_otherwise(
    chosen: str | None, expected: str
) -> None:
    """Set before NumPy loads its BLAS, else it would come too late."""
    code = (
        "import sys, os, importlib.abc\n"
        "class Watch(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name == 'numpy':\n"
        "            print(os.environ.get('OPENBLAS_THREAD_TIMEOUT'))\n"
        "sys.meta_path.insert(0, Watch())\n"
        "import frontends\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_THREAD_TIMEOUT"}
    if chosen is not None:
        environment["OPENBLAS_THREAD_TIMEOUT"] = chosen
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [expected]
