"""Verdicts on fixes against the truth."""

from dataclasses import replace

import numpy as np
import pytest

from frontends.measurements import AbsoluteFix, FixCandidate, Verdict
from lunar_fg.evaluation.fixes import FixCounts, count_fixes
from lunar_fg.graph.ledger import Height, LedgerEntry, Ruling

SHARP = np.diag([0.05, 0.05, 0.01]) ** 2
VAGUE = np.diag([2.0, 2.0, 0.01]) ** 2


def entry(number, candidates, believed):
    verdict = Verdict.REFUSED if believed is None else Verdict.ACCEPTED
    fix = AbsoluteFix(number, tuple(candidates))
    return LedgerEntry(number, fix, (Ruling(number, verdict, believed, 1.0, "", number),))


def place(x, covariance=SHARP):
    return FixCandidate(x, 0.0, 0.0, covariance)


def test_what_was_right_and_what_was_believed():
    ledger = [
        entry(0, [place(0.1)], 0),  # right, believed
        entry(1, [place(5.0), place(1.0)], 1),  # the second place is right, and believed
        entry(2, [place(9.0)], 0),  # wrong, believed
        entry(3, [place(3.1)], None),  # right, refused
        entry(4, [place(8.0, VAGUE)], 0),  # far, but within what it states
        entry(5, [], None),  # nothing found
        entry(99, [place(0.0)], 0),  # no truth
        LedgerEntry(7, Height(0, 1.0, 0.1), (Ruling(0, Verdict.ACCEPTED, 0, 1.0, "", 7),)),
    ]
    counts = count_fixes(ledger, {k: np.array([float(k), 0.0]) for k in range(6)})
    # errors of 2, 0, 2 and 2 sigmas along one of two axes
    assert counts.nees == pytest.approx(1.5)
    assert replace(counts, nees=None) == FixCounts(tried=6, right=4, accepted=4, accepted_right=3)
    assert counts.precision == 0.75
    assert counts.recall == 0.75


def test_without_fixes_there_is_no_rate():
    assert count_fixes([], {}).precision is None
    assert count_fixes([], {}).recall is None
    assert count_fixes([], {}).nees is None
