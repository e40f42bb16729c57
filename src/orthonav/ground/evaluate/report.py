"""The evaluation of flights as one self-contained page, and its figures as files.

Colour shows confidence and the mark shows the error; false fixes stand out by both. States of a
track differ in colour and in mark.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.ground.evaluate.metrics import FAR_M, Comparison, Metrics, worst_views
from orthonav.ground.evaluate.statistics import (
    BoolArray,
    ConfidenceCalibration,
    FloatArray,
    runs,
    seconds_since_first,
)
from orthonav.ground.evaluate.tables import (
    FlightReport,
    confidence_text,
    consistency_text,
    criteria_table,
    integrity_rows,
    runs_table,
    standard_table,
    track_rows,
    verdict,
    wrong_bound_text,
)
from orthonav.ground.evaluate.track import GnssMetrics, TrackMetrics
from orthonav.ground.report import measure_text, percent_text, plain_text
from orthonav.ground.report.drawing import (
    BACKING,
    GREY,
    LEGEND_ABOVE,
    LOW_CONFIDENCE,
    OFFSET,
    RIGHT,
    SOFT,
    TRUTH,
    WRONG,
    Background,
    Drawing,
    draw_axes,
    draw_figure,
    draw_map,
    map_size_in,
)
from orthonav.ground.report.page import Figure, file_names, render, write_page

if TYPE_CHECKING:
    from matplotlib import figure as mpl
    from matplotlib.axes import Axes

STATE_STYLES = {
    "searching": (LOW_CONFIDENCE, "^"),
    "tracking": (RIGHT, "o"),
    "coasting": ("#56B4E9", "s"),
    "lost": ("#B8558F", "X"),
}


def write_report(
    out_dir: Path, flights: Sequence[FlightReport], made_from: Mapping[str, str] | None = None
) -> Path:
    """Write `index.html` into `out_dir` and return its path; it needs no other file and no network.

    Figures are also written beside it. `made_from`: names and values for the end of the page.
    Raises `OutputError`.
    """
    first = flights[0].metrics
    several = len(flights) > 1
    prefixes = [""]
    if several:  # two dashes, which neither `file_names` nor the names of figures contain
        prefixes = [f"{name}--" for name in file_names([flight.name for flight in flights])]
    sections = [_section(*each) for each in zip(flights, prefixes, strict=True)]
    subject = f"{len(flights)} runs" if several else flights[0].name
    values: dict[str, Any] = {
        "title": f"Evaluation of {subject}",
        "kind": "Evaluation of flights",
        "radius": f"{first.radius_m:g} m",
        "wrong_above": f"{first.wrong_above_m:g} m",
        "runs": runs_table(flights),
        "sections": sections,
        "made_from": (made_from or {}).items(),
    }
    page = render("orthonav.ground.evaluate", "report.html", values)
    return write_page(out_dir, page, [each for section in sections for each in section["figures"]])


def _cards(metrics: Metrics) -> tuple[tuple[str, ...], ...]:
    of_confident, of_all = metrics.of_confident, metrics.standard
    low, high = (100 * each for each in metrics.availability_95)
    views = f"{metrics.n_confident} of {metrics.n_views} views have a confident fix"
    bound = f" ({wrong_bound_text(metrics)})" * (metrics.n_confident > 0)
    wrong = f"{metrics.n_confident_wrong} of {metrics.n_confident}"
    kind = "bad" * (metrics.n_confident_wrong > 0)

    def cep(name: str, mine_m: float, all_m: float) -> tuple[str, str]:
        said = f"{name} of confident fixes; {measure_text(all_m, ' m')} of all fixes"
        return measure_text(mine_m, " m"), said

    nees = "NEES, mean of correct fixes: 2 expected, more where covariances are too small"
    gap = f"longest gap without a confident fix, {measure_text(metrics.gap.path_m, ' m')}"
    return (
        (percent_text(metrics.availability), f"{views} (95 % interval {low:.0f} to {high:.0f} %)"),
        (wrong, f"false fixes among confident fixes{bound}", kind),
        cep("CEP50", of_confident.cep50_m, of_all.cep50_m),
        cep("CEP95", of_confident.cep95_m, of_all.cep95_m),
        (plain_text(metrics.consistency.nees_mean), nees),
        (measure_text(metrics.gap.seconds_s, " s"), gap),
    )


def _section(flight: FlightReport, prefix: str) -> dict[str, Any]:
    metrics = flight.metrics
    return {
        "name": flight.name,
        "metrics": metrics,
        "verdict": verdict(metrics),
        "verdict_kind": "bad" if metrics.n_confident_wrong else "good" * (metrics.n_confident > 0),
        "cards": _cards(metrics),
        "view_command": flight.view_command,
        "figures": [
            Figure(f"{prefix}{name}", f"{flight.name}: {alt}", caption, drawing)
            for name, alt, caption, drawing in _figures(flight)
        ],
        "track": track_rows(flight),
        "worst": list(_worst(flight.comparison, metrics)),
        "standard": standard_table(metrics),
        "criteria": criteria_table(metrics),
        "confidence": confidence_text(metrics),
        "covariance": consistency_text(metrics.consistency, "correct fixes"),
        "integrity": integrity_rows(metrics),
    }


def _worst(comparison: Comparison, metrics: Metrics) -> Iterator[tuple[str, ...]]:
    wrong = comparison.confident_wrong(metrics.wrong_above_m)
    for i in worst_views(comparison, 10, metrics.wrong_above_m):
        east_m, north_m = comparison.fix_en_m[i] - comparison.truth_en_m[i]
        confidence = plain_text(comparison.criteria["confidence"][i])
        yield (
            comparison.frames[i],
            f"{comparison.time_ns[i] / 1e9:.2f}",
            measure_text(comparison.errors_m[i]) + (" ✗" if wrong[i] else ""),
            f"{east_m:+.1f}",
            f"{north_m:+.1f}",
            confidence + ("" if comparison.confident[i] else ", low confidence"),
        )


def _figures(flight: FlightReport) -> list[tuple[str, str, str, Drawing]]:
    """Name, description, caption and drawing of each figure."""
    comparison, metrics, track = flight.comparison, flight.metrics, flight.track
    over_time = "Error over time; shaded where there is no fix."
    if track is not None:
        over_time += " Shaded below: 1 sigma and the 95 % bound that the covariance states."
    placed = "Map, north up: each fix is joined to its true position."
    reliability = (
        "Fraction of correct fixes over their confidence, with 95 % intervals (Wilson); dashed: "
        "ideal; orange: the difference. Below: fixes per bin."
    )
    diagram = f"reliability diagram of confidence, ECE {plain_text(metrics.calibration.ece)}"
    track_map = map_picture(comparison, metrics.radius_m, track, flight.background)
    errors = over_time_picture(comparison, metrics.radius_m, track)
    figures = [
        ("map", "map of the fixes", placed, track_map),
        ("error-over-time", "error of each view over time", over_time, errors),
        ("reliability", diagram, reliability, reliability_picture(metrics.calibration)),
    ]
    if metrics.integrity is not None:
        limit_m = metrics.integrity.alert_limit_m
        stanford = (
            f"Stanford diagram: error and protection level of {metrics.integrity.n_levels} of "
            f"{metrics.n_fixes} fixes at a risk of {metrics.integrity.risk:g}; the level of the "
            "others is infinite. Below the diagonal the error is beyond the level"
            + "; dotted: the alert limit"
            * math.isfinite(limit_m)
        )
        picture = stanford_picture(comparison, limit_m)
        figures.append(("stanford", "Stanford diagram", f"{stanford}.", picture))
    if flight.gnss:
        gnss = (
            "Errors of GNSS and of the map, and the distance between them; shaded while the GNSS "
            "monitor reports a fault."
        )
        figures.append(("gnss", "errors of GNSS and of the map", gnss, gnss_picture(flight.gnss)))
    return figures


def fix_classes(
    comparison: Comparison, radius_m: float, track: TrackMetrics | None
) -> list[tuple[str, BoolArray, str, str, float]]:
    """Label, mask (N,), colour, mark and size of each kind of fix, the worst last."""
    errors_m, confident = comparison.errors_m, comparison.confident
    if track is not None:
        wrong, states = track.series.wrong, np.array(track.series.states)
        kinds: list[tuple[str, BoolArray, str, str, float]] = [
            (state, (states == state) & np.isfinite(errors_m) & ~wrong, colour, mark, 4.5)
            for state, (colour, mark) in STATE_STYLES.items()
        ]
    else:
        wrong = comparison.confident_wrong(max(FAR_M, radius_m))
        near, off = errors_m <= radius_m, errors_m > radius_m
        beyond = f"off by more than {radius_m:g} m"
        kinds = [
            ("low confidence", near & ~confident, LOW_CONFIDENCE, "o", 4.5),
            (f"low confidence, {beyond}", off & ~confident, LOW_CONFIDENCE, "x", 5.5),
            ("confident", near & confident, RIGHT, "o", 5.0),
            (f"confident, {beyond}", off & confident & ~wrong, RIGHT, "x", 5.5),
        ]
    kinds.append(("false fix", wrong, WRONG, "X", 7.5))
    return [kind for kind in kinds if kind[1].any()]


def map_picture(
    comparison: Comparison,
    radius_m: float,
    track: TrackMetrics | None = None,
    background: Background | None = None,
) -> Drawing:
    box = view_box(comparison, radius_m)
    truth, fixes = comparison.truth_en_m, comparison.fix_en_m
    none = np.isnan(comparison.errors_m)

    def draw(axes: "Axes") -> None:
        draw_map(axes, box, background)
        if not none.all():
            dots: dict[str, Any] = {"color": TRUTH, "markersize": 3, "label": "ground truth"}
            axes.plot(*truth[~none].T, "." if track is None else ".-", **dots, zorder=7)
        kinds = fix_classes(comparison, radius_m, track)
        for order, (label, chosen, colour, mark, size) in enumerate(kinds):
            lines = np.full((3 * int(chosen.sum()), 2), np.nan)  # as one, with gaps
            lines[0::3], lines[1::3] = truth[chosen], fixes[chosen]
            axes.plot(*lines.T, color=colour, linewidth=0.9, alpha=0.7, zorder=3)
            outside = int((chosen & ~inside_box(fixes, box)).sum())
            style: dict[str, Any] = {"color": colour, "markersize": size, "zorder": 5 + order / 10}
            label += f" ({outside} outside)" if outside else ""
            axes.plot(*fixes[chosen].T, mark, **style, label=label)
        if none.any():
            ring: dict[str, Any] = {"color": TRUTH, "markersize": 4.5, "markerfacecolor": "white"}
            axes.plot(*truth[none].T, "o", **ring, zorder=4, label="ground truth, no fix")
        axes.legend(ncols=3, **LEGEND_ABOVE)

    return draw_axes(map_size_in(box, 7.5), draw)


def view_box(comparison: Comparison, radius_m: float) -> tuple[float, float, float, float]:
    truth, fixes = comparison.truth_en_m, comparison.fix_en_m
    low, high = truth.min(axis=0), truth.max(axis=0)
    reach = max(float((high - low).max()) * 0.35, 5 * radius_m)
    near = inside_box(fixes, (low[0] - reach, high[0] + reach, low[1] - reach, high[1] + reach))
    seen = np.concatenate([truth, fixes[near]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    side = max(float((high - low).max()), 4 * radius_m)
    middle = (low + high) / 2
    half = np.maximum((high - low) / 2 + 0.06 * side, 0.3 * side)
    west, south = (float(value) for value in middle - half)
    east, north = (float(value) for value in middle + half)
    return west, east, south, north


def inside_box(positions_en_m: FloatArray, box: tuple[float, ...]) -> BoolArray:
    east, north = positions_en_m.T
    inside: BoolArray = (box[0] <= east) & (east <= box[1]) & (box[2] <= north) & (north <= box[3])
    return inside


def over_time_picture(
    comparison: Comparison, radius_m: float, track: TrackMetrics | None = None
) -> Drawing:
    def draw(axes: "Axes") -> None:
        errors_m = comparison.errors_m
        x, name = _time_axis(seconds_since_first(comparison.time_ns))
        half = max(float(np.median(np.diff(x))) / 2 if x.size > 1 else 0.5, 1e-3)
        edges = np.concatenate([[x[0] - half], (x[1:] + x[:-1]) / 2, [x[-1] + half]])
        shown_m = np.maximum(errors_m, 0.01)  # a log axis has no zero; NaN stays NaN
        finite = shown_m[np.isfinite(shown_m)]
        low = min([radius_m / 10, *finite]) / 1.5
        high = max([radius_m * 10, *finite]) * 1.5
        for i, (start, stop) in enumerate(runs(np.isnan(errors_m))):
            label = "no fix" if i == 0 else "_nolegend_"
            axes.axvspan(edges[start], edges[stop], color="#EFE6C8", linewidth=0, label=label)
        if track is not None:
            for label, bound_m in (
                ("95 % bound", track.series.bound_95_m),
                ("1 sigma", track.series.sigma_m),
            ):
                axes.fill_between(x, low, bound_m, color=RIGHT, alpha=0.15, lw=0, label=label)
        axes.plot(x, shown_m, color="#BBBBBB", linewidth=0.9, zorder=2)
        for label, chosen, colour, mark, size in fix_classes(comparison, radius_m, track):
            style: dict[str, Any] = {"color": colour, "markersize": size, "label": label}
            axes.plot(x[chosen], shown_m[chosen], mark, **style, zorder=3)
        axes.axhline(radius_m, color=SOFT, linewidth=1.2, label=f"{radius_m:g} m")
        axes.set(yscale="log", ylim=(low, high), xlim=(edges[0], edges[-1]))
        axes.set(xlabel=name, ylabel="error (m)")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
        axes.legend(ncols=4, **LEGEND_ABOVE)

    return draw_axes((10.5, 3.4), draw)


def _time_axis(seconds_s: FloatArray) -> tuple[FloatArray, str]:
    if np.isfinite(seconds_s).all():
        return seconds_s, "time since the first view (s)"
    return np.arange(1.0, seconds_s.size + 1), "view, in order of the flight"


def reliability_picture(calibration: ConfidenceCalibration) -> Drawing:
    def draw(figure: "mpl.Figure") -> None:
        from matplotlib.ticker import MaxNLocator

        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
        above.plot([0, 1], [0, 1], linewidth=1.2, color=GREY, linestyle=(0, (4, 3)))
        side: dict[str, Any] = {"fontsize": 9, "color": "#777777", "style": "italic"}
        above.text(0.03, 0.96, "under-confident", va="top", **side)
        above.text(0.97, 0.04, "over-confident", ha="right", **side)
        if calibration.n_fixes:
            _draw_bins(above, calibration)
        else:
            above.text(0.5, 0.5, "no fix states a confidence", ha="center", bbox=BACKING)
        above.set(xlim=(-0.015, 1.015), ylim=(-0.02, 1.04))
        above.set(ylabel="fraction off by less\nthan the radius")
        counts = [b.n_fixes for b in calibration.bins]
        middles = [(b.lower + b.upper) / 2 for b in calibration.bins]
        below.bar(middles, counts, width=0.094, color="#9DB9CC")
        for x, count in zip(middles, counts, strict=True):
            below.annotate(f"{count}", (x, count), (0, 2), **OFFSET, ha="center", color=SOFT)
        below.set(ylim=(0, 1.45 * max([1, *counts])), ylabel="fixes", xlabel="stated confidence")
        below.set_xticks(np.arange(11) / 10)
        below.yaxis.set_major_locator(MaxNLocator(nbins=2, integer=True))
        figure.align_ylabels()

    return draw_figure((6.2, 5.0), draw)


def _draw_bins(axes: "Axes", calibration: ConfidenceCalibration) -> None:
    filled = [b for b in calibration.bins if b.n_fixes]
    x = [b.mean_confidence for b in filled]
    y = np.array([b.share_right for b in filled])
    low = y - [b.right_low for b in filled]
    high = [b.right_high for b in filled] - y
    for b in filled:  # the gap that counts in the ECE
        ends = [b.mean_confidence, b.share_right]
        axes.plot([b.mean_confidence] * 2, ends, color=WRONG, linewidth=5, alpha=0.3, zorder=2)
    yerr = np.maximum([low, high], 0.0)  # rounding may leave -1e-17
    axes.errorbar(x, y, yerr, fmt="none", ecolor=RIGHT, elinewidth=1.3, capsize=3, zorder=3)
    axes.plot(x, y, "-", color=RIGHT, linewidth=1.2, alpha=0.8, zorder=3)
    axes.plot(x, y, "o", color=RIGHT, markersize=7, markeredgecolor="white", zorder=4)
    title = (
        f"ECE {calibration.ece:.3f} · Brier {calibration.brier:.3f}\n"
        f"mean confidence {calibration.mean_confidence:.2f}, "
        f"fraction correct {calibration.share_right:.2f}"
    )
    axes.set_title(title, fontsize=9, color=SOFT, linespacing=1.4)


def stanford_picture(comparison: Comparison, alert_limit_m: float) -> Drawing:
    levels_m, errors_m = comparison.protection_levels_m, comparison.errors_m
    shown = np.isfinite(levels_m + errors_m)
    levels_m, errors_m = levels_m[shown], np.maximum(errors_m[shown], 0.01)
    beyond = errors_m > levels_m

    def draw(axes: "Axes") -> None:
        seen = [*levels_m, *errors_m, 1.0, 10.0, np.nan_to_num(alert_limit_m, nan=1.0)]
        low, high = min(seen) / 1.5, max(seen) * 1.5
        axes.plot([low, high], [low, high], color=GREY, linewidth=1.2)
        for chosen, colour, mark in ((~beyond, RIGHT, "."), (beyond, WRONG, "X")):
            dots: dict[str, Any] = {"color": colour, "markersize": 5, "alpha": 0.6}
            axes.plot(errors_m[chosen], levels_m[chosen], mark, **dots)
        if math.isfinite(alert_limit_m):
            for line in (axes.axhline, axes.axvline):
                line(alert_limit_m, color=SOFT, linewidth=1.2, linestyle=":")
        axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
        axes.set(xlabel="error (m)", ylabel="protection level (m)")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")

    return draw_axes((6.2, 5.0), draw)


def gnss_picture(found: GnssMetrics) -> Drawing:
    def draw(figure: "mpl.Figure") -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        x, name = _time_axis(found.seconds_s)
        thin: dict[str, Any] = {"linewidth": 1.0, "markersize": 3}
        above.plot(x, found.errors_m, ".-", color=WRONG, label="GNSS", **thin)
        above.plot(x, found.map_errors_m, ".-", color=RIGHT, label="map", **thin)
        below.plot(x, found.differences_m, ".-", color=TRUTH, **thin)
        for axes in (above, below):
            for first, end in found.alarms:
                axes.axvspan(x[first], x[min(end, len(x) - 1)], color=GREY, alpha=0.25, linewidth=0)
            axes.set_ylim(bottom=0)
        above.legend(ncols=2, loc="upper left", frameon=False)
        above.set(ylabel="error (m)")
        below.set(ylabel="difference (m)", xlabel=name)
        figure.align_ylabels()

    return draw_figure((6.2, 4.0), draw)
