"""What a run writes down as it goes; a run without a log writes nothing."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

from frontends.errors import InputError
from frontends.measurements import Estimate
from frontends.revisit import Place
from lunar_fg.checkpoint import Checkpoint
from lunar_fg.graph.keyframe import Keyframe
from lunar_fg.graph.ledger import FixDecision, LedgerEntry
from lunar_fg.log import TraverseLog
from lunar_fg.log_entries import LoggedFrame
from lunar_fg.record import FrameRecord


@dataclass(frozen=True, slots=True)
class Past:
    """What a run has written before it was interrupted.

    Attributes
    ----------
    frames
        All of them, at least one, each with its record.
    checkpoint
        From where the images' side goes on.
    ledger
        Map measurements with all verdicts.
    places
        What is kept of old places.
    """

    frames: tuple[LoggedFrame, ...]
    checkpoint: Checkpoint
    ledger: tuple[LedgerEntry, ...]
    places: tuple[Place, ...]

    @property
    def keyframes(self) -> list[Keyframe]:
        """Measurements of all frames."""
        return [frame.keyframe for frame in self.frames]

    @property
    def estimates(self) -> list[Estimate]:
        """Where all frames led as they came in."""
        return [frame.estimate for frame in self.frames]

    @property
    def records(self) -> list[FrameRecord]:
        """What all frames gave beside their measurements."""
        return [frame.record for frame in self.frames if frame.record is not None]


class Journal:
    """The traverse log of a run, or none.

    Parameters
    ----------
    log
        None: all that is written is dropped.
    """

    def __init__(self, log: TraverseLog | None) -> None:
        self._log = log

    def one_entry(self) -> AbstractContextManager[None]:
        """All that is written within is written or lost together."""
        return nullcontext() if self._log is None else self._log.together()

    def frame(
        self, keyframe: Keyframe, estimate: Estimate, record: FrameRecord, checkpoint: Checkpoint
    ) -> None:
        """Write a frame: what was measured, where it led, from where the images go on."""
        if self._log is not None:
            self._log.append(keyframe, estimate, record, checkpoint)

    def place(self, place: Place) -> None:
        """Write what is kept of a place."""
        if self._log is not None:
            self._log.append_place(place)

    def decision(self, decision: FixDecision) -> None:
        """Write the verdict on a map measurement, and those that it changed."""
        if self._log is not None:
            self._log.append_decisions([decision])

    def ledger(self, ledger: Sequence[LedgerEntry]) -> None:
        """Write all map measurements anew."""
        if self._log is not None:
            self._log.replace_ledger(ledger)

    def rewrite(
        self,
        entries: Sequence[tuple[Keyframe, Estimate]],
        checkpoint: Checkpoint,
        ledger: Sequence[LedgerEntry],
        places: Sequence[Place],
    ) -> None:
        """Write all frames anew, after a correction of their measurements."""
        if self._log is not None:
            self._log.rewrite(entries, checkpoint, ledger, places)

    def past(self) -> Past | None:
        """What was written so far; None if that is nothing.

        Raises
        ------
        InputError
            A run cannot go on from it, or it cannot be read.
        """
        if self._log is None:
            return None
        frames, newest = self._log.frames(), self._log.checkpoint()
        if not frames:
            return None
        whole = all(frame.record is not None for frame in frames)
        if newest is None or newest[0] != frames[-1].keyframe.index or not whole:
            raise InputError(
                "holds measurements only: the images' side cannot go on from it",
                source="log",
                remedy="use `lunar-fg replay`, or run again",
            )
        ledger, places = self._log.ledger(), self._log.places()
        return Past(tuple(frames), newest[1], tuple(ledger), tuple(places))
