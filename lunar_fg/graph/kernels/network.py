"""Gauss-Newton on planar poses (x, y, yaw) that follow each other.

A term says where a pose is, or, where its `base` is not -1, how it lies in the axes of another;
the first n terms are the start and the motions from each pose to the next. The error of a motion
is its logarithm, in the axes at its end: uncertain yaw bends the spread of a long motion into an
arc, and the logarithm follows it. The system is factorised within its envelope: a path alone
costs what a band of six costs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from frontends.jit import kernel, njit
from frontends.measurements import FloatArray, IntArray

_LARGEST_DAMPING = 1e8
#: Rest: chi-square no longer falls by this much, absolute and relative.
_STILL = 1e-7


class Terms(NamedTuple):
    """What is known and what is claimed, one row each; numba takes it as it is.

    Attributes
    ----------
    base, station
        (C,) poses that a term is about; `base` is -1 for a place.
    value
        (C, 3) x, y, yaw.
    root
        (C, 3, 3) inverse Cholesky roots of the covariances of the errors.
    weight
        (C,) share of its chi-square that counts.
    """

    base: IntArray
    station: IntArray
    value: FloatArray
    root: FloatArray
    weight: FloatArray

    def after(self, count: int) -> Terms:
        """All but the first so many rows."""
        base, station, value, root, weight = self
        return Terms(base[count:], station[count:], value[count:], root[count:], weight[count:])


@njit
def _wrapped(angle: float) -> float:
    return float(angle - 2.0 * np.pi * np.floor((angle + np.pi) / (2.0 * np.pi)))


@njit
def _term(
    poses: FloatArray,
    base: int,
    station: int,
    value: FloatArray,
    off: FloatArray,
    jacobian: FloatArray,
) -> int:
    """Error of a term (3,), its derivatives by station and base (3, 6), and how many count."""
    x, y, yaw = poses[station, 0], poses[station, 1], poses[station, 2]
    jacobian[:] = 0.0
    if base < 0:
        off[0], off[1], off[2] = x - value[0], y - value[1], _wrapped(yaw - value[2])
        jacobian[0, 0] = jacobian[1, 1] = jacobian[2, 2] = 1.0
        return 3
    dx, dy = x - poses[base, 0], y - poses[base, 1]
    # Measured end to station: from the axes of the base into those of the measured end.
    turn = poses[base, 2] + value[2]
    cosine, sine = np.cos(turn), np.sin(turn)
    c, s = np.cos(value[2]), np.sin(value[2])
    tx = cosine * dx + sine * dy - c * value[0] - s * value[1]
    ty = cosine * dy - sine * dx + s * value[0] - c * value[1]
    angle = _wrapped(yaw - turn)
    half = 0.5 * angle
    if abs(half) < 1e-4:
        near, slope = 1.0 - half * half / 3.0, -half / 3.0
    else:
        near = half / np.tan(half)
        slope = 0.5 * (near - near * near) / half - 0.5 * half
    off[0], off[1], off[2] = near * tx + half * ty, near * ty - half * tx, angle
    jacobian[0, 0] = near * cosine - half * sine
    jacobian[0, 1] = near * sine + half * cosine
    jacobian[1, 0], jacobian[1, 1] = -jacobian[0, 1], jacobian[0, 0]
    jacobian[0, 2] = slope * tx + 0.5 * ty
    jacobian[1, 2] = slope * ty - 0.5 * tx
    jacobian[2, 2] = 1.0
    for i in range(3):
        for j in range(3):
            jacobian[i, 3 + j] = -jacobian[i, j]
    jacobian[0, 5] += jacobian[0, 0] * dy - jacobian[0, 1] * dx
    jacobian[1, 5] += jacobian[1, 0] * dy - jacobian[1, 1] * dx
    return 6


@kernel
def dead_reckoned(values: FloatArray) -> FloatArray:
    """Poses (n, 3) that the first one and the motions from each to the next lead to."""
    poses = values.copy()
    for n in range(1, len(values)):
        cosine, sine = np.cos(poses[n - 1, 2]), np.sin(poses[n - 1, 2])
        poses[n, 0] = poses[n - 1, 0] + cosine * values[n, 0] - sine * values[n, 1]
        poses[n, 1] = poses[n - 1, 1] + sine * values[n, 0] + cosine * values[n, 1]
        poses[n, 2] = poses[n - 1, 2] + values[n, 2]
    return poses


@kernel
def network_terms(poses: FloatArray, terms: Terms) -> tuple[FloatArray, FloatArray]:
    """Errors of all terms (C, 3) and derivatives by station and base (C, 3, 6), not whitened."""
    off, jacobian = np.empty((len(terms.base), 3)), np.empty((len(terms.base), 3, 6))
    for c in range(len(terms.base)):
        _term(poses, terms.base[c], terms.station[c], terms.value[c], off[c], jacobian[c])
    return off, jacobian


@njit
def _cost(poses: FloatArray, terms: Terms) -> float:
    total, off, jacobian = 0.0, np.empty(3), np.empty((3, 6))
    for c in range(len(terms.base)):
        if terms.weight[c] > 0.0:
            _term(poses, terms.base[c], terms.station[c], terms.value[c], off, jacobian)
            for i in range(3):
                white = 0.0
                for j in range(i + 1):
                    white += terms.root[c, i, j] * off[j]
                total += terms.weight[c] * white * white
    return total


@njit
def _first_columns(terms: Terms, n: int) -> IntArray:
    """Column in which each row of the lower triangle begins, (3n,)."""
    first = np.empty(3 * n, dtype=np.int64)
    for row in range(3 * n):
        first[row] = 3 * (row // 3)
    for c in range(len(terms.base)):
        if terms.base[c] >= 0 and terms.weight[c] > 0.0:
            a, b = terms.base[c], terms.station[c]
            for row in range(3 * max(a, b), 3 * max(a, b) + 3):
                first[row] = min(first[row], 3 * min(a, b))
    return first


@njit
def _system(
    poses: FloatArray,
    terms: Terms,
    damping: float,
    first: IntArray,
    hessian: FloatArray,
    gradient: FloatArray,
) -> None:
    """Normal equations, lower triangle; the damping holds each motion where it is."""
    for row in range(len(first)):
        gradient[row] = 0.0
        hessian[row, first[row] : row + 1] = 0.0
    off, white = np.empty(3), np.empty(3)
    jacobian, whitened = np.empty((3, 6)), np.empty((3, 6))
    column = np.empty(6, dtype=np.int64)
    for c in range(len(terms.base)):
        if terms.weight[c] <= 0.0:
            continue
        wide = _term(poses, terms.base[c], terms.station[c], terms.value[c], off, jacobian)
        for i in range(3):
            column[i], column[3 + i] = 3 * terms.station[c] + i, 3 * terms.base[c] + i
        for i in range(3):
            white[i] = 0.0
            whitened[i] = 0.0
            for j in range(i + 1):
                white[i] += terms.root[c, i, j] * off[j]
                for k in range(wide):
                    whitened[i, k] += terms.root[c, i, j] * jacobian[j, k]
        held = terms.weight[c] * (1.0 + damping if c < len(poses) else 1.0)
        for a in range(wide):
            for i in range(3):
                gradient[column[a]] += terms.weight[c] * whitened[i, a] * white[i]
            for b in range(wide):
                if column[b] <= column[a]:
                    for i in range(3):
                        hessian[column[a], column[b]] += held * whitened[i, a] * whitened[i, b]


@njit
def _factorise(hessian: FloatArray, first: IntArray) -> bool:
    """Cholesky root within the envelope, in place; False where it is not positive."""
    for i in range(len(first)):
        for j in range(first[i], i + 1):
            value = hessian[i, j]
            for k in range(max(first[i], first[j]), j):
                value -= hessian[i, k] * hessian[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                hessian[i, i] = np.sqrt(value)
            else:
                hessian[i, j] = value / hessian[j, j]
    return True


@njit
def _substitute(root: FloatArray, first: IntArray, vector: FloatArray) -> None:
    """Solve with a root, in place."""
    for i in range(len(first)):
        value = vector[i]
        for k in range(first[i], i):
            value -= root[i, k] * vector[k]
        vector[i] = value / root[i, i]
    for i in range(len(first) - 1, -1, -1):
        vector[i] /= root[i, i]
        for k in range(first[i], i):
            vector[k] -= root[i, k] * vector[i]


@njit
def _inverse(root: FloatArray, first: IntArray, out: FloatArray) -> None:
    """Inverse of the matrix with this root; all columns at once, their lower triangle."""
    n = len(first)
    for i in range(n):
        out[i, :i] = 0.0
        out[i, i] = 1.0
        for k in range(first[i], i):
            for c in range(k + 1):
                out[i, c] -= root[i, k] * out[k, c]
        for c in range(i + 1):
            out[i, c] /= root[i, i]
    for i in range(n - 1, -1, -1):
        for c in range(i + 1):
            out[i, c] /= root[i, i]
        for k in range(first[i], i):
            for c in range(k + 1):
                out[k, c] -= root[i, k] * out[i, c]
    for i in range(n):
        for c in range(i):
            out[c, i] = out[i, c]


@njit
def _moved(poses: FloatArray, step: FloatArray, out: FloatArray) -> None:
    """Take a step so that each motion changes by what the step means for it.

    A turn far back moves all that follows on an arc, not on its tangent.
    """
    for i in range(3):
        out[0, i] = poses[0, i] + step[i]
    for n in range(1, len(poses)):
        before, yaw = 3 * (n - 1), poses[n - 1, 2]
        dx, dy = poses[n, 0] - poses[n - 1, 0], poses[n, 1] - poses[n - 1, 1]
        mx = dx + step[before + 3] - step[before] + dy * step[before + 2]
        my = dy + step[before + 4] - step[before + 1] - dx * step[before + 2]
        # From the old axes of the pose before into its new ones.
        turn = out[n - 1, 2] - yaw
        cosine, sine = np.cos(turn), np.sin(turn)
        out[n, 0] = out[n - 1, 0] + cosine * mx - sine * my
        out[n, 1] = out[n - 1, 1] + sine * mx + cosine * my
        out[n, 2] = poses[n, 2] + step[before + 5]


@kernel
def solve_network(poses: FloatArray, terms: Terms, most: int) -> tuple[bool, FloatArray, float]:
    """Least squares over all terms of positive weight, in at most `most` steps.

    `poses` (n, 3) is where to begin. Returns whether it could be solved, the poses, and their
    chi-square.
    """
    n = len(poses)
    first = _first_columns(terms, n)
    hessian, gradient = np.empty((3 * n, 3 * n)), np.empty(3 * n)
    here, there = poses.copy(), np.empty((n, 3))
    cost = _cost(here, terms)
    damping = 0.0
    for _ in range(most):
        _system(here, terms, damping, first, hessian, gradient)
        if not _factorise(hessian, first):
            return False, here, cost
        for i in range(3 * n):
            gradient[i] = -gradient[i]
        _substitute(hessian, first, gradient)
        _moved(here, gradient, there)
        new = _cost(there, terms)
        if new <= cost * (1.0 + 1e-12):
            gain, cost = cost - new, new
            here, there = there, here
            damping = 0.0 if damping < 1e-3 else 0.1 * damping
            if gain <= _STILL * (1.0 + cost):
                break
        else:
            if new - cost <= _STILL * (1.0 + cost):
                break
            damping = max(1e-2, 10.0 * damping)
            if damping > _LARGEST_DAMPING:
                break
    return True, here, cost


@kernel
def network_covariance(poses: FloatArray, terms: Terms) -> tuple[bool, FloatArray]:
    """Joint covariance (3n, 3n) of all poses, and whether there is one."""
    n = len(poses)
    first = _first_columns(terms, n)
    hessian, gradient = np.empty((3 * n, 3 * n)), np.empty(3 * n)
    _system(poses, terms, 0.0, first, hessian, gradient)
    result = np.zeros((3 * n, 3 * n))
    if not _factorise(hessian, first):
        return False, result
    _inverse(hessian, first, result)
    return True, result
