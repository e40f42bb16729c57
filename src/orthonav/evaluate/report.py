"""The evaluation of flights as one self-contained page, and its figures as files."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

from orthonav.evaluate import plots
from orthonav.evaluate.calibration_report import (
    calibration_figures,
    calibration_html,
    criteria_html,
)
from orthonav.evaluate.contact_sheet import row_text, sheet_picture
from orthonav.evaluate.flights import FlightReport, table_header, table_rows, total
from orthonav.evaluate.metrics import Comparison, Metrics, pool, worst_views
from orthonav.evaluate.track_plots import track_figures
from orthonav.evaluate.track_report import track_rows
from orthonav.report import (
    SAID_STYLE,
    STYLE,
    Figure,
    cards,
    definitions,
    document,
    figure_html,
    file_names,
    html_table,
    measure_text,
    notes,
    percent_text,
    pictures,
    plain_text,
    write_page,
)

_N_WORST = 10
_FILES = (
    '<p class="small">The figures are also files, as SVG and PNG: in the folder “figures”, written '
    "beside this page.</p>"
)


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


@dataclass(frozen=True)
class _Drawn:
    """The figures of one section: in general, of its track, of its worst views."""

    general: tuple[Figure, ...]
    track: tuple[Figure, ...] = ()
    worst: tuple[Figure, ...] = ()


def write_report(
    out_dir: Path,
    flights: Sequence[FlightReport],
    made_from: MadeFrom | None = None,
    title: str = "",
) -> Path:
    """Write `index.html` into `out_dir` and return its path; it needs no other file and no network.

    Its figures are written beside it too, as `orthonav.report.write_page` says. Raises
    `MissingExtraError` without matplotlib, `OutputError` where something cannot be written.
    """
    page, figures = render(flights, made_from or MadeFrom(), title)
    return write_page(out_dir, page, figures)


def render(
    flights: Sequence[FlightReport], made_from: MadeFrom, title: str = ""
) -> tuple[str, list[Figure]]:
    """The whole page as HTML text, and its figures; those of several flights carry their names."""
    whole, several = total(flights), len(flights) > 1
    drawn = [_drawn(flight) for flight in flights]
    if several:
        drawn.append(_Drawn(_figures(pool([flight.comparison for flight in flights]), whole)))
    names = [*(flight.name for flight in flights), "all flights"]
    files = file_names(names) if several else [""]
    drawn = [_named(*each) for each in zip(drawn, names, files, strict=False)]
    parts = [
        _headline(whole),
        notes(_notes(whole)),
        "<h2>Flights</h2>",
        html_table(table_header(flights), table_rows(flights), several, label="flights"),
        _legend(whole.radius_m),
        *(_section(flight, drawn[i], i) for i, flight in enumerate(flights)),
    ]
    if several:
        parts.insert(5, _contents(names))
        parts.append(_all_flights(drawn[-1], whole, len(flights)))
    parts += ["<h2>Made from</h2>", _made_from(made_from), _FILES]
    style = STYLE + SAID_STYLE * any(flight.track is not None for flight in flights)
    said = f"{len(flights)} flights" if several else flights[0].name
    page = document(
        title or f"Evaluation of {said}", "\n".join(parts), style, "Evaluation of flights"
    )
    return page, [figure for each in drawn for figure in _all_of(each)]


def _headline(metrics: Metrics) -> str:
    radius = f"{metrics.radius_m:g} m"
    return cards(
        (
            (percent_text(metrics.accuracy), f"of all views have a fix within {radius}"),
            (percent_text(metrics.accuracy_of_fixes), f"of fixes are within {radius}"),
            (percent_text(metrics.coverage), f"of {metrics.n_views} views have a fix"),
            (measure_text(metrics.error_median_m, " m"), "median error of fixes"),
            (measure_text(metrics.error_p95_m, " m"), "95 % of fixes err less"),
            (measure_text(metrics.latency_median_ms, " ms"), "median time per view"),
        )
    )


def _notes(metrics: Metrics) -> list[str]:
    said = []
    if metrics.n_without_truth:
        said.append(f"{metrics.n_without_truth} results have no true position and are left out.")
    if metrics.n_without_result:
        said.append(f"{metrics.n_without_result} true positions have no result: not counted.")
    if not metrics.n_fixes:
        said.append("No view has a fix, so errors are not defined.")
    return said


def _legend(radius_m: float) -> str:
    radius = f"{radius_m:g} m"
    return (
        f'<p class="small">“acc@{radius}”: share of all views with a fix within {radius}; “of '
        "fixes”: share of fixes within it. Errors are of fixes, latency is the median over all "
        "views.</p>"
    )


def _contents(names: Sequence[str]) -> str:
    """Where the sections of several flights are."""
    links = (f'<a href="#flight-{i}">{escape(name)}</a>' for i, name in enumerate(names))
    return f'<nav class="small" aria-label="flights">Go to: {" · ".join(links)}</nav>'


def _section(flight: FlightReport, drawn: _Drawn, place: int) -> str:
    comparison, metrics = flight.comparison, flight.metrics
    return (
        f'<section id="flight-{place}"><h2>{escape(flight.name)}</h2>'
        f"{_shown(drawn.general, n_broad=2)}{_track(flight, drawn)}{_trust(metrics)}"
        f"<h3>Worst views</h3>{_worst(comparison, metrics)}"
        f"{''.join(map(figure_html, drawn.worst))}"
        f"<h3>Views without a fix</h3>{_reasons(metrics)}</section>"
    )


def _track(flight: FlightReport, drawn: _Drawn) -> str:
    """Figures of the track in words and drawn; nothing where there is none."""
    if flight.track is None:
        return ""
    said = definitions(dict(track_rows(flight.track)), sentences=True)
    return f"<h3>Track</h3>{said}{_shown(drawn.track, n_broad=2)}"


def _all_flights(drawn: _Drawn, whole: Metrics, place: int) -> str:
    return (
        f'<section id="flight-{place}"><h2>All flights</h2>{_shown(drawn.general)}'
        f"{_trust(whole)}</section>"
    )


def _shown(figures: Iterable[Figure], n_broad: int = 0) -> str:
    return pictures(figure_html(figure, i < n_broad) for i, figure in enumerate(figures))


def _drawn(flight: FlightReport) -> _Drawn:
    comparison, metrics, track = flight.comparison, flight.metrics, flight.track
    radius_m, background = metrics.radius_m, flight.background
    general = (
        Figure(
            "map",
            f"Map of {metrics.n_views} true positions and {metrics.n_fixes} fixes",
            "From above, north up: each fix is joined to where the view was really taken.",
            plots.map_picture(comparison, radius_m, background),
        ),
        Figure(
            "error-over-time",
            f"Error of each view over time; {percent_text(metrics.coverage)} have a fix",
            "Error over time; shaded where there is no fix.",
            plots.over_time_picture(comparison, radius_m),
        ),
        *_figures(comparison, metrics),
    )
    of_track = track_figures(comparison, track, radius_m, background) if track else ()
    return _Drawn(general, tuple(of_track), _contact_sheet(flight))


def _contact_sheet(flight: FlightReport) -> tuple[Figure, ...]:
    """The worst views as pictures; nothing where these were not asked for."""
    if not flight.worst:
        return ()
    said = (
        "The worst fixes, those of state tracking first: the view by the heading and height of its "
        "fix, north up, and the map at the same scale; + where it was put, ○ where it was taken."
    )
    alt = "The worst views. " + "; ".join(map(row_text, flight.worst))
    return (Figure("worst-views", alt, said, sheet_picture(flight.worst)),)


def _figures(comparison: Comparison, metrics: Metrics) -> tuple[Figure, ...]:
    """The figures that need no place, so that they can be drawn of several flights too."""
    return (
        Figure(
            "error-curve",
            f"Error curve: {percent_text(metrics.accuracy)} of all views within "
            f"{metrics.radius_m:g} m",
            "Share of all views with a fix within an error.",
            plots.error_curve_picture(comparison, metrics),
        ),
        Figure(
            "kept-against-accuracy",
            "Share of views kept against accuracy among them, per confidence criterion",
            "What a stricter criterion keeps and how much of it is right, with thresholds; "
            "the ring is a confidence of 0.9.",
            plots.criteria_picture(metrics),
        ),
        *calibration_figures(metrics),
    )


def _named(drawn: _Drawn, name: str, file_name: str) -> _Drawn:
    """The same with the flight in texts, and in names of files where there is one to go there.

    Two dashes set it off: neither `file_names` nor the names of figures have any.
    """
    start = f"{file_name}--" if file_name else ""

    def named(figures: Iterable[Figure]) -> tuple[Figure, ...]:
        return tuple(
            replace(each, name=f"{start}{each.name}", alt=f"{name}: {each.alt}") for each in figures
        )

    return _Drawn(named(drawn.general), named(drawn.track), named(drawn.worst))


def _all_of(drawn: _Drawn) -> tuple[Figure, ...]:
    return (*drawn.general, *drawn.track, *drawn.worst)


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
                measure_text(comparison.errors_m[i]) + ("" if right else " ✗"),
                f"{east_m:+.1f}",
                f"{north_m:+.1f}",
                plain_text(comparison.criteria["confidence"][i]),
                plain_text(comparison.criteria["peak_ratio"][i]),
            )
        )
    said = f"The fixes with the largest errors; ✗ marks those beyond {metrics.radius_m:g} m."
    return f'<p class="small">{said}</p>' + html_table(header, rows, label="worst views")


def _reasons(metrics: Metrics) -> str:
    if not metrics.reasons:
        return "<p>Every view has a fix.</p>"
    rows = [(reason, str(count)) for reason, count in metrics.reasons.items()]
    return html_table(("reason", "views"), rows, label="views without a fix")


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
