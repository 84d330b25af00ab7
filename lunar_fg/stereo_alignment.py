"""Whether the two cameras keep their place against each other during a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar_fg.plausibility import frames_named

#: A vertical offset below this is within what the epipolar band allows for anyway, px.
NOTEWORTHY_OFFSET_PX = 0.5


@dataclass(frozen=True, slots=True)
class _Span:
    """Frames during which the images lay elsewhere, and by how much at most, px."""

    first: int
    last: int
    most_px: float


class StereoAlignment:
    """Notices where the images of a pair lie elsewhere vertically than when the run began.

    Perception measures the vertical offset, removes it and follows it as it changes
    (`frontends.stereo`): the estimate goes on, but a rig that was bent is worth a word.
    """

    def __init__(self) -> None:
        self._at_start_px: float | None = None
        self._spans: list[_Span] = []

    def see(self, frame: int, offset_px: float) -> None:
        """Take in the vertical offset (v_left - v_right) that was removed from a frame, px."""
        if self._at_start_px is None:
            self._at_start_px = offset_px
        moved = offset_px - self._at_start_px
        if abs(moved) <= NOTEWORTHY_OFFSET_PX:
            return
        if self._spans and self._spans[-1].last == frame - 1:
            span = self._spans.pop()
            most = moved if abs(moved) > abs(span.most_px) else span.most_px
            self._spans.append(_Span(span.first, frame, most))
        else:
            self._spans.append(_Span(frame, frame, moved))

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each run of frames."""
        return tuple(
            f"{frames_named(span.first, span.last)}: the images lie up to {span.most_px:+.1f} px "
            "elsewhere vertically than when the run began: the cameras have moved against each "
            "other; followed and removed"
            for span in self._spans
        )

    @property
    def state(self) -> NDArray[np.float64]:
        """All that `restore` needs: the first offset, then three values a span."""
        if self._at_start_px is None:
            return np.zeros(0)
        spans = [(span.first, span.last, span.most_px) for span in self._spans]
        return np.concatenate([[self._at_start_px], np.ravel(spans)])

    def restore(self, state: NDArray[np.float64]) -> None:
        """Go on from the `state` of another one."""
        if not len(state):
            return
        self._at_start_px = float(state[0])
        self._spans = [
            _Span(int(first), int(last), float(most))
            for first, last, most in state[1:].reshape(-1, 3)
        ]
