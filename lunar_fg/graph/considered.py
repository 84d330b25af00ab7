"""The error of the calibration's scale in the covariances, as the fixes of the moment leave it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frontends.measurements import FloatArray
from lunar_fg.graph.fixes import FixJudge
from lunar_fg.graph.scale import Anchors, FixedScale
from lunar_fg.graph.setup import Setup


class ConsideredScale:
    """What `scale` says, kept until a fix changes it.

    Parameters
    ----------
    setup
        Of the graph.
    judge
        Knows the fixes.
    frames
        Frame number of each keyframe; it may grow.
    """

    def __init__(self, setup: Setup, judge: FixJudge, frames: Sequence[int]) -> None:
        self._setup, self._judge, self._frames = setup, judge, frames
        self._sigma = setup.config.scale_sigma
        self._warning: tuple[str, ...] = ()
        self._anchors: Anchors | None = None

    @property
    def warning(self) -> tuple[str, ...]:
        """One line where the fixes contradict the calibration."""
        if self._frames:
            self._fixed_at()
        return self._warning

    def changed(self) -> None:
        """Forget what is kept: there is a fix more, or another verdict."""
        self._anchors = None

    def covariances(
        self, frames: Sequence[int], poses: FloatArray, covariances: FloatArray
    ) -> FloatArray:
        """Covariances (N, 6, 6) of keyframes at `poses` (N, 4, 4) with the scale's share."""
        index = np.array(frames, dtype=np.int64)
        return self._fixed_at().considered(index, poses, covariances, self._sigma)

    def _fixed_at(self) -> Anchors:
        if self._anchors is None:
            scale, moved = self._judge.fixed_scale(self._setup.config.scale_sigma)
            self._take(scale)
            self._anchors = Anchors.of(
                self._frames[0],
                self._setup.start.map_T_rover,
                self._judge.ledger,
                {self._frames[ordinal]: shift for ordinal, shift in moved.items()},
            )
        return self._anchors

    def _take(self, scale: FixedScale | None) -> None:
        """Consider a scale as wrong as the fixes say, and say so where they contradict it."""
        config = self._setup.config
        self._sigma = config.scale_sigma if scale is None else scale.considered(config.scale_sigma)
        self._warning = ()
        if scale is not None and scale.contradicts(config.scale_sigma, config.fix_gate_probability):
            length = "long" if scale.excess > 0.0 else "short"
            self._warning = (
                f"by the fixes the path is {100.0 * abs(scale.excess):.1f} % too {length} (sigma "
                f"{100.0 * scale.sigma:.1f} %): check the baseline and the focal length; the "
                "covariances allow for it",
            )
