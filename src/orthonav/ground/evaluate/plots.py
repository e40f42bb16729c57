"""Figures of an evaluation: map, error curve, criteria, errors over time.

Colour shows confidence and the mark shows the error; false fixes stand out by both.
"""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.ground.evaluate.figures import BoolArray, FloatArray, runs
from orthonav.ground.evaluate.gaps import seconds_since_first
from orthonav.ground.evaluate.metrics import FAR_M, Comparison, CriterionCurve, Metrics
from orthonav.ground.report.canvas import (
    BACKING,
    GREY,
    LOW_CONFIDENCE,
    OFFSET,
    RIGHT,
    SOFT,
    TRUTH,
    WRONG,
    Drawing,
    draw_axes,
)
from orthonav.ground.report.maps import Background, draw_map, map_size_in

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# colour, line, mark, drawing order
CURVE_STYLES: dict[str, tuple[str, Any, str, float]] = {
    "confidence": ("#0072B2", "-", "o", 2.0),
    "peak_ratio": ("#009E73", (0, (5, 3)), "s", 2.1),
    "lowe_ratio": ("#B8558F", (0, (1.5, 1.5)), "^", 2.2),
}
LABELS = {
    "confidence": "confidence",
    "peak_ratio": "peak ratio",
    "lowe_ratio": "Lowe's ratio",
}
MAIN = ("confidence", 0.9)
"""The criterion and threshold that is highlighted."""
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
    """Map of true positions and fixes, joined by lines; north is up.

    Of fixes far outside the flight only the lines to the edge are visible.
    """
    box = view_box(comparison, radius_m)

    def draw(axes: "Axes") -> None:
        draw_map(axes, box, background)
        _draw_positions(axes, comparison, radius_m, box)
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)

    return draw_axes(map_size_in(box, 7.5), draw)


def error_curve_picture(comparison: Comparison, metrics: Metrics) -> Drawing:
    """Share of all views with a fix within an error, over that error; the radius marked."""

    def draw(axes: "Axes") -> None:
        radius_m = metrics.radius_m
        errors_m = np.sort(comparison.errors_m[np.isfinite(comparison.errors_m)])
        shown_m = np.maximum(errors_m, 0.01)  # a log axis has no zero
        low = min([radius_m / 30, *shown_m[:1]]) * 0.8
        high = max([radius_m * 30, *shown_m[-1:]]) * 1.25
        shares = np.arange(errors_m.size + 1) / metrics.n_views * 100
        x = np.concatenate([[low], shown_m, [high]])
        axes.step(x, [*shares, shares[-1]], where="post", color=RIGHT, linewidth=2)
        axes.axhline(100 * metrics.coverage, color=GREY, linestyle=(0, (4, 3)), linewidth=1)
        coverage = f"{100 * metrics.coverage:.0f} % have a position, low confidence included"
        axes.annotate(coverage, (low, 100 * metrics.coverage), (6, 4), **OFFSET, color=SOFT)
        axes.axvline(radius_m, color=WRONG, linewidth=1.2)
        axes.plot([radius_m], [100 * metrics.accuracy], "o", color=WRONG, zorder=5)
        lift = -14 if metrics.accuracy > 0.15 else 18  # clear of the axis, and of the other note
        note = f"{100 * metrics.accuracy:.0f} % within {radius_m:g} m"
        axes.annotate(note, (radius_m, 100 * metrics.accuracy), (8, lift), **OFFSET, color=WRONG)
        axes.set(xscale="log", xlim=(low, high), ylim=(0, 107))
        axes.set(xlabel="error (m)", ylabel="percentage of all views")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")

    return draw_axes((6.2, 4.0), draw)


def criteria_picture(metrics: Metrics) -> Drawing:
    """Accuracy over the share of views accepted, per criterion, with its thresholds."""

    def draw(axes: "Axes") -> None:
        drawn = [curve for curve in metrics.curves if curve.thresholds.size]
        for curve in drawn:
            _draw_criterion(axes, curve)
        # shares of the first few views are noisy and do not set the scale
        tails = [curve.accuracy[curve.share_accepted >= 0.05] for curve in drawn]
        lowest = min((float(tail.min()) for tail in tails if tail.size), default=0.0)
        bottom = max(0.0, math.floor(lowest * 10 - 0.5) * 10)
        axes.set(xlim=(0, 102), ylim=(min(bottom, 85.0), 101.5))
        axes.set(xlabel="percentage of all views accepted")
        axes.set(ylabel=f"percentage of these within {metrics.radius_m:g} m")
        if drawn:
            _draw_thresholds(axes, metrics)
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
        else:
            axes.text(51, 50 + min(bottom, 85.0) / 2, "no fix states a criterion", ha="center")

    return draw_axes((6.2, 4.0), draw)


