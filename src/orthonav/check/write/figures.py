"""Figures of a check: map, profile along the route, envelope of errors."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import Along, BlindStretch, CheckResult, Envelope
from orthonav.check.write.imagery import shrunk, visible_box
from orthonav.check.write.risk import EDGE_PX, RISKS, segments
from orthonav.check.write.shapes import stretch_en_m
from orthonav.check.write.summary import summarize
from orthonav.check.write.wording import share_text, tolerance_sentence
from orthonav.records import CONFIDENT
from orthonav.report import Background, Figure, draw_axes, draw_figure, draw_map, map_size_in
from orthonav.report.canvas import BACKING, GREY, INK, OFFSET, RIGHT, SOFT, WRONG

if TYPE_CHECKING:
    from matplotlib import figure as mpl
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
FIGURE_NAMES = ("map", "profile", "envelope")
MAX_LOOKALIKES = 20
"""Shown on map and page, the most similar ones; the files hold all."""
_BACKGROUND_PX = 900
_STEPS = 10
_NUMBERED = 0.01
"""Recoverable stretches shorter than this share of the route get no number in the profile."""
_LEGEND: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "frameon": False}


def figures(result: CheckResult, image: Background) -> list[Figure]:
    """The figures of a check, in the order in which the page shows them."""
    found = [_map(result, image)]
    if result.along is not None and len(result.along.distance_m) > 1:
        found.append(_profile(result, result.along))
    if result.envelope is not None and result.envelope.share.size:
        found.append(_envelope(result.envelope))
    return found


def _map(result: CheckResult, image: Background) -> Figure:
    west, south, east, north = visible_box(result)
    visible = west, east, south, north
    width, height = map_size_in(visible, 7.0, (4.0, 3.0))
    marks = ["Black with a number: blind stretches."] if result.stretches else []
    marks += ["Dotted: lookalikes."] if result.lookalikes else []
    background = replace(image, grey=shrunk(image.grey, _BACKGROUND_PX))

    def draw(axes: "Axes") -> None:
        draw_map(axes, visible, background)
        _draw_cells(axes, result)
        if result.along is not None:
            _draw_route(axes, result, result.along)
        _draw_lookalikes(axes, result)
        axes.set(xlim=visible[:2], ylim=visible[2:])

    return Figure(
        "map",
        f"Map of the probability of a fix, mean {share_text(result.mean)} over "
        f"{result.area_km2:.2f} square kilometres; {len(result.stretches)} blind stretches",
        "Probability of a correct, confident fix of one view; white where unknown. "
        + " ".join(marks),
        draw_axes((width + 1.0, height), draw),
    )


def _draw_cells(axes: "Axes", result: CheckResult) -> None:
    import matplotlib

    cells = result.cells
    rows, cols = cells.probability.shape
    extent = (
        *(cells.west_m, cells.west_m + cols * cells.side_m),
        *(cells.north_m - rows * cells.side_m, cells.north_m),
    )
    shown = axes.imshow(
        np.ma.masked_invalid(cells.probability),
        cmap=matplotlib.colormaps["cividis"].resampled(_STEPS),  # few colours: a PNG has a palette
        vmin=0,
        vmax=1,
        alpha=0.55,
        extent=extent,
        interpolation="none",
        zorder=1,
    )
    assert axes.figure is not None
    axes.figure.colorbar(shown, ax=axes, shrink=0.75, label="probability of a fix")


def _draw_route(axes: "Axes", result: CheckResult, along: Along) -> None:
    """The route in classes of risk; blind stretches in black, with numbers."""
    points = along.points_en_m
    drawn = segments(along.probability)
    for number, risk in enumerate(RISKS):
        style: Any = (0, [each / risk.width for each in risk.dash]) if risk.dash else "-"
        looks = {"color": risk.colour, "linewidth": 0.5 * risk.width, "linestyle": style}
        found = [points[first : last + 1] for kind, first, last in drawn if kind == number]
        edge: dict[str, Any] = {
            "color": risk.edge,
            "linewidth": 0.5 * (risk.width + EDGE_PX),
            "zorder": 3,
        }
        for i, line in enumerate(found):
            axes.plot(*line.T, **edge, solid_capstyle="round")
            axes.plot(*line.T, **looks, label="" if i else risk.range_text, zorder=4)
    for number, each in enumerate(result.stretches, start=1):
        line = stretch_en_m(along, each.start_m, each.end_m)
        if len(line) > 1:
            axes.plot(*line.T, color=INK, linewidth=1.0, zorder=5)
            middle = line[len(line) // 2]
            bold: dict[str, Any] = {"weight": "bold", "bbox": BACKING}
            axes.annotate(str(number), middle, (7, 5), **OFFSET, **bold, zorder=7)
    if drawn:
        axes.legend(ncols=5, title="probability along the route", **_LEGEND)


def _draw_lookalikes(axes: "Axes", result: CheckResult) -> None:
    for each in result.lookalikes[:MAX_LOOKALIKES]:
        ends = [
            result.frame.en_from_latlon(*each.place_latlon_deg),
            result.frame.en_from_latlon(*each.other_latlon_deg),
        ]
        axes.plot(*np.array(ends).T, "o:", color="#8a2f63", markersize=3, linewidth=1, zorder=6)


def _profile(result: CheckResult, along: Along) -> Figure:
    summary = summarize(result)
    return Figure(
        "profile",
        f"Probability and expected drift along the route; {share_text(summary.confident_share)} of "
        f"it at {CONFIDENT:g} or more, {len(result.stretches)} blind stretches",
        "Probability along the route with its 80 % interval and the lowest across the band; below, "
        "the expected position error (one standard deviation). Shaded: blind stretches.",
        draw_figure((10.0, 5.0), lambda figure: _draw_profile(figure, result, along)),
    )


def _draw_profile(figure: "mpl.Figure", result: CheckResult, along: Along) -> None:
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    x = along.distance_m / 1000
    above.fill_between(
        x, along.low, along.high, color=RIGHT, alpha=0.18, linewidth=0, label="80 % interval"
    )
    above.plot(x, along.across_low, color=SOFT, linewidth=0.9, label="lowest across the band")
    above.plot(x, along.probability, color=RIGHT, linewidth=1.6, label="probability")
    above.axhline(CONFIDENT, color=GREY, linestyle=(0, (4, 3)), linewidth=1)
    above.set(ylim=(0, 1.02), ylabel="probability")
    above.legend(ncols=3, loc="lower right")
    below.plot(x, along.drift_m, color=WRONG, linewidth=1.6, label="position")
    below.plot(x, along.error_m, color=SOFT, linewidth=1.0, linestyle="--", label="one fix")
    below.set(xlabel="distance (km)", ylabel="error (m)", xlim=(x[0], max(x[-1], x[0] + 1e-6)))
    below.set_ylim(bottom=0)
    below.legend(ncols=2, loc="upper right")
    for number, each in enumerate(result.stretches, start=1):
        _shade(above, below, number, each)
    minutes = 1000 / result.conditions.speed_mps / 60
    times = above.secondary_xaxis("top", functions=(lambda km: km * minutes, lambda t: t / minutes))
    times.set_xlabel("minutes")


def _shade(above: "Axes", below: "Axes", number: int, stretch: BlindStretch) -> None:
    for axes in (above, below):
        colour = GREY if stretch.recoverable else WRONG
        axes.axvspan(stretch.start_m / 1000, stretch.end_m / 1000, color=colour, alpha=0.25, lw=0)
    at = (stretch.start_m + stretch.end_m) / 2000
    if stretch.recoverable and stretch.length_m < _NUMBERED * 1000 * above.get_xlim()[1]:
        return  # no room for its number
    above.annotate(str(number), (at, 0.03), (0, 0), **OFFSET, ha="center", bbox=BACKING)


def _envelope(envelope: Envelope) -> Figure:
    rows, cols = envelope.share.shape

    def draw(axes: "Axes") -> None:
        shown = axes.imshow(
            np.ma.masked_invalid(envelope.share),
            cmap="cividis",
            vmin=0,
            vmax=1,
            aspect="auto",
            interpolation="none",
            origin="lower",
        )
        for i in range(rows):
            for j in range(cols):
                share = envelope.share[i, j]
                colour = "white" if share < 0.55 else "black"
                text = f"{100 * share:.0f}" if np.isfinite(share) else "-"
                axes.text(j, i, text, ha="center", va="center", color=colour, fontsize=9)
        axes.set_xticks(range(cols), [f"{100 * value:+.3g}" for value in envelope.agl_off])
        axes.set_yticks(range(rows), [f"{value:+.3g}" for value in envelope.yaw_off_deg])
        axes.set(xlabel="error of reported height (%)", ylabel="error of reported heading (deg)")
        axes.grid(visible=False)
        assert axes.figure is not None
        axes.figure.colorbar(shown, ax=axes, label="share of correct, confident fixes")

    size = (min(10.0, max(5.6, 2.2 + 0.62 * cols)), min(8.0, max(3.4, 1.2 + 0.42 * rows)))
    return Figure(
        "envelope",
        "Share of correct, confident fixes over errors of reported heading and height. "
        + tolerance_sentence(envelope),
        "Share of correct, confident fixes (%) over errors of reported heading and height.",
        draw_axes(size, draw),
    )
