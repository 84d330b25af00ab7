"""The vote on the fix keyframes: what gates and kernels get wrong."""

import numpy as np
import pytest

from lunar_fg.graph.ballot import NONE, Ballot, Group
from lunar_fg.graph.network import Claim
from lunar_fg.graph.planar import Planar, composed, turn
from lunar_fg.graph.stories import Refused, stories
from lunar_fg.graph.vote import Vote

BARRIER = 16.27
STEP = Planar(np.array([100.0, 0.0, 0.1]), np.diag([1.0, 4.0, 4e-4]))
PLACE = np.diag([1.0, 1.0, 4e-4])


def truths(n):
    poses = [np.zeros(3)]
    for _ in range(n):
        poses.append(composed(poses[-1], STEP.xyyaw))
    return poses


def ballot(offsets, seed=0, start_sigma=0.01, variance=1.0):
    """One fix a station; of each `offsets` the claims' errors, first one first."""
    covariance = variance * STEP.covariance
    rng = np.random.default_rng(seed)
    poses = truths(len(offsets))
    root = np.linalg.cholesky(covariance)
    motions = [Planar(STEP.xyyaw + root @ rng.normal(size=3), covariance) for _ in offsets]
    groups = [
        Group(
            tuple(
                Claim(i, Planar(poses[i] + off + rng.normal(size=3) * [1, 1, 0.02], PLACE))
                for off in np.atleast_2d(claims)
            )
        )
        for i, claims in enumerate(offsets, start=1)
    ]
    start = Planar(np.zeros(3), start_sigma**2 * np.eye(3))
    return Ballot(start, tuple(motions), tuple(groups))


def decide(the_ballot, incumbent=None):
    incumbent = incumbent or [None] * len(the_ballot.groups)
    return Vote(the_ballot, BARRIER).decide(incumbent)


@pytest.mark.parametrize("seed", range(5))
def test_random_false_fixes_are_found(seed):
    rng = np.random.default_rng(seed)
    false = rng.random(20) < 0.4
    wrong = rng.uniform(20, 60, (20, 3)) * rng.choice([-1, 1], (20, 3)) * [1, 1, 0]
    outcome = decide(ballot(wrong * false[:, None], seed))
    assert [choice is None for choice in outcome.chosen] == false.tolist()


@pytest.mark.parametrize("seed", range(5))
def test_false_fixes_that_agree_do_not_outvote_the_path(seed):
    """60 % are off by one and the same vector; counted one by one they would win."""
    rng = np.random.default_rng(seed)
    false = np.ones(20, dtype=bool)
    false[rng.choice(20, 8, replace=False)] = False
    false[0] = False
    outcome = decide(ballot(false[:, None] * np.array([60.0, -45.0, 0.0]), seed))
    assert [choice is None for choice in outcome.chosen] == false.tolist()


def test_a_believed_false_start_is_corrected():
    """What gates one after another never recover from."""
    offsets = np.zeros((8, 3))
    offsets[0] = [5.0, 5.0, 0.0]
    loose = ballot(offsets, start_sigma=3.0)
    outcome = decide(loose, [0] + [None] * 7)
    assert outcome.chosen == (None, *[0] * 7)
    assert np.sqrt(outcome.distance[0][0]) > 4.0
    assert all(np.sqrt(d[0]) < 4.0 for d in outcome.distance[1:])


def test_of_a_group_the_true_place_wins():
    offsets = [[[30.0, 0, 0], [0, 0, 0], [0, -40.0, 0]]] * 6 + [[[25.0, 0, 0], [0, 33.0, 0]]]
    outcome = decide(ballot([np.array(o) for o in offsets]))
    assert outcome.chosen == (1, 1, 1, 1, 1, 1, None)


def test_forced_groups_are_not_voted_on():
    free = ballot(np.zeros((6, 3)))
    groups = list(free.groups)
    groups[2] = Group(groups[2].claims, forced=NONE)
    assert decide(Ballot(free.start, free.motions, tuple(groups))).chosen == (0, 0, None, 0, 0, 0)
    wrong = ballot([np.array([0, 40.0, 0]) if i == 3 else np.zeros(3) for i in range(6)])
    groups = list(wrong.groups)
    assert decide(wrong).chosen[3] is None
    groups[3] = Group(groups[3].claims, forced=0)
    assert decide(Ballot(wrong.start, wrong.motions, tuple(groups))).chosen[3] == 0


def test_a_loop_closure_is_a_claim_on_two_stations():
    poses = truths(6)
    closed = turn(poses[1][2]).T @ (poses[5][:2] - poses[1][:2])
    motion = Planar(np.array([*closed, poses[5][2] - poses[1][2]]), 0.01 * PLACE)
    off = Planar(motion.xyyaw + np.array([9.0, 0.0, 0.0]), motion.covariance)
    plain = ballot(np.zeros((6, 3)))
    groups = (*plain.groups, Group((Claim(5, motion, 1),)), Group((Claim(5, off, 1),)))
    outcome = decide(Ballot(plain.start, plain.motions, groups))
    assert outcome.chosen == (*[0] * 7, None)


def test_leaving_one_out_is_exact():
    """The distance of a believed claim is its innovation against all others."""
    whole = ballot(np.zeros((6, 3)), seed=4)
    inside = decide(whole)
    groups = list(whole.groups)
    groups[3] = Group(groups[3].claims, forced=NONE)
    without = decide(Ballot(whole.start, whole.motions, tuple(groups)))
    np.testing.assert_allclose(inside.distance[3], without.distance[3], rtol=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_one_story_turns_into_the_other(seed):
    """Half are off by 7 m and come in runs, which hold each other in."""
    false = np.array([c == "f" for c in "ffTTTTffffTTffTTfTTf"])
    whole = ballot(false[:, None] * np.array([5.0, -5.0, 0.0]), seed, variance=0.1)
    chosen = []
    for n in range(1, len(false) + 1):
        so_far = Ballot(whole.start, whole.motions[:n], whole.groups[:n])
        chosen = list(decide(so_far, [*chosen, None]).chosen)
    assert [choice is None for choice in chosen] == false.tolist()


def test_places_that_a_loose_path_brings_together_tell_no_story():
    """Two agree within what the path does not know: no reason to count them once."""
    station = np.array([1, 2])
    near = np.array([[30.0, 0.0, 0.0], [30.5, 1.0, 0.01]])
    far = np.array([[30.0, 0.0, 0.0], [20.0, 15.0, 0.0]])
    for off, sigma, told in ((near, 0.5, 1), (near, 50.0, 0), (far, 0.5, 0), (far, 50.0, 0)):
        path = np.diag([0.0] * 3 + [sigma**2, sigma**2, 1e-4] * 2)
        refused = Refused(station, station, off, np.stack([PLACE] * 2))
        assert len(stories(refused, path, BARRIER, 0)[1]) == told


@pytest.mark.parametrize("seed", range(4))
def test_true_places_are_not_told_as_two_stories(seed):
    """Any noise fits better in two halves, each about its own middle."""
    off = np.random.default_rng(seed).normal(size=(60, 3)) * [1.0, 1.0, 0.02]
    off = off[np.argsort(off[:, 0])]
    chi_square = (off**2 / np.diag(PLACE)).sum(axis=1)
    half = np.arange(30)
    refused = Refused(half, half, off[:30], np.stack([PLACE] * 30))
    cost, _ = stories(refused, 1e-8 * np.eye(90), BARRIER, 30)
    assert cost + chi_square[30:].sum() > chi_square.sum()
