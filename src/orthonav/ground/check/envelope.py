"""Tolerated errors of heading and height, and the best height to fly at."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.check.outcome import Alternative, Envelope
from orthonav.ground.check.trials import Trial, Work
from orthonav.ground.check.views import TrialPlan

Array = NDArray[np.float64]
YAW_OFF_DEG = (0.0, 5.0, 10.0, 15.0, 20.0)
AGL_OFF = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Errors tried: about one to four default standard deviations."""
TOLERATED = 0.85
"""An error is tolerated while the rate of fixes stays above this part of that without error."""
HEIGHTS = (0.5, 0.7, 1.4, 2.0)
"""Other heights tried, as parts of the planned one: steps of about the square root of two."""


def envelope_work(plan: TrialPlan, places_en_m: Array) -> list[Work]:
    """Trials at the same places for every error of heading and height."""
    return [
        (replace(plan, yaw_off_deg=yaw, agl_off=agl), places_en_m)
        for yaw in YAW_OFF_DEG
        for agl in AGL_OFF
    ]


def envelope_of(trials: Sequence[Sequence[Trial]]) -> Envelope:
    """The envelope from the trials of `envelope_work`."""
    shares = [right_share(each) for each in trials]
    share = np.array(shares, np.float64).reshape(len(YAW_OFF_DEG), len(AGL_OFF))
    middle = AGL_OFF.index(0.0)
    tolerated = (share >= TOLERATED * share[0, middle]) & (share > 0)
    yaw = YAW_OFF_DEG[_last_without_gap(tolerated[:, middle])]
    low = AGL_OFF[middle - _last_without_gap(tolerated[0, middle::-1])]
    high = AGL_OFF[middle + _last_without_gap(tolerated[0, middle:])]
    return Envelope(np.array(YAW_OFF_DEG), np.array(AGL_OFF), share, yaw, low, high)


def _last_without_gap(tolerated: NDArray[np.bool_]) -> int:
    gaps = np.flatnonzero(~tolerated)
    return max(int(gaps[0]) - 1, 0) if len(gaps) else len(tolerated) - 1


def heights_work(plan: TrialPlan, places_en_m: Array) -> list[Work]:
    """Trials at the same places from other heights."""
    return [(replace(plan, agl_m=plan.agl_m * part), places_en_m) for part in HEIGHTS]


def heights_of(
    plan: TrialPlan, planned: Sequence[Trial], others: Sequence[Sequence[Trial]]
) -> tuple[Alternative, ...]:
    """Alternatives from `planned` trials at `plan.agl_m` and those of `heights_work`, by height."""
    tried = sorted({1.0: planned, **dict(zip(HEIGHTS, others, strict=True))}.items())
    return tuple(
        Alternative("agl_m", plan.agl_m * part, right_share(each), part == 1.0)
        for part, each in tried
    )


def right_share(trials: Sequence[Trial]) -> float:
    """Fraction of trials that were confident and correct; NaN without trials."""
    return float(np.mean([each.right for each in trials])) if trials else float("nan")
