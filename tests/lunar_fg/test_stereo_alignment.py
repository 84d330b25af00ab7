"""A rig that bends is told of, with when and how far; one that does not, is not."""

import numpy as np

from lunar_fg.checkpoint import Checkpoint
from lunar_fg.stereo_alignment import StereoAlignment


def seen(offsets_px, alignment=None, first=0):
    alignment = alignment or StereoAlignment()
    for frame, offset_px in enumerate(offsets_px, start=first):
        alignment.see(frame, offset_px)
    return alignment


def test_a_rig_that_keeps_still_is_not_told_of_whatever_its_offset():
    rng = np.random.default_rng(0)
    assert seen(12.0 + 0.1 * rng.standard_normal(200)).warnings == ()


def test_a_rig_that_bends_and_comes_back_is_told_of_with_the_most_it_bent():
    bent = seen([1.0] * 5 + [1.4, 2.0, -3.0, 0.2] + [1.1] * 5 + [1.6])
    assert len(bent.warnings) == 2
    assert bent.warnings[0].startswith("frames 6 to 8: the images lie up to -4.0 px elsewhere")
    assert bent.warnings[1].startswith("frame 14: the images lie up to +0.6 px elsewhere")


def test_a_checkpoint_keeps_what_was_seen():
    bent = seen([0.0, 0.0, 3.0, 4.0])
    kept = Checkpoint.from_bytes(Checkpoint(alignment=bent.state).to_bytes())
    resumed = StereoAlignment()
    resumed.restore(kept.alignment)
    for alignment in (bent, resumed):
        seen([5.0, 0.0], alignment, first=4)
    assert resumed.warnings == bent.warnings
    assert "frames 2 to 4" in bent.warnings[0]
    untouched = StereoAlignment()
    untouched.restore(Checkpoint().alignment)
    assert untouched.warnings == ()
