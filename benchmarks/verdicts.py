"""Metrics of located views: errors, confidence, and wrong views among the confident ones."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.placing import FlownView, row_of
from benchmarks.scenes import FAR_M
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import CONFIDENT
from orthonav.ground.evaluate.statistics import calibrate, check_covariance
from orthonav.onboard.run import Locator, locate_view

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Verdict:
    """Results of one method for the views (N) of one flight; NaN where it gave no value.

    - `errors_en_m`: (N, 2), errors east and north, m.
    - `confidence`: (N,), stated confidence, 0 to 1.
    - `radius_m`: (N,), radius of the confidence, m.
    - `cov_en_m2`: (N, 2, 2), stated covariance, m^2.
    - `times_ms`: (N,), time per view, ms.
    """

    errors_en_m: Array
    confidence: Array
    radius_m: Array
    cov_en_m2: Array
    times_ms: Array

    @classmethod
    def of(cls, rows: list[list[float]] | Array) -> "Verdict":
        """From rows of east, north, confidence, radius, three numbers of a covariance, ms."""
        made = np.array(rows, dtype=np.float64).reshape(-1, 8)
        cov = made[:, [4, 5, 5, 6]].reshape(-1, 2, 2)
        return cls(made[:, :2], made[:, 2], made[:, 3], cov, made[:, 7])

    @property
    def errors_m(self) -> Array:
        """Errors (N,), m; infinite without a position."""
        far = np.hypot(self.errors_en_m[:, 0], self.errors_en_m[:, 1])
        return np.where(np.isnan(far), np.inf, far)

    def within(self, radius_m: float) -> NDArray[np.bool_]:
        """Mask (N,) of the views with an error of at most `radius_m`."""
        return self.errors_m <= radius_m

    @property
    def median_m(self) -> float:
        """Median error of positions; NaN without any."""
        known = self.errors_m[np.isfinite(self.errors_m)]
        return float(np.median(known)) if known.size else math.nan

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Mask (N,) of the views with a confidence of at least `CONFIDENT`."""
        return np.asarray(self.confidence >= CONFIDENT)

    @property
    def wrong_accepted(self) -> int:
        """Number of accepted views that are wrong by more than `FAR_M`."""
        return int((self.accepted & (self.errors_m > FAR_M)).sum())

    def accepted_of_right(self, radius_m: float) -> float:
        """Fraction of the correct views that is accepted; NaN if no view is correct."""
        right = self.within(radius_m)
        return float(self.accepted[right].mean()) if right.any() else math.nan

    @property
    def ece(self) -> float:
        """Expected calibration error of the views with a fix, each at its own radius."""
        errors_m = np.hypot(*self.errors_en_m.T)
        return float(calibrate(self.confidence, errors_m, self.radius_m, FAR_M).ece)

    @property
    def nees_mean(self) -> float:
        """Mean normalized error squared of right fixes: 2 if the covariance is consistent."""
        checked = check_covariance(self.errors_en_m, self.cov_en_m2, self.radius_m, FAR_M)
        return float(checked.nees_mean)


def placed(locator: Locator, views: Iterable[FlownView], frame: LocalFrame) -> Verdict:
    """Views located one after the other; the first one prepares the map."""
    rows: list[list[float]] = []
    for each in views:
        if not rows:
            locate_view(locator, each.view)
        outcome, took_ms = locate_view(locator, each.view)
        rows.append([*row_of(outcome, frame, each.truth_latlon_deg), took_ms])
    return Verdict.of(rows)
