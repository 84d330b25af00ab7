"""Compile or load every kernel, once a process."""

from __future__ import annotations

import functools

from frontends.surf._jit import load_kernels
from frontends.surf.describe import describe_level
from frontends.surf.integral import halve, integrate
from frontends.surf.maxima import detect_pair
from frontends.surf.refinement import refine_all
from frontends.surf.rotated import box_pairs

_KERNELS = (
    (halve, "void(uint8[:,::1], int64, uint16[:,::1])"),
    (halve, "void(uint16[:,::1], int64, uint16[:,::1])"),
    (integrate, "void(uint8[:,::1], int64, int32[:,::1])"),
    (integrate, "void(uint16[:,::1], int64, int32[:,::1])"),
    (
        detect_pair,
        "int64(int32[:,::1], int64, int64, float32, boolean, int32[:,::1], float32[:,::1],"
        " float32[::1])",
    ),
    (
        refine_all,
        "int64(int32[:,::1], int64, int32[:,::1], float32[:,::1], int64[::1], float32[:,::1])",
    ),
    (box_pairs, "void(int32[:,::1], uint32[:,::1])"),
    (
        describe_level,
        "void(int32[:,::1], uint32[:,::1], boolean, boolean, float32[:,::1], float32[::1],"
        " int64[::1], float32[::1], float32[:,::1], float32[::1], float32[:,::1])",
    ),
)


@functools.cache
def warmup() -> float:
    """Compile all SURF kernels, or load them from the disk cache; later calls do nothing.

    Returns
    -------
    float
        Seconds the first call of this process took.
    """
    return load_kernels(_KERNELS)
