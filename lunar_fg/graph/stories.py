"""Refused places that agree with each other: one common error, not many independent ones.

A repetitive terrain, or a map that is shifted, makes false fixes that are all off by the same
vector. Counted one by one they would outvote the path; so the refused ones that one offset
explains cost one barrier together, and the path decides which of two stories is true. That they
agree counts for what it tells: nothing where the path itself is as loose as they are apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frontends.measurements import FloatArray, IntArray

#: How far an offset may be (m) and turn (rad).
_OFFSET_SIGMAS = (1e4, 1e4, 0.02)


@dataclass(frozen=True, slots=True)
class Refused:
    """Refused places, one row each.

    Attributes
    ----------
    group
        (M,) which group each belongs to; of a group at most one place is in a story.
    station
        (M,) where.
    off
        (M, 3) place less the station's estimate, map axes.
    covariance
        (M, 3, 3) of the places.
    """

    group: IntArray
    station: IntArray
    off: FloatArray
    covariance: FloatArray


def stories(
    refused: Refused, covariance: FloatArray, barrier: float, believed: int
) -> tuple[float, list[IntArray]]:
    """What all refused groups cost together, and the stories of two or more that are told.

    Parameters
    ----------
    refused
        The places.
    covariance
        (3n, 3n) of the stations, map axes, without the refused ones.
    barrier
        What one independent error costs.
    believed
        How many groups are not refused.

    Returns
    -------
    tuple
        The cost, and of each story the rows of its members.
    """
    told: list[IntArray] = []
    left = np.ones(len(refused.group), dtype=bool)
    sizes, total = [believed], 0.0
    n = len(covariance) // 3
    joint = covariance.reshape(n, 3, n, 3)[refused.station][:, :, refused.station]
    rows = np.arange(len(refused.group))
    joint[rows, :, rows] += refused.covariance
    agree = _agreement(refused, joint) <= barrier
    while left.any():
        members = _largest(agree & left[:, None] & left[None], refused.group)
        while len(members) > 1:
            cost = barrier + _fit(
                refused.off[members],
                joint[np.ix_(members, np.arange(3), members)],
                refused.covariance[members],
            )
            cost += _division([*sizes, len(members)]) - _division(sizes)
            if cost < barrier * len(members):
                break
            cost = np.inf
            members = members[:-1]
        if len(members) < 2:
            break
        told.append(members)
        sizes.append(len(members))
        total += cost
        left &= ~np.isin(refused.group, refused.group[members])
    return total + barrier * len(np.unique(refused.group[left])), told


def _division(sizes: list[int]) -> float:
    """Twice the negative logarithm of the likelihood that each belongs where it does.

    Any places are better described in two parts than in one; what the division itself takes to
    be told outweighs that.
    """
    share = np.array(sizes, dtype=np.float64)
    share = share[share > 0.0]
    return float(-2.0 * (share * np.log(share / share.sum())).sum())


def _agreement(refused: Refused, joint: FloatArray) -> FloatArray:
    """Squared Mahalanobis distance of each two offsets from each other, (M, M)."""
    own = np.einsum("aiaj->aij", joint)
    cross = joint.transpose(0, 2, 1, 3)
    spread = own[:, None] + own[None] - cross - cross.transpose(0, 1, 3, 2)
    spread = spread + np.diag([0.0, 0.0, 2.0 * _OFFSET_SIGMAS[2] ** 2])
    off = refused.off[:, None] - refused.off[None]
    rows = np.arange(len(off))
    spread[rows, rows] = np.eye(3)
    solved = np.linalg.solve(spread, off[..., None])[..., 0]
    return np.asarray(np.einsum("abi,abi->ab", off, solved))


def _largest(agree: NDArray[np.bool_], group: IntArray) -> IntArray:
    """Members of the largest set that agrees with one of them, one a group."""
    best: IntArray = np.empty(0, dtype=np.int64)
    count = agree.sum(axis=1)
    for seed in np.flatnonzero(count):
        if count[seed] < len(best):
            continue
        members = np.flatnonzero(agree[seed])
        members = members[members != seed]
        members = members[group[members] != group[seed]]
        _, first = np.unique(group[members], return_index=True)
        if len(first) + 1 > len(best):
            best = np.concatenate([[seed], members[first]])
    return best


def _fit(off: FloatArray, joint: FloatArray, noise: FloatArray) -> float:
    """What offsets (m, 3) cost that are one unknown vector plus noise.

    Chi-square, and how much looser than its own noise each but the first is predicted: places
    that a loose path brings together agree by chance.
    """
    m = len(off)
    covariance = joint.reshape(3 * m, 3 * m) + np.tile(np.diag(np.square(_OFFSET_SIGMAS)), (m, m))
    loose = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(covariance[:3, :3])[1]
    loose -= np.linalg.slogdet(noise[1:])[1].sum()
    return float(off.ravel() @ np.linalg.solve(covariance, off.ravel()) + loose)
