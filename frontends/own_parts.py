"""The rover's own parts in the picture: they stay where they are while the ground moves.

Deck, wheels and arm agree on one motion, none, and can be more than the ground's landmarks: a
drive would look like a stop. When the ground moves, there is a second motion in the same picture
that chance does not explain. Which of the two is the rover's own is told by the distance: it is
nearer than what it drives over. A rover that truly stands shows no second motion, or, where its
arm moves, a nearer one.
"""

from __future__ import annotations

import numpy as np

from frontends.measurements import RelativePose
from frontends.relative import MotionPrediction, RelativePositioning
from frontends.tracks import Tracks

#: Of landmarks that agree on standing still, so many have not moved in the image either.
_MOST = 0.9


def without_own_parts(
    positioning: RelativePositioning,
    tracks: Tracks,
    relative: RelativePose,
    prediction: MotionPrediction,
) -> tuple[Tracks, RelativePose, bool]:
    """Tracks of the ground and their motion, where the rover's own parts outnumber them.

    Parameters
    ----------
    positioning
        Measures motions.
    tracks, relative
        What a frame shows, and the motion that most of it agrees on.
    prediction
        Of the motion since the previous frame.

    Returns
    -------
    tracks, relative
        As given, but where nothing moved nearby and something farther off did: that.
    bool
        Whether all that agrees stayed where it was.
    """
    if not relative.accepted:
        return tracks, relative, False
    still = positioning.agreeing(
        np.eye(4), tracks.points_a, tracks.covariance_a, tracks.observations_b
    )
    agreeing = tracks.agreeing(relative)
    if np.mean(still[agreeing]) < _MOST:
        return tracks, relative, False
    rest = tracks.select(np.flatnonzero(~still))
    moved = positioning.estimate(rest.points_a, rest.covariance_a, rest.observations_b, prediction)
    if not moved.accepted:
        return tracks, relative, True
    near, far = tracks.points_a[agreeing, 2], rest.points_a[rest.agreeing(moved), 2]
    if np.median(near) > np.median(far):
        return tracks, relative, True
    return rest, moved, False
