"""A process that compiles a kernel and one that loads it from the disk compute the same bits."""

import os
import subprocess
import sys

import pytest

FOLLOWED = """
import hashlib
import cv2
import numpy as np
from frontends.template_alignment import follow_all
from frontends.templates import Templates

rng = np.random.default_rng(0)
first = cv2.GaussianBlur(rng.integers(0, 255, (160, 200)).astype(np.uint8), (0, 0), 2.0)
first = cv2.normalize(first, None, 0, 255, cv2.NORM_MINMAX)
warp = np.array([[1.1, 0.05, -10.0], [0.0, 1.2, -16.0]])
later = cv2.warpAffine(first, warp, (200, 160))
uv = rng.uniform(50, 110, (80, 2))
start = uv @ warp[:, :2].T + warp[:, 2] + 0.3
found = Templates.cut(first, uv).follow(later, start, np.full(80, 9.0))
assert found.found.sum() > 40
print(hashlib.md5(found.uv.tobytes()).hexdigest(), sum(follow_all.stats.cache_hits.values()))
"""

DISPARITIES = """
import hashlib
import cv2
import numpy as np
from frontends.patch_alignment import refine_all
from frontends.patch_window import PATCH

rng = np.random.default_rng(0)
wide = cv2.GaussianBlur(rng.integers(0, 255, (120, 220)).astype(np.uint8), (0, 0), 2.0)
wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX)
left, right = np.ascontiguousarray(wide[:, 10:210]), np.ascontiguousarray(wide[:, 3:203])
zero = np.zeros(100)
start = np.stack([rng.uniform(40, 160, 100), rng.uniform(30, 90, 100),
                  rng.normal(-7.0, 0.3, 100), zero, zero + 1.0], axis=1)
result, confirmed = np.zeros((100, 6)), np.zeros(100, dtype=np.bool_)
refine_all(left, right, start, PATCH, result, confirmed)
assert confirmed.sum() > 50
print(hashlib.md5(result.tobytes()).hexdigest(), sum(refine_all.stats.cache_hits.values()))
"""


@pytest.mark.parametrize("script", [DISPARITIES, FOLLOWED], ids=["disparities", "followed"])
def test_compiled_and_cached_agree_to_the_bit(tmp_path, script):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    outputs = [
        subprocess.run(
            [sys.executable, "-c", script],
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.split()
        for _ in range(2)
    ]
    assert [hits for _, hits in outputs] == ["0", "1"]
    assert outputs[0][0] == outputs[1][0]
