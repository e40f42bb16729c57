"""Time and path of a flight, and the longest stretch of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthonav.ground.evaluate.figures import BoolArray, FloatArray, runs


@dataclass(frozen=True)
class Longest:
    """The longest of several stretches in time, and in metres of the true path."""

    seconds_s: float
    path_m: float


def seconds_since_first(times_ns: Sequence[float]) -> FloatArray:
    """(N,) seconds since the first view; all NaN where times are unknown, fall or stand still.

    Nanoseconds since 1970 do not fit a float64: they are subtracted before they become one.
    """
    unknown = np.full(len(times_ns), math.nan)
    if not times_ns or not all(math.isfinite(time) for time in times_ns):
        return unknown
    seconds = np.array([(time - times_ns[0]) / 1e9 for time in times_ns], dtype=np.float64)
    rises = bool((np.diff(seconds) >= 0.0).all()) and seconds[-1] > 0.0
    return seconds if rises or len(seconds) == 1 else unknown


def path_so_far_m(truth_en_m: FloatArray) -> FloatArray:
    """(N,) metres along the true positions (N, 2) until each of them."""
    steps_m = np.hypot(*np.diff(truth_en_m, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def longest_stretch(flags: BoolArray, until: FloatArray) -> float:
    """The largest rise of `until` from the start of a run to its end; 0 without runs."""
    last = len(flags) - 1
    steps = [until[min(stop, last)] - until[start] for start, stop in runs(flags)]
    return float(max(steps, default=0.0 if np.isfinite(until).all() else math.nan))


def longest(flags: BoolArray, seconds_s: FloatArray, path_m: FloatArray) -> Longest:
    """The longest run of true flags (N,) in time and in metres of the path; NaN without views."""
    if not flags.size:
        return Longest(math.nan, math.nan)
    return Longest(longest_stretch(flags, seconds_s), longest_stretch(flags, path_m))
