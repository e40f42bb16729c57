"""Figures of a track; states differ in colour and in mark."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.core.records import CONFIDENT
from orthonav.ground.evaluate.calibration import is_covariance, nees_bound
from orthonav.ground.evaluate.figures import FloatArray, runs
from orthonav.ground.evaluate.metrics import Comparison
from orthonav.ground.evaluate.plots import view_box
from orthonav.ground.evaluate.track import TrackMetrics, TrackSeries
from orthonav.ground.evaluate.track_report import consistency_text, spread_text
from orthonav.ground.report.canvas import (
    GREY,
    RIGHT,
    SOFT,
    TRUTH,
    WRONG,
    Drawing,
    draw_axes,
    draw_figure,
)
from orthonav.ground.report.figures import Figure
from orthonav.ground.report.maps import Background, draw_map, map_size_in

if TYPE_CHECKING:
    from matplotlib import figure as mpl
    from matplotlib.axes import Axes

STATE_STYLES = {
    "searching": ("#E69F00", "^"),
    "tracking": (RIGHT, "o"),
    "coasting": ("#56B4E9", "s"),
    "lost": ("#B8558F", "X"),
}
"""State -> colour and mark."""
MOST_ELLIPSES = 40
_ERROR_FLOOR_M = 0.1  # a log axis has no zero
_LEGEND: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "frameon": False}


def track_figures(
    comparison: Comparison, track: TrackMetrics, radius_m: float, background: Background | None
) -> list[Figure]:
    """Track on the map; error, state and confidence; signed errors; estimated biases."""
    series, found = track.series, track.consistency
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
            + consistency_text(found),
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
    """True path, estimates coloured by state, 95 % ellipses of some, lines from wrong ones."""
    box = view_box(comparison, radius_m)
    wrong = comparison.errors_m > radius_m
    size = 7.0 if len(series.states) < 120 else 5.0

    def draw(axes: "Axes") -> None:
        draw_map(axes, box, background)
        lines = np.full((3 * int(wrong.sum()), 2), np.nan)  # truth, estimate, pen up
        lines[0::3], lines[1::3] = comparison.truth_en_m[wrong], comparison.fix_en_m[wrong]
        axes.plot(*lines.T, color=WRONG, linewidth=1.8 if wrong.sum() < 30 else 0.9, zorder=3)
        axes.plot(*comparison.truth_en_m.T, color="white", linewidth=3.4, zorder=2)
        axes.plot(*comparison.truth_en_m.T, ".-", **_TRUTH, label="ground truth")
        _draw_ellipses(axes, comparison, series, box)
        for state, (colour, mark) in STATE_STYLES.items():
            here = np.array([each == state for each in series.states])
            marks: dict[str, Any] = {"markersize": size, "markeredgewidth": 0, "zorder": 6}
            if here.any():
                at = comparison.fix_en_m[here].T
                axes.plot(*at, mark, color=colour, linestyle="none", label=state, **marks)
        axes.legend(ncols=4, **_LEGEND)

    return draw_axes(map_size_in(box, 8.5, (4.0, 3.0)), draw)


_TRUTH: dict[str, Any] = {"color": TRUTH, "linewidth": 1.4, "markersize": 2.5, "zorder": 4}


def error_picture(comparison: Comparison, series: TrackSeries, radius_m: float) -> Drawing:
    """Error with its stated 1 sigma and 95 % bounds, state and confidence over time."""

    def draw(figure: "mpl.Figure") -> None:
        above, band, below = figure.subplots(3, 1, sharex=True, height_ratios=(6, 0.5, 2))
        x, name = _axis(series)
        _draw_errors(above, x, comparison.errors_m, series, radius_m)
        _draw_states(band, x, series.states)
        confidence = comparison.criteria["confidence"]
        below.plot(x, confidence, ".-", color=RIGHT, linewidth=1.0, markersize=3)
        below.axhline(CONFIDENT, color=GREY, linestyle=(0, (4, 3)), linewidth=1)
        below.set(ylim=(-0.05, 1.08), ylabel="confidence", xlabel=name)
        below.set_xlim(*_limits(x))
        figure.align_ylabels([above, below])

    return draw_figure((10.5, 5.2), draw)


def signed_picture(series: TrackSeries) -> Drawing:
    """Errors ahead and to the right of the ground truth over time, scaled to the tracking views."""

    def draw(figure: "mpl.Figure") -> None:
        parts = figure.subplots(2, 1, sharex=True)
        x, name = _axis(series)
        tracking = np.array([state == "tracking" for state in series.states])
        signed = np.stack([series.along_m, series.across_m])
        scale_from = signed[:, tracking] if np.isfinite(signed[:, tracking]).any() else signed
        sizes = np.abs(scale_from[np.isfinite(scale_from)])
        reach = 1.15 * float(max([1.0, *sizes]))
        for axes, values, label in zip(parts, signed, ("ahead (m)", "right (m)"), strict=True):
            axes.axhline(0.0, color=GREY, linewidth=1)
            within = np.where(np.abs(values) <= reach, values, math.nan)  # no lines to far away
            axes.plot(x, within, color="#BBBBBB", linewidth=0.9)
            for state, (colour, mark) in STATE_STYLES.items():
                here = np.array([each == state for each in series.states])
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
    """Estimated biases of heading, height and tilt over time, as far as they are known."""
    scale = 100.0 * np.expm1(np.clip(series.biases["log_scale_bias"], -5.0, 5.0))
    tilt = {
        "pitch": series.biases["pitch_bias_deg"],
        "roll": series.biases["roll_bias_deg"],
    }
    panels: list[tuple[str, dict[str, FloatArray]]] = [
        ("heading (deg)", {"": series.biases["heading_bias_deg"]}),
        ("height (%)", {"": scale}),
        ("tilt (deg)", tilt),
    ]
    panels = [p for p in panels if any(np.isfinite(v).any() for v in p[1].values())]

    def draw(figure: "mpl.Figure") -> None:
        parts = np.atleast_1d(np.asarray(figure.subplots(len(panels), 1, sharex=True)))
        x, name = _axis(series)
        for axes, (label, curves) in zip(parts, panels, strict=True):
            axes.axhline(0.0, color=GREY, linewidth=1)
            for (name, values), colour in zip(curves.items(), (RIGHT, WRONG), strict=False):
                axes.plot(x, values, ".-", color=colour, linewidth=1.2, markersize=3, label=name)
            axes.set(ylabel=label)
            if len(curves) > 1:
                axes.legend(ncols=2, loc="best", fontsize=8)
        parts[-1].set(xlabel=name)
        parts[-1].set_xlim(*_limits(x))
        figure.align_ylabels()

    return draw_figure((6.2, 4.6), draw)


def _draw_ellipses(
    axes: "Axes", comparison: Comparison, series: TrackSeries, box: tuple[float, ...]
) -> None:
    """The 95 % ellipses of up to `MOST_ELLIPSES` estimates, evenly along the flight."""
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

    sigma_m = np.maximum(series.sigma_m, _ERROR_FLOOR_M)
    bound_m = np.maximum(series.bound_95_m, _ERROR_FLOOR_M)
    shown_m = np.maximum(errors_m, _ERROR_FLOOR_M)  # NaN stays NaN
    known = np.concatenate([shown_m, sigma_m])
    known = known[np.isfinite(known)]
    low, high = min([radius_m / 10, *known]) / 1.5, max([radius_m * 2, *known]) * 1.5
    axes.fill_between(x, low, bound_m, color=RIGHT, alpha=0.13, linewidth=0, label="95 % bound")
    axes.fill_between(x, low, sigma_m, color=RIGHT, alpha=0.22, linewidth=0, label="1 sigma")
    axes.plot(x, shown_m, ".-", color=TRUTH, linewidth=1.0, markersize=4, label="error")
    axes.axhline(radius_m, color=WRONG, linewidth=1.2, label=f"{radius_m:g} m")
    axes.set(yscale="log", ylim=(low, high), ylabel="error (m)")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 200 * low else (1.0,)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    for state, (colour, _) in STATE_STYLES.items():
        if state in series.states:
            axes.plot([], [], "s", color=colour, markersize=7, label=state)
    axes.legend(ncols=7, **_LEGEND)


def _draw_states(axes: "Axes", x: FloatArray, states: Sequence[str]) -> None:
    """A coloured band per state, labelled where it is wide enough."""
    edges = np.append(x, _limits(x)[1])
    whole = float(edges[-1] - edges[0])
    for state, (colour, _) in STATE_STYLES.items():
        for start, stop in runs(np.array([each == state for each in states])):
            axes.axvspan(edges[start], edges[stop], color=colour, linewidth=0)
            if edges[stop] - edges[start] > 0.09 * whole:
                middle = (edges[start] + edges[stop]) / 2
                place: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8}
                axes.text(middle, 0.47, state, color="white", weight="bold", **place)
    axes.set(ylim=(0, 1), yticks=[])
    axes.grid(visible=False)


def _axis(series: TrackSeries) -> tuple[FloatArray, str]:
    """Times of the views and the name of the axis; their numbers where times are unknown."""
    if np.isfinite(series.seconds_s).all():
        return series.seconds_s, "time since the first view (s)"
    return np.arange(1.0, len(series.states) + 1), "view (times are unknown, or do not rise)"


def _limits(x: FloatArray) -> tuple[float, float]:
    """Ends of the axis, with room after the last view."""
    step = float(np.median(np.diff(x))) if x.size > 1 else 1.0
    return float(x[0]), float(x[-1]) + max(step, 1e-3)
