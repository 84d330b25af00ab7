"""Settings of the factor graph."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from frontends.relative import LANDMARK_CORRELATION


class GraphConfig(BaseModel):
    """How measurements become a trajectory; every value is a probability, a sigma or a count.

    Attributes
    ----------
    landmarks
        ``"segments"``: a short window of stereo landmark factors is solved and marginalised
        to one relative pose, iSAM2 smooths the poses. ``"full"``: all landmarks stay in iSAM2.
    segment_keyframes
        Motions a segment spans; its boundary keyframes are the poses of the graph.
    gate_probability
        Share of good landmark tracks that the two-view chi-square gate lets pass.
    robust_threshold_sigma
        Huber's threshold on a landmark's whitened residual (3 values), sigmas.
    landmark_correlation
        Between the errors of any two landmarks of a segment or of a relative pose: they look at
        the same rocks under the same light from the same side, so that ever more of them do not
        average the error out. N landmarks count for N / (1 + correlation N).
    disparity_sigma_px
        Error of all disparities of a segment alike that calibration and matching leave.
    scale_sigma
        Share by which the calibration's scale (baseline, focal length) may be wrong for good:
        considered in every covariance, not estimated. See `lunar_fg.graph.scale`.
    min_tracks
        With fewer landmark tracks from earlier keyframes than this, the measured relative
        pose carries a keyframe instead of its landmarks.
    max_track_gap
        For how many keyframes a landmark may stay unseen and still be the same landmark.
    max_landmarks
        In a segment; of more, the longest tracks are taken.
    fix_gate_probability
        Share of true absolute fixes and loop closures that the chi-square gate lets pass.
    fix_window
        How many of the latest fixes and loop closures are judged anew with each new one.
    max_iterations
        Of the solver of one segment, and of the offline optimiser (ten times as many).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    landmarks: Literal["segments", "full"] = "segments"
    segment_keyframes: int = Field(default=10, ge=1, le=100)
    gate_probability: float = Field(default=0.999, gt=0.5, lt=1.0)
    robust_threshold_sigma: float = Field(default=2.0, ge=0.5, le=100.0)
    landmark_correlation: float = Field(default=LANDMARK_CORRELATION, ge=0.0, le=1.0)
    disparity_sigma_px: float = Field(default=0.05, ge=0.0, le=10.0)
    scale_sigma: float = Field(default=0.005, ge=0.0, le=1.0)
    min_tracks: int = Field(default=8, ge=3)
    max_track_gap: int = Field(default=10, ge=1)
    max_landmarks: int = Field(default=1000, ge=20)
    fix_gate_probability: float = Field(default=0.999, gt=0.5, lt=1.0)
    fix_window: int = Field(default=40, ge=1, le=200)
    max_iterations: int = Field(default=20, ge=1, le=1000)
