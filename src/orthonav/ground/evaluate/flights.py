"""Evaluated flights: their figures as a table, as lines for a terminal and as JSON values."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from orthonav.ground.evaluate.calibration_report import (
    calibration_lines,
    calibration_to_json,
    consistency_to_json,
    row_to_json,
)
from orthonav.ground.evaluate.contact_sheet import Row
from orthonav.ground.evaluate.figures import or_none
from orthonav.ground.evaluate.gnss import GnssMetrics, gnss_rows, gnss_to_json
from orthonav.ground.evaluate.metrics import Comparison, Metrics, measure, pool, radius_key
from orthonav.ground.evaluate.standard import standard_to_json
from orthonav.ground.evaluate.track import TrackMetrics
from orthonav.ground.evaluate.track_report import track_lines, track_to_json, tracks_to_json
from orthonav.ground.report.maps import Background
from orthonav.ground.report.numbers import measure_text, percent_text

_COLUMNS = (
    "flight",
    "views",
    "confident",
    "wrong",
    "low confidence",
    "coverage",
    "right",  # named after the radius
    "of fixes",
    "median m",
    "95 % m",
    "max m",
    "latency ms",
)


@dataclass(frozen=True, eq=False)
class FlightReport:
    """One evaluated flight.

    `comparison`: results with their true positions; `metrics`: figures of these.
    `background`: image in the plane of `comparison`; optional.
    `track`: metrics of the track; None where views were localized one by one.
    `worst`: rows of the contact sheet; empty where images were not requested.
    `gnss`: GNSS beside the map; None where it was not recorded.
    `view_command`: command that shows single views; empty without a map.
    """

    name: str
    comparison: Comparison
    metrics: Metrics
    background: Background | None = None
    track: TrackMetrics | None = None
    worst: tuple[Row, ...] = ()
    gnss: GnssMetrics | None = None
    view_command: str = ""


def total(flights: Sequence[FlightReport]) -> Metrics:
    """Metrics of all views of all flights together.

    Raises `ValueError` for no flight, and where flights were measured at different radii.
    """
    radius_m = _radius_m(flights)
    first = flights[0].metrics
    if len(flights) == 1:
        return first
    pooled = pool([flight.comparison for flight in flights])
    distance_m = first.standard.distance_m
    return measure(pooled, radius_m, list(first.acc_at_m), rpe_distance_m=distance_m)


def _radius_m(flights: Sequence[FlightReport]) -> float:
    """The radius of all flights; raises `ValueError` as `total` does."""
    radii_m = {flight.metrics.radius_m for flight in flights}
    if len(radii_m) != 1:
        raise ValueError("a total needs at least one flight, and one radius for all of them")
    return radii_m.pop()


def table(flights: Sequence[FlightReport], whole: Metrics) -> str:
    """The figures in aligned columns for a terminal: a row per flight, and a total of several.

    `whole`: what `total` gives. Raises `ValueError` as `total` does.
    """
    rows = [table_header(flights), *table_rows(flights, whole)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_COLUMNS))]
    lines = []
    for row in rows:
        first, *others = zip(row, widths, strict=True)
        cells = [first[0].ljust(first[1]), *(text.rjust(width) for text, width in others)]
        lines.append("  ".join(cells).rstrip())
    if len(flights) > 1:
        lines.insert(-1, "-" * max(map(len, lines)))
    return "\n".join(lines)


def metrics_to_json(metrics: Metrics) -> dict[str, object]:
    """`metrics` as values for strict JSON; undefined ones become None."""
    return {
        "n_views": metrics.n_views,
        "n_fixes": metrics.n_fixes,
        "n_confident": metrics.n_confident,
        "n_low_confidence": metrics.n_fixes - metrics.n_confident,
        "n_confident_wrong": metrics.n_confident_wrong,
        "wrong_above_m": metrics.wrong_above_m,
        "wrong_upper_95": or_none(metrics.wrong_upper_95),
        "availability": or_none(metrics.availability),
        "availability_95": [or_none(each) for each in metrics.availability_95],
        "longest_gap_s": or_none(metrics.gap.seconds_s),
        "longest_gap_m": or_none(metrics.gap.path_m),
        "confident_error_median_m": or_none(metrics.of_confident.cep50_m),
        "confident_error_p95_m": or_none(metrics.of_confident.cep95_m),
        "confident_error_max_m": or_none(metrics.of_confident.ape.max_m),
        "n_without_truth": metrics.n_without_truth,
        "n_without_result": metrics.n_without_result,
        "radius_m": metrics.radius_m,
        "coverage": or_none(metrics.coverage),
        **{radius_key(r): or_none(share) for r, share in metrics.acc_at_m.items()},
        **{f"fixes_{radius_key(r)}": or_none(s) for r, s in metrics.acc_fixes_at_m.items()},
        "error_median_m": or_none(metrics.standard.cep50_m),
        "error_p95_m": or_none(metrics.standard.cep95_m),
        "error_mean_m": or_none(metrics.standard.ape.mean_m),
        "error_max_m": or_none(metrics.standard.ape.max_m),
        "latency_median_ms": or_none(metrics.latency_median_ms),
        "latency_p95_ms": or_none(metrics.latency_p95_ms),
        "reasons": dict(metrics.reasons),
        "criteria": [row_to_json(row) for row in metrics.criteria],
        "standard": standard_to_json(metrics.standard),
        "standard_of_confident": standard_to_json(metrics.of_confident),
        "curves": {
            curve.name: {
                "threshold": [or_none(value) for value in curve.thresholds],
                "share_accepted": curve.share_accepted.tolist(),
                "accuracy": curve.accuracy.tolist(),
            }
            for curve in metrics.curves
        },
        "calibration": calibration_to_json(metrics.calibration),
        "covariance": consistency_to_json(metrics.consistency),
    }


def flights_to_json(flights: Sequence[FlightReport], whole: Metrics) -> dict[str, Any]:
    """The figures of all flights together, and of several also of each, for strict JSON.

    `whole`: what `total` gives. Of several tracks only sums and maxima are given.
    """
    plain = metrics_to_json(whole)
    if len(flights) == 1:
        track, gnss = flights[0].track, flights[0].gnss
        plain |= {} if track is None else {"track": track_to_json(track)}
        return plain | ({} if gnss is None else {"gnss": gnss_to_json(gnss)})
    tracks = [flight.track for flight in flights if flight.track is not None]
    if tracks:
        plain["track"] = tracks_to_json(tracks)
    plain["flights"] = {each.name: flights_to_json([each], each.metrics) for each in flights}
    return plain


def summary(flights: Sequence[FlightReport], whole: Metrics) -> str:
    """Standard figures, confidence and covariance of all flights, and metrics of each track.

    `whole`: what `total` gives.
    """
    lines = calibration_lines(whole)
    for flight in flights:
        if flight.track is not None:
            lines += track_lines(flight.track, flight.name if len(flights) > 1 else "")
        if flight.gnss is not None:
            lines += [f"  {name}: {text}" for name, text in gnss_rows(flight.gnss)]
    return "\n".join(lines)


def verdict(metrics: Metrics) -> str:
    """A sentence that answers whether any confident fix was wrong."""
    confident, wrong = metrics.n_confident, metrics.n_confident_wrong
    above = f"{metrics.wrong_above_m:g} m and the stated radius"
    if not confident:
        guesses = metrics.n_fixes
        return f"No fix is confident: rely on no position ({guesses} are best guesses)."
    errors = (
        f"median error {measure_text(metrics.of_confident.cep50_m, ' m')}, largest "
        f"{measure_text(metrics.of_confident.ape.max_m, ' m')}"
    )
    bound = f"95 % bound of the rate: below {percent_text(metrics.wrong_upper_95)}"
    if not wrong:
        return (
            f"No confident fix is wrong: none of {confident} has an error above {above} ({bound}); "
            f"{errors}."
        )
    verb = "is" if wrong == 1 else "are"
    return (
        f"{wrong} of {confident} confident fixes {verb} WRONG, by more than {above} ({bound}); "
        f"{errors}."
    )


def table_header(flights: Sequence[FlightReport]) -> list[str]:
    """Names of the columns. Raises `ValueError` as `total` does."""
    radius_m = _radius_m(flights)
    return [f"acc@{radius_m:g} m" if name == "right" else name for name in _COLUMNS]


def table_rows(flights: Sequence[FlightReport], whole: Metrics) -> list[list[str]]:
    """A row per flight, and the total `whole` of several."""
    rows = [_row(flight.name, flight.metrics) for flight in flights]
    return rows if len(flights) == 1 else [*rows, _row("total", whole)]


def _row(name: str, metrics: Metrics) -> list[str]:
    return [
        " ".join(name.split()),
        str(metrics.n_views),
        str(metrics.n_confident),
        str(metrics.n_confident_wrong),
        str(metrics.n_fixes - metrics.n_confident),
        percent_text(metrics.coverage),
        percent_text(metrics.accuracy),
        percent_text(metrics.accuracy_of_fixes),
        measure_text(metrics.standard.cep50_m),
        measure_text(metrics.standard.cep95_m),
        measure_text(metrics.standard.ape.max_m),
        measure_text(metrics.latency_median_ms),
    ]
