"""Reads result files and computes the figures of tables and plots."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.paper.methods import PER_TILE

ACCURACY_M = 15.0
NEAREST_STRIDES = math.sqrt(0.5)
"""A position names the correct tile if it is within half a tile spacing on each axis."""
ACCURACY = 0.95
COLUMNS = {"error_m": 0, "score": 1, "lowe_ratio": 2, "peak_ratio": 3, "confidence": 4}
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Result:
    """One result file, as it was written."""

    plain: dict[str, Any]

    @property
    def scene(self) -> str:
        """Name of the trajectory or pair of orthophotos."""
        return str(self.plain["scene"])

    @property
    def family(self) -> str:
        """Method without its parameters; "" for a file of baselines."""
        return str(self.plain.get("method", {}).get("family", ""))

    @property
    def edges(self) -> str:
        """Input of the method, for tables."""
        edges = str(self.plain["method"]["edges"])
        return edges.partition(":")[0] + ("-tile" if PER_TILE in edges else "")

    @property
    def registration(self) -> bool:
        """Whether views are placed below tile size."""
        return bool(self.plain.get("method", {}).get("registration"))

    @property
    def stride_m(self) -> float:
        """Distance between neighbouring tiles."""
        flown = self.plain["trajectory"]
        return float(max(1, round(256 * (1 - flown["overlap"]))) * flown["gsd_m"])

    def column(self, placement: str, name: str) -> Array:
        """A number per view (N,); NaN where there was none, errors then infinite."""
        at = COLUMNS[name]
        values = [row[at] for row in self.plain["views"][placement]]
        return numbers(values, math.inf if name == "error_m" else math.nan)

    def right(self, placement: str) -> NDArray[np.bool_]:
        """Mask (N,) of the views within 15 m."""
        return self.column(placement, "error_m") <= ACCURACY_M

    def accuracy(self, placement: str, radius_m: float = ACCURACY_M) -> float:
        """Share of views within a radius; NaN without any."""
        errors = self.column(placement, "error_m")
        return float((errors <= radius_m).mean()) if errors.size else math.nan

    def right_tile(self, placement: str) -> float:
        """Share of views whose tile is the nearest one, or as near."""
        return self.accuracy(placement, NEAREST_STRIDES * self.stride_m + 1e-6)


def read(folder: Path) -> list[Result]:
    """All results of a folder, by name of file."""
    paths = sorted(folder.glob("*.json"))
    return [Result(json.loads(path.read_text(encoding="utf-8"))) for path in paths]


def numbers(values: Sequence[float | None], missing: float) -> Array:
    """Numbers (N,) of a JSON list, None as `missing`."""
    return np.array([missing if value is None else value for value in values], np.float64)


def percent(value: float | None) -> str:
    """A share in per cent, "-" where there is none."""
    return "-" if value is None or math.isnan(value) else f"{100 * value:.0f}"


def share(counted: Sequence[int]) -> float:
    """Share of views within 15 m: number of them, and of all."""
    hits, count = counted
    return hits / count if count else math.nan


def confident(right: NDArray[np.bool_], ratio: Array, threshold: float) -> tuple[float, float]:
    """Accuracy of the accepted views and the accepted share; accuracy NaN if none is accepted."""
    accepted = ratio >= threshold
    return float(right[accepted].mean()) if accepted.any() else math.nan, float(accepted.mean())


def accepted_at(right: NDArray[np.bool_], ratio: Array, accuracy: float = ACCURACY) -> float:
    """Largest share of views that a threshold on `ratio` keeps with at least that accuracy."""
    thresholds = np.unique(ratio[np.isfinite(ratio)])
    pairs = [confident(right, ratio, threshold) for threshold in thresholds]
    return max((accepted for found, accepted in pairs if found >= accuracy), default=0.0)


def ceiling(stride_m: float) -> float:
    """Accuracy at 15 m of one who always names the right tile, for views anywhere: the part of a
    square of `stride_m` that lies within the circle."""
    axis = (np.arange(400) + 0.5) / 400 * stride_m / 2
    return float((np.hypot(axis[:, None], axis) <= ACCURACY_M).mean())
