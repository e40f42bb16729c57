"""Synthetic trials for tests."""

import math
from dataclasses import replace

import made_check

from orthonav.ground.check.trials import Trial

CONDITIONS = replace(made_check.CONDITIONS, prior_std_m=50.0, speed_mps=20.0, drift=0.03)


def right(en_m, *, error_m=2.0, expected=0.5):
    return Trial(tuple(en_m), error_m, expected, right=True)


def lost(en_m, *, expected=0.5):
    """A trial without a fix."""
    return Trial(tuple(en_m), math.nan, expected)


def misplaced(en_m, found_en_m, *, expected=0.5):
    """A trial with a fix in a wrong place."""
    return Trial(tuple(en_m), math.dist(en_m, found_en_m), expected, wrong=True)
