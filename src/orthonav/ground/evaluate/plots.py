"""Figures of an evaluation: errors on the map and over time, criteria, calibration, track, GNSS.

Colour shows confidence and the mark shows the error; false fixes stand out by both. States of a
track differ in colour and in mark.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.core.records import CONFIDENT
from orthonav.ground.evaluate.calibration import (
    NEES_LEVELS,
    Bin,
    ConfidenceCalibration,
    CovarianceConsistency,
    is_covariance,
    nees_bound,
)
from orthonav.ground.evaluate.figures import BoolArray, FloatArray, runs, seconds_since_first
from orthonav.ground.evaluate.metrics import FAR_M, Comparison, Metrics
from orthonav.ground.evaluate.tables import (
    LABELS,
    percentiles_text,
    spread_text,
    track_consistency_text,
    within_text,
)
from orthonav.ground.evaluate.track import GnssMetrics, TrackMetrics, TrackSeries
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
from orthonav.ground.report.page import Figure

if TYPE_CHECKING:
    from matplotlib import figure as mpl
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

# colour, line, mark, drawing order
CURVE_STYLES: dict[str, tuple[str, Any, str, float]] = {
    "confidence": ("#0072B2", "-", "o", 2.0),
    "peak_ratio": ("#009E73", (0, (5, 3)), "s", 2.1),
    "lowe_ratio": ("#B8558F", (0, (1.5, 1.5)), "^", 2.2),
}
MAIN = ("confidence", 0.9)
STATE_STYLES = {
    "searching": ("#E69F00", "^"),
    "tracking": (RIGHT, "o"),
    "coasting": ("#56B4E9", "s"),
    "lost": ("#B8558F", "X"),
}
MOST_ELLIPSES = 40
_DASHED: dict[str, Any] = {"color": GREY, "linestyle": (0, (4, 3))}
_SIDE: dict[str, Any] = {"fontsize": 9, "color": "#777777", "style": "italic"}
_NEES_AXIS = (0.01, 1e4)  # its edges at the widest; 1 in 200 of consistent fixes lie below
_NO_FIX_SHADE = "#EFE6C8"


def fix_classes(
    comparison: Comparison, radius_m: float
) -> list[tuple[str, BoolArray, str, str, float]]:
    """Label, mask (N,), colour, mark and size of each kind of fix, the worst last."""
    errors_m, confident = comparison.errors_m, comparison.confident
    wrong = comparison.confident_wrong(max(FAR_M, radius_m))
    near, off = errors_m <= radius_m, errors_m > radius_m
    beyond = f"off by more than {radius_m:g} m"
    return [
        ("low confidence", near & ~confident, LOW_CONFIDENCE, "o", 4.5),
        (f"low confidence, {beyond}", off & ~confident, LOW_CONFIDENCE, "x", 5.5),
        ("confident", near & confident, RIGHT, "o", 5.0),
        (f"confident, {beyond}", off & confident & ~wrong, RIGHT, "x", 5.5),
        ("false fix", wrong, WRONG, "X", 7.5),
    ]


def map_picture(
    comparison: Comparison, radius_m: float, background: Background | None = None
) -> Drawing:
    box = view_box(comparison, radius_m)

    def draw(axes: "Axes") -> None:
        draw_map(axes, box, background)
        _draw_positions(axes, comparison, radius_m, box)
        axes.legend(ncols=3, **LEGEND_ABOVE)

    return draw_axes(map_size_in(box, 7.5), draw)


def error_curve_picture(comparison: Comparison, metrics: Metrics) -> Drawing:
    def draw(axes: "Axes") -> None:
        radius_m = metrics.radius_m
        errors_m = np.sort(comparison.errors_m[np.isfinite(comparison.errors_m)])
        shown_m = np.maximum(errors_m, 0.01)  # a log axis has no zero
        low = min([radius_m / 30, *shown_m[:1]]) * 0.8
        high = max([radius_m * 30, *shown_m[-1:]]) * 1.25
        shares = np.arange(errors_m.size + 1) / metrics.n_views * 100
        x = np.concatenate([[low], shown_m, [high]])
        axes.step(x, [*shares, shares[-1]], where="post", color=RIGHT, linewidth=2)
        axes.axhline(100 * metrics.coverage, linewidth=1, **_DASHED)
        coverage = f"{100 * metrics.coverage:.0f} % have a position, low confidence included"
        axes.annotate(coverage, (low, 100 * metrics.coverage), (6, 4), **OFFSET, color=SOFT)
        axes.axvline(radius_m, color=WRONG, linewidth=1.2)
        axes.plot([radius_m], [100 * metrics.accuracy], "o", color=WRONG, zorder=5)
        lift = -14 if metrics.accuracy > 0.15 else 18  # clear of the axis, and of the other note
        note = f"{100 * metrics.accuracy:.0f} % within {radius_m:g} m"
        axes.annotate(note, (radius_m, 100 * metrics.accuracy), (8, lift), **OFFSET, color=WRONG)
        axes.set(xscale="log", xlim=(low, high), ylim=(0, 107))
        axes.set(xlabel="error (m)", ylabel="percentage of all views")
        _plain_numbers(axes.xaxis)

    return draw_axes((6.2, 4.0), draw)


def criteria_picture(metrics: Metrics) -> Drawing:
    def draw(axes: "Axes") -> None:
        drawn = [curve for curve in metrics.curves if curve.thresholds.size]
        for curve in drawn:
            colour, line, _, order = CURVE_STYLES[curve.name]
            looks: dict[str, Any] = {"color": colour, "linestyle": line, "zorder": order}
            shares = 100 * curve.share_accepted, 100 * curve.accuracy
            axes.plot(*shares, **looks, linewidth=1.8, label=LABELS[curve.name])
        # fractions of the first few views are noisy and do not set the scale
        tails = [curve.accuracy[curve.share_accepted >= 0.05] for curve in drawn]
        lowest = min((float(tail.min()) for tail in tails if tail.size), default=0.0)
        bottom = max(0.0, math.floor(lowest * 10 - 0.5) * 10)
        axes.set(xlim=(0, 102), ylim=(min(bottom, 85.0), 101.5))
        axes.set(xlabel="percentage of all views accepted")
        axes.set(ylabel=f"percentage of these within {metrics.radius_m:g} m")
        if drawn:
            _draw_thresholds(axes, metrics)
            axes.legend(ncols=3, **LEGEND_ABOVE)
        else:
            axes.text(51, 50 + min(bottom, 85.0) / 2, "no fix states a criterion", ha="center")

    return draw_axes((6.2, 4.0), draw)


def over_time_picture(comparison: Comparison, radius_m: float) -> Drawing:
    def draw(axes: "Axes") -> None:
        errors_m = comparison.errors_m
        x, name = _time_axis(seconds_since_first(comparison.time_ns))
        half = max(float(np.median(np.diff(x))) / 2 if x.size > 1 else 0.5, 1e-3)
        edges = np.concatenate([[x[0] - half], (x[1:] + x[:-1]) / 2, [x[-1] + half]])
        shown_m = np.maximum(errors_m, 0.01)  # a log axis has no zero; NaN stays NaN
        for i, (start, stop) in enumerate(runs(np.isnan(errors_m))):
            label = "no fix" if i == 0 else "_nolegend_"
            axes.axvspan(edges[start], edges[stop], color=_NO_FIX_SHADE, linewidth=0, label=label)
        axes.plot(x, shown_m, color="#BBBBBB", linewidth=0.9, zorder=2)
        for label, chosen, colour, mark, size in fix_classes(comparison, radius_m):
            if chosen.any():
                style: dict[str, Any] = {"color": colour, "markersize": size, "label": label}
                axes.plot(x[chosen], shown_m[chosen], mark, **style, zorder=3)
        axes.axhline(radius_m, color=SOFT, linewidth=1.2, label=f"{radius_m:g} m")
        finite = shown_m[np.isfinite(shown_m)]
        low = min([radius_m / 10, *finite]) / 1.5
        high = max([radius_m * 10, *finite]) * 1.5
        axes.set(yscale="log", ylim=(low, high), xlim=(edges[0], edges[-1]))
        axes.set(xlabel=name, ylabel="error (m)")
        _plain_numbers(axes.yaxis)
        axes.legend(ncols=4, **LEGEND_ABOVE)

    return draw_axes((10.5, 3.4), draw)


def view_box(comparison: Comparison, radius_m: float) -> tuple[float, float, float, float]:
    """West, east, south, north of the flight and of the fixes near it."""
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


def _time_axis(seconds_s: FloatArray) -> tuple[FloatArray, str]:
    if np.isfinite(seconds_s).all():
        return seconds_s, "time since the first view (s)"
    return np.arange(1.0, seconds_s.size + 1), "view, in order of the flight"


def _plain_numbers(axis: "Axis") -> None:
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


def _to_truth(comparison: Comparison, chosen: BoolArray) -> FloatArray:
    """Lines (2, 3 K) from the true positions to the fixes of `chosen`, as one with gaps."""
    lines = np.full((3 * int(chosen.sum()), 2), np.nan)
    lines[0::3], lines[1::3] = comparison.truth_en_m[chosen], comparison.fix_en_m[chosen]
    return lines.T


def _draw_positions(
    axes: "Axes", comparison: Comparison, radius_m: float, box: tuple[float, ...]
) -> None:
    truth, fixes = comparison.truth_en_m, comparison.fix_en_m
    none = np.isnan(comparison.errors_m)
    if not none.all():
        axes.plot(*truth[~none].T, ".", color=TRUTH, markersize=3, zorder=7, label="ground truth")
    for order, (label, chosen, colour, mark, size) in enumerate(fix_classes(comparison, radius_m)):
        if not chosen.any():
            continue
        lines = _to_truth(comparison, chosen)
        axes.plot(*lines, color=colour, linewidth=0.9, alpha=0.7, zorder=3)
        outside = int((chosen & ~inside_box(fixes, box)).sum())
        style: dict[str, Any] = {"color": colour, "markersize": size, "zorder": 5 + order / 10}
        label += f" ({outside} outside)" if outside else ""
        axes.plot(*fixes[chosen].T, mark, **style, label=label)
    if none.any():
        ring: dict[str, Any] = {"color": TRUTH, "markersize": 4.5, "markerfacecolor": "white"}
        axes.plot(*truth[none].T, "o", **ring, zorder=4, label="ground truth, no fix")


def _draw_thresholds(axes: "Axes", metrics: Metrics) -> None:
    rows = [row for row in metrics.criteria if math.isfinite(row.accuracy)]
    rows.sort(key=lambda row: list(CURVE_STYLES).index(row.name))
    spots = [(100 * row.share_accepted, 100 * row.accuracy) for row in rows]
    at_pt = axes.transData.transform(np.reshape(spots, (-1, 2))) * 72 / axes.figure.dpi
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in at_pt]
    for row, spot, (x, y) in zip(rows, spots, at_pt, strict=True):
        colour, _, mark, _ = CURVE_STYLES[row.name]
        main = (row.name, row.threshold) == MAIN
        if main:
            _draw_main(axes, spot, colour)
        axes.plot(*spot, mark, color=colour, markersize=6, markeredgecolor="white", zorder=4)
        text = f"{row.threshold:g}"
        width = 6.5 * len(text)
        places = ((-8, 8), (7, -14), (-width - 5, -14), (8, 3), (-width - 8, 3), (-8, -26))
        boxes = {p: (x + p[0], y + p[1], x + p[0] + width, y + p[1] + 10) for p in places}
        free = [p for p, box in boxes.items() if not any(_overlap(box, other) for other in taken)]
        place = (free or places)[0]
        taken.append(boxes[place])
        weight = "bold" if main else "normal"
        looks: dict[str, Any] = {"color": colour, "weight": weight, "zorder": 3, "bbox": BACKING}
        axes.annotate(text, spot, place, **OFFSET, **looks)


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    across = min(one[2], other[2]) > max(one[0], other[0])
    return across and min(one[3], other[3]) > max(one[1], other[1])


def _draw_main(axes: "Axes", at: tuple[float, float], colour: str) -> None:
    lead: dict[str, Any] = {"color": colour, "linewidth": 1.0, "alpha": 0.55, "zorder": 1.5}
    axes.plot([at[0], at[0], 0], [0, at[1], at[1]], linestyle=(0, (1, 2)), **lead)
    ring: dict[str, Any] = {"markerfacecolor": "none", "markeredgewidth": 1.5, "zorder": 4}
    axes.plot(*at, "o", markersize=12, markeredgecolor=colour, **ring)


# Calibration.


def reliability_picture(calibration: ConfidenceCalibration) -> Drawing:
    def draw(figure: "mpl.Figure") -> None:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
        above.plot([0, 1], [0, 1], linewidth=1.2, **_DASHED)
        above.text(0.03, 0.96, "under-confident", va="top", **_SIDE)
        above.text(0.97, 0.04, "over-confident", ha="right", **_SIDE)
        filled = [b for b in calibration.bins if b.n_fixes]
        if filled:
            _draw_bins(above, filled)
            title = (
                f"ECE {calibration.ece:.3f} · Brier {calibration.brier:.3f}\n"
                f"mean confidence {calibration.mean_confidence:.2f}, "
                f"fraction correct {calibration.share_right:.2f}"
            )
            above.set_title(title, fontsize=9, color=SOFT, linespacing=1.4)
        else:
            above.text(0.5, 0.5, "no fix states a confidence", ha="center", bbox=BACKING)
        above.set(xlim=(-0.015, 1.015), ylim=(-0.02, 1.04))
        above.set(ylabel="fraction with an error\nwithin the stated radius")
        _draw_counts(below, calibration)
        below.set(xlabel="stated confidence")
        figure.align_ylabels()

    return draw_figure((6.2, 5.0), draw)


def _draw_bins(axes: "Axes", filled: list[Bin]) -> None:
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


def _draw_counts(axes: "Axes", calibration: ConfidenceCalibration) -> None:
    from matplotlib.ticker import MaxNLocator

    counts = [b.n_fixes for b in calibration.bins]
    middles = [(b.lower + b.upper) / 2 for b in calibration.bins]
    axes.bar(middles, counts, width=0.094, color="#9DB9CC")
    for x, count in zip(middles, counts, strict=True):
        axes.annotate(f"{count}", (x, count), (0, 2), **OFFSET, ha="center", color=SOFT)
    axes.set(ylim=(0, 1.45 * max([1, *counts])), ylabel="fixes")
    axes.set_xticks(np.arange(11) / 10)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=2, integer=True))


def nees_picture(consistency: CovarianceConsistency) -> Drawing:
    def draw(axes: "Axes") -> None:
        nees = np.clip(consistency.nees, _NEES_AXIS[0], None)  # a log axis has no zero
        high = float(min(max([50.0, *(1.3 * nees[-1:])]), _NEES_AXIS[1]))
        x = np.geomspace(_NEES_AXIS[0], high, 300)
        expected = 100 * -np.expm1(-x / 2)
        label = "chi-square, 2 degrees of freedom"
        axes.plot(x, expected, linewidth=1.6, label=label, **_DASHED)
        if nees.size:
            # the 95 % band of samples of this size (Dvoretzky, Kiefer, Wolfowitz; Massart 1990)
            reach = 100 * math.sqrt(math.log(2 / 0.05) / (2 * nees.size))
            band = np.clip([expected - reach, expected + reach], 0, 100)
            axes.fill_between(x, *band, color=GREY, alpha=0.18, linewidth=0)
            shares = 100 * np.arange(nees.size + 1) / nees.size
            steps = (np.append(_NEES_AXIS[0], nees), shares)
            label = f"correct fixes ({nees.size})"
            axes.step(*steps, where="post", color=RIGHT, linewidth=2, label=label)
            axes.plot([nees[-1], _NEES_AXIS[1]], [100, 100], color=RIGHT, linewidth=2)
            _draw_levels(axes, consistency)
        else:
            said = "no correct fix has a usable covariance"
            axes.text(0.5, 0.5, said, ha="center", transform=axes.transAxes, bbox=BACKING)
        axes.text(0.02, 0.955, "under-confident", va="top", transform=axes.transAxes, **_SIDE)
        axes.text(0.98, 0.04, "over-confident", ha="right", transform=axes.transAxes, **_SIDE)
        axes.set(xscale="log", xlim=(_NEES_AXIS[0], high), ylim=(0, 104))
        axes.set(xlabel="normalized error squared, eᵀC⁻¹e (no unit)")
        axes.set(ylabel="percentage of correct fixes below it")
        _plain_numbers(axes.xaxis)
        axes.legend(ncols=2, **LEGEND_ABOVE)

    return draw_axes((6.2, 5.0), draw)


def _draw_levels(axes: "Axes", consistency: CovarianceConsistency) -> None:
    for level in NEES_LEVELS:
        bound, found = nees_bound(level), 100 * consistency.within[level]
        axes.plot([bound] * 2, [0, 104], color=GREY, linewidth=0.9, zorder=1.5)
        name = f"{100 * level:g} % bound"
        looks: dict[str, Any] = {"rotation": 90, "color": SOFT, "bbox": BACKING}
        axes.annotate(name, (bound, 0), (-12, 4), **{**OFFSET, "fontsize": 8}, **looks)
        axes.plot(bound, found, "o", color=WRONG, markersize=6, markeredgecolor="white", zorder=5)
    title = (
        f"mean {consistency.nees_mean:.3g} (2 expected), "
        f"median {consistency.nees_median:.3g} ({nees_bound(0.5):.2f} expected)\n"
        f"{within_text(consistency)}"
    )
    axes.set_title(title, fontsize=9, color=SOFT, linespacing=1.4, pad=24)


# The track.


def track_figures(
    comparison: Comparison, track: TrackMetrics, radius_m: float, background: Background | None
) -> list[Figure]:
    series = track.series
    figures = [
        Figure(
            "track-map",
            f"Track of {track.n_compared} views with a true position, coloured by state",
            "Map, north up: true path and estimated positions. Ellipses hold 95 %; lines join "
            f"estimates with an error above {radius_m:g} m to the true position.",
            track_map_picture(comparison, series, radius_m, background),
        ),
        Figure(
            "track-error",
            "Error with its stated bounds over time, state and confidence; "
            + track_consistency_text(track.consistency),
            "Error and its stated bounds (longer axis of the covariance), state, and confidence.",
            error_picture(comparison, series, radius_m),
        ),
        Figure(
            "track-ahead-and-right",
            f"Errors ahead of the true position: {spread_text(track.along)}; "
            f"to the right of it: {spread_text(track.across)}",
            "Errors ahead and to the right of the true position. Errors of heading or mount appear "
            "as constants, whatever the course.",
            signed_picture(series),
        ),
    ]
    if any(np.isfinite(values).any() for values in series.biases.values()):
        figures.append(
            Figure(
                "track-biases",
                "Estimated biases of reported heading, height and tilt (pitch and roll)",
                "Estimated biases, to be added to the reported values.",
                biases_picture(series),
            )
        )
    return figures


def track_map_picture(
    comparison: Comparison,
    series: TrackSeries,
    radius_m: float,
    background: Background | None = None,
) -> Drawing:
    box = view_box(comparison, radius_m)
    wrong = comparison.errors_m > radius_m
    size = 7.0 if len(series.states) < 120 else 5.0

    def draw(axes: "Axes") -> None:
        draw_map(axes, box, background)
        width = 1.8 if wrong.sum() < 30 else 0.9
        axes.plot(*_to_truth(comparison, wrong), color=WRONG, linewidth=width, zorder=3)
        axes.plot(*comparison.truth_en_m.T, color="white", linewidth=3.4, zorder=2)
        path: dict[str, Any] = {"color": TRUTH, "linewidth": 1.4, "markersize": 2.5, "zorder": 4}
        axes.plot(*comparison.truth_en_m.T, ".-", **path, label="ground truth")
        _draw_ellipses(axes, comparison, series, box)
        marks: dict[str, Any] = {"markersize": size, "markeredgewidth": 0, "zorder": 6}
        for state, here, colour, mark in _by_state(series.states):
            at = comparison.fix_en_m[here].T
            axes.plot(*at, mark, color=colour, linestyle="none", label=state, **marks)
        axes.legend(ncols=4, **LEGEND_ABOVE)

    return draw_axes(map_size_in(box, 8.5, (4.0, 3.0)), draw)


def error_picture(comparison: Comparison, series: TrackSeries, radius_m: float) -> Drawing:
    def draw(figure: "mpl.Figure") -> None:
        above, band, below = figure.subplots(3, 1, sharex=True, height_ratios=(6, 0.5, 2))
        x, name = _time_axis(series.seconds_s)
        _draw_errors(above, x, comparison.errors_m, series, radius_m)
        _draw_states(band, x, series.states)
        confidence = comparison.criteria["confidence"]
        below.plot(x, confidence, ".-", color=RIGHT, linewidth=1.0, markersize=3)
        below.axhline(CONFIDENT, linewidth=1, **_DASHED)
        below.set(ylim=(-0.05, 1.08), ylabel="confidence", xlabel=name)
        below.set_xlim(*_limits(x))
        figure.align_ylabels([above, below])

    return draw_figure((10.5, 5.2), draw)


def signed_picture(series: TrackSeries) -> Drawing:
    def draw(figure: "mpl.Figure") -> None:
        parts = figure.subplots(2, 1, sharex=True)
        x, name = _time_axis(series.seconds_s)
        tracking = np.array(series.states) == "tracking"
        signed = np.stack([series.along_m, series.across_m])
        scale_from = signed[:, tracking] if np.isfinite(signed[:, tracking]).any() else signed
        sizes = np.abs(scale_from[np.isfinite(scale_from)])
        reach = 1.15 * float(max([1.0, *sizes]))
        for axes, values, label in zip(parts, signed, ("ahead (m)", "right (m)"), strict=True):
            axes.axhline(0.0, color=GREY, linewidth=1)
            within = np.where(np.abs(values) <= reach, values, math.nan)  # no lines to far away
            axes.plot(x, within, color="#BBBBBB", linewidth=0.9)
            for _, here, colour, mark in _by_state(series.states):
                axes.plot(x[here], values[here], mark, color=colour, markersize=3.5)
            known = values[tracking & np.isfinite(values)]
            if known.size:
                mean = float(known.mean())
                axes.axhline(mean, color=RIGHT, linestyle=(0, (4, 3)), linewidth=1.2)
                axes.set_title(f"tracking: mean {mean:+.1f} m", fontsize=9, color=SOFT)
            axes.set(ylim=(-reach, reach), ylabel=label)
        parts[1].set(xlabel=name)
        parts[1].set_xlim(*_limits(x))

    return draw_figure((6.2, 4.6), draw)


def biases_picture(series: TrackSeries) -> Drawing:
    found = series.biases
    panels: list[tuple[str, dict[str, FloatArray]]] = [
        ("heading (deg)", {"": found["heading_bias_deg"]}),
        ("height (%)", {"": 100.0 * np.expm1(np.clip(found["log_scale_bias"], -5.0, 5.0))}),
        ("tilt (deg)", {"pitch": found["pitch_bias_deg"], "roll": found["roll_bias_deg"]}),
    ]
    panels = [p for p in panels if any(np.isfinite(v).any() for v in p[1].values())]

    def draw(figure: "mpl.Figure") -> None:
        parts = np.atleast_1d(np.asarray(figure.subplots(len(panels), 1, sharex=True)))
        x, name = _time_axis(series.seconds_s)
        for axes, (label, curves) in zip(parts, panels, strict=True):
            axes.axhline(0.0, color=GREY, linewidth=1)
            for (part, values), colour in zip(curves.items(), (RIGHT, WRONG), strict=False):
                axes.plot(x, values, ".-", color=colour, linewidth=1.2, markersize=3, label=part)
            axes.set(ylabel=label)
            if len(curves) > 1:
                axes.legend(ncols=2, loc="best", fontsize=8)
        parts[-1].set(xlabel=name)
        parts[-1].set_xlim(*_limits(x))
        figure.align_ylabels()

    return draw_figure((6.2, 4.6), draw)


def _by_state(states: Sequence[str]) -> list[tuple[str, BoolArray, str, str]]:
    masks = {state: np.array([each == state for each in states]) for state in STATE_STYLES}
    return [(state, masks[state], *STATE_STYLES[state]) for state in masks if masks[state].any()]


def _draw_ellipses(
    axes: "Axes", comparison: Comparison, series: TrackSeries, box: tuple[float, ...]
) -> None:
    from matplotlib.patches import Ellipse

    side_m = max(box[1] - box[0], box[3] - box[2])
    seen = is_covariance(comparison.cov_en_m2) & np.isfinite(comparison.errors_m)
    usable = np.flatnonzero(seen & (np.nan_to_num(series.bound_95_m, nan=math.inf) < side_m / 3))
    for i in usable[:: max(1, math.ceil(usable.size / MOST_ELLIPSES))]:
        sizes, axes_en = np.linalg.eigh(comparison.cov_en_m2[i])
        width, height = 2 * np.sqrt(nees_bound(0.95) * np.maximum(sizes[::-1], 0.0))
        turn_deg = math.degrees(math.atan2(axes_en[1, 1], axes_en[0, 1]))
        colour = STATE_STYLES.get(series.states[i], (GREY, ""))[0]
        at = tuple(map(float, comparison.fix_en_m[i]))
        shape = Ellipse((at[0], at[1]), width, height, angle=turn_deg, fill=False, zorder=5)
        shape.set(edgecolor=colour, linewidth=1.0, alpha=0.9)
        axes.add_patch(shape)


def _draw_errors(
    axes: "Axes", x: FloatArray, errors_m: FloatArray, series: TrackSeries, radius_m: float
) -> None:
    from matplotlib.ticker import LogLocator

    # a log axis has no zero; NaN stays NaN
    shown_m, sigma_m, bound_m = np.maximum([errors_m, series.sigma_m, series.bound_95_m], 0.1)
    known = np.concatenate([shown_m, sigma_m])
    known = known[np.isfinite(known)]
    low, high = min([radius_m / 10, *known]) / 1.5, max([radius_m * 2, *known]) * 1.5
    axes.fill_between(x, low, bound_m, color=RIGHT, alpha=0.13, linewidth=0, label="95 % bound")
    axes.fill_between(x, low, sigma_m, color=RIGHT, alpha=0.22, linewidth=0, label="1 sigma")
    axes.plot(x, shown_m, ".-", color=TRUTH, linewidth=1.0, markersize=4, label="error")
    axes.axhline(radius_m, color=WRONG, linewidth=1.2, label=f"{radius_m:g} m")
    axes.set(yscale="log", ylim=(low, high), ylabel="error (m)")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 200 * low else (1.0,)))
    _plain_numbers(axes.yaxis)
    for state, _, colour, _ in _by_state(series.states):
        axes.plot([], [], "s", color=colour, markersize=7, label=state)
    axes.legend(ncols=7, **LEGEND_ABOVE)


def _draw_states(axes: "Axes", x: FloatArray, states: Sequence[str]) -> None:
    edges = np.append(x, _limits(x)[1])
    whole = float(edges[-1] - edges[0])
    for state, here, colour, _ in _by_state(states):
        for start, stop in runs(here):
            axes.axvspan(edges[start], edges[stop], color=colour, linewidth=0)
            if edges[stop] - edges[start] > 0.09 * whole:
                middle = (edges[start] + edges[stop]) / 2
                place: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8}
                axes.text(middle, 0.47, state, color="white", weight="bold", **place)
    axes.set(ylim=(0, 1), yticks=[])
    axes.grid(visible=False)


def _limits(x: FloatArray) -> tuple[float, float]:
    step = float(np.median(np.diff(x))) if x.size > 1 else 1.0
    return float(x[0]), float(x[-1]) + max(step, 1e-3)


# GNSS.


def gnss_figure(found: GnssMetrics) -> Figure:
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

    return Figure(
        "gnss",
        f"GNSS: {percentiles_text(found.errors_m)}; alarms: {len(found.alarms)}",
        "Errors of GNSS and of the map, and the distance between them; shaded while the GNSS "
        "monitor reports a fault.",
        draw_figure((6.2, 4.0), draw),
    )
