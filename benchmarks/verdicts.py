"""Figures of placed views: how near, how sure, how often wrong when sure."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.evaluate.calibration import calibrate, check_covariance

CONFIDENT, FAR_M = 0.9, 35.0
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Verdict:
    """Views (N) of one flight by one method: `errors_en_m` (N, 2) and what was stated, NaN where
    nothing was; `times_ms` (N,)."""

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
        """(N,) infinite where there is no position."""
        far = np.hypot(self.errors_en_m[:, 0], self.errors_en_m[:, 1])
        return np.where(np.isnan(far), np.inf, far)

    @property
    def states_confidence(self) -> bool:
        """Whether any view has one."""
        return bool(np.isfinite(self.confidence).any())

    def within(self, radius_m: float) -> NDArray[np.bool_]:
        """(N,) whether the position is that near."""
        return self.errors_m <= radius_m

    @property
    def median_m(self) -> float:
        """Median error of positions; NaN without any."""
        known = self.errors_m[np.isfinite(self.errors_m)]
        return float(np.median(known)) if known.size else math.nan

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(N,) whether the stated confidence is at least `CONFIDENT`."""
        return np.asarray(self.confidence >= CONFIDENT)

    @property
    def wrong_accepted(self) -> int:
        """Views kept that are wrong by more than `FAR_M`."""
        return int((self.kept & (self.errors_m > FAR_M)).sum())

    def accepted_of_right(self, radius_m: float) -> float:
        """Share of the right ones that is kept; NaN where none is right."""
        right = self.within(radius_m)
        return float(self.kept[right].mean()) if right.any() else math.nan

    @property
    def ece(self) -> float:
        """Expected calibration error, each view at its own radius; no answer states nothing."""
        errors_m = np.hypot(*self.errors_en_m.T)
        return float(calibrate(self.confidence, errors_m, self.radius_m, FAR_M).ece)

    @property
    def nees_mean(self) -> float:
        """Mean normalized error squared of right fixes: 2 if the covariance is theirs."""
        checked = check_covariance(self.errors_en_m, self.cov_en_m2, self.radius_m, FAR_M)
        return float(checked.nees_mean)


def percent(share: float, digits: int = 0) -> str:
    """A share as text."""
    return "-" if math.isnan(share) else f"{share:.{digits}%}"


def from_placed(told: dict[str, Any]) -> Verdict:
    """The verdict of what `benchmarks.placing.placed` told."""
    return Verdict.of(told["rows"])
