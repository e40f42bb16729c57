"""The records of a check: what is asked and assumed, predictions, findings and the verdict.

A probability refers to one view; NaN means unknown (no imagery, or outside the band of the route).
"""

import math
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import UsageError
from orthonav.core.files import with_paths
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.limits import ALERT_LIMITS_M, CAMERA_KINDS, DEFAULT_RISK, RISKS
from orthonav.core.records import CONFIDENT, DEFAULT_TILT_STD_DEG
from orthonav.core.track.filter import Model
from orthonav.ground.check.cells import CellGrid
from orthonav.ground.check.estimate import INTERVAL, LEARNT, Prediction, Recalibration
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.spacing import DEFAULT_CAMERA, DEFAULT_PRIOR_STD_M
from orthonav.ground.report import metres_text

Array = NDArray[np.float64]
OBJECT_M = 8.0
"""Height of a house or tree."""
MIN_RISK = round(Model.lost / 10, 6)
"""At a lower one too few fixes have a protection level: of the belief in other places that returns
with every view, eight of ten views leave at most a tenth (docs/check.md)."""


class Word(Enum):
    GO = "go"
    MARGINAL = "marginal"
    NO_GO = "no-go"

    @property
    def exit_code(self) -> int:
        """Exit status of the command: 0 go, 3 marginal, 4 no-go (1 and 2 are errors)."""
        return {Word.GO: 0, Word.MARGINAL: 3, Word.NO_GO: 4}[self]


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


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """What is assumed of flight and camera.

    `yaw_std_deg`: standard deviation of the reported heading, 0 to 90; None: heading unknown.
    `agl_std`: standard deviation of the reported height, a fraction of it, 0 to 0.5.
    `prior_std_m`: standard deviation of the prior position per axis; None: no prior.
    `accept`: confidence that a fix needs, 0.01 to 0.999.
    `risk`: allowed probability of an error beyond the alert limit.
    `speed_mps`: ground speed; 20 m/s is the cruise of a small fixed-wing aircraft.
    `drift`: error of dead reckoning per metre flown, 0 to 1; with an airspeed sensor and a known
    wind usually 0.02 to 0.05.
    `relief_m`: standard deviation of the height of houses and trees; 3 m in open country, 0: none.
    `camera_pitch_deg`: how far the camera looks ahead of straight down, 0 to 65; trial views look
    straight down, and findings say what that leaves out.
    `tilt_std_deg`: standard deviation of the error of the reported pitch and roll, 0 to 20.
    `camera_kind`: of `CAMERA_KINDS`: how the camera's light differs from that of the map's imagery.
    """

    yaw_std_deg: float | None = 5.0
    agl_std: float = 0.05
    prior_std_m: float | None = DEFAULT_PRIOR_STD_M
    accept: float = CONFIDENT
    risk: float = DEFAULT_RISK
    speed_mps: float = 20.0
    drift: float = 0.03
    relief_m: float = 3.0
    camera_pitch_deg: float = 0.0
    tilt_std_deg: float = DEFAULT_TILT_STD_DEG
    camera_kind: str = "colour"


