"""What an uncertain path does to a fix: against the fit itself, motion by motion."""

import numpy as np
import pytest

from frontends.absolute.bending import Strip, bending


def strip(motions, count=9):
    way = np.linspace(0.0, 8.0, count)
    xyyaw = np.stack([way, 0.05 * way**2, 0.1 * way], axis=1)
    ahead = np.stack([np.cos(xyyaw[:, 2]), np.sin(xyyaw[:, 2])], axis=1)
    return Strip(
        xyyaw, xyyaw[:, :2] + 4.0 * ahead, np.full(count, 3.0), np.full(count, 100.0), motions
    )


def test_a_path_that_is_exact_bends_nothing():
    assert np.all(bending(strip([np.zeros((3, 3))] * 8), 4) == 0.0)


def test_it_is_the_scatter_of_the_places_at_which_wrong_strips_fit():
    rng = np.random.default_rng(3)
    sigma = np.array([0.02, 0.01, 0.004])
    sigmas = [sigma * (20.0 if k == 5 else 1.0) for k in range(8)]  # one motion was lost
    true, anchor = strip([np.diag(s**2) for s in sigmas]), 4
    offsets = rng.normal(0.0, 1.0, (60, 2))
    offsets *= np.sqrt(3.0 / np.mean(np.sum((offsets - offsets.mean(axis=0)) ** 2, axis=1)))
    offsets -= offsets.mean(axis=0)

    def ground(xyyaw):
        """What each keyframe sees, placed by a path; the ground is where `true` has it."""
        placed = []
        for seen, at, wrong in zip(true.ground_m, true.xyyaw, xyyaw, strict=True):
            turn = wrong[2] - at[2]
            matrix = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
            placed.append((seen + offsets - at[:2]) @ np.transpose(matrix) + wrong[:2])
        return np.concatenate(placed)

    found = []
    for _ in range(600):
        path = [true.xyyaw[0]]
        for k in range(8):
            a, b, e = true.xyyaw[k], true.xyyaw[k + 1], 0.02 * sigmas[k] * rng.standard_normal(3)
            turn = path[-1][2]
            back = np.array([[np.cos(a[2]), np.sin(a[2])], [-np.sin(a[2]), np.cos(a[2])]])
            on = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            step = on @ (back @ (b[:2] - a[:2]) + e[:2])
            path.append(np.array([*(path[-1][:2] + step), turn + b[2] - a[2] + e[2]]))
        wrong = np.array(path)
        # the strip as it is laid out, moved so that its anchor is where the true one is
        seen, at = ground(wrong), wrong[anchor]
        turn = true.xyyaw[anchor, 2] - at[2]
        matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        seen = (seen - at[:2]) @ matrix.T + true.xyyaw[anchor, :2]
        wanted = ground(true.xyyaw)
        a, b = seen - seen.mean(axis=0), wanted - wanted.mean(axis=0)
        yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
        matrix = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        place = matrix @ (true.xyyaw[anchor, :2] - seen.mean(axis=0)) + wanted.mean(axis=0)
        found.append([*(place - true.xyyaw[anchor, :2]), yaw])
    stated = 0.02**2 * bending(true, anchor)
    scatter = np.cov(np.transpose(found))
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(stated)), rtol=0.12)
    squared = np.einsum("ni,ij,nj->n", found, np.linalg.inv(stated), found)
    assert np.mean(squared) / 3.0 == pytest.approx(1.0, abs=0.15)
