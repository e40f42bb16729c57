"""Figures of evaluated flights: JSON values, and tables and sentences of terminal and page."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from orthonav.core.flight.fixes import STATES
from orthonav.core.flight.gnss import BIASES
from orthonav.ground.evaluate.metrics import FAR_M, Comparison, Metrics, radius_key
from orthonav.ground.evaluate.statistics import (
    RPE_DISTANCE_M,
    Consistency,
    ErrorStatistics,
    FloatArray,
    Longest,
    StandardFigures,
    nees_bound,
    percentile,
    share,
)
from orthonav.ground.evaluate.track import GnssMetrics, TrackMetrics
from orthonav.ground.report import aligned, measure_text, percent_text, to_plain
from orthonav.ground.report.drawing import Background

Plain = dict[str, Any]
Row = tuple[str, ...]
Table = tuple[Row, list[Row]]
"""Header and rows."""


@dataclass(frozen=True, eq=False)
class FlightReport:
    """One evaluated flight, and what its report shows beside the metrics.

    `background`: image in the plane of `comparison`; `track`, `gnss`: None where there is none;
    `view_command`: shows single views, "" without a map.
    """

    name: str
    comparison: Comparison
    metrics: Metrics
    background: Background | None = None
    track: TrackMetrics | None = None
    gnss: GnssMetrics | None = None
    view_command: str = ""


# JSON.


def metrics_to_json(metrics: Metrics) -> Plain:
    apart = ("acc_at_m", "acc_fixes_at_m", "gap", "consistency", "standard", "of_confident")
    values = {name: each for name, each in vars(metrics).items() if name not in apart}
    if metrics.integrity is None:
        del values["integrity"]
    confident, standard = metrics.of_confident, metrics.standard
    found = metrics.consistency
    plain: Plain = to_plain(
        {
            **values,
            **{radius_key(r): share for r, share in metrics.acc_at_m.items()},
            **{f"fixes_{radius_key(r)}": share for r, share in metrics.acc_fixes_at_m.items()},
            "n_low_confidence": metrics.n_fixes - metrics.n_confident,
            "longest_gap_s": metrics.gap.seconds_s,
            "longest_gap_m": metrics.gap.path_m,
            "confident_error_median_m": confident.cep50_m,
            "confident_error_p95_m": confident.cep95_m,
            "confident_error_max_m": confident.ape.max_m,
            "error_median_m": standard.cep50_m,
            "error_p95_m": standard.cep95_m,
            "error_mean_m": standard.ape.mean_m,
            "error_max_m": standard.ape.max_m,
            "standard": _standard_to_json(standard),
            "standard_of_confident": _standard_to_json(confident),
            "covariance": {
                "n_right": found.n,
                "n_nees": found.nees.size,
                "n_without_covariance": found.n_without,
                "n_unusable_covariance": found.n_unusable,
                **_nees_to_json(found),
            },
        }
    )
    return plain


def _standard_to_json(standard: StandardFigures) -> Plain:
    return {
        "rmse_m": standard.ape.rmse_m,
        "cep50_m": standard.cep50_m,
        "cep95_m": standard.cep95_m,
        "ape": standard.ape,
        "rpe": [
            {"delta": 1, "unit": "frames", **asdict(standard.rpe_frames)},
            {"delta": RPE_DISTANCE_M, "unit": "m", **asdict(standard.rpe_distance)},
        ],
    }


def _nees_to_json(found: Consistency) -> Plain:
    return {
        "nees_mean": found.nees_mean,
        "nees_median": found.nees_median,
        **{f"nees_within_{100 * level:g}": share for level, share in found.within.items()},
        "n_effective": found.n_effective,
        "effective_low": found.low,
        "effective_high": found.high,
        "verdict": found.verdict or None,
    }


def runs_to_json(runs: Sequence[FlightReport]) -> Plain:
    """The figures of a run, or of several by name, for strict JSON."""
    if len(runs) > 1:
        return {"runs": {each.name: runs_to_json([each]) for each in runs}}
    plain, track, gnss = metrics_to_json(runs[0].metrics), runs[0].track, runs[0].gnss
    plain |= {} if track is None else {"track": track_to_json(track)}
    return plain | ({} if gnss is None else {"gnss": gnss_to_json(gnss)})


def track_to_json(track: TrackMetrics) -> Plain:
    found, after = track.consistency, track.after
    within = {radius_key(radius_m): share for radius_m, share in after.acc_at_m.items()}
    plain: Plain = to_plain(
        {
            **vars(track),
            "first_view": int(track.first_view) if math.isfinite(track.first_view) else None,
            "after": {name: each for name, each in vars(after).items() if name != "acc_at_m"}
            | within,
            "along": _spread_to_json(track.along),
            "across": _spread_to_json(track.across),
            "consistency": {
                "n_views": found.nees.size,
                "n_left_out": found.n_without + found.n_unusable,
                **_nees_to_json(found),
            },
        }
    )
    del plain["series"]
    names = ("seconds_s", "sigma_m", "bound_95_m", "along_m", "across_m")
    plain["over_time"] = to_plain({name: getattr(track.series, name) for name in names}, 3)
    return plain


def _spread_to_json(errors: ErrorStatistics) -> Plain:
    values = errors.n, errors.mean_m, errors.std_m, errors.rmse_m
    return dict(zip(("n_views", "mean_m", "std_m", "rmse_m"), values, strict=True))


def gnss_to_json(found: GnssMetrics) -> Plain:
    values = {
        f"{name}_{label}_m": percentile(each, percent)
        for name, each in (("error", found.errors_m), ("difference", found.differences_m))
        for label, percent in (("median", 50), ("p95", 95), ("max", 100))
    }
    alarms = [
        {"fault": found.faults[i], "first_s": found.seconds_s[i], "views": end - i}
        for i, end in found.alarms
    ]
    plain: Plain = to_plain({**values, "alarms": alarms, "learnt": found.learnt})
    return plain


# Text for a terminal.


def verdict(metrics: Metrics) -> str:
    confident, wrong = metrics.n_confident, metrics.n_confident_wrong
    above = f"off by more than {_far_text(metrics.wrong_above_m)}"
    if not confident:
        guesses = metrics.n_fixes
        return f"No fix is confident: rely on no position ({guesses} are best guesses)."
    errors = (
        f"({wrong_bound_text(metrics)}); "
        f"median error {measure_text(metrics.of_confident.cep50_m, ' m')}, largest "
        f"{measure_text(metrics.of_confident.ape.max_m, ' m')}."
    )
    if not wrong:
        return f"No confident fix is wrong: none of {confident} is {above} {errors}"
    verb = "is" if wrong == 1 else "are"
    return f"{wrong} of {confident} confident fixes {verb} WRONG, {above} {errors}"


def _far_text(far_m: float) -> str:
    return f"{far_m:g} m or its radius, whichever is larger"


def wrong_bound_text(metrics: Metrics) -> str:
    return f"95 % bound of the rate: below {percent_text(metrics.wrong_upper_95)}"


def text(runs: Sequence[FlightReport]) -> str:
    """Runs beside each other, never together: those of one flight are not independent."""
    names = [f"{_name(run)}: " * (len(runs) > 1) for run in runs]
    lines = []
    for name, run in zip(names, runs, strict=True):
        judged = covariance_verdict(run.metrics.consistency)
        lines += [f"{name}{verdict(run.metrics)}", f"{name}{judged}"]
    lines += ["", *_lines(runs_table(runs))]
    for name, run in zip(names, runs, strict=True):
        lines += ["", *([name.rstrip()] if name else []), summary(run)]
    return "\n".join(lines)


def _name(run: FlightReport) -> str:
    return " ".join(run.name.split())


def _lines(table: Table) -> list[str]:
    header, rows = table
    return aligned([header, *rows])


def summary(flight: FlightReport) -> str:
    whole = flight.metrics
    low, high = map(percent_text, whole.availability_95)
    lines = [
        f"views with a confident fix: {percent_text(whole.availability)} (95 % interval {low} to "
        f"{high}); longest gap {_stretch_text(whole.gap)}",
        *("", *_lines(standard_table(whole))),
        *("", *_lines(criteria_table(whole)), ""),
        f"confidence: {confidence_text(whole)}",
        f"covariance: {consistency_text(whole.consistency, 'correct fixes')}",
        *(f"{name}: {text}" for name, text in integrity_rows(whole)),
    ]
    if flight.track is not None:
        lines.append("track:")
    return "\n".join([*lines, *(f"  {name}: {text}" for name, text in track_rows(flight))])


def _stretch_text(stretch: Longest) -> str:
    return f"{measure_text(stretch.seconds_s, ' s')}, {measure_text(stretch.path_m, ' m')}"


def confidence_text(metrics: Metrics) -> str:
    calibration = metrics.calibration
    if not calibration.n_fixes:
        return "unknown, no fix states one"
    n_default = calibration.n_fixes - calibration.n_own_radius
    default = f" ({n_default} state no radius; {metrics.radius_m:g} m is used)" if n_default else ""
    stated = "1 fix states" if calibration.n_fixes == 1 else f"{calibration.n_fixes} fixes state"
    return (
        f"{stated} a mean confidence of {calibration.mean_confidence:.3f}; the fraction off by "
        f"less than the radius is {calibration.share_right:.3f}{default}; "
        f"ECE {calibration.ece:.3f}, Brier score {calibration.brier:.3f}"
    )


def integrity_rows(metrics: Metrics) -> list[tuple[str, str]]:
    found = metrics.integrity
    if found is None:
        return []
    beyond = _bounded(found.n_beyond, found.n_levels, found.beyond_upper_95)
    rows = [("errors beyond the protection level", f"{beyond}, at a risk of {found.risk:g}")]
    if not math.isfinite(found.alert_limit_m):
        return rows
    views, of_time = map(percent_text, (found.availability, found.availability_of_time))
    outage = f"longest outage {_stretch_text(found.outage)}"
    limit = f"alert limit of {found.alert_limit_m:g} m"
    false = _bounded(found.n_false, found.n_available, found.false_upper_95)
    return [
        *rows,
        (f"available at the {limit}", f"{views} of views, {of_time} of the time; {outage}"),
        (f"available and beyond the {limit}", false),
    ]


def _bounded(part: int, whole: int, upper_95: float) -> str:
    if not whole:
        return "none of 0"
    return (
        f"{part} of {whole} ({100 * share(part, whole):.2g} %; 95 % bound {100 * upper_95:.2g} %)"
    )


def covariance_verdict(found: Consistency) -> str:
    if not found.nees.size:
        return "Whether covariances are right is unknown: no correct fix states one."
    return f"Covariances are {_judged(found)}."


def consistency_text(found: Consistency, what: str) -> str:
    """`what`: the fixes or views that were judged."""
    counts = ((found.n_without, "without one"), (found.n_unusable, "unusable"))
    left_out = "".join(f"; {count} {kind}" for count, kind in counts if count)
    if not found.nees.size:
        return f"unknown: {found.n} {what}{left_out}"
    levels = " / ".join(f"{100 * level:g}" for level in found.within)
    within = " / ".join(f"{100 * share:.1f}" for share in found.within.values())
    return (
        f"{_judged(found)}; NEES of {found.nees.size} {what} has mean {found.nees_mean:.3g} "
        f"(2 expected; 95 % interval {found.low:.2f} to {found.high:.2f} for "
        f"{found.n_effective:.0f} independent ones), median {found.nees_median:.3g} "
        f"({nees_bound(0.5):.2f} expected); {within} % within the bounds of {levels} %{left_out}"
    )


def _judged(found: Consistency) -> str:
    times = f"errors are {math.sqrt(found.nees_mean / 2):.1f} times as large as stated"
    return {
        "over-confident": f"too small: {times}",
        "under-confident": f"conservative: {times}",
    }.get(found.verdict, "consistent with the errors")


# Tables.


def runs_table(runs: Sequence[FlightReport]) -> Table:
    right = f"acc@{runs[0].metrics.radius_m:g} m"
    header = (
        *("run", "views", "confident", "wrong", "low confidence", "coverage", right, "of fixes"),
        *("median m", "95 % m", "max m", "latency ms"),
    )
    return header, [_run_row(_name(run), run.metrics) for run in runs]


def _run_row(name: str, metrics: Metrics) -> Row:
    n_low = metrics.n_fixes - metrics.n_confident
    counts = (metrics.n_views, metrics.n_confident, metrics.n_confident_wrong, n_low)
    shares = (metrics.coverage, metrics.accuracy, metrics.accuracy_of_fixes)
    standard = metrics.standard
    measures = (standard.cep50_m, standard.cep95_m, standard.ape.max_m, metrics.latency_median_ms)
    return (name, *map(str, counts), *map(percent_text, shares), *map(measure_text, measures))


def standard_table(metrics: Metrics) -> Table:
    header = ("", "fixes", "RMSE m", "mean m", "median m", "std m", "max m", "number")
    return header, [
        (name, kind, *map(measure_text, list(vars(found).values())[1:]), str(found.n))
        for kind, standard in (("confident", metrics.of_confident), ("all", metrics.standard))
        for name, found in (
            ("APE", standard.ape),
            ("RPE over 1 frame", standard.rpe_frames),
            (f"RPE over {RPE_DISTANCE_M:g} m", standard.rpe_distance),
        )
    ]


def criteria_table(metrics: Metrics) -> Table:
    header = (
        *("criterion", "at least", "accepted", "of all views"),
        *(f"precision within {metrics.radius_m:g} m", "recall", f"wrong by > {FAR_M:g} m"),
    )
    return header, [
        (
            "Lowe's ratio" if row.name == "lowe_ratio" else row.name,
            f"{row.threshold:g}",
            str(row.n_accepted),
            percent_text(row.share_accepted),
            percent_text(row.accuracy),
            percent_text(row.share_of_right_accepted),
            percent_text(row.wrong_by_35m) + f" ({row.n_wrong_by_35m})" * (row.n_accepted > 0),
        )
        for row in metrics.criteria
    ]


def track_rows(flight: FlightReport) -> list[tuple[str, str]]:
    """What is said of the track and of GNSS, where there are any."""
    return [
        *([] if flight.track is None else _track_rows(flight.track)),
        *([] if flight.gnss is None else gnss_rows(flight.gnss)),
    ]


def _track_rows(track: TrackMetrics) -> list[tuple[str, str]]:
    after, errors, found = track.after, "unknown", "never"
    if math.isfinite(track.first_view):
        first = f"view {track.first_view:.0f} of {track.n_views}"
        found = f"{first}, {measure_text(track.first_s, ' s')} after the first"
    if after.n_views:
        within = ", ".join(f"{percent_text(s)} within {r:g} m" for r, s in after.acc_at_m.items())
        values = (after.error_median_m, after.error_p95_m, after.error_max_m)
        median, p95, most = (measure_text(value, " m") for value in values)
        errors = f"median {median}, 95 % {p95}, largest {most}; of {after.n_views} views {within}"
    by_view = ", ".join(f"{name} {percent_text(track.share_of_views[name])}" for name in STATES)
    by_time = ", ".join(percent_text(track.share_of_time[name]) for name in STATES)
    lost = f"lost {track.n_lost} time{'s' * (track.n_lost != 1)}"
    without, after_first = map(_stretch_text, (track.low_confidence, track.low_confidence_after))
    wrong = (
        f"{track.n_false_locks} times, the longest "
        f"{measure_text(track.false_lock_longest_s, ' s')}; {track.n_confident_wrong} confident or "
        f"tracking views, each off by more than {_far_text(track.far_m)}"
    )
    gaps = f"{without}; from the first confirmed fix on {after_first}"
    return [
        ("first confirmed fix", found),
        ("errors from then on", errors),
        ("states", f"{by_view} of views; {by_time} of the time; {lost}"),
        ("longest without a confident fix", gaps),
        ("on wrong positions", wrong),
        ("ahead of the ground truth", spread_text(track.along)),
        ("right of the ground truth", spread_text(track.across)),
        ("covariance", consistency_text(track.consistency, "tracking views")),
    ]


def spread_text(errors: ErrorStatistics) -> str:
    if not errors.n:
        return "unknown"
    return (
        f"mean {errors.mean_m:+.1f} m, standard deviation {errors.std_m:.1f} m, "
        f"RMSE {errors.rmse_m:.1f} m of {errors.n} tracking views"
    )


def gnss_rows(found: GnssMetrics) -> list[tuple[str, str]]:
    named = [found.faults[first] for first, _ in found.alarms]
    rows = [
        ("error of GNSS", percentiles_text(found.errors_m)),
        ("difference of GNSS and map", percentiles_text(found.differences_m)),
        ("GNSS alarms", f"{len(named)}{': ' if named else ''}{', '.join(named)}"),
    ]
    if not found.learnt:
        return rows
    units = ((1, "m east"), (1, "m north"), (2, "deg pitch"), (2, "deg roll"), (0, "ms"))
    east, north, pitch, roll, latency = (
        f"{found.learnt[key]:.{digits}f} +- {found.learnt[std_key]:.{digits}f} {unit}"
        for (key, std_key), (digits, unit) in zip(BIASES, units, strict=True)
    )
    return [
        *rows,
        ("learnt displacement of the map", f"{east}, {north}"),
        ("learnt error of the mount", f"{pitch}, {roll}"),
        ("learnt latency", latency),
    ]


def percentiles_text(values: FloatArray) -> str:
    median, p95, most = (measure_text(percentile(values, q), " m") for q in (50, 95, 100))
    return f"median {median}, 95 % {p95}, largest {most}"
