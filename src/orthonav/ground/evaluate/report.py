"""The evaluation of flights as one self-contained page, and its figures as files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from orthonav.ground.evaluate import plots
from orthonav.ground.evaluate.contact_sheet import row_text, sheet_picture
from orthonav.ground.evaluate.figures import share
from orthonav.ground.evaluate.metrics import Comparison, Metrics, pool, worst_views
from orthonav.ground.evaluate.tables import (
    STANDARD_HEADER,
    FlightReport,
    bins_rows,
    confidence_text,
    covariance_card,
    covariance_text,
    criteria_header,
    criteria_rows,
    gnss_rows,
    levels_rows,
    standard_rows,
    table_header,
    table_rows,
    total,
    track_rows,
    verdict,
    wrong_bound_text,
)
from orthonav.ground.report import measure_text, percent_text, plain_text
from orthonav.ground.report.page import Figure, file_names, render, write_page

_N_WORST = 10


@dataclass(frozen=True)
class MadeFrom:
    map_name: str = ""
    recipe: str = ""
    imagery: str = ""
    flight: str = ""
    command: str = ""
    version: str = ""


class _Drawn(NamedTuple):
    general: tuple[Figure, ...]
    track: tuple[Figure, ...] = ()
    worst: tuple[Figure, ...] = ()

    def named(self, name: str, file_name: str) -> "_Drawn":
        """With the flight's name in texts and, if given, in file names, set off by two dashes,
        which neither `file_names` nor the names of figures contain."""
        start = f"{file_name}--" if file_name else ""
        return _Drawn(
            *(
                tuple(replace(f, name=f"{start}{f.name}", alt=f"{name}: {f.alt}") for f in figures)
                for figures in self
            )
        )


def write_report(
    out_dir: Path,
    flights: Sequence[FlightReport],
    made_from: MadeFrom | None = None,
    whole: Metrics | None = None,
) -> Path:
    """Write `index.html` into `out_dir` and return its path; it needs no other file and no network.

    `whole`: what `total` gives, computed where it is None. Figures are also written beside it.
    Raises `ValueError` as `total` and `OutputError` as `write_figures`.
    """
    whole = whole or total(flights)
    several = len(flights) > 1
    drawn = [_drawn(flight) for flight in flights]
    if several:
        drawn.append(_Drawn(_figures(pool([flight.comparison for flight in flights]), whole)))
    names = [*(flight.name for flight in flights), "all flights"]
    files = file_names(names) if several else [""]
    drawn = [each.named(*named) for each, *named in zip(drawn, names, files, strict=False)]
    subject = f"{len(flights)} flights" if several else flights[0].name
    values: dict[str, Any] = {
        "title": f"Evaluation of {subject}",
        "kind": "Evaluation of flights",
        "verdict": verdict(whole),
        "verdict_kind": "bad" if whole.n_confident_wrong else "good" if whole.n_confident else "",
        "cards": _cards(whole),
        "compared": _compared(whole),
        "notes": _notes(whole),
        "radius": f"{whole.radius_m:g} m",
        "wrong_above": f"{whole.wrong_above_m:g} m",
        "table_header": table_header(whole),
        "table_rows": table_rows(flights, whole),
        "sections": [_section(*each) for each in zip(flights, drawn, strict=False)],
        "total_section": None,
        "made_from": [
            ("orthonav" if name == "version" else name.removesuffix("_name"), text)
            for name, text in vars(made_from or MadeFrom()).items()
        ],
    }
    if several:
        figures = {"name": "all flights", "figures": drawn[-1].general}
        values["total_section"] = {**figures, **_trust(whole)}
    page = render("orthonav.ground.evaluate", "report.html", values)
    shown = [figure for each in drawn for figures in each for figure in figures]
    return write_page(out_dir, page, shown)


def _cards(metrics: Metrics) -> tuple[tuple[str, ...], ...]:
    of_confident, of_all = metrics.of_confident, metrics.standard
    low, high = (100 * each for each in metrics.availability_95)
    return (
        (
            percent_text(metrics.availability),
            f"availability: {metrics.n_confident} of {metrics.n_views} views have a confident fix "
            f"(95 % interval {low:.0f} to {high:.0f} %)",
        ),
        (
            f"{metrics.n_confident_wrong} of {metrics.n_confident}",
            "false fixes among confident fixes"
            + f" ({wrong_bound_text(metrics)})" * (metrics.n_confident > 0),
            "bad" if metrics.n_confident_wrong else "",
        ),
        (
            measure_text(of_confident.cep50_m, " m"),
            f"CEP50 of confident fixes; {measure_text(of_all.cep50_m, ' m')} of all fixes",
        ),
        (
            measure_text(of_confident.cep95_m, " m"),
            f"CEP95 of confident fixes; {measure_text(of_all.cep95_m, ' m')} of all fixes",
        ),
        covariance_card(metrics.consistency),
        (
            measure_text(metrics.gap.seconds_s, " s"),
            f"longest gap without a confident fix, {measure_text(metrics.gap.path_m, ' m')}",
        ),
    )


def _compared(metrics: Metrics) -> list[tuple[str, ...]]:
    kinds = (
        ("confident fixes", metrics.accuracy_of_confident, metrics.of_confident),
        ("all fixes", metrics.accuracy_of_fixes, metrics.standard),
    )
    return [
        (
            name,
            str(figures.ape.n),
            percent_text(share(figures.ape.n, metrics.n_views)),
            percent_text(within),
            *map(measure_text, (figures.cep50_m, figures.cep95_m)),
            *map(measure_text, (figures.ape.rmse_m, figures.ape.max_m)),
        )
        for name, within, figures in kinds
    ]


def _notes(metrics: Metrics) -> list[str]:
    notes = []
    if metrics.n_without_truth:
        notes.append(f"{metrics.n_without_truth} results have no true position and are left out.")
    if metrics.n_without_result:
        notes.append(
            f"{metrics.n_without_result} true positions have no result: views without a fix."
        )
    if not metrics.n_fixes:
        notes.append("No view has a fix, so errors are not defined.")
    return notes


def _section(flight: FlightReport, drawn: _Drawn) -> dict[str, Any]:
    return {
        "name": flight.name,
        "view_command": flight.view_command,
        "figures": drawn.general,
        "track": (
            *(track_rows(flight.track) if flight.track else ()),
            *(gnss_rows(flight.gnss) if flight.gnss else ()),
        ),
        "track_figures": drawn.track,
        "worst": _worst(flight.comparison, flight.metrics),
        "worst_figures": drawn.worst,
        "reasons": [(reason, str(count)) for reason, count in flight.metrics.reasons.items()],
        **_trust(flight.metrics),
    }


def _trust(metrics: Metrics) -> dict[str, Any]:
    return {
        "standard_header": STANDARD_HEADER,
        "standard": standard_rows(metrics),
        "standard_more": [
            ("ECE", plain_text(metrics.calibration.ece)),
            ("NEES (mean, 2 expected)", plain_text(metrics.consistency.nees_mean)),
            ("definitions", "APE and RPE as evo defines them: horizontal, not aligned, fixes only"),
        ],
        "criteria_header": criteria_header(metrics),
        "criteria": criteria_rows(metrics),
        "confidence": confidence_text(metrics),
        "bins": bins_rows(metrics),
        "covariance": covariance_text(metrics.consistency),
        "levels": levels_rows(metrics.consistency),
    }


def _worst(comparison: Comparison, metrics: Metrics) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    wrong = comparison.confident_wrong(metrics.wrong_above_m)
    for i in worst_views(comparison, _N_WORST, metrics.wrong_above_m):
        east_m, north_m = comparison.fix_en_m[i] - comparison.truth_en_m[i]
        confidence = plain_text(comparison.criteria["confidence"][i])
        rows.append(
            (
                comparison.frames[i],
                f"{comparison.time_ns[i] / 1e9:.2f}",
                measure_text(comparison.errors_m[i]) + (" ✗" if wrong[i] else ""),
                f"{east_m:+.1f}",
                f"{north_m:+.1f}",
                confidence + ("" if comparison.confident[i] else ", low confidence"),
                plain_text(comparison.criteria["peak_ratio"][i]),
            )
        )
    return rows


def _drawn(flight: FlightReport) -> _Drawn:
    comparison, metrics, track = flight.comparison, flight.metrics, flight.track
    radius_m, background = metrics.radius_m, flight.background
    general = (
        Figure(
            "map",
            f"Map of {metrics.n_views} true positions, {metrics.n_confident} confident fixes and "
            f"{metrics.n_fixes - metrics.n_confident} best guesses",
            "Map, north up: each fix is joined to its true position.",
            plots.map_picture(comparison, radius_m, background),
        ),
        Figure(
            "error-over-time",
            f"Error of each view over time; {percent_text(metrics.coverage)} have a fix",
            "Error over time, confident and of low confidence; shaded where there is no fix.",
            plots.over_time_picture(comparison, radius_m),
        ),
        *_figures(comparison, metrics),
    )
    of_track = plots.track_figures(comparison, track, radius_m, background) if track else []
    of_gnss = [plots.gnss_figure(flight.gnss)] if flight.gnss else []
    if not flight.worst:
        return _Drawn(general, (*of_track, *of_gnss))
    caption = (
        "The worst fixes, those in state tracking first: the view rectified with heading and "
        "height of its fix, north up, beside the map at the same scale; + fix, ○ true position."
    )
    alt = "The worst views. " + "; ".join(map(row_text, flight.worst))
    sheet = Figure("worst-views", alt, caption, sheet_picture(flight.worst))
    return _Drawn(general, (*of_track, *of_gnss), (sheet,))


def _figures(comparison: Comparison, metrics: Metrics) -> tuple[Figure, ...]:
    return (
        Figure(
            "error-curve",
            f"Error curve: {percent_text(metrics.accuracy)} of all views within "
            f"{metrics.radius_m:g} m",
            "Percentage of all views with a fix whose error is at most the value on the axis.",
            plots.error_curve_picture(comparison, metrics),
        ),
        Figure(
            "accepted-against-accuracy",
            "Percentage of views accepted against accuracy among them, per confidence criterion",
            "Percentage of views that a stricter criterion accepts, and percentage of these that "
            "are correct, with thresholds; the ring marks a confidence of 0.9.",
            plots.criteria_picture(metrics),
        ),
        Figure(
            "reliability",
            f"Reliability diagram of confidence: {confidence_text(metrics)}",
            "Fraction of correct fixes over their confidence, with 95 % intervals (Wilson); "
            "dashed: ideal; orange: the difference. Below: fixes per bin.",
            plots.reliability_picture(metrics.calibration),
        ),
        Figure(
            "covariance",
            f"Errors of correct fixes against covariance: {covariance_text(metrics.consistency)}",
            "Errors of correct fixes in units of their covariance C; dashed: ideal; shaded: where "
            "95 % of samples of this size stay.",
            plots.nees_picture(metrics.consistency),
        ),
    )
