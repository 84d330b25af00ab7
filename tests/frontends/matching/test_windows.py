"""The window search kernel against a slow reference."""

import numpy as np
import pytest

from frontends.matching import SearchWindows, match_in_windows

SAME_POINT_PX = 3.0


def slow(query, query_sign, windows, train, train_sign, train_uv, ratio, max_distance2):
    """The rules of `match_in_windows`, one pair of loops a rule."""
    n, m = len(query), len(train)
    cost = np.full((n, m), np.inf)
    for i in range(n):
        for j in range(m):
            inside = (
                abs(train_uv[j, 0] - windows.u[i]) <= windows.half_width
                and abs(train_uv[j, 1] - windows.v[i]) <= windows.half_height
            )
            if inside and query_sign[i] == train_sign[j]:
                cost[i, j] = ((query[i].astype(float) - train[j]) ** 2).sum()
    pairs = []
    for i in range(n):
        if not np.isfinite(cost[i]).any():
            continue
        j = int(cost[i].argmin())
        elsewhere = np.hypot(*(train_uv - train_uv[j]).T) > SAME_POINT_PX
        second = min(cost[i][elsewhere].min(initial=np.inf), 4.0)
        if cost[i, j] > max_distance2 or cost[i, j] > ratio**2 * second:
            continue
        if int(cost[:, j].argmin()) == i:
            pairs.append((i, j, cost[i, j]))
    return pairs


def problem(seed, n=120, m=150, width=12, size=100.0):
    rng = np.random.default_rng(seed)
    train = rng.standard_normal((m, width)).astype(np.float32)
    train /= np.linalg.norm(train, axis=1, keepdims=True)
    partner = rng.integers(0, m, n)
    query = (train[partner] + 0.25 * rng.standard_normal((n, width))).astype(np.float32)
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    train_uv = rng.uniform(0, size, (m, 2))
    train_uv[: m // 4] = train_uv[m // 4 : 2 * (m // 4)] + rng.uniform(-3, 3, (m // 4, 2))
    # the same point found twice, not quite alike: ties would be decided by the order
    train[: m // 8] = train[m // 4 : m // 4 + m // 8] + 0.02 * train[-(m // 8) :]
    train_sign = rng.choice(np.array([-1, 1], np.int8), m)
    query_sign = np.where(rng.random(n) < 0.85, train_sign[partner], -train_sign[partner])
    centre = train_uv[partner] + rng.uniform(-12, 12, (n, 2))
    return query, query_sign.astype(np.int8), centre, train, train_sign, train_uv


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("half", [(20.0, 20.0), (100.0, 1.5), (5.0, 40.0), (1e6, 1e6)])
def test_the_kernel_is_the_definition(seed, half):
    query, query_sign, centre, train, train_sign, train_uv = problem(seed)
    windows = SearchWindows(centre[:, 0], centre[:, 1], *half)
    found = match_in_windows(
        query, query_sign, windows, train, train_sign, train_uv, ratio=0.8, max_distance2=0.6
    )
    expected = slow(query, query_sign, windows, train, train_sign, train_uv, 0.8, 0.6)
    if half[1] > 10.0:
        assert len(expected) > 5
    assert [(int(q), int(t)) for q, t in zip(found.query, found.train, strict=True)] == [
        pair[:2] for pair in expected
    ]
    np.testing.assert_allclose(found.distance2, [pair[2] for pair in expected], atol=1e-5)
    assert found.candidates == len(query)


def one_to_one(train_uv, centre, half=(10.0, 2.0), signs=(1, 1), width=4):
    descriptor = np.eye(1, width, dtype=np.float32)
    return match_in_windows(
        descriptor,
        np.array(signs[:1], np.int8),
        SearchWindows(np.array([centre[0]]), np.array([centre[1]]), *half),
        descriptor,
        np.array(signs[1:], np.int8),
        np.array([train_uv], float),
    )


@pytest.mark.parametrize(
    ("place", "inside"),
    [
        ((60.0, 50.0), True),
        ((40.0, 50.0), True),
        ((50.0, 52.0), True),
        ((50.0, 48.0), True),
        ((60.0, 48.0), True),
        ((60.01, 50.0), False),
        ((39.99, 50.0), False),
        ((50.0, 52.01), False),
        ((50.0, 47.99), False),
    ],
)
def test_window_borders_belong_to_the_window(place, inside):
    assert len(one_to_one(place, (50.0, 50.0))) == inside


def test_a_bright_blob_never_matches_a_dark_one():
    assert len(one_to_one((50.0, 50.0), (50.0, 50.0), signs=(1, 1))) == 1
    assert len(one_to_one((50.0, 50.0), (50.0, 50.0), signs=(1, -1))) == 0


def test_the_same_point_found_twice_is_no_rival_but_another_point_is():
    descriptor = np.array([[1.0, 0.0]], np.float32)
    train = np.repeat(descriptor, 2, axis=0) + np.array([[0.05], [0.06]], np.float32)
    for gap, count in ((2.9, 1), (3.1, 0)):
        found = match_in_windows(
            descriptor,
            np.ones(1, np.int8),
            SearchWindows(np.zeros(1), np.zeros(1), 50.0, 50.0),
            train,
            np.ones(2, np.int8),
            np.array([[0.0, 0.0], [gap, 0.0]]),
        )
        assert len(found) == count, gap


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0)])
def test_nothing_to_match(n, m):
    found = match_in_windows(
        np.zeros((n, 64), np.float32),
        np.zeros(n, np.int8),
        SearchWindows(np.zeros(n), np.zeros(n), 5.0, 5.0),
        np.zeros((m, 64), np.float32),
        np.zeros(m, np.int8),
        np.zeros((m, 2)),
    )
    assert len(found) == 0
    assert found.candidates == n


def test_order_of_the_train_set_does_not_matter():
    query, query_sign, centre, train, train_sign, train_uv = problem(3)
    windows = SearchWindows(centre[:, 0], centre[:, 1], 20.0, 20.0)
    found = match_in_windows(query, query_sign, windows, train, train_sign, train_uv)
    order = np.random.default_rng(0).permutation(len(train))
    again = match_in_windows(
        query, query_sign, windows, train[order], train_sign[order], train_uv[order]
    )
    same = (train[found.train] == train[order[again.train]]).all()
    assert same
    np.testing.assert_array_equal(found.query, again.query)
