"""Matching without geometry: k-d tree, brute force, ratio and mutual tests."""

import numpy as np
import pytest

from frontends.errors import InputError
from frontends.matching import match_descriptors


def descriptors(n, seed, width=64):
    rows = np.random.default_rng(seed).standard_normal((n, width)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def noisy(rows, sigma, seed):
    rows = rows + sigma * np.random.default_rng(seed).standard_normal(rows.shape)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def slow(query, train, ratio, mutual):
    """What the two tests mean, in double precision."""
    distance2 = ((query[:, None].astype(float) - train[None].astype(float)) ** 2).sum(axis=2)
    pairs = []
    for i, row in enumerate(distance2):
        j, second = np.argsort(row, kind="stable")[:2]
        if row[j] <= ratio**2 * row[second] and (not mutual or distance2[:, j].argmin() == i):
            pairs.append((i, int(j)))
    return pairs


@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize("ratio", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("method", ["kd-tree", "brute"])
def test_both_searches_give_the_pairs_of_the_definition(method, ratio, mutual):
    train = descriptors(300, 0, width=16)
    query = np.concatenate([noisy(train[:150], 0.12, 1), descriptors(120, 2, width=16)])
    found = match_descriptors(query, train, ratio=ratio, mutual=mutual, method=method)
    expected = slow(query, train, ratio, mutual)
    assert len(expected) > 20
    assert list(zip(found.query, found.train, strict=True)) == expected
    exact = ((query[found.query] - train[found.train]) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.distance2, exact, atol=1e-5)
    assert found.candidates == len(query)


def test_true_partners_are_found_and_random_ones_refused():
    train = descriptors(500, 3)
    order = np.random.default_rng(4).permutation(500)
    found = match_descriptors(noisy(train[order], 0.03, 5), train)
    assert len(found) > 480
    assert np.mean(found.train == order[found.query]) > 0.99
    assert len(match_descriptors(descriptors(500, 6), train, ratio=0.7)) < 10


def test_no_train_feature_is_used_twice_in_mutual_matches():
    train = descriptors(20, 7)
    query = noisy(np.repeat(train, 10, axis=0), 0.05, 8)
    found = match_descriptors(query, train, ratio=1.0)
    assert len(np.unique(found.train)) == len(found) == 20


def test_repeated_texture_is_refused_by_the_ratio():
    one = descriptors(1, 9)
    # all about equally near: nothing says which
    found = match_descriptors(one, noisy(np.repeat(one, 5, axis=0), 1e-3, 10), ratio=0.8)
    assert len(found) == 0


@pytest.mark.parametrize("method", ["kd-tree", "brute"])
@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0), (5, 1), (1, 1), (1, 2)])
def test_few_features_are_no_error(method, n, m):
    found = match_descriptors(descriptors(n, 1), descriptors(m, 2), ratio=1.0, method=method)
    assert len(found) == (1 if (n, m) == (1, 2) else 0)
    assert found.query.dtype == found.train.dtype == np.int64
    assert len(found.select(np.zeros(len(found), bool))) == 0


@pytest.mark.parametrize("ratio", [0.0, -0.5, 1.2, np.nan])
def test_a_ratio_out_of_range_is_named(ratio):
    with pytest.raises(InputError, match="ratio") as caught:
        match_descriptors(descriptors(3, 1), descriptors(3, 2), ratio=ratio)
    assert caught.value.field == "ratio"


@pytest.mark.parametrize("shapes", [((3, 64), (3, 128)), ((3,), (3, 64)), ((3, 64), (64,))])
def test_sets_that_cannot_be_compared_are_input_errors(shapes):
    first, second = (np.zeros(shape, np.float32) for shape in shapes)
    with pytest.raises(InputError, match="cannot be compared"):
        match_descriptors(first, second)
