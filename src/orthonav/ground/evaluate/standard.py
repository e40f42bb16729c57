"""Standard figures of the field: APE and RPE as evo defines them, CEP50 and CEP95.

Errors are horizontal: trajectories are positions in an east-north plane, with neither alignment nor
scale correction, and only views with a fix are poses of them. Definitions: evo's documentation,
https://github.com/MichaelGrupp/evo/wiki/Metrics (translation part). ECE and NEES are in
`orthonav.ground.evaluate.calibration`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from orthonav.ground.evaluate.figures import FloatArray, percentile

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
