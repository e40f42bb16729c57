"""How a track is shown: its figures in words and as JSON values, its pictures as PNG bytes.

States differ by colour and by mark.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.evaluate import plots
from orthonav.evaluate.calibration import is_covariance, nees_bound
from orthonav.evaluate.calibration_report import Picture
from orthonav.evaluate.canvas import GREY, RIGHT, SOFT, TRUTH, WRONG, figure_png, png
from orthonav.evaluate.figures import FloatArray, or_none, percent_text
from orthonav.evaluate.metrics import Comparison, radius_key
from orthonav.evaluate.track import SURE, Consistency, Longest, Series, Spread, Track, runs
from orthonav.publish.jsonl import STATES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STATE_STYLES = {
    "searching": ("#E69F00", "^"),
    "tracking": (RIGHT, "o"),
    "lost": ("#B8558F", "X"),
}
"""State -> colour and mark."""
MOST_ELLIPSES = 40
_ERROR_FLOOR_M = 0.1  # a log axis has no zero
_LEGEND: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "frameon": False}


def track_rows(track: Track) -> tuple[tuple[str, str], ...]:
    """The figures of a track as names and what is said of them."""
    after, far = track.after, f"{track.far_m:g} m"
    within = ", ".join(f"{percent_text(s)} within {r:g} m" for r, s in after.acc_at_m.items())
    found = "never"
    if math.isfinite(track.first_view):
        found = f"at view {track.first_view:.0f} of {track.n_views}, {_s(track.first_s)} after the "
        found += "first"
    return (
        ("first confirmed fix", found),
        (
            "errors from then on",
            f"median {_m(after.error_median_m)}, 95 % {_m(after.error_p95_m)}, "
            f"largest {_m(after.error_max_m)}; of {after.n_views} views {within}"
            if after.n_views
            else "not known",
        ),
        ("states", _states_said(track)),
        (
            "longest without a confident fix",
            f"{_longest_said(track.unsure)}; from the first confirmed fix on "
            f"{_longest_said(track.unsure_after)}",
        ),
        (
            "false locks",
            f"{track.n_false_locks}, the longest {_s(track.false_lock_longest_s)}; "
            f"{track.n_sure_wrong} views sure and more than {far} off",
        ),
        ("ahead of the truth", _spread_said(track.along)),
        ("right of the truth", _spread_said(track.across)),
        ("covariance", consistency_said(track.consistency)),
    )


def track_lines(track: Track, name: str = "") -> list[str]:
    """The same for a terminal."""
    head = f"track of {' '.join(name.split())}:" if name else "track:"
    return [head, *(f"  {key}: {said}" for key, said in track_rows(track))]


def consistency_said(found: Consistency) -> str:
    """Whether a track is as good as its covariance says."""
    if not found.n_views:
        return "not known, no tracking view has a usable one and a true position"
    left_out = f"; {found.n_left_out} have no usable one" if found.n_left_out else ""
    return (
        f"{found.verdict}: NEES of {found.n_views} tracking views has mean {found.nees_mean:.3g} "
        f"(2 expected; 95 % lie within {found.effective_low:.2f} to {found.effective_high:.2f}, as "
        f"errors of neighbours are alike and count as {found.n_effective:.0f} independent ones; "
        f"were all independent, {found.independent_low:.2f} to {found.independent_high:.2f}); "
        f"{percent_text(found.nees_within_95)} below {nees_bound(0.95):.2f} (95 % expected)"
        f"{left_out}"
    )


def track_to_json(track: Track) -> dict[str, object]:
    """`track` as values for strict JSON, units in the names; what is not defined becomes None.

    `over_time` has one value per compared view, rounded to milliseconds and millimetres.
    """
    values: dict[str, Any] = {}
    for name, value in vars(track).items():
        if isinstance(value, Series):
            names = ("seconds_s", "sigma_m", "bound_95_m", "along_m", "across_m")
            values["over_time"] = {each: _rounded(getattr(value, each)) for each in names}
        elif isinstance(value, Mapping):
            values[name] = {key: or_none(part) for key, part in value.items()}
        elif hasattr(value, "__dataclass_fields__"):
            values[name] = {key: _plain(part) for key, part in vars(value).items()}
        else:
            values[name] = _plain(value)
    values["first_view"] = int(track.first_view) if math.isfinite(track.first_view) else None
    after = values["after"]
    after |= {radius_key(r): or_none(s) for r, s in after.pop("acc_at_m").items()}
    return values


def tracks_to_json(tracks: Sequence[Track]) -> dict[str, object]:
    """What of several tracks adds up: counts, shares of views, and the worst of each.

    Medians, biases and consistency are left to the flights.
    """
    n_after = sum(track.after.n_views for track in tracks)
    known = [track.after for track in tracks if track.after.n_views]
    within = {
        radius_key(r): sum(a.acc_at_m[r] * a.n_views for a in known) / n_after if known else None
        for r in tracks[0].after.acc_at_m
    }
    n_views = sum(track.n_views for track in tracks)
    shares = {
        state: sum(t.share_of_views[state] * t.n_views for t in tracks) / n_views
        for state in tracks[0].share_of_views
    }
    return {
        "n_tracks": len(tracks),
        "n_found": sum(math.isfinite(track.first_view) for track in tracks),
        "n_views": n_views,
        "first_s_max": _most(track.first_s for track in tracks),
        "after": {
            "n_views": n_after,
            "error_max_m": _most(t.after.error_max_m for t in tracks),
            **within,
        },
        "share_of_views": shares,
        "n_lost": sum(track.n_lost for track in tracks),
        "unsure_seconds_s_max": _most(track.unsure.seconds_s for track in tracks),
        "unsure_way_m_max": _most(track.unsure.way_m for track in tracks),
        "n_sure_wrong": sum(track.n_sure_wrong for track in tracks),
        "n_false_locks": sum(track.n_false_locks for track in tracks),
        "false_lock_longest_s": _most(track.false_lock_longest_s for track in tracks),
    }


def track_pictures(
    comparison: Comparison, track: Track, radius_m: float, background: plots.Background | None
) -> list[Picture]:
    """Track on the map; error, state and confidence; errors along and across; what was learnt."""
    series, found = track.series, track.consistency
    pictures = [
        (
            track_map_picture(comparison, series, radius_m, background),
            f"Track of {track.n_compared} views with a true position, coloured by state",
            "From above, north up: the true way, and where the track had the aircraft. Ellipses "
            f"hold 95 %; a line leads to the truth from what is more than {radius_m:g} m off.",
        ),
        (
            error_picture(comparison, series, radius_m),
            f"Error and its own bounds over time, state and confidence; {consistency_said(found)}",
            "Error against what the track says of it (longer axis of the covariance), state, and "
            "confidence.",
        ),
        (
            signed_picture(series),
            f"Errors ahead of the truth: {_spread_said(track.along)}; "
            f"to the right of it: {_spread_said(track.across)}",
            "Errors ahead and to the right of the truth. What is wrong with heading or mount "
            "stays the same here, wherever the aircraft flies.",
        ),
    ]
    if any(np.isfinite(values).any() for values in series.biases.values()):
        pictures.append(
            (
                biases_picture(series),
                "What the track learnt to be wrong with told heading, height and lean, over time",
                "What was learnt to be wrong with what is told: to be added to it.",
            )
        )
    return pictures


def track_map_picture(
    comparison: Comparison,
    series: Series,
    radius_m: float,
    background: plots.Background | None = None,
) -> bytes:
    """True way, estimates coloured by state, 95 % ellipses of some, lines from wrong ones."""
    box = plots._view_box(comparison, radius_m)
    width_m, height_m = box[1] - box[0], box[3] - box[2]
    scale = 8.5 / max(width_m, height_m)
    size_in = (max(scale * width_m, 4.0) + 1.0, max(scale * height_m, 3.0) + 1.0)
    wrong = comparison.errors_m > radius_m
    size = 7.0 if len(series.states) < 120 else 5.0

    def draw(axes: "Axes") -> None:
        if background is not None:
            plots._draw_background(axes, background, box)
        lines = np.full((3 * int(wrong.sum()), 2), np.nan)  # truth, estimate, pen up
        lines[0::3], lines[1::3] = comparison.truth_en_m[wrong], comparison.fix_en_m[wrong]
        axes.plot(*lines.T, color=WRONG, linewidth=1.8 if wrong.sum() < 30 else 0.9, zorder=3)
        axes.plot(*comparison.truth_en_m.T, color="white", linewidth=3.4, zorder=2)
        axes.plot(*comparison.truth_en_m.T, ".-", **_TRUTH, label="truth")
        _draw_ellipses(axes, comparison, series, box)
        for state, (colour, mark) in STATE_STYLES.items():
            here = np.array([each == state for each in series.states])
            marks: dict[str, Any] = {"markersize": size, "markeredgewidth": 0, "zorder": 6}
            if here.any():
                at = comparison.fix_en_m[here].T
                axes.plot(*at, mark, color=colour, linestyle="none", label=state, **marks)
        axes.set(xlim=box[:2], ylim=box[2:], aspect="equal")
        axes.set(xlabel="east (m)", ylabel="north (m)")
        plots._draw_scale_bar(axes, box)
        plots._draw_north(axes)
        axes.legend(ncols=4, **_LEGEND)

    return png(size_in, draw)


_TRUTH: dict[str, Any] = {"color": TRUTH, "linewidth": 1.4, "markersize": 2.5, "zorder": 4}


def error_picture(comparison: Comparison, series: Series, radius_m: float) -> bytes:
    """Error with 1 sigma and 95 % of its own, state as a band, confidence; one time axis."""

    def draw(figure: "Figure") -> None:
        above, band, below = figure.subplots(3, 1, sharex=True, height_ratios=(6, 0.5, 2))
        x, name = _axis(series)
        _draw_errors(above, x, comparison.errors_m, series, radius_m)
        _draw_states(band, x, series.states)
        confidence = comparison.criteria["confidence"]
        below.plot(x, confidence, ".-", color=RIGHT, linewidth=1.0, markersize=3)
        below.axhline(SURE, color=GREY, linestyle=(0, (4, 3)), linewidth=1)
        below.set(ylim=(-0.05, 1.08), ylabel="confidence", xlabel=name)
        below.set_xlim(*_limits(x))
        figure.align_ylabels([above, below])

    return figure_png((10.5, 5.2), draw)


def signed_picture(series: Series) -> bytes:
    """Errors ahead of and to the right of the truth over time; the scale is that of tracking."""

    def draw(figure: "Figure") -> None:
        parts = figure.subplots(2, 1, sharex=True)
        x, name = _axis(series)
        tracking = np.array([state == "tracking" for state in series.states])
        signed = np.stack([series.along_m, series.across_m])
        scale_from = signed[:, tracking] if np.isfinite(signed[:, tracking]).any() else signed
        sizes = np.abs(scale_from[np.isfinite(scale_from)])
        reach = 1.15 * float(max([1.0, *sizes]))
        for axes, values, said in zip(parts, signed, ("ahead (m)", "right (m)"), strict=True):
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
            axes.set(ylim=(-reach, reach), ylabel=said)
        parts[1].set(xlabel=name)
        parts[1].set_xlim(*_limits(x))

    return figure_png((6.2, 4.6), draw)


def biases_picture(series: Series) -> bytes:
    """What was learnt to be wrong with heading, height and lean, over time; only what is there."""
    scale = 100.0 * np.expm1(np.clip(series.biases["log_scale_bias"], -5.0, 5.0))
    lean = {
        "pitch": series.biases["pitch_bias_deg"],
        "roll": series.biases["roll_bias_deg"],
    }
    panels: list[tuple[str, dict[str, FloatArray]]] = [
        ("heading (deg)", {"": series.biases["heading_bias_deg"]}),
        ("height (%)", {"": scale}),
        ("lean (deg)", lean),
    ]
    panels = [p for p in panels if any(np.isfinite(v).any() for v in p[1].values())]

    def draw(figure: "Figure") -> None:
        parts = np.atleast_1d(np.asarray(figure.subplots(len(panels), 1, sharex=True)))
        x, name = _axis(series)
        for axes, (said, curves) in zip(parts, panels, strict=True):
            axes.axhline(0.0, color=GREY, linewidth=1)
            for (label, values), colour in zip(curves.items(), (RIGHT, WRONG), strict=False):
                axes.plot(x, values, ".-", color=colour, linewidth=1.2, markersize=3, label=label)
            axes.set(ylabel=said)
            if len(curves) > 1:
                axes.legend(ncols=2, loc="best", fontsize=8)
        parts[-1].set(xlabel=name)
        parts[-1].set_xlim(*_limits(x))
        figure.align_ylabels()

    return figure_png((6.2, 4.6), draw)


def _draw_ellipses(
    axes: "Axes", comparison: Comparison, series: Series, box: tuple[float, ...]
) -> None:
    """The 95 % ellipses of up to `MOST_ELLIPSES` estimates, evenly along the flight."""
    from matplotlib.patches import Ellipse

    side_m = max(box[1] - box[0], box[3] - box[2])
    seen = is_covariance(comparison.cov_en_m2) & np.isfinite(comparison.errors_m)
    usable = np.flatnonzero(seen & (np.nan_to_num(series.bound_95_m, nan=math.inf) < side_m / 3))
    for i in usable[:: max(1, math.ceil(usable.size / MOST_ELLIPSES))]:
        sizes, ways = np.linalg.eigh(comparison.cov_en_m2[i])
        width, height = 2 * np.sqrt(nees_bound(0.95) * np.maximum(sizes[::-1], 0.0))
        turn_deg = math.degrees(math.atan2(ways[1, 1], ways[0, 1]))
        colour = STATE_STYLES.get(series.states[i], (GREY, ""))[0]
        at = tuple(map(float, comparison.fix_en_m[i]))
        shape = Ellipse((at[0], at[1]), width, height, angle=turn_deg, fill=False, zorder=5)
        shape.set(edgecolor=colour, linewidth=1.0, alpha=0.9)
        axes.add_patch(shape)


def _draw_errors(
    axes: "Axes", x: FloatArray, errors_m: FloatArray, series: Series, radius_m: float
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
    """A band of colour per state, from each view to the next; named where it is wide enough."""
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


def _axis(series: Series) -> tuple[FloatArray, str]:
    """Where views lie on the time axis and its name; their number where times are not known."""
    if np.isfinite(series.seconds_s).all():
        return series.seconds_s, "time since the first view (s)"
    return np.arange(1.0, len(series.states) + 1), "view (times are not known, or do not rise)"


def _limits(x: FloatArray) -> tuple[float, float]:
    """Ends of the axis: room for what the last view stands for, and some for a single view."""
    step = float(np.median(np.diff(x))) if x.size > 1 else 1.0
    return float(x[0]), float(x[-1]) + max(step, 1e-3)


def _states_said(track: Track) -> str:
    by_view = ", ".join(f"{name} {percent_text(track.share_of_views[name])}" for name in STATES)
    by_time = ", ".join(percent_text(track.share_of_time[name]) for name in STATES)
    lost = f"lost {track.n_lost} time{'s' * (track.n_lost != 1)}"
    return f"{by_view} of views; {by_time} of the time; {lost}"


def _longest_said(longest: Longest) -> str:
    return f"{_s(longest.seconds_s)}, {_m(longest.way_m)}"


def _spread_said(spread: Spread) -> str:
    if not spread.n_views:
        return "not known"
    return (
        f"mean {spread.mean_m:+.1f} m, standard deviation {spread.std_m:.1f} m, "
        f"RMS {spread.rms_m:.1f} m of {spread.n_views} tracking views"
    )


def _m(value: float) -> str:
    return f"{value:.1f} m" if math.isfinite(value) else "- m"


def _s(value: float) -> str:
    return f"{value:.1f} s" if math.isfinite(value) else "- s"


def _plain(value: Any) -> Any:
    """Numbers for strict JSON; no word for no verdict."""
    if isinstance(value, float):
        return or_none(value)
    return None if value == "" else value


def _rounded(values: FloatArray) -> list[float | None]:
    return [or_none(round(float(value), 3)) for value in values]


def _most(values: Iterable[float]) -> float | None:
    """The largest of what is known."""
    return max((value for value in values if math.isfinite(value)), default=None)
