"""Result types of a check: predictions for places and along a route, and the verdict.

`orthonav.ground.check.run` computes them and `orthonav.ground.check.write` writes them. A
probability refers to one view; NaN means unknown (no imagery, or outside the band of the route).
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import CONFIDENT
from orthonav.ground.changes.record import CellGrid

Array = NDArray[np.float64]


class Word(Enum):
    GO = "go"
    MARGINAL = "marginal"
    NO_GO = "no-go"

    @property
    def exit_code(self) -> int:
        """Exit status of the command: 0 go, 3 marginal, 4 no-go (1 and 2 are errors)."""
        return {Word.GO: 0, Word.MARGINAL: 3, Word.NO_GO: 4}[self]


OF_REQUEST = (
    *("yaw_std_deg", "agl_std", "prior_std_m", "accept", "speed_mps", "drift", "tilt_std_deg"),
    "other_sensor",
)


@dataclass(frozen=True)
class Conditions:
    """What a check assumes; fields that are not listed are those of `CheckRequest`.

    `width_m`, `height_m`: footprint of a vertical view; `radius_m`: largest error of a correct fix.
    """

    width_m: float
    height_m: float
    agl_m: float
    yaw_std_deg: float | None
    agl_std: float
    prior_std_m: float | None
    accept: float
    radius_m: float
    speed_mps: float
    drift: float
    tilt_std_deg: float = 0.0
    other_sensor: bool = False


@dataclass(frozen=True, eq=False)
class Cells:
    """Predictions for square cells; arrays are (rows, cols), row 0 in the north, as `CELL_VALUES`
    says.

    `west_m`, `north_m`: north-west corner in the plane of the map's sheet.
    """

    west_m: float
    north_m: float
    side_m: float
    probability: Array
    low: Array
    high: Array
    error_m: Array
    wrong: Array
    trials: NDArray[np.int32]
    persistence: Array
    changed: Array

    @property
    def grid(self) -> CellGrid:
        return CellGrid(self.west_m, self.north_m, self.side_m, *self.probability.shape)


CELL_VALUES = {
    "probability": "probability of a correct, confident fix of one view",
    "low": "lower end of its 80 % interval",
    "high": "upper end of its 80 % interval",
    "error_m": "expected error of such a fix, root mean square, metres",
    "wrong": "fraction of trials that were false fixes",
    "trials": "number of views tried",
    "persistence": "expected correlation of the ground with another year, 0 to 1",
    "changed": "fraction that changed since the map was made",
}
"""Arrays of `Cells` and their meaning, in the order of the bands of the raster."""


@dataclass(frozen=True, eq=False)
class Along:
    """Predictions at points (N,) along the route; fields that are not listed are as in `Cells`.

    `points_en_m`: (N, 2) in the plane of the map's sheet.
    `across_low`: lowest probability across the band at that point.
    `drift_m`: expected position error (one standard deviation) when each fix arrives with its
    probability and dead reckoning drifts in between.
    """

    distance_m: Array
    points_en_m: Array
    probability: Array
    low: Array
    high: Array
    across_low: Array
    error_m: Array
    drift_m: Array


@dataclass(frozen=True)
class BlindStretch:
    """A gap: a part of the route where a fix is unlikely; distance and time are from its start.

    `drift_m`: error of dead reckoning at its end.
    `allowed_m`: largest error there at which the next view is still searched in the right place;
    infinite without a prior.
    `ends_lost`: the route ends inside the gap.
    """

    start_m: float
    end_m: float
    start_s: float
    end_s: float
    probability: float
    drift_m: float
    allowed_m: float
    ends_lost: bool = False

    @property
    def length_m(self) -> float:
        return self.end_m - self.start_m

    @property
    def recoverable(self) -> bool:
        return not self.ends_lost and self.drift_m <= self.allowed_m


@dataclass(frozen=True)
class Lookalike:
    """A pair of ambiguous places, which can be mistaken for each other.

    `similarity`: score of the other place divided by that of the true one, 0 to 1.
    `trials`: number of trials that found the pair.
    `within_prior`: a view of one place would also be searched at the other.
    """

    place_latlon_deg: tuple[float, float]
    other_latlon_deg: tuple[float, float]
    apart_m: float
    similarity: float
    trials: int
    within_prior: bool


@dataclass(frozen=True, eq=False)
class Envelope:
    """Fraction `share` (A, B) of correct, confident fixes over errors added to heading and height.

    `agl_off` (B,): as a fraction of the height.
    `tolerated_*`: largest error of each alone at which `share` stays at 85 % or more of that
    without.
    """

    yaw_off_deg: Array
    agl_off: Array
    share: Array
    tolerated_yaw_deg: float
    tolerated_agl_low: float
    tolerated_agl_high: float


@dataclass(frozen=True)
class Alternative:
    """Mean probability with another value, in metres, of one parameter: "agl_m" or "band_m"."""

    what: str
    value: float
    probability: float
    chosen: bool = False


@dataclass(frozen=True)
class Reason:
    """One finding behind the verdict: a stable code for programs, a sentence for people."""

    code: str
    text: str
    word: Word


@dataclass(frozen=True)
class Verdict:
    """The verdict and its reasons, worst first; the worst reason decides."""

    word: Word
    reasons: tuple[Reason, ...]


@dataclass(frozen=True)
class CheckedInputs:
    """What was checked, as text for reports; empty where it does not apply.

    `map_sha256`: of the manifest; `terms`: attribution and licence of each imagery source.
    """

    map_name: str = ""
    imagery: str = ""
    recipe: str = ""
    other_date: str = ""
    route_name: str = ""
    height: str = ""
    command: str = ""
    version: str = ""
    terms: tuple[str, ...] = ()
    map_sha256: str = ""


@dataclass(frozen=True, eq=False)
class CheckResult:
    """Everything that a check found; `frame` is the plane of the map's sheet.

    `mean`: mean probability over `area_km2`; `second_date`: views of a second date were tried too.
    `route_en_m`: waypoints (M, 2); `band_m`: width of the widest band.
    """

    about: CheckedInputs
    conditions: Conditions
    frame: LocalFrame
    cells: Cells
    verdict: Verdict
    area_km2: float
    mean: float
    second_date: bool
    along: Along | None = None
    route_en_m: Array | None = None
    band_m: float | None = None
    stretches: tuple[BlindStretch, ...] = ()
    lookalikes: tuple[Lookalike, ...] = ()
    envelope: Envelope | None = None
    alternatives: tuple[Alternative, ...] = ()


def summarize(result: CheckResult) -> dict[str, Any]:
    """The key figures of a check, which the page, the terminal and `check.json` share.

    `longest_stretch`: number of the longest gap, from 1. Without a route its figures are NaN, 0 or
    None.
    """
    along, cells, stretches = result.along, result.cells, result.stretches
    route_m = likely = math.nan
    if along is None or not len(along.distance_m):
        error_m = _rms(cells.error_m, cells.probability)
    else:
        route_m = float(along.distance_m[-1] - along.distance_m[0])
        # Length of the route (N,) that each of its points represents.
        lengths_m = np.gradient(along.distance_m) if route_m else np.ones(len(along.distance_m))
        lengths_m[[0, -1]] /= 2 if route_m else 1
        known = np.isfinite(along.probability)
        confident = np.where(known, along.probability, 0.0) >= CONFIDENT
        likely = float(lengths_m[confident].sum() / lengths_m.sum()) if known.any() else math.nan
        error_m = _rms(along.error_m, lengths_m * np.nan_to_num(along.probability))
    longest = max(stretches, key=lambda each: each.length_m, default=None)
    return {
        "area_km2": result.area_km2,
        "second_date": result.second_date,
        "mean_probability": result.mean,
        "error_m": error_m,
        "route_m": route_m,
        "route_s": route_m / result.conditions.speed_mps,
        "route_share_from_0_9": likely,
        "blind_stretches": len(stretches),
        "unrecoverable_stretches": sum(not each.recoverable for each in stretches),
        "longest_stretch": None if longest is None else stretches.index(longest) + 1,
    }


def _rms(values: Array, weights: Array) -> float:
    known = np.isfinite(values) & np.isfinite(weights) & (weights > 0)
    if not known.any():
        return math.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=weights[known])))
