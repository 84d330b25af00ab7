"""Compile or load the kernels, once a process; a detector loads only those it calls."""

from __future__ import annotations

import functools
from collections.abc import Callable

from frontends.jit import load_kernels
from frontends.surf.accurate import describe_accurate
from frontends.surf.integral import halve
from frontends.surf.maxima import detect_pair
from frontends.surf.orientation import orient_level
from frontends.surf.rotated import describe_rotated_level
from frontends.surf.upright import describe_upright_level

_Kernels = tuple[tuple[Callable[..., object], str], ...]

_COMMON: _Kernels = (
    (halve, "void(uint8[:,::1], int64, uint16[:,::1])"),
    (halve, "void(uint16[:,::1], int64, uint16[:,::1])"),
    (
        detect_pair,
        "int64(uint8[:,::1], uint16[:,::1], int64, int64, float32, boolean, float32[:,::1])",
    ),
)
_UPRIGHT: _Kernels = (
    (
        describe_upright_level,
        "void(uint8[:,::1], uint16[:,::1], float32[:,::1], float32[::1], int64[::1], float32[::1],"
        " float32[:,::1])",
    ),
)
_ORIENT: _Kernels = (
    (
        orient_level,
        "void(uint8[:,::1], uint16[:,::1], float32[:,::1], float32[::1], int64[::1],"
        " float32[:,::1], float32[::1])",
    ),
)
_ROTATED: _Kernels = (
    (
        describe_rotated_level,
        "void(uint8[:,::1], uint16[:,::1], float32[:,::1], float32[::1], int64[::1], float32[::1],"
        " float32[::1], float32[:,::1])",
    ),
)
_ACCURATE: _Kernels = (
    (
        describe_accurate,
        "void(uint16[:,::1], float32[:,::1], float32[::1], int64[::1], float32[::1],"
        " float32[:,::1], float32[:,::1])",
    ),
)


@functools.cache
def load(upright: bool, accurate: bool) -> float:
    """Load the kernels of one kind of detector; later calls do nothing.

    Returns
    -------
    float
        Seconds the first call of this process took.
    """
    kernels = _COMMON
    if not upright:
        kernels += _ORIENT
    if accurate:
        return load_kernels(kernels + _ACCURATE)
    return load_kernels(kernels + (_UPRIGHT if upright else _ROTATED))


@functools.cache
def warmup() -> float:
    """Compile all SURF kernels, or load them from the disk cache; later calls do nothing.

    Returns
    -------
    float
        Seconds the first call of this process took.
    """
    return load_kernels(_COMMON + _UPRIGHT + _ORIENT + _ROTATED + _ACCURATE)
