"""Would as many correspondences agree on a motion by chance: an a-contrario test.

Wrong matches fall anywhere in the search window, so that their residuals fill the space
around any motion evenly: a shell of seven times the gate's volume holds seven times as many
as the gate. A true motion has far more inside. The shell therefore tells how many agree by
chance, whatever the windows, the texture and the noise; the test asks how often the best of
all three-point samples would reach the count that was found (Desolneux, Moisan & Morel 2000;
Moisan & Stival 2004).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import pdtrc

FloatArray = NDArray[np.float64]

#: Correspondences that define a motion.
_SAMPLE = 3
#: Volume of the shell from one to two gate radii, in volumes of the gate, three dimensions.
_SHELL = 7.0


def false_alarms(distances2: FloatArray, gate: float) -> float:
    """Expected number of motions that wrong matches alone would support as well.

    Parameters
    ----------
    distances2
        (N,) squared Mahalanobis distances of all correspondences from the motion, three
        degrees of freedom each.
    gate
        Below it a correspondence agrees.

    Returns
    -------
    float
        Well below 1 for a motion that the landmarks show; may be far above 1.
    """
    agree = int((distances2 < gate).sum())
    shell = int(((distances2 >= gate) & (distances2 < 4.0 * gate)).sum())
    if agree <= _SAMPLE:
        return math.inf
    by_chance = (shell + 1.0) / _SHELL
    samples = math.comb(len(distances2), _SAMPLE)
    return float(samples * pdtrc(agree - _SAMPLE - 1, by_chance))
