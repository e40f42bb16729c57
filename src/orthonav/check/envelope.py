"""How far heading and height may be off, and at which height views are placed best."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import Alternative, Envelope
from orthonav.check.trials import Trial
from orthonav.check.views import TrialPlan

Array = NDArray[np.float64]
YAW_OFF_DEG = (0.0, 5.0, 10.0, 15.0, 20.0)
AGL_OFF = (-0.2, -0.1, 0.0, 0.1, 0.2)
STILL_FINE = 0.85
"""Errors are fine while the share of fixes stays above this part of that without them."""
HEIGHTS = (0.5, 0.7, 1.4, 2.0)
"""Other heights that are tried, as parts of the planned one."""

Work = list[tuple[TrialPlan, Array]]


def envelope_work(plan: TrialPlan, places_en_m: Array) -> Work:
    """Trials at the same places for every error of heading and height."""
    exact = replace(plan, agl_off=0.0)
    return [
        (replace(exact, yaw_off_deg=yaw, agl_off=agl), places_en_m)
        for yaw in YAW_OFF_DEG
        for agl in AGL_OFF
    ]


def envelope_of(found: Sequence[Sequence[Trial]], accept: float, radius_m: float) -> Envelope:
    """From the outcome of `envelope_work`."""
    shares = [accepted_share(trials, accept, radius_m) for trials in found]
    share = np.array(shares, np.float64).reshape(len(YAW_OFF_DEG), len(AGL_OFF))
    middle = AGL_OFF.index(0.0)
    least = STILL_FINE * share[0, middle]
    fine = (share >= least) & (share > 0)
    yaw = YAW_OFF_DEG[_reach(fine[:, middle])]
    low = AGL_OFF[middle - _reach(fine[0, middle::-1])]
    high = AGL_OFF[middle + _reach(fine[0, middle:])]
    return Envelope(np.array(YAW_OFF_DEG), np.array(AGL_OFF), share, yaw, low, high)


def _reach(fine: NDArray[np.bool_]) -> int:
    """How many steps from the first are fine without a gap."""
    gaps = np.flatnonzero(~fine)
    return max(int(gaps[0]) - 1, 0) if len(gaps) else len(fine) - 1


def heights_work(plan: TrialPlan, places_en_m: Array) -> Work:
    """Trials at the same places from other heights."""
    return [(replace(plan, agl_m=plan.agl_m * part), places_en_m) for part in HEIGHTS]


def heights_of(
    plan: TrialPlan,
    found: Sequence[Sequence[Trial]],
    planned: float,
    accept: float,
    radius_m: float,
) -> tuple[Alternative, ...]:
    """From the outcome of `heights_work`, and what was found at the `planned` height."""
    others = [
        Alternative("agl_m", plan.agl_m * part, accepted_share(trials, accept, radius_m))
        for part, trials in zip(HEIGHTS, found, strict=True)
    ]
    chosen = Alternative("agl_m", plan.agl_m, planned, chosen=True)
    return tuple(sorted([*others, chosen], key=lambda each: each.value))


def accepted_share(trials: Sequence[Trial], accept: float, radius_m: float) -> float:
    """Share of trials that were confident and right; NaN of none."""
    kept = [each.confidence >= accept and each.error_m <= radius_m for each in trials]
    return float(np.mean(kept)) if kept else float("nan")
