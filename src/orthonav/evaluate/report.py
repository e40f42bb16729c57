"""The evaluation of flights as one self-contained page, as a table and as JSON values."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from orthonav.evaluate import plots
from orthonav.evaluate.calibration_report import (
    Picture,
    calibration_html,
    calibration_lines,
    calibration_pictures,
    calibration_to_json,
    consistency_to_json,
    criteria_html,
    row_to_json,
)
from orthonav.evaluate.contact_sheet import Row, row_text, sheet_picture
from orthonav.evaluate.figures import or_none, percent_text, plain_text
from orthonav.evaluate.ground import Background
from orthonav.evaluate.metrics import (
    Comparison,
    Metrics,
    measure,
    pool,
    radius_key,
    worst_views,
)
from orthonav.evaluate.page import (
    SAID_STYLE,
    STYLE,
    definitions,
    document,
    html_table,
    picture,
)
from orthonav.evaluate.track import Track
from orthonav.evaluate.track_plots import track_pictures
from orthonav.evaluate.track_report import (
    track_lines,
    track_rows,
    track_to_json,
    tracks_to_json,
)
from orthonav.files import write_text

_COLUMNS = (
    "flight",
    "views",
    "fixes",
    "coverage",
    "right",  # named after the radius
    "of fixes",
    "median m",
    "95 % m",
    "mean m",
    "max m",
    "latency ms",
)
_N_WORST = 10


@dataclass(frozen=True, eq=False)
class FlightReport:
    """One evaluated flight: its name, its results beside the truth, and the figures of those.

    `background` is in the plane of `comparison`; see `orthonav.evaluate.ground.Background`. `track`
    is None where views were placed one by one, `worst` empty where pictures were not asked for.
    """

    name: str
    comparison: Comparison
    metrics: Metrics
    background: Background | None = None
    track: Track | None = None
    worst: tuple[Row, ...] = ()


@dataclass(frozen=True)
class MadeFrom:
    """What a report was made from, as text to show; empty where not known."""

    map_name: str = ""
    recipe: str = ""
    imagery: str = ""
    flight: str = ""
    command: str = ""
    version: str = ""
    date: str = ""


def total(flights: Sequence[FlightReport]) -> Metrics:
    """Figures of all views of all flights together.

    Raises `ValueError` for no flight, and where flights were measured at different radii.
    """
    if len({flight.metrics.radius_m for flight in flights}) != 1:
        raise ValueError("a total needs at least one flight, and one radius for all of them")
    if len(flights) == 1:
        return flights[0].metrics
    first = flights[0].metrics
    return measure(pool([f.comparison for f in flights]), first.radius_m, list(first.acc_at_m))


def table(flights: Sequence[FlightReport]) -> str:
    """The figures in aligned columns for a terminal: a row per flight, and a total of several."""
    rows = [list(_header(flights)), *_rows(flights)]
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
    """`metrics` as values for strict JSON; what is not defined becomes None."""
    return {
        "n_views": metrics.n_views,
        "n_fixes": metrics.n_fixes,
        "n_without_truth": metrics.n_without_truth,
        "n_without_result": metrics.n_without_result,
        "radius_m": metrics.radius_m,
        "coverage": or_none(metrics.coverage),
        **{radius_key(r): or_none(share) for r, share in metrics.acc_at_m.items()},
        **{f"fixes_{radius_key(r)}": or_none(s) for r, s in metrics.acc_fixes_at_m.items()},
        "error_median_m": or_none(metrics.error_median_m),
        "error_p95_m": or_none(metrics.error_p95_m),
        "error_mean_m": or_none(metrics.error_mean_m),
        "error_max_m": or_none(metrics.error_max_m),
        "latency_median_ms": or_none(metrics.latency_median_ms),
        "latency_p95_ms": or_none(metrics.latency_p95_ms),
        "reasons": dict(metrics.reasons),
        "criteria": [row_to_json(row) for row in metrics.criteria],
        "curves": {
            curve.name: {
                "threshold": [or_none(value) for value in curve.thresholds],
                "share_kept": curve.share_kept.tolist(),
                "accuracy": curve.accuracy.tolist(),
            }
            for curve in metrics.curves
        },
        "calibration": calibration_to_json(metrics.calibration),
        "covariance": consistency_to_json(metrics.consistency),
    }


def flights_to_json(flights: Sequence[FlightReport]) -> dict[str, Any]:
    """The figures of all flights together, and of several also of each, for strict JSON.

    A track's figures are those of its flight: only what adds up is told of several. Raises
    `ValueError` as `total` does.
    """
    plain = metrics_to_json(total(flights))
    if len(flights) == 1:
        track = flights[0].track
        return plain if track is None else {**plain, "track": track_to_json(track)}
    tracks = [flight.track for flight in flights if flight.track is not None]
    if tracks:
        plain["track"] = tracks_to_json(tracks)
    plain["flights"] = {flight.name: flights_to_json([flight]) for flight in flights}
    return plain


def summary(flights: Sequence[FlightReport]) -> str:
    """How far confidence and covariance can be believed, in lines for a terminal, of all flights;
    and how each track held.

    Raises `ValueError` as `total` does.
    """
    lines = calibration_lines(total(flights))
    for flight in flights:
        if flight.track is not None:
            lines += track_lines(flight.track, flight.name if len(flights) > 1 else "")
    return "\n".join(lines)


def write_report(
    out_dir: Path,
    flights: Sequence[FlightReport],
    made_from: MadeFrom | None = None,
    title: str = "orthonav evaluation",
) -> Path:
    """Write `index.html` into `out_dir` and return its path; it needs no other file and no network.

    Raises `MissingExtraError` without matplotlib, `OutputError` where it cannot be written.
    """
    path = Path(out_dir) / "index.html"
    page = render(flights, made_from or MadeFrom(), title)
    write_text(path, page.encode("utf-8", "replace").decode("utf-8"))
    return path


def render(flights: Sequence[FlightReport], made_from: MadeFrom, title: str) -> str:
    """The whole page as HTML text."""
    whole = total(flights)
    parts = [
        f"<h1>{escape(title)}</h1>",
        _headline(whole),
        _notes(whole),
        "<h2>Flights</h2>",
        html_table(_header(flights), _rows(flights), last_is_total=len(flights) > 1),
        _legend(whole.radius_m),
        *(_section(flight) for flight in flights),
    ]
    if len(flights) > 1:
        parts.append(_all_flights(flights, whole))
    parts += ["<h2>Made from</h2>", _made_from(made_from)]
    style = STYLE + SAID_STYLE * any(flight.track is not None for flight in flights)
    return document(title, "\n".join(parts), style)


def _headline(metrics: Metrics) -> str:
    radius = f"{metrics.radius_m:g} m"
    cards = (
        (percent_text(metrics.accuracy), f"of all views have a fix within {radius}"),
        (percent_text(metrics.accuracy_of_fixes), f"of fixes are within {radius}"),
        (percent_text(metrics.coverage), f"of {metrics.n_views} views have a fix"),
        (_figure(metrics.error_median_m, " m"), "median error of fixes"),
        (_figure(metrics.error_p95_m, " m"), "95 % of fixes err less"),
        (_figure(metrics.latency_median_ms, " ms"), "median time per view"),
    )
    inside = "".join(f"<div><b>{value}</b><span>{said}</span></div>" for value, said in cards)
    return f'<div class="cards">{inside}</div>'


def _notes(metrics: Metrics) -> str:
    notes = []
    if metrics.n_without_truth:
        notes.append(f"{metrics.n_without_truth} results have no true position and are left out.")
    if metrics.n_without_result:
        notes.append(f"{metrics.n_without_result} true positions have no result: not counted.")
    if not metrics.n_fixes:
        notes.append("No view has a fix, so errors are not defined.")
    return "".join(f'<p class="note">{note}</p>' for note in notes)


def _legend(radius_m: float) -> str:
    radius = f"{radius_m:g} m"
    return (
        f'<p class="small">“acc@{radius}”: share of all views with a fix within {radius}; “of '
        "fixes”: share of fixes within it. Errors are of fixes, latency is the median over all "
        "views.</p>"
    )


def _section(flight: FlightReport) -> str:
    comparison, metrics = flight.comparison, flight.metrics
    pictures = (
        (
            plots.map_picture(comparison, metrics.radius_m, flight.background),
            f"Map of {metrics.n_views} true positions and {metrics.n_fixes} fixes",
            "From above, north up: each fix is joined to where the view was really taken.",
        ),
        (
            plots.along_picture(comparison, metrics.radius_m),
            f"Error of each view in order; {percent_text(metrics.coverage)} have a fix",
            "Error along the flight; shaded where there is no fix.",
        ),
        *_figure_pictures(comparison, metrics),
    )
    return (
        f'<section><h2>{escape(flight.name)}</h2><div class="pictures">'
        f"{_shown(pictures, flight.name)}</div>{_track(flight)}{_trust(metrics)}"
        f"<h3>Worst views</h3>{_worst(comparison, metrics)}{_contact_sheet(flight)}"
        f"<h3>Views without a fix</h3>{_reasons(metrics)}</section>"
    )


def _track(flight: FlightReport) -> str:
    """Figures and pictures of the track; nothing where there is none."""
    track, radius_m = flight.track, flight.metrics.radius_m
    if track is None:
        return ""
    pictures = track_pictures(flight.comparison, track, radius_m, flight.background)
    return (
        f"<h3>Track</h3>{definitions(dict(track_rows(track)), sentences=True)}"
        f'<div class="pictures">{_shown(pictures, flight.name)}</div>'
    )


def _contact_sheet(flight: FlightReport) -> str:
    """The worst views as pictures; nothing where these were not asked for."""
    if not flight.worst:
        return ""
    alt = f"{flight.name}: the worst views. " + "; ".join(map(row_text, flight.worst))
    said = (
        "The worst fixes, those of state tracking first: the view by the heading and height of its "
        "fix, north up, and the map at the same scale; + where it was put, ○ where it was taken."
    )
    return picture(sheet_picture(flight.worst), alt, said)


def _all_flights(flights: Sequence[FlightReport], whole: Metrics) -> str:
    pictures = _figure_pictures(pool([flight.comparison for flight in flights]), whole)
    return (
        '<section><h2>All flights</h2><div class="pictures even">'
        f"{_shown(pictures, 'all flights')}</div>{_trust(whole)}</section>"
    )


def _figure_pictures(comparison: Comparison, metrics: Metrics) -> Sequence[Picture]:
    """The pictures that need no place, so that they can be drawn of several flights too."""
    return (
        (
            plots.error_curve_picture(comparison, metrics),
            f"Error curve: {percent_text(metrics.accuracy)} of all views within "
            f"{metrics.radius_m:g} m",
            "Share of all views with a fix within an error.",
        ),
        (
            plots.criteria_picture(metrics),
            "Share of views kept against accuracy among them, per confidence criterion",
            "What a stricter criterion keeps and how much of it is right, with thresholds; "
            "the ring is a confidence of 0.9.",
        ),
        *calibration_pictures(metrics),
    )


def _shown(pictures: Sequence[Picture], name: str) -> str:
    return "".join(picture(png, f"{name}: {alt}", said) for png, alt, said in pictures)


def _trust(metrics: Metrics) -> str:
    return (
        f"<h3>Confidence criteria</h3>{criteria_html(metrics, plots.LABELS)}"
        f"<h3>Confidence and covariance against errors</h3>{calibration_html(metrics)}"
    )


def _worst(comparison: Comparison, metrics: Metrics) -> str:
    worst = worst_views(comparison, _N_WORST)
    if not worst:
        return "<p>There is no fix.</p>"
    header = ("frame", "time s", "error m", "east m", "north m", "confidence", "peak ratio")
    rows = []
    for i in worst:
        east_m, north_m = comparison.fix_en_m[i] - comparison.truth_en_m[i]
        right = comparison.errors_m[i] <= metrics.radius_m
        rows.append(
            (
                comparison.frames[i],
                f"{comparison.time_ns[i] / 1e9:.2f}",
                _figure(comparison.errors_m[i]) + ("" if right else " ✗"),
                f"{east_m:+.1f}",
                f"{north_m:+.1f}",
                plain_text(comparison.criteria["confidence"][i]),
                plain_text(comparison.criteria["peak_ratio"][i]),
            )
        )
    said = f"The fixes with the largest errors; ✗ marks those beyond {metrics.radius_m:g} m."
    return f'<p class="small">{said}</p>' + html_table(header, rows)


def _reasons(metrics: Metrics) -> str:
    if not metrics.reasons:
        return "<p>Every view has a fix.</p>"
    rows = [(reason, str(count)) for reason, count in metrics.reasons.items()]
    return html_table(("reason", "views"), rows)


def _made_from(made_from: MadeFrom) -> str:
    said = {
        "map": made_from.map_name,
        "recipe": made_from.recipe,
        "imagery": made_from.imagery,
        "flight": made_from.flight,
        "command": made_from.command,
        "orthonav": made_from.version,
        "date": made_from.date,
    }
    return definitions({name: text for name, text in said.items() if text}) or "<p>Not said.</p>"


def _header(flights: Sequence[FlightReport]) -> Sequence[str]:
    radius_m = total(flights).radius_m
    return [f"acc@{radius_m:g} m" if name == "right" else name for name in _COLUMNS]


def _rows(flights: Sequence[FlightReport]) -> list[list[str]]:
    rows = [_row(flight.name, flight.metrics) for flight in flights]
    return rows if len(flights) == 1 else [*rows, _row("total", total(flights))]


def _row(name: str, metrics: Metrics) -> list[str]:
    return [
        " ".join(name.split()),
        str(metrics.n_views),
        str(metrics.n_fixes),
        percent_text(metrics.coverage),
        percent_text(metrics.accuracy),
        percent_text(metrics.accuracy_of_fixes),
        _figure(metrics.error_median_m),
        _figure(metrics.error_p95_m),
        _figure(metrics.error_mean_m),
        _figure(metrics.error_max_m),
        _figure(metrics.latency_median_ms),
    ]


def _figure(value: float, unit: str = "") -> str:
    """A length or time with as many decimals as say something."""
    if not math.isfinite(value):
        return "-"
    return (f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}") + unit
