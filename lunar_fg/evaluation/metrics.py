"""The figures of a run: what ``metrics.json`` holds and ``lunar-fg eval`` prints.

The dataclasses mirror the JSON key by key. A figure that cannot be computed is None (null),
and `warnings` says why.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lunar_fg.route import RouteSummary


@dataclass(frozen=True, slots=True)
class AteRmse:
    """Absolute trajectory error (rmse, m) after each alignment."""

    none: float | None = None
    origin: float | None = None
    yaw: float | None = None
    se3: float | None = None
    sim3: float | None = None


@dataclass(frozen=True, slots=True)
class KittiDrift:
    """Mean segment errors, see `lunar_fg.evaluation.drift.segment_errors`."""

    translation_percent: float | None = None
    rotation_deg_per_m: float | None = None


@dataclass(frozen=True, slots=True)
class Rpe:
    """Frame-to-frame error, rmse."""

    translation_m: float | None = None
    rotation_deg: float | None = None


@dataclass(frozen=True, slots=True)
class NeesBand:
    """NEES a degree of freedom, its 95 % band, and the independent poses it is worth."""

    mean: float | None = None
    lower95: float | None = None
    upper95: float | None = None
    n: float | None = None


@dataclass(frozen=True, slots=True)
class StageTiming:
    """Time a frame of one stage, ms."""

    median: float
    p95: float


@dataclass(frozen=True, slots=True)
class Accuracy:
    """What a comparison of an estimate with the truth gives.

    Attributes
    ----------
    distance_m
        Length of the true path over the compared poses; of the estimate without truth.
    ate_rmse_m, scale_sim3, kitti, rpe, nees
        See the modules `alignment`, `drift` and `consistency`.
    final_error_m
        Position error of the last pose, from a common start (see `evaluate`).
    warnings
        Why figures are missing, and what must be known to read the others.
    """

    distance_m: float | None = None
    ate_rmse_m: AteRmse = AteRmse()
    scale_sim3: float | None = None
    kitti: KittiDrift = KittiDrift()
    rpe: Rpe = Rpe()
    final_error_m: float | None = None
    nees: NeesBand = NeesBand()
    warnings: tuple[str, ...] = ()

    def to_json(self) -> str:
        """One JSON object, the accuracy keys of ``metrics.json``."""
        return to_json(asdict(self))


@dataclass(frozen=True, slots=True)
class Metrics:
    """Everything in ``metrics.json``, in its order."""

    frames: int
    frames_lost: int
    distance_m: float | None
    ate_rmse_m: AteRmse
    scale_sim3: float | None
    kitti: KittiDrift
    rpe: Rpe
    final_error_m: float | None
    nees: NeesBand
    timing_ms: Mapping[str, StageTiming]
    matches: Mapping[str, float]
    warnings: tuple[str, ...]
    route: RouteSummary | None = None
    dead_reckoning: Accuracy | None = None

    @classmethod
    def of_run(
        cls,
        accuracy: Accuracy,
        *,
        frames: int,
        frames_lost: int,
        timing_ms: Mapping[str, ArrayLike] | None = None,
        matches: Mapping[str, ArrayLike] | None = None,
        warnings: Sequence[str] = (),
        route: RouteSummary | None = None,
        dead_reckoning: Accuracy | None = None,
    ) -> Metrics:
        """Metrics of a run from its accuracy and what was counted a frame.

        Parameters
        ----------
        accuracy
            From `lunar_fg.evaluation.evaluate` or `without_truth`.
        frames, frames_lost
            Frames read, and those whose motion was only predicted.
        timing_ms
            For each stage the time of each frame, ms; a stage that did not run in a frame
            has no entry, or NaN.
        matches
            For each kind of match the count of each frame; medians are kept.
        warnings
            Of the run; they come before those of the accuracy.
        route
            Of the drive along a planned route, where there was one.
        dead_reckoning
            Of the same drive by wheels and attitude alone, where there were wheels.
        """
        figures = {f.name: getattr(accuracy, f.name) for f in fields(Accuracy)}
        figures["warnings"] = (*warnings, *accuracy.warnings)
        timing = {stage: _finite(samples) for stage, samples in (timing_ms or {}).items()}
        counts = {name: _finite(samples) for name, samples in (matches or {}).items()}
        return cls(
            frames=frames,
            frames_lost=frames_lost,
            timing_ms={
                stage: StageTiming(float(np.median(ms)), float(np.percentile(ms, 95)))
                for stage, ms in timing.items()
                if ms.size
            },
            matches={name: float(np.median(n)) for name, n in counts.items() if n.size},
            route=route,
            dead_reckoning=dead_reckoning,
            **figures,
        )

    def to_json(self) -> str:
        """Text of ``metrics.json``."""
        return to_json(asdict(self))


def to_json(figures: Mapping[str, Any]) -> str:
    """Indented JSON; a NaN or infinity, which JSON does not know, is null."""
    return json.dumps(_plain(figures), indent=2, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _finite(samples: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    array = np.asarray(samples, dtype=np.float64).ravel()
    return array[np.isfinite(array)]
