"""iSAM2 behind a guard: a failed update costs its own factors, never the trajectory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TypeVar

import gtsam
import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray
from lunar_fg.graph.books import Books
from lunar_fg.graph.descent import descend, named_landmark, values_without
from lunar_fg.graph.isam_steps import (
    GTSAM_ERRORS,
    Relinearization,
    carry,
    first_line,
    joint_covariance,
    linearization,
    ordered_last,
    require_finite,
)
from lunar_fg.graph.snapshots import Snapshot, Snapshots

_MOST_SETTLING_STEPS = 100
_MOST_REPAIRS = 12
_T = TypeVar("_T")

QR_WARNING = (
    "GTSAM's Cholesky refused the graph (loose directions have drifted past 4096 local sigmas, "
    "or nothing anchors the vertical); iSAM2 goes on with QR, which is slower"
)


class GuardedIsam:
    """An ISAM2 that can be rebuilt from its own books after any failure.

    Parameters
    ----------
    qr
        Factorise by QR from the start. QR has no limit on how far loose directions drift;
        Cholesky is faster with many landmarks.
    relinearization
        When it linearises anew.
    snapshots
        How many copies from before the last map measurements are kept.
    unsound
        Names the landmarks that make a system with these values indeterminate; None where
        there are no landmarks.
    """

    def __init__(
        self,
        *,
        qr: bool,
        relinearization: Relinearization | None = None,
        snapshots: int = 1,
        unsound: Callable[[gtsam.Values], set[int]] | None = None,
    ) -> None:
        self._qr = qr
        self._relinearization = relinearization or Relinearization()
        self._snapshots = Snapshots(snapshots)
        self._unsound = unsound or (lambda _: set())
        self._books = Books()
        self._initial = gtsam.Values()
        self._isam = self._relinearization.fresh(qr=qr)
        self._warnings: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know about the solver."""
        return self._warnings

    def _rebuild(self, values: gtsam.Values) -> None:
        isam = self._relinearization.fresh(qr=self._qr)
        self._snapshots.clear()
        self._books = self._books.cleared()
        try:
            if len(self._books):
                isam.update(self._books.factors, values)
        except GTSAM_ERRORS as error:
            if self._qr:
                raise EstimationError(
                    f"the graph cannot be solved ({first_line(error)})"
                ) from error
            self._qr, self._warnings = True, (QR_WARNING,)
            self._rebuild(values)
            return
        self._isam = isam

    def update(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, frame: int
    ) -> set[int]:
        """Add checked factors and the initial values of their new variables.

        Returns
        -------
        set of int
            Keys of landmarks that had to be taken out, with all their factors.

        Raises
        ------
        EstimationError
            When they cannot be solved; the graph is as it was before the call.
        """
        try:
            self._isam.update(factors, values, [], ordered_last(factors))
            if self._relinearization.skip == 1:
                # A new pose that its attitude turned by much counts anew at once.
                self._isam.update()
            require_finite(self._isam, values)
        except GTSAM_ERRORS as error:
            return self._recover(factors, values, frame, error)
        self._books.add(factors)
        self._initial.insert(values)
        return set()

    def exchange(
        self, entering: Mapping[str, gtsam.NonlinearFactor], leaving: Collection[str], frame: int
    ) -> None:
        """Put named factors on known variables in, and take others out, by their index.

        A name stands for one factor for good, in or out.

        Raises
        ------
        EstimationError
            When the graph cannot be solved so; it is as it was before the call.
        """
        wanted = ({*self._books.named} - {*leaving}) | {*entering}
        back = self._snapshots.take(wanted, self._books)
        if back is not None and self._go_back(back, entering, wanted):
            return
        # Copied only where the copy is kept: a failure costs less often than a copy each time.
        before = Snapshot(gtsam.ISAM2(self._isam), self._books.copy()) if entering else None
        factors = gtsam.NonlinearFactorGraph()
        for factor in entering.values():
            factors.add(factor)
        gone = [self._books.named[name] for name in leaving]
        try:
            carry(self._isam, factors, gtsam.Values(), gone)
        except GTSAM_ERRORS as error:
            if before is not None:
                self._isam = before.isam
            else:
                self._rebuild(linearization(self._isam, self._initial))
            raise EstimationError(
                f"keyframe {frame}: the map measurement could not be solved and is left out "
                f"({first_line(error)})"
            ) from error
        if before is not None:
            self._snapshots.keep(before)
        self._books.exchange(entering, leaving)

    def exchange_from(
        self,
        values: gtsam.Values,
        entering: Mapping[str, gtsam.NonlinearFactor],
        leaving: Collection[str],
        frame: int,
    ) -> set[int]:
        """`exchange`, with all variables anew from `values`: for what no linear step reaches.

        Returns
        -------
        set of int
            Keys of landmarks that had to be taken out.

        Raises
        ------
        EstimationError
            As for `exchange`.
        """
        before, self._books = self._books, self._books.copy()
        self._books.exchange(entering, leaving)
        try:
            return self._settle(values)
        except EstimationError as error:
            self._books = before
            raise EstimationError(
                f"keyframe {frame}: the map measurement is left out ({error})"
            ) from error

    def _go_back(
        self,
        back: Snapshot,
        entering: Mapping[str, gtsam.NonlinearFactor],
        wanted: Collection[str],
    ) -> bool:
        """Go on from a snapshot with what came since and is wanted; whether that can be solved."""
        try:
            isam, books = back.grown(self._isam, self._books, entering, wanted)
        except GTSAM_ERRORS:
            return False
        self._snapshots.leave(Snapshot(self._isam, self._books), wanted)
        self._isam, self._books = isam, books
        return True

    def start_anew(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Drop everything but the named factors, and go on from these by QR.

        Raises
        ------
        EstimationError
            When even they cannot be solved.
        """
        self._books, self._initial, self._qr = self._books.only_named(factors), values, True
        self._rebuild(values)

    def remove(self, landmarks: set[int]) -> None:
        """Take landmarks out of the graph, with all their factors."""
        gone = self._books.slots_of(landmarks)
        try:
            self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), gone)
        except GTSAM_ERRORS:
            estimate = linearization(self._isam, self._initial)
            self._books = self._books.cleared(landmarks)
            self._initial = values_without(self._initial, landmarks)
            self._rebuild(values_without(estimate, landmarks))
            return
        self._snapshots.clear()
        self._books.remove(gone)
        self._initial = values_without(self._initial, landmarks)

    def _recover(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        frame: int,
        error: Exception,
    ) -> set[int]:
        """Solve anew without the landmarks that are at fault, by QR if need be."""
        before = linearization(self._isam, self._initial)
        whole, start = self._books.cleared().copy(), gtsam.Values(before)
        whole.add(factors)
        start.insert(values)
        aside: set[int] = set()
        was_qr, reason = self._qr, error
        for _ in range(_MOST_REPAIRS):
            more = (self._unsound(start) | named_landmark(reason)) - aside
            if more:
                aside |= more
                whole, start = whole.cleared(aside), values_without(start, aside)
            elif not self._qr:
                self._qr = True
            else:
                break
            isam = self._relinearization.fresh(qr=self._qr)
            try:
                isam.update(whole.factors, start)
                require_finite(isam, values)
            except GTSAM_ERRORS as failure:
                reason = failure
                continue
            self._snapshots.clear()
            self._isam, self._books, self._initial = isam, whole, start
            if self._qr and not was_qr:
                self._warnings = (QR_WARNING,)
            return aside
        self._qr = was_qr
        self._rebuild(before)
        raise EstimationError(
            f"keyframe {frame}: its measurements could not be solved and are left out "
            f"({first_line(error)})"
        ) from error

    def values(self) -> gtsam.Values:
        """Return the current estimate of all variables."""
        return self._isam.calculateEstimate()

    def pose(self, key: int) -> FloatArray:
        """Return the current estimate, (4, 4)."""
        return np.asarray(self._isam.calculateEstimatePose3(key).matrix())

    def estimate(self, pose: int, landmarks: Iterable[int]) -> gtsam.Values:
        """Return the current estimate of a pose and of those of `landmarks` in the graph."""
        values = gtsam.Values()
        values.insert(pose, self._isam.calculateEstimatePose3(pose))
        for key in landmarks:
            if self._isam.valueExists(key):
                values.insert(key, self._isam.calculateEstimatePoint3(key))
        return values

    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a pose, (6, 6)."""
        return self._marginal(lambda isam: np.asarray(isam.marginalCovariance(key)))

    def joint_covariance(self, *keys: int) -> FloatArray:
        """Joint covariance of n poses, (6 n, 6 n), in the order given."""
        return self._marginal(lambda isam: joint_covariance(isam, keys))

    def _marginal(self, query: Callable[[gtsam.ISAM2], _T]) -> _T:
        try:
            return query(self._isam)
        except GTSAM_ERRORS as error:
            if self._qr:
                raise EstimationError(
                    f"the marginal covariance failed ({first_line(error)})"
                ) from error
        self._qr = True
        self._warnings = (QR_WARNING,)
        self._rebuild(self._isam.calculateEstimate())
        return self._marginal(query)

    def settle(self) -> set[int]:
        """Relinearise everything until no pose moves: where the batch optimiser would end.

        Returns
        -------
        set of int
            Keys of landmarks that had to be taken out.

        Raises
        ------
        EstimationError
            When the graph cannot be solved; the estimate stays as it was.
        """
        if not len(self._books):
            return set()
        return self._settle(self._isam.calculateEstimate())

    def _settle(self, values: gtsam.Values) -> set[int]:
        """`settle` from other values."""
        before = self._isam, self._books, self._initial
        try:
            books = self._books.cleared()
            end = descend(books.factors, values, _MOST_SETTLING_STEPS, self._unsound)
            self._books, self._initial = books.cleared(end.set_aside), end.values
            self._rebuild(self._initial)
        except EstimationError:
            self._isam, self._books, self._initial = before
            raise
        return end.set_aside
