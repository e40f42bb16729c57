"""Recalibration: predicted fix rates from the fix rates of trials.

Trials show the map's own imagery with simulated ageing. Real ground changes more or less than that.
The relation is fitted to real scenes of two dates: `python -m benchmarks.check_trust --fit`.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FULL_VIEW_PX = 256.0
"""Views of so many pixels of the map across need no correction for their width."""
LEAST, MOST = 0.01, 0.99
"""Limits of predictions: no check is more certain of fixes, or of their absence."""


@dataclass(frozen=True)
class Recalibration:
    """Logit of the predicted rate: `shift` + `slope` times that of trials + corrections.

    `narrow`: for every halving of the width of a view below `FULL_VIEW_PX`; `no_prior`: without a
    prior position; `std`: standard deviation of the logit from scene to scene, 0 or more.
    """

    shift: float
    slope: float
    narrow: float
    no_prior: float
    std: float

    def __call__(self, share: Array, view_px: float, has_prior: bool) -> Array:
        """Predicted rates (N,) from those of trials, for views `view_px` pixels of the map."""
        octaves = max(0.0, math.log2(FULL_VIEW_PX / max(view_px, 1.0)))
        added = self.shift + self.narrow * octaves + self.no_prior * (not has_prior)
        return np.asarray(np.clip(expit(self.slope * logit(share) + added), LEAST, MOST))

    def other_sensor(self) -> "Recalibration":
        """For views of another sensor than the map's: a drone over satellite imagery, say."""
        return Recalibration(
            self.shift + OTHER_SENSOR_SHIFT,
            self.slope,
            self.narrow,
            self.no_prior,
            math.hypot(self.std, OTHER_SENSOR_STD),
        )


def logit(share: Array) -> Array:
    """Logarithm of the odds of rates, which are held between `LEAST` and `MOST`."""
    held = np.clip(share, LEAST, MOST)
    return np.asarray(np.log(held / (1 - held)))


def expit(value: Array) -> Array:
    """The inverse of `logit`."""
    return np.asarray(1 / (1 + np.exp(-value)))


PLAIN = Recalibration(0.0, 1.0, 0.0, 0.0, 0.6)
"""Trials as they are; between dates of generated and NAIP imagery the logit differs by 0.6."""
LEARNT = Recalibration(0.85, 0.54, -0.51, -0.2, 0.8)
"""What checks use: fitted to 57 conditions of nine scenes of two dates (docs/check.md)."""
OTHER_SENSOR_SHIFT, OTHER_SENSOR_STD = -0.8, 0.8
"""An assumption that rests on one flight: a drone over two satellite maps was placed less often
than predicted by 0.6 and 1.0 (docs/check.md)."""
