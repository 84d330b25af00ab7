"""What was decided on every map measurement, when, and why."""

from __future__ import annotations

from dataclasses import dataclass

from frontends.measurements import AbsoluteFix, FloatArray, Verdict


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """A measured motion between two keyframes that need not follow each other.

    Attributes
    ----------
    base, frame
        Indices of the earlier and of the later keyframe.
    a_T_b
        (4, 4) pose of the rover at `frame` in the rover at `base`.
    covariance
        (6, 6), right perturbation, rover axes at `frame`.
    """

    base: int
    frame: int
    a_T_b: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Height:
    """The height of a keyframe in the map, m, e.g. from an orbital elevation model."""

    frame: int
    z_m: float
    sigma_m: float


MapMeasurement = AbsoluteFix | LoopClosure | Height


@dataclass(frozen=True, slots=True)
class Ruling:
    """One verdict on a map measurement.

    Attributes
    ----------
    at_frame
        Latest keyframe when it was given.
    verdict
        Whether the measurement is in the graph from then on.
    candidate
        Which of its places is believed, or None.
    mahalanobis
        Distance, in sigmas, of the believed or else the nearest place from what everything
        else said; NaN where there is none.
    reason
        In words.
    number
        Of all rulings of a run, in the order in which they were given, from 0.
    by_person
        A person's word; it holds whatever a later vote says.
    """

    at_frame: int
    verdict: Verdict
    candidate: int | None
    mahalanobis: float
    reason: str
    number: int
    by_person: bool = False


@dataclass(frozen=True, slots=True)
class LedgerEntry:
    """A map measurement and all that was decided on it, in order; the last ruling holds.

    Attributes
    ----------
    number
        In the order in which they came, from 0.
    measurement
        As given.
    history
        One ruling or more.
    """

    number: int
    measurement: MapMeasurement
    history: tuple[Ruling, ...]

    @property
    def ruling(self) -> Ruling:
        """What holds now."""
        return self.history[-1]

    @property
    def frame(self) -> int:
        """Keyframe that it says something about."""
        return self.measurement.frame

    @property
    def base(self) -> int | None:
        """Earlier keyframe of a loop closure."""
        measurement = self.measurement
        return measurement.base if isinstance(measurement, LoopClosure) else None


@dataclass(frozen=True, slots=True)
class FixDecision:
    """What became of a new map measurement, and what it changed.

    Attributes
    ----------
    entry
        The measurement with its ruling.
    changes
        Earlier measurements whose verdict changed with it, with their new last ruling.
    accepted_frames, refused_frames
        Keyframes of all fixes that are in the graph now, and of those that are not.
    """

    entry: LedgerEntry
    changes: tuple[LedgerEntry, ...]
    accepted_frames: tuple[int, ...]
    refused_frames: tuple[int, ...]

    @property
    def verdict(self) -> Verdict:
        """Of the new measurement."""
        return self.entry.ruling.verdict

    @property
    def accepted(self) -> bool:
        """Whether it is in the graph."""
        return self.verdict is Verdict.ACCEPTED

    @property
    def candidate(self) -> int | None:
        """Which place is believed."""
        return self.entry.ruling.candidate

    @property
    def mahalanobis(self) -> float:
        """Distance from what was expected, sigmas."""
        return self.entry.ruling.mahalanobis

    @property
    def reason(self) -> str:
        """Why."""
        return self.entry.ruling.reason