@dataclass(frozen=True)
class CheckRequest(Assumptions):
    """What to check, under which assumptions.

    `map_path`: map file with a registration layer.
    `route`: planned route; None: the whole map.
    `band_m`: width of the band for legs without one; None: derived from the prior.
    `other_date`: orthophoto of the same ground that the map was not built from.
    `agl_m`: height above ground, 1 to 50,000 m; None: the shorter side of a view covers one tile.
    `alert_limit_m`: largest error that the mission allows; None: 2.5 % of the height, at least 35.
    `effort`: factor on the number of trials, 0.05 to 50.
    `workers`: processes; None: one per core.
    """

    map_path: Path
    route: Route | None = None
    band_m: float | None = None
    other_date: Path | None = None
    camera: Camera = DEFAULT_CAMERA
    agl_m: float | None = None
    alert_limit_m: float | None = None
    effort: float = 1.0
    workers: int | None = None
    seed: int = 1
    recalibration: Recalibration = LEARNT
    about: CheckedInputs = field(default_factory=CheckedInputs)

    def __post_init__(self) -> None:
        with_paths(self, "map_path", "other_date")
        if self.camera_kind not in CAMERA_KINDS:
            kinds = ", ".join(CAMERA_KINDS)
            raise UsageError(f"camera_kind must be {kinds}, got '{self.camera_kind:.40}'")
        if self.camera_kind != "colour" and self.other_date is not None:
            raise UsageError("--camera-kind is for checks without --other-date, which shows it")
        limits = {
            "agl_m": (1.0, 50_000.0, " m"),
            "yaw_std_deg": (0.0, 90.0, " deg"),
            "agl_std": (0.0, 0.5, " (a fraction of the height: 0.05 is 5 %)"),
            "prior_std_m": (0.0, 1e6, " m"),
            "accept": (0.01, 0.999, ""),
            "alert_limit_m": (*ALERT_LIMITS_M, " m"),
            "risk": (*RISKS, ""),
            "speed_mps": (0.1, 10_000.0, " m/s"),
            "drift": (0.0, 1.0, " (metres per metre flown: 0.03 is 3 %)"),
            "tilt_std_deg": (0.0, 20.0, " deg"),
            "relief_m": (0.0, 1000.0, " m"),
            "camera_pitch_deg": (0.0, 65.0, " deg"),
            "effort": (0.05, 50.0, ""),
            "workers": (1, 1000, " processes"),
            "seed": (0, 2**63, ""),
        }
        for name, (low, high, unit) in limits.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise UsageError(f"{name} must be {low:g} to {high:g}{unit}, got {value}")


@dataclass(frozen=True, kw_only=True)
class Conditions(Assumptions):
    """The assumptions of a check, and what follows from them for its map and height.

    `width_m`, `height_m`: footprint of a vertical view along the rows and columns of the image.
    `radius_m`: largest error of a correct fix. `limit_given`: whether the alert limit was given.
    """

    width_m: float
    height_m: float
    agl_m: float
    radius_m: float
    alert_limit_m: float
    limit_given: bool = False

    @classmethod
    def of(cls, request: CheckRequest, agl_m: float, radius_m: float) -> "Conditions":
        camera, given_m = request.camera, request.alert_limit_m
        return cls(
            width_m=agl_m * camera.width_px / camera.fx_px,
            height_m=agl_m * camera.height_px / camera.fy_px,
            agl_m=agl_m,
            radius_m=radius_m,
            alert_limit_m=given_m or max(35.0, round(0.025 * agl_m)),
            limit_given=given_m is not None,
            **{each.name: getattr(request, each.name) for each in fields(Assumptions)},
        )

    @property
    def side_m(self) -> float:
        """Side of the square with the area of the footprint."""
        return math.sqrt(self.width_m * self.height_m)

    @property
    def displaced_share(self) -> float:
        """Largest displacement of the image of a house or tree, a fraction of `side_m`: its height
        times the tangent of the angle off nadir, at the far rim of a view."""
        rim = math.atan(max(self.width_m, self.height_m) / 2 / self.agl_m)
        off = min(math.radians(self.camera_pitch_deg) + rim, math.radians(80.0))
        return OBJECT_M * math.tan(off) / self.side_m

    @property
    def states_level(self) -> bool:
        """Whether enough fixes have a protection level at this risk."""
        return self.risk >= MIN_RISK

    @property
    def limit_text(self) -> str:
        return metres_text(self.alert_limit_m) + " (the default)" * (not self.limit_given)

    @property
    def footprint_text(self) -> str:
        return f"a view from {self.agl_m:.0f} m covers {self.width_m:.0f} x {self.height_m:.0f} m"


@dataclass(frozen=True, eq=False, kw_only=True)
class Cells(Prediction):
    """Predictions for the cells of a grid in the plane of the map's sheet; arrays are (rows, cols),
    row 0 in the north, as `CELL_VALUES` says."""

    grid: CellGrid
    trials: NDArray[np.int32]


