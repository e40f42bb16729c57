"""Basic statistics: shares, percentiles, intervals, runs, and stretches of a flight."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_Z95 = 1.959963984540054  # two-sided 95 % of a normal distribution


@dataclass(frozen=True)
class Longest:
    seconds_s: float
    path_m: float


def share(part: int | np.integer, whole: int) -> float:
    """`part` of `whole`, 0 to 1; NaN for a `whole` of 0."""
    return float(part / whole) if whole else math.nan


def share_of(flags: BoolArray, whole: int | None = None) -> float:
    return share(np.count_nonzero(flags), flags.size if whole is None else whole)


def mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else math.nan


def percentile(values: FloatArray, percent: float) -> float:
    """A percentile of the finite ones of `values` (N,); NaN for none."""
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if finite.size else math.nan


def wilson(part: int, whole: int) -> tuple[float, float]:
    """The 95 % interval of a share, given `part` of `whole`; NaN for a `whole` of 0.

    Wilson, "Probable inference, the law of succession, and statistical inference", 1927: unlike
    the normal interval it stays within 0 to 1 and has a width at 0 and 1.
    """
    if not whole:
        return math.nan, math.nan
    seen, square = part / whole, _Z95**2 / whole
    middle = (seen + square / 2) / (1 + square)
    half = math.sqrt(square * (seen * (1 - seen) + square / 4)) / (1 + square)
    low = 0.0 if part == 0 else max(middle - half, 0.0)
    high = 1.0 if part == whole else min(middle + half, 1.0)
    return low, high


def upper_bound(part: int, whole: int) -> float:
    """The one-sided 95 % upper bound of a rate, given `part` of `whole`; NaN for a `whole` of 0.

    Clopper and Pearson, "The use of confidence or fiducial limits", 1934: exact for independent
    cases; for 0 of n it is 1 - 0.05^(1 / n), about 3 / n.
    """
    if not whole:
        return math.nan
    return 1.0 if part == whole else float(betaincinv(part + 1, whole - part, 0.95))


def frozen(values: FloatArray | Sequence[float]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


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
    steps_m = np.hypot(*np.diff(truth_en_m, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def longest_stretch(flags: BoolArray, until: FloatArray) -> float:
    """The largest rise of `until` from the start of a run to its end; 0 without runs."""
    last = len(flags) - 1
    steps = [until[min(stop, last)] - until[start] for start, stop in runs(flags)]
    return float(max(steps, default=0.0 if np.isfinite(until).all() else math.nan))


def longest(flags: BoolArray, seconds_s: FloatArray, path_m: FloatArray) -> Longest:
    if not flags.size:
        return Longest(math.nan, math.nan)
    return Longest(longest_stretch(flags, seconds_s), longest_stretch(flags, path_m))
