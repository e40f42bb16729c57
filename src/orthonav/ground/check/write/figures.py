"""Figures of a check (map, profile along the route, envelope of errors), and its map's imagery."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import CONFIDENT
from orthonav.ground.check.outcome import Along, BlindStretch, CheckResult, Envelope, summarize
from orthonav.ground.check.write.plain import EDGE_PX, RISKS, segments, stretch_en_m
from orthonav.ground.check.write.wording import probability_text, tolerance_sentence
from orthonav.ground.report.drawing import (
    BACKING,
    GREY,
    INK,
    LEGEND_ABOVE,
    OFFSET,
    RIGHT,
    SOFT,
    WRONG,
    Background,
    draw_axes,
    draw_figure,
    draw_map,
    map_size_in,
)
from orthonav.ground.report.imagery import Box, SheetImagery, jpeg, shrunk
from orthonav.ground.report.page import Figure

if TYPE_CHECKING:
    from matplotlib import figure as mpl
    from matplotlib.axes import Axes

FIGURE_NAMES = ("map", "profile", "envelope")
MAX_LOOKALIKES = 20
"""Shown on map and page, the most similar ones; the files hold all."""
MAX_SIDE_PX, MAX_AREA_PX = 2000, 2_600_000
"""Limits of the image: its longer side, and its area."""
MAX_BYTES = 1_300_000
KNEE = 0.5, 0.2
"""A probability and its place on the colour scale: most of the scale is for what is likely."""
_MARGIN = 0.04
_EMPTY = 226
"""Grey level without imagery, as light as a light page."""
_QUALITIES = (72, 60, 45, 30, 15)
_BACKGROUND_PX = 825
_STEPS = 20
_NUMBERED = 0.01
"""Recoverable stretches shorter than this fraction of the route get no number in the profile."""


def check_figures(result: CheckResult, image: Background) -> list[Figure]:
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
    marks = ["Black with a number: gaps."] if result.stretches else []
    marks += ["Dotted: pairs of ambiguous places."] if result.lookalikes else []
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
        f"Map of the probability of a fix, mean {probability_text(result.mean)} over "
        f"{result.area_km2:.2f} square kilometres; {len(result.stretches)} gaps without fixes",
        "Probability of a correct, confident fix of one view; white where unknown. "
        + " ".join(marks),
        draw_axes((width + 1.0, height), draw),
    )


def _draw_cells(axes: "Axes", result: CheckResult) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    cells = result.cells
    steps = (np.arange(_STEPS) + 0.5) / _STEPS  # few colours: a PNG has a palette
    shades = np.interp(steps, [0.0, KNEE[0], 1.0], [0.0, KNEE[1], 1.0])
    rows, cols = cells.probability.shape
    extent = (
        *(cells.west_m, cells.west_m + cols * cells.side_m),
        *(cells.north_m - rows * cells.side_m, cells.north_m),
    )
    shown = axes.imshow(
        np.ma.masked_invalid(cells.probability),
        cmap=ListedColormap(colormaps["cividis"](shades)),
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
        axes.legend(ncols=5, title="probability along the route", **LEGEND_ABOVE)


def _draw_lookalikes(axes: "Axes", result: CheckResult) -> None:
    for each in result.lookalikes[:MAX_LOOKALIKES]:
        ends = [
            result.frame.en_from_latlon(*each.place_latlon_deg),
            result.frame.en_from_latlon(*each.other_latlon_deg),
        ]
        axes.plot(*np.array(ends).T, "o:", color="#8a2f63", markersize=3, linewidth=1, zorder=6)


def _profile(result: CheckResult, along: Along) -> Figure:
    likely = probability_text(summarize(result)["route_share_from_0_9"])
    return Figure(
        "profile",
        f"Probability and expected drift along the route; {likely} of "
        f"it at {CONFIDENT:g} or more, {len(result.stretches)} gaps without fixes",
        "Probability along the route with its 80 % interval and the lowest across the band; below, "
        "the predicted position error (1 sigma). Shaded: gaps without fixes.",
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
        for (row, col), share in np.ndenumerate(envelope.share):
            looks: dict[str, Any] = {"color": "white" if share < 0.55 else "black", "fontsize": 9}
            text = f"{100 * share:.0f}" if np.isfinite(share) else "-"
            axes.text(col, row, text, ha="center", va="center", **looks)
        axes.set_xticks(range(cols), [f"{100 * value:+.3g}" for value in envelope.agl_off])
        axes.set_yticks(range(rows), [f"{value:+.3g}" for value in envelope.yaw_off_deg])
        axes.set(xlabel="error of reported height (%)", ylabel="error of reported heading (deg)")
        axes.grid(visible=False)
        assert axes.figure is not None
        axes.figure.colorbar(shown, ax=axes, label="fraction of correct, confident fixes")

    size = (min(10.0, max(5.6, 2.2 + 0.62 * cols)), min(8.0, max(3.4, 1.2 + 0.42 * rows)))
    return Figure(
        "envelope",
        "Rate of correct, confident fixes over errors of reported heading and height. "
        + tolerance_sentence(envelope),
        "Rate of correct, confident fixes (%) over errors of reported heading and height.",
        draw_axes(size, draw),
    )


def page_jpeg(image: Background) -> bytes:
    for quality in _QUALITIES:
        data = jpeg(image.grey, quality)
        if len(data) <= MAX_BYTES:
            break
    return data


def visible_box(result: CheckResult) -> Box:
    """West, south, east, north in metres of cells and route, with a margin."""
    cells = result.cells
    rows, cols = np.nonzero(np.isfinite(cells.probability) | (cells.trials > 0))
    if not len(rows):
        height, width = cells.probability.shape
        rows, cols = np.array([0, height - 1]), np.array([0, width - 1])
    side = cells.side_m
    corners = [
        (cells.west_m + cols.min() * side, cells.north_m - (rows.max() + 1) * side),
        (cells.west_m + (cols.max() + 1) * side, cells.north_m - rows.min() * side),
    ]
    half_m = (result.band_m or 0.0) / 2
    if result.route_en_m is not None and len(result.route_en_m):
        corners += [tuple(result.route_en_m.min(0) - half_m)]
        corners += [tuple(result.route_en_m.max(0) + half_m)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = _MARGIN * float((high - low).max())
    west, south, east, north = (float(v) for v in (*(low - margin), *(high + margin)))
    return west, south, east, north


def map_image(opened: MapFile, box: Box) -> Background:
    sheet = SheetImagery(opened)
    limits = np.array(sheet.grid.extent_en_m)
    low, high = np.tile(limits[:2], 2), np.tile(limits[2:], 2)
    west, south, east, north = (float(edge) for edge in np.clip(box, low, high))
    width_m, height_m = east - west, north - south
    gsd_m = max(
        sheet.grid.gsd_m,
        max(width_m, height_m) / MAX_SIDE_PX,
        math.sqrt(width_m * height_m / MAX_AREA_PX),
    )
    size = max(1, round(width_m / gsd_m)), max(1, round(height_m / gsd_m))
    grey, valid = sheet.crop((west, south, east, north), size)
    grey[~valid] = _EMPTY
    return Background(grey, (west, south, east, north))
