"""Metrics of the fixes of a flight. Arrays and records only: no files, no plots.

Names follow the paper (arXiv 2404.06207): accuracy at a radius (`acc_at_15m`), confidence
criterion, Lowe's ratio. A share is 0 to 1, and NaN where it is not defined.
"""

import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from orthonav.core import records
from orthonav.core.errors import FlightError
from orthonav.core.files import StrPath
from orthonav.core.flight import read_truth
from orthonav.core.flight.fixes import Identity, read_identity, read_results
from orthonav.core.geo.frames import MAX_SHEET_M, LocalFrame, distances_m
from orthonav.core.geo.swapped import HINT
from orthonav.core.limits import DEFAULT_RISK
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.ground.evaluate.statistics import (
    BoolArray,
    ConfidenceCalibration,
    Consistency,
    FloatArray,
    Longest,
    StandardFigures,
    calibrate,
    check_covariance,
    frozen,
    longest,
    path_so_far_m,
    percentile,
    seconds_since_first,
    share,
    share_of,
    standard_figures,
    upper_bound,
    wilson,
)

LatLon = tuple[float, float]
"""Degrees."""
Positions = Mapping[str, LatLon]
"""By frame name."""

FAR_M = 35.0
"""A larger error is wrong by any measure: half a tile of the paper, `wrong_by_35m`."""
RADII_M = (5.0, 10.0, 15.0, 25.0, 35.0, 50.0, 100.0)
CRITERIA = (("lowe_ratio", 1.13), ("confidence", 0.5), ("confidence", 0.9), ("confidence", 0.99))
"""Confidence criteria and thresholds, the first of the paper (best tile against second best).

A view is accepted if its value is at least the threshold.
"""
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results with their truth: N views that have both, in the order of the results.

    `lat_deg`, `lon_deg`: origin of the east-north plane of `truth_en_m`, `fix_en_m` (N, 2).
    `errors_m` (N,): distance between them, NaN without a fix.
    `cov_en_m2` (N, 2, 2), `own_radius_m` (N,): as each fix states, NaN where unknown.
    `criteria`: for each name of `CRITERIA` values (N,), NaN where unknown or without a fix.
    `reasons`: code of each view without a fix, "" for a fix.
    `place_probability`, `protection_levels_m` (N,): NaN where unknown or without a fix; the level,
    at `risk`, is infinite where the place is too uncertain.
    `followed` (N,): 1, or 0 where true positions without a result come next; NaN at the end of a
    flight whose first or last true position has none.
    `n_without_truth`, `n_without_result`: results without truth, and the reverse.
    """

    lat_deg: float
    lon_deg: float
    frames: tuple[str, ...]
    time_ns: tuple[int, ...]
    truth_en_m: FloatArray
    fix_en_m: FloatArray
    errors_m: FloatArray
    cov_en_m2: FloatArray
    own_radius_m: FloatArray
    confident: BoolArray
    criteria: Mapping[str, FloatArray]
    reasons: tuple[str, ...]
    latency_ms: FloatArray
    place_probability: FloatArray
    protection_levels_m: FloatArray
    risk: float
    followed: FloatArray
    n_without_truth: int
    n_without_result: int

    @property
    def n_views(self) -> int:
        """Number of true positions: views without a result have no fix either."""
        return self.errors_m.size + self.n_without_result

    def confident_wrong(self, least_m: float) -> BoolArray:
        """(N,): confident fixes with an error above `least_m` and above the stated radius."""
        wrong: BoolArray = self.confident & (self.errors_m > np.fmax(least_m, self.own_radius_m))
        return wrong


@dataclass(frozen=True)
class CriterionRow:
    """What one threshold of a criterion accepts, NaN where undefined.

    `share_accepted`: of all views; `accuracy`: right ones among the accepted;
    `share_of_right_accepted`: recall, accepted ones among all right fixes; `n_wrong_by_35m`,
    `wrong_by_35m`: accepted views wrong by more than `FAR_M`, their number and fraction.
    """

    name: str
    threshold: float
    share_accepted: float
    accuracy: float
    n_accepted: int
    n_right: int
    share_of_right_accepted: float
    n_wrong_by_35m: int
    wrong_by_35m: float


@dataclass(frozen=True)
class Integrity:
    """Protection levels of one flight; NaN where undefined.

    `risk`: of the levels. `n_levels`: fixes with a finite one; `n_beyond`, `beyond`,
    `beyond_upper_95`: errors larger than their own level, their fraction of these fixes, and its
    one-sided 95 % bound for independent views.
    `alert_limit_m`: NaN where none was given, and then all that follows. `n_available`,
    `availability`, `availability_of_time`: fixes whose level is at most the limit, their fraction
    of the true positions, and that of the time. `outage`: longest without one, time and path each
    by itself. `n_false`, `false_upper_95`: available fixes with an error beyond the limit, and the
    bound of their fraction.
    """

    risk: float
    n_levels: int
    n_beyond: int
    beyond: float
    beyond_upper_95: float
    alert_limit_m: float
    n_available: int
    availability: float
    availability_of_time: float
    outage: Longest
    n_false: int
    false_upper_95: float


@dataclass(frozen=True, eq=False)
class Metrics:
    """Metrics of one flight; undefined ones are NaN.

    `radius_m`: a fix within it is right.
    `n_confident_wrong`: confident fixes that err by more than `wrong_above_m` and their own radius.
    `wrong_upper_95`: one-sided 95 % upper bound of the rate of wrong ones among confident fixes.
    `availability`: fraction of the true positions with a confident fix; `availability_95`: its 95 %
    interval. Both bounds are those of independent views.
    `coverage`: fraction of the true positions with a fix, low confidence included.
    `gap`: the longest stretch without a confident fix.
    `acc_at_m`, `acc_fixes_at_m`: for each radius the share of all views, and of fixes, within it.
    `reasons`: number of views without a fix by reason.
    `standard`, `of_confident`: errors of all and of confident fixes.
    `integrity`: None where no fix states a place probability and no alert limit was given.
    """

    radius_m: float
    n_views: int
    n_fixes: int
    n_without_truth: int
    n_without_result: int
    n_confident: int
    n_confident_wrong: int
    wrong_above_m: float
    wrong_upper_95: float
    availability: float
    availability_95: tuple[float, float]
    coverage: float
    gap: Longest
    acc_at_m: Mapping[float, float]
    acc_fixes_at_m: Mapping[float, float]
    latency_median_ms: float
    latency_p95_ms: float
    reasons: Mapping[str, int]
    criteria: tuple[CriterionRow, ...]
    calibration: ConfidenceCalibration
    consistency: Consistency
    standard: StandardFigures
    of_confident: StandardFigures
    integrity: Integrity | None = None

    @property
    def accuracy(self) -> float:
        """Fraction of all views with a fix within `radius_m`."""
        return self.acc_at_m[self.radius_m]

    @property
    def accuracy_of_fixes(self) -> float:
        """Fraction of fixes within `radius_m`."""
        return self.acc_fixes_at_m[self.radius_m]


def radius_key(radius_m: float) -> str:
    return f"acc_at_{radius_m:g}m"


def evaluate(
    fixes: StrPath,
    truth: StrPath,
    radius_m: float = 15.0,
    alert_limit_m: float = math.nan,
    risk: float = DEFAULT_RISK,
) -> Metrics:
    """Metrics of a file of fixes (`fixes.jsonl`) against the true positions of a `truth.csv`.

    `alert_limit_m`: largest error that the mission allows, NaN: none; `risk`: of protection levels.
    Raises `MissingFileError`, `FlightError`, also where latitudes and longitudes of the file seem
    to be swapped, or `ValueError` for a radius that is not positive or a risk that is not 0 to 1.
    """
    known, results = read_truth(Path(truth)), read_results(Path(fixes))
    check_truth(known, results, None, Path(truth))
    return measure(compare(known, results, risk=risk), radius_m, alert_limit_m)


def check_truth(
    truth: Positions,
    results: Sequence[ViewResult],
    centre_latlon_deg: tuple[float, float] | None,
    path: Path,
) -> None:
    """Log a warning where true positions are far from the fixes of the same views or, without any,
    from the centre of the map, and where most of the confident fixes are wrong by them.

    Raises `FlightError` where they are near once latitude and longitude are exchanged.
    """
    placed = [
        (result.outcome, truth[result.frame], result.is_confident)
        for result in results
        if isinstance(result.outcome, Fix) and result.frame in truth
    ]
    both = [(place, (fix.lat_deg, fix.lon_deg)) for fix, place, _ in placed]
    compared = "the fixes" if both else "the map"
    if not both and centre_latlon_deg is not None:
        both = [(place, centre_latlon_deg) for place in truth.values()]
    if not both:
        return
    true, expected = np.array(both).transpose(1, 0, 2)
    far_m, swapped_m = (
        float(np.nanmedian(distances_m(places, expected))) for places in (true, true[:, ::-1])
    )
    far = f"true positions are {far_m / 1000:,.0f} km from {compared} (median)"
    if far_m > 1000 and swapped_m < far_m / 10:  # nearer, both may be equal
        raise FlightError(f"{far}; {HINT}: {path}")
    errors_m = distances_m(true, expected)
    wrong = [
        error_m > np.fmax(FAR_M, fix.radius_m)
        for error_m, (fix, _, is_confident) in zip(errors_m, placed, strict=False)
        if is_confident
    ]
    if far_m > 50_000:  # maps of one sheet are smaller
        log.warning("%s; are these of the same flight?: %s", far, path)
    elif 2 * sum(wrong) > len(wrong):  # false fixes are few: rather the truth or the map is wrong
        log.warning(
            "%d of %d confident fixes are far from the true positions (all fixes: %.0f m in the "
            "median); are these of the same flight, and is the map in its place?: %s",
            *(sum(wrong), len(wrong), far_m, path),
        )


def warn_of_another_run(
    fixes: Path, opened: MapFile | None, flight: Path | None, flight_sha256: str | None
) -> None:
    """Log a warning where fixes were computed from another map or flight than the given ones."""
    given = Identity(opened.manifest.sha256 if opened else None, flight_sha256)
    other = read_identity(fixes).differences(given, opened.path if opened else None, flight)
    if other:
        log.warning("fixes are of %s: %s", other, fixes)


def compare(
    truth: Positions,
    results: Sequence[ViewResult],
    local: LocalFrame | None = None,
    risk: float = DEFAULT_RISK,
) -> Comparison:
    """Results matched with ground truth by frame name.

    `local` is the plane of the positions; without one, or where it is that of another place, it is
    centred on the median of the true positions, as the first may be 0, 0. `risk` is that of the
    protection levels. A true position that is not finite counts as missing. Raises
    `FlightError` where no result has a truth or a frame has two results, and `ValueError` for a
    risk that is not 0 to 1.
    """
    if not 0.0 <= risk <= 1.0:  # also where no fix has a level
        raise ValueError(f"a risk is a probability, 0 to 1, got {risk}")
    known = {name: at for name, at in truth.items() if all(map(math.isfinite, at))}
    twice = [name for name, n in Counter(result.frame for result in results).items() if n > 1]
    if twice:
        raise FlightError(f"{len(twice)} frames have more than one result, such as {twice[0]!r}")
    matched = [result for result in results if result.frame in known]
    if not matched:
        first_known = repr(next(iter(known))) if known else "none"
        first_result = repr(results[0].frame) if results else "none"
        raise FlightError(
            "no view has both a result and a true position: "
            f"{len(results)} results (first {first_result}), {len(known)} true positions "
            f"(first {first_known}); are these of the same flight?"
        )
    true = [known[result.frame] for result in matched]
    centre = np.percentile(true, 50, axis=0, method="nearest").tolist()
    if local is None or distances_m(centre, (local.lat_deg, local.lon_deg))[0] > MAX_SHEET_M:
        local = LocalFrame(*centre)
    frames = {result.frame for result in matched}
    missing = dict(zip(known, np.cumsum([name not in frames for name in known]), strict=True))
    before = [missing[result.frame] for result in matched]  # true positions without a result
    is_whole = before[0] == 0 and before[-1] == len(known) - len(matched)
    outcomes = [result.outcome for result in matched]
    truth_en_m = places_en_m(local, true)
    fix_en_m = places_en_m(local, [place_of(outcome) for outcome in outcomes])

    def stated(value: Callable[[Fix], Any], unknown: Any = math.nan) -> FloatArray:
        """(N, ..), `unknown` without a fix."""
        return frozen([value(each) if isinstance(each, Fix) else unknown for each in outcomes])

    return Comparison(
        lat_deg=local.lat_deg,
        lon_deg=local.lon_deg,
        frames=tuple(result.frame for result in matched),
        time_ns=tuple(result.time_ns for result in matched),
        truth_en_m=truth_en_m,
        fix_en_m=fix_en_m,
        errors_m=frozen(np.hypot(*(fix_en_m - truth_en_m).T)),
        cov_en_m2=stated(attrgetter("cov_en_m2"), np.full((2, 2), math.nan)),
        own_radius_m=stated(attrgetter("radius_m")),
        confident=np.array([result.is_confident for result in matched], dtype=np.bool_),
        criteria={name: stated(partial(_criterion, name=name)) for name, _ in CRITERIA},
        reasons=tuple(reason_of(outcome) for outcome in outcomes),
        latency_ms=frozen([result.latency_ms for result in matched]),
        place_probability=stated(attrgetter("place_probability")),
        protection_levels_m=protection_levels_m(matched, risk),
        risk=risk,
        followed=frozen([*(np.diff(before) == 0), 1.0 if is_whole else math.nan]),
        n_without_truth=len(results) - len(matched),
        n_without_result=len(known) - len(matched),
    )


def protection_levels_m(results: Sequence[ViewResult], risk: float | None = None) -> FloatArray:
    """(N,) m, infinite where the place is too uncertain, NaN without a fix; `risk`: None: that of
    each result."""
    levels_m = np.full(len(results), math.nan)
    by_risk: dict[float, list[tuple[int, Fix]]] = {}
    for i, result in enumerate(results):
        if isinstance(result.outcome, Fix):
            own = result.risk if risk is None else risk
            by_risk.setdefault(own, []).append((i, result.outcome))
    for own, fixes in by_risk.items():
        place = np.array([fix.right_probability for _, fix in fixes])
        covs = np.array([fix.cov_en_m2 for _, fix in fixes])
        levels_m[[i for i, _ in fixes]] = records.protection_levels_m(place, covs, own)
    return frozen(levels_m)


def measure(
    comparison: Comparison, radius_m: float = 15.0, alert_limit_m: float = math.nan
) -> Metrics:
    """All metrics of `comparison`; `radius_m` defines right fixes and joins `RADII_M`;
    `alert_limit_m`: largest error that the mission allows, NaN: none.

    Raises `ValueError` for a radius that is not a positive finite number.
    """
    if not 0.0 < radius_m < math.inf:
        raise ValueError(f"a radius must be positive and finite, got {radius_m} m")
    radius_m = float(radius_m)
    truth_en_m, fix_en_m = comparison.truth_en_m, comparison.fix_en_m
    errors_m, own_radius_m = comparison.errors_m, comparison.own_radius_m
    of_fixes_m = errors_m[np.isfinite(errors_m)]
    n_confident = int(np.count_nonzero(comparison.confident & np.isfinite(errors_m)))
    wrong_above_m, n_views = max(FAR_M, radius_m), comparison.n_views
    n_wrong = int(np.count_nonzero(comparison.confident_wrong(wrong_above_m)))
    reasons = Counter(filter(None, comparison.reasons))
    reasons += Counter(no_result=comparison.n_without_result)
    radii = sorted({radius_m, *RADII_M})
    confident_en_m = np.where(comparison.confident[:, None], fix_en_m, np.nan)
    return Metrics(
        radius_m=radius_m,
        n_views=n_views,
        n_fixes=of_fixes_m.size,
        n_without_truth=comparison.n_without_truth,
        n_without_result=comparison.n_without_result,
        n_confident=n_confident,
        n_confident_wrong=n_wrong,
        wrong_above_m=wrong_above_m,
        wrong_upper_95=upper_bound(n_wrong, n_confident),
        availability=share(n_confident, n_views),
        availability_95=wilson(n_confident, n_views),
        coverage=share(of_fixes_m.size, n_views),
        gap=_longest_without(comparison, comparison.confident),
        acc_at_m={r: share_of(of_fixes_m <= r, n_views) for r in radii},
        acc_fixes_at_m={r: share_of(of_fixes_m <= r) for r in radii},
        latency_median_ms=percentile(comparison.latency_ms, 50.0),
        latency_p95_ms=percentile(comparison.latency_ms, 95.0),
        reasons=dict(reasons.most_common()),
        criteria=tuple(
            _criterion_row(comparison, name, threshold, radius_m) for name, threshold in CRITERIA
        ),
        calibration=calibrate(comparison.criteria["confidence"], errors_m, own_radius_m, radius_m),
        consistency=check_covariance(
            fix_en_m - truth_en_m, comparison.cov_en_m2, own_radius_m, radius_m
        ),
        standard=standard_figures(truth_en_m, fix_en_m),
        of_confident=standard_figures(truth_en_m, confident_en_m),
        integrity=measure_integrity(comparison, alert_limit_m),
    )


def measure_integrity(comparison: Comparison, alert_limit_m: float) -> Integrity | None:
    limited = math.isfinite(alert_limit_m)
    if not (limited or np.isfinite(comparison.place_probability).any()):
        return None
    levels_m, errors_m = comparison.protection_levels_m, comparison.errors_m
    finite = np.isfinite(levels_m) & np.isfinite(errors_m)
    available = finite & (levels_m <= alert_limit_m)
    n_levels, n_available = int(finite.sum()), int(available.sum())
    n_beyond = int((errors_m > levels_m)[finite].sum())
    n_false = int((errors_m > alert_limit_m)[available].sum())
    return Integrity(
        risk=comparison.risk,
        n_levels=n_levels,
        n_beyond=n_beyond,
        beyond=share(n_beyond, n_levels),
        beyond_upper_95=upper_bound(n_beyond, n_levels),
        alert_limit_m=alert_limit_m,
        n_available=n_available,
        availability=share(n_available, comparison.n_views) if limited else math.nan,
        availability_of_time=_share_of_time(comparison, available) if limited else math.nan,
        outage=_longest_without(comparison, available) if limited else Longest(math.nan, math.nan),
        n_false=n_false,
        false_upper_95=upper_bound(n_false, n_available),
    )


def worst_views(comparison: Comparison, n: int = 10, wrong_above_m: float = FAR_M) -> list[int]:
    fixes = np.flatnonzero(np.isfinite(comparison.errors_m))
    wrong = comparison.confident_wrong(wrong_above_m)
    order = np.lexsort((-comparison.errors_m[fixes], ~wrong[fixes]))
    return [int(i) for i in fixes[order[:n]]]


def _criterion_row(
    comparison: Comparison, name: str, threshold: float, radius_m: float
) -> CriterionRow:
    values, errors_m = comparison.criteria[name], comparison.errors_m
    known = not np.isnan(values).all()
    accepted_m = errors_m[values >= threshold]  # NaN is never accepted
    n_accepted = accepted_m.size
    n_right, n_far = int((accepted_m <= radius_m).sum()), int((accepted_m > FAR_M).sum())
    n_all_right = int((errors_m <= radius_m).sum())
    return CriterionRow(
        name=name,
        threshold=threshold,
        share_accepted=share(n_accepted, comparison.n_views) if known else math.nan,
        accuracy=share(n_right, n_accepted),
        n_accepted=n_accepted,
        n_right=n_right,
        share_of_right_accepted=share(n_right, n_all_right) if known else math.nan,
        n_wrong_by_35m=n_far,
        wrong_by_35m=share(n_far, n_accepted),
    )


def _share_of_time(comparison: Comparison, flags: BoolArray) -> float:
    """Of the views with `flags` (N,), each up to the next view, none where a view between has no
    result; NaN where the flight has no result at an end or its times do not rise."""
    if np.isnan(comparison.followed).any():
        return math.nan
    steps_s = np.diff(seconds_since_first(comparison.time_ns))
    whole_s = float(steps_s.sum())
    part_s = float(steps_s[(flags & (comparison.followed > 0))[:-1]].sum())
    return part_s / whole_s if whole_s else math.nan


def _longest_without(comparison: Comparison, flags: BoolArray) -> Longest:
    """The longest stretch without `flags` (N,), as `_share_of_time` counts them, time and path each
    by itself; NaN likewise."""
    if np.isnan(comparison.followed).any():
        return Longest(math.nan, math.nan)
    seconds_s = seconds_since_first(comparison.time_ns)
    without = ~(flags & (comparison.followed > 0))
    return longest(without, seconds_s, path_so_far_m(comparison.truth_en_m))


def place_of(outcome: Fix | NoFix) -> LatLon | None:
    return (outcome.lat_deg, outcome.lon_deg) if isinstance(outcome, Fix) else None


def reason_of(outcome: Fix | NoFix) -> str:
    """Why there is no position; "" for a fix."""
    return "" if isinstance(outcome, Fix) else outcome.reason or "not_said"


def _criterion(fix: Fix, name: str) -> float:
    return fix.confidence if name == "confidence" else fix.evidence.get(name, math.nan)


def places_en_m(local: LocalFrame, places: Sequence[LatLon | None]) -> FloatArray:
    """(N, 2) metres in the plane of `local`; NaN where a place is None or not finite."""
    nowhere = math.nan, math.nan
    lat_lon_deg = np.array([place or nowhere for place in places], np.float64).reshape(-1, 2)
    en_m = np.full(lat_lon_deg.shape, np.nan)
    known = np.isfinite(lat_lon_deg).all(axis=1)
    if known.any():
        en_m[known] = local.en_from_latlon(*lat_lon_deg[known].T)
    return frozen(en_m)
