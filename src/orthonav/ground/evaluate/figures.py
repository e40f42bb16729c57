"""Statistics: shares, percentiles, intervals, stretches of a flight; APE, RPE, CEP50 and CEP95.

Pose errors are horizontal: trajectories are positions in an east-north plane, with neither
alignment nor scale correction, and only views with a fix are poses of them. Definitions: evo's
documentation, https://github.com/MichaelGrupp/evo/wiki/Metrics (translation part).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

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
    if part == whole:
        return 1.0
    counts = np.arange(1, part + 1)
    logs = np.concatenate([[0.0], np.cumsum(np.log((whole - counts + 1) / counts))])
    ks = np.arange(part + 1)

    def chance_of_more(rate: float) -> float:
        return 1 - float(
            np.exp(logs + ks * math.log(rate) + (whole - ks) * math.log1p(-rate)).sum()
        )

    return root(chance_of_more, 0.95, 1.0)


def root(rising: Callable[[float], float], value: float, largest: float) -> float:
    """Where a function that rises from 0 to `largest` takes a value, by bisection."""
    low, high = 0.0, largest
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if rising(middle) < value else (low, middle)
    return high


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


RPE_FRAMES = 1
"""evo's default delta: from each pose to the next."""
RPE_DISTANCE_M = 100.0
"""The shortest segment of the KITTI odometry benchmark (Geiger et al., CVPR 2012)."""


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of `n` errors in metres, NaN without any; `std_m` divides by `n`, as evo does."""

    n: int
    rmse_m: float
    mean_m: float
    median_m: float
    std_m: float
    max_m: float


@dataclass(frozen=True)
class StandardFigures:
    """The standard figures of one flight, or of several pooled.

    `ape`: absolute pose error, the distance between a fix and its true position.
    `rpe_frames`: relative pose error from each fix to the next.
    `rpe_distance`: relative pose error over `distance_m` of the true path.
    `cep50_m`, `cep95_m`: circular error probable, the radius around the true position that holds
    50 % and 95 % of the fixes.
    """

    ape: ErrorStatistics
    rpe_frames: ErrorStatistics
    rpe_distance: ErrorStatistics
    distance_m: float
    cep50_m: float
    cep95_m: float


def standard_figures(
    truth_en_m: FloatArray,
    fix_en_m: FloatArray,
    starts: Sequence[int] = (0,),
    distance_m: float = RPE_DISTANCE_M,
) -> StandardFigures:
    """Standard figures of positions (N, 2) in metres, NaN where there is no fix.

    `starts` are the indices at which flights begin: relative errors do not cross them. Raises
    `ValueError` for a distance that is not positive.
    """
    if not 0.0 < distance_m < math.inf:
        raise ValueError(f"the distance of RPE must be positive and finite, got {distance_m} m")
    errors_m = np.hypot(*(fix_en_m - truth_en_m).T)
    errors_m = errors_m[np.isfinite(errors_m)]
    frames: list[FloatArray] = []
    distances: list[FloatArray] = []
    for first, last in pairwise((*starts, len(truth_en_m))):
        fixes = np.flatnonzero(np.isfinite(fix_en_m[first:last]).all(axis=1)) + first
        truth, found = truth_en_m[fixes], fix_en_m[fixes]
        steps = np.arange(0, len(fixes), RPE_FRAMES)
        frames.append(relative_errors_m(truth, found, steps))
        distances.append(relative_errors_m(truth, found, _marks(truth, distance_m)))
    return StandardFigures(
        ape=error_statistics(errors_m),
        rpe_frames=error_statistics(np.concatenate(frames)),
        rpe_distance=error_statistics(np.concatenate(distances)),
        distance_m=distance_m,
        cep50_m=percentile(errors_m, 50.0),
        cep95_m=percentile(errors_m, 95.0),
    )


def relative_errors_m(
    truth_en_m: FloatArray, fix_en_m: FloatArray, chosen: NDArray[np.intp]
) -> FloatArray:
    """(K - 1,) errors of the displacement between consecutive ones of K `chosen` positions."""
    error_en_m = np.diff(fix_en_m[chosen], axis=0) - np.diff(truth_en_m[chosen], axis=0)
    return np.asarray(np.hypot(error_en_m[:, 0], error_en_m[:, 1]))


def error_statistics(errors_m: FloatArray) -> ErrorStatistics:
    if not errors_m.size:
        return ErrorStatistics(0, *[math.nan] * 5)
    return ErrorStatistics(
        n=errors_m.size,
        rmse_m=math.sqrt(float(np.mean(errors_m**2))),
        mean_m=float(errors_m.mean()),
        median_m=float(np.median(errors_m)),
        std_m=float(errors_m.std()),
        max_m=float(errors_m.max()),
    )


def _marks(truth_en_m: FloatArray, distance_m: float) -> NDArray[np.intp]:
    """Indices at which the path since the index before, first since the start, reaches a distance.

    These are evo's consecutive pairs in metres, taken from the reference trajectory.
    """
    steps_m = np.hypot(*np.diff(truth_en_m, axis=0).T)
    marks, path_m = [], 0.0
    for i, step_m in enumerate(steps_m, start=1):
        path_m += float(step_m)
        if path_m >= distance_m:
            marks.append(i)
            path_m = 0.0
    return np.array(marks, dtype=np.intp)
