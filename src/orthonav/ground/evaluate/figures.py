"""Basic statistics: shares, percentiles, intervals, runs."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_Z95 = 1.959963984540054  # two-sided 95 % of a normal distribution


def share(part: int, whole: int) -> float:
    """`part` of `whole`, 0 to 1; NaN for a `whole` of 0."""
    return part / whole if whole else math.nan


def mean(values: FloatArray) -> float:
    """Mean of `values` (N,); NaN for none."""
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
    """A read-only copy as float64."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Start and stop of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def or_none(value: float | np.floating) -> float | None:
    """`value` for strict JSON, which knows neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None