def over_time_picture(comparison: Comparison, radius_m: float) -> Drawing:
    """Error of each view over time, or in their order; views without a fix are shaded."""

    def draw(axes: "Axes") -> None:
        errors_m = comparison.errors_m
        x, name, edges = _time_axis(comparison)
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
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False)

    return draw_axes((10.5, 3.4), draw)


def _time_axis(comparison: Comparison) -> tuple[FloatArray, str, FloatArray]:
    """Positions of views (N,), the name of the axis, and the edges between views (N + 1,)."""
    x, name = seconds_since_first(comparison.time_ns), "time since the first view (s)"
    if not np.isfinite(x).all():
        x, name = np.arange(1.0, x.size + 1), "view, in order of the flight"
    half = float(np.median(np.diff(x))) / 2 if x.size > 1 else 0.5
    half = max(half, 1e-3)
    edges = np.concatenate([[x[0] - half], (x[1:] + x[:-1]) / 2, [x[-1] + half]])
    return x, name, edges


def _if(label: str, shown: BoolArray) -> str:
    """A label for the legend if anything is shown."""
    return label if shown.any() else "_nolegend_"


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
    """Which of positions (N, 2) lie in a box: west, east, south, north."""
    east, north = positions_en_m.T
    inside: BoolArray = (box[0] <= east) & (east <= box[1]) & (box[2] <= north) & (north <= box[3])
    return inside


def _draw_positions(
    axes: "Axes", comparison: Comparison, radius_m: float, box: tuple[float, ...]
) -> None:
    truth, fixes = comparison.truth_en_m, comparison.fix_en_m
    none = np.isnan(comparison.errors_m)
    ring: dict[str, Any] = {
        "linestyle": "none",
        "marker": "o",
        "markerfacecolor": "white",
        "zorder": 4,
    }
    axes.plot(
        *truth[~none].T, ".", color=TRUTH, markersize=3, zorder=7, label=_if("ground truth", ~none)
    )
    for order, (label, chosen, colour, mark, size) in enumerate(fix_classes(comparison, radius_m)):
        if not chosen.any():
            continue
        lines = np.full((3 * int(chosen.sum()), 2), np.nan)  # truth, fix, pen up
        lines[0::3], lines[1::3] = truth[chosen], fixes[chosen]
        axes.plot(*lines.T, color=colour, linewidth=0.9, alpha=0.7, zorder=3)
        outside = int((chosen & ~inside_box(fixes, box)).sum())
        style: dict[str, Any] = {"color": colour, "markersize": size, "zorder": 5 + order / 10}
        label += f" ({outside} outside)" if outside else ""
        axes.plot(*fixes[chosen].T, mark, **style, label=label)
    axes.plot(
        *truth[none].T, color=TRUTH, markersize=4.5, label=_if("ground truth, no fix", none), **ring
    )


def _draw_criterion(axes: "Axes", curve: CriterionCurve) -> None:
    colour, line, _, order = CURVE_STYLES[curve.name]
    axes.plot(
        100 * curve.share_accepted,
        100 * curve.accuracy,
        color=colour,
        linestyle=line,
        linewidth=1.8,
        label=LABELS[curve.name],
        zorder=order,
    )


def _draw_thresholds(axes: "Axes", metrics: Metrics) -> None:
    """A mark and a number for each threshold, placed without overlap."""
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
    """Whether two boxes (left, bottom, right, top) share more than an edge."""
    across = min(one[2], other[2]) > max(one[0], other[0])
    return across and min(one[3], other[3]) > max(one[1], other[1])


def _draw_main(axes: "Axes", at: tuple[float, float], colour: str) -> None:
    """A ring around the point, with lines to both axes."""
    lead: dict[str, Any] = {"color": colour, "linewidth": 1.0, "alpha": 0.55, "zorder": 1.5}
    axes.plot([at[0], at[0], 0], [0, at[1], at[1]], linestyle=(0, (1, 2)), **lead)
    ring: dict[str, Any] = {"markerfacecolor": "none", "markeredgewidth": 1.5, "zorder": 4}
    axes.plot(*at, "o", markersize=12, markeredgecolor=colour, **ring)
