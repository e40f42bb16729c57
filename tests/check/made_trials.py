"""Synthetic trials for tests."""

import math
from dataclasses import replace

import made_check

from orthonav.ground.check.trials import Trial

NOWHERE = (math.nan, math.nan)
CONDITIONS = replace(made_check.CONDITIONS, prior_std_m=50.0, speed_mps=20.0, drift=0.03)


def judged(error_m, confidence):
    """Whether a fix is right, and whether it is wrong."""
    accepted, near = confidence >= CONDITIONS.accept, error_m <= CONDITIONS.radius_m
    return accepted and near, accepted and not near


def right(en_m, *, error_m=2.0, confidence=0.99, expected=0.5, rival=NOWHERE, share=None):
    """A trial that was placed `error_m` east of its true position."""
    found = (en_m[0] + error_m, en_m[1])
    share = math.nan if share is None else share
    known = judged(error_m, confidence)
    return Trial(tuple(en_m), error_m, confidence, expected, *known, found, rival, share)


def lost(en_m, *, expected=0.5):
    """A trial without a fix."""
    return Trial(tuple(en_m), math.nan, 0.0, expected)


def misplaced(en_m, found_en_m, *, confidence=0.99, expected=0.5):
    """A trial with a fix in a wrong place."""
    error_m = math.dist(en_m, found_en_m)
    known = judged(error_m, confidence)
    return Trial(tuple(en_m), error_m, confidence, expected, *known, tuple(found_en_m))
