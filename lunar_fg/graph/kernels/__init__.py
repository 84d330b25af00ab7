"""The inner loops of segments, gate and vote, compiled: serial, without the GIL, cached."""

from __future__ import annotations

from functools import cache

import numpy as np

from lunar_fg.graph.kernels.forward import gated, squared_lengths
from lunar_fg.graph.kernels.gate import distances
from lunar_fg.graph.kernels.motions import add_motions, moved
from lunar_fg.graph.kernels.network import (
    Terms,
    dead_reckoned,
    network_covariance,
    network_terms,
    solve_network,
)
from lunar_fg.graph.kernels.projection import LEAST_DEPTH_SHARE
from lunar_fg.graph.kernels.system import (
    inverse_positive,
    linearise,
    step_of,
    stepped,
    whiteners,
)

__all__ = [
    "LEAST_DEPTH_SHARE",
    "Terms",
    "add_motions",
    "dead_reckoned",
    "distances",
    "gated",
    "inverse_positive",
    "linearise",
    "moved",
    "network_covariance",
    "network_terms",
    "solve_network",
    "squared_lengths",
    "step_of",
    "stepped",
    "warm",
    "whiteners",
]


@cache
def warm() -> None:
    """Load or compile all kernels now (once a process), not in the middle of a run."""
    one, pixels = np.eye(4)[None], np.array([[20.0, 10.0, 5.0], [20.0, 10.0, 5.0]])
    lens = np.array([100.0, 100.0, 10.0, 10.0, 10.0])
    white = whiteners(np.stack([np.eye(3)] * 2))
    none, starts = np.zeros(2, dtype=np.int64), np.array([0, 2])
    points = np.array([[0.0, 0.0, 1.0, 0.0]])
    _, hessian, gradient, *landmarks = linearise(
        lens, one, points, pixels, white, none, starts, 2.0
    )
    stepped(points, gradient, none, starts, landmarks[0], landmarks[1], landmarks[2], 1.0)
    step_of(hessian, gradient, 0.0)
    moved(one, gradient)
    add_motions(one, none, none, one, hessian[None] + np.eye(6), hessian, gradient)
    inverse_positive(hessian + np.eye(6))
    noise = np.stack([np.eye(3)] * 2)
    distances(lens, pixels, noise, pixels, noise, none, one, hessian[None])
    place, here = np.zeros((1, 3)), none[:1]
    terms = Terms(here, here, place, noise[:1], np.ones(1))
    dead_reckoned(place)
    solve_network(place, terms, 1)
    network_covariance(place, terms)
    network_terms(place, terms)
    squared_lengths(place, noise[:1])
    gated(place, noise[:1], 0, here, none, here, here, 1.0)