CELL_VALUES = {
    "probability": "probability of a correct, confident fix of one view",
    "low": "probability, lower end of its 80 % interval",
    "high": "probability, upper end of its 80 % interval",
    "error_m": "expected error of such a fix, root mean square, metres",
    "wrong": "fraction of trials that were false fixes",
    "trials": "number of views tried",
    "persistence": "expected correlation of the ground with another year, 0 to 1",
}
"""Arrays of `Cells` and their meaning, in the order of the bands of the raster."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Along(Prediction):
    """Predictions at points (N,) along the route.

    `points_en_m`: (N, 2) in the plane of the map's sheet.
    `across_low`: lowest probability across the band at that point.
    """

    distance_m: Array
    points_en_m: Array
    across_low: Array

    @property
    def lengths_m(self) -> Array:
        """Length (N,) of the route that each point represents, half-way to its neighbours; 1 for a
        route without a length."""
        if not self.distance_m[-1] > 0:
            return np.ones(len(self.distance_m))
        lengths_m = np.gradient(self.distance_m)
        lengths_m[[0, -1]] /= 2
        return np.asarray(lengths_m)


class Range(NamedTuple):
    """Median and 80 % interval over the flights."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Array) -> "Range":
        low, median, high = np.quantile(values, (INTERVAL[0], 0.5, INTERVAL[1]), method="nearest")
        return cls(float(median), float(low), float(high))


@dataclass(frozen=True, eq=False)
class Flights:
    """What happens along the route in `count` simulated flights. Below `MIN_RISK` protection
    levels, and what follows from them, are NaN.

    `probability`: mean chance of a fix per view.
    `availability`: fraction of the route with a protection level of at most the alert limit.
    `outage_m`, `outage_s`: longest stretch without.
    `error_95_m`: largest position error along the route (95 %).
    `false_fix`: probability of at least one confident fix that is not correct.
    `available` (N,): fraction of the flights with an available position at a point of the route.
    `protection_m`, `protection_high_m` (N,): protection level there, median and 90 %.
    """

    count: int
    probability: Range
    availability: Range
    outage_m: Range
    outage_s: Range
    error_95_m: Range
    false_fix: Range
    available: Array
    protection_m: Array
    protection_high_m: Array


@dataclass(frozen=True)
class Outage:
    """A stretch where most simulated flights have no available position.

    Distance and time are from the start of the route. `probability`: mean chance of a fix per view.
    `available`: mean fraction of the flights with an available position.
    """

    start_m: float
    end_m: float
    start_s: float
    end_s: float
    probability: float
    available: float

    @property
    def length_m(self) -> float:
        return self.end_m - self.start_m


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


@dataclass(frozen=True, eq=False)
class CheckResult:
    """Everything that a check found; `frame` is the plane of the map's sheet.

    `mean`: mean probability along the route, or over `area_km2` without one.
    `second_date`: views of a second date were tried too.
    `flights`: simulated along the route; `outages`: from them.
    `route_en_m`: waypoints (M, 2); `band_m`: width of the widest band.
    """

    about: CheckedInputs
    conditions: Conditions
    frame: LocalFrame
    cells: Cells
    verdict: Verdict
    area_km2: float
    mean: Range
    second_date: bool
    along: Along | None = None
    flights: Flights | None = None
    route_en_m: Array | None = None
    band_m: float | None = None
    outages: tuple[Outage, ...] = ()


def summarize(result: CheckResult) -> dict[str, Any]:
    """The key figures of a check, which the page, the terminal and `check.json` share.

    `longest_stretch`: number of the longest outage, from 1. Without a route its figures are NaN, 0
    or None.
    """
    along, cells, outages = result.along, result.cells, result.outages
    route_m = likely = math.nan
    if along is None:
        error_m = _rms(cells.error_m, cells.probability)
    else:
        route_m, lengths_m = float(along.distance_m[-1]), along.lengths_m
        likely = float(lengths_m[along.probability >= CONFIDENT].sum() / lengths_m.sum())
        error_m = _rms(along.error_m, lengths_m * along.probability)
    longest = max(outages, key=lambda each: each.length_m, default=None)
    return {
        "area_km2": result.area_km2,
        "second_date": result.second_date,
        "mean_probability": result.mean.median,
        "error_m": error_m,
        "route_m": route_m,
        "route_s": route_m / result.conditions.speed_mps,
        "route_share_from_0_9": likely,
        "blind_stretches": len(outages),
        "longest_stretch": None if longest is None else outages.index(longest) + 1,
    }


def _rms(values: Array, weights: Array) -> float:
    known = np.isfinite(values) & np.isfinite(weights) & (weights > 0)
    if not known.any():
        return math.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=weights[known])))
