"""Contact sheet: the worst views beside the map at the fix and at the true position, at one scale.

A view is rectified to nadir, north up, with the heading and height of its fix. The map is the grey
registration layer of the sheet in whose plane the comparison is.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError, OrthonavError
from orthonav.core.flight.recording import Flight, RecordedView
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.rectify import downsampled, rectify
from orthonav.core.localize.view import check_telemetry
from orthonav.core.records import Fix, Telemetry, View, ViewResult
from orthonav.core.register.window import GreyPyramid
from orthonav.ground.evaluate.calibration import is_covariance
from orthonav.ground.evaluate.metrics import Comparison
from orthonav.ground.report.canvas import BACKING, INK, RIGHT, SOFT, WRONG, Drawing, draw_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure, SubFigure

N_ROWS = 6
SIDE_PX = 260
"""Width of each image in pixels."""
MARGIN = 1.15
"""Width of an image relative to the view."""
MOST_READ_PX = 4 * SIDE_PX
"""Larger windows of the map are not read: no level is coarse enough."""
USUAL_SIDE_M = 200.0
"""Width of the map images where the footprint of the view is unknown."""
_NOTHING = "#F0E6D2"
_GREY_LEVELS = 40


@dataclass(frozen=True, eq=False)
class Cutout:
    """A north-up image.

    `grey`: grey levels (H, W), masked where there is no imagery.
    `extent_m`: west, east, south, north edges, from the position in the middle.
    """

    grey: "np.ma.MaskedArray[tuple[int, ...], np.dtype[np.uint8]]"
    extent_m: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Row:
    """One view of the contact sheet: its figures, and three images `side_m` wide.

    `state`, `error_m`, `sigma_m`, `confidence`: of the fix.
    `shift_en_m` (2,): from the true to the estimated position.
    `centre_en_m` (2,): from a position to the middle of the images, which a tilt displaces.
    `view`, `at_estimate`, `at_truth`: the rectified view, and the map at both positions.
    `why_not`, `why_no_map`: why one of these is None.
    """

    frame: str
    state: str
    error_m: float
    sigma_m: float
    confidence: float
    side_m: float
    shift_en_m: NDArray[np.float64]
    centre_en_m: NDArray[np.float64]
    view: Cutout | None
    at_estimate: Cutout | None
    at_truth: Cutout | None
    why_not: str = ""
    why_no_map: str = ""


def worst_rows(
    comparison: Comparison,
    results: Sequence[ViewResult],
    flight: Flight,
    pyramid: GreyPyramid,
    grid: TileGrid,
    count: int = N_ROWS,
) -> list[Row]:
    """The `count` fixes with the largest errors, those of state tracking first.

    `comparison` is made of `results`, in the plane of the sheet that `grid` and `pyramid` are of.
    Raises `MapFileError` where a chunk of the map is damaged.
    """
    by_frame = {result.frame: result for result in results}
    chosen = [by_frame[comparison.frames[i]] for i in worst_first(comparison, results, count)]
    wanted = {result.frame for result in chosen}
    views = {view.frame: view for view in flight.views if view.frame in wanted}
    places = {frame: i for i, frame in enumerate(comparison.frames)}
    return [
        _row(
            comparison, places[result.frame], result, views.get(result.frame), flight, pyramid, grid
        )
        for result in chosen
    ]


def worst_first(
    comparison: Comparison, results: Sequence[ViewResult], count: int = N_ROWS
) -> list[int]:
    """Indices of the views of `comparison` to show: tracking before others, large errors first."""
    states = {result.frame: result.state for result in results}
    fixes = [i for i, error_m in enumerate(comparison.errors_m) if math.isfinite(error_m)]
    fixes.sort(key=lambda i: (states[comparison.frames[i]] != "tracking", -comparison.errors_m[i]))
    return fixes[:count]


def sheet_picture(rows: Sequence[Row]) -> Drawing:
    """The rows as one drawing: view, map at the fix, map at the true position."""

    def draw(figure: "Figure") -> None:
        if not rows:
            axes = figure.add_subplot()
            axes.text(0.5, 0.5, "no view has a fix", ha="center", color=SOFT)
            axes.set_axis_off()
            return
        parts = np.atleast_1d(np.asarray(figure.subfigures(len(rows), 1, hspace=0.03)))
        for part, row in zip(parts, rows, strict=True):
            _draw_row(part, row)

    return draw_figure((9.6, 3.5 * max(len(rows), 0.4)), draw)


def row_text(row: Row) -> str:
    """The title of a row."""
    known = [row.frame, f"error {row.error_m:.1f} m"]
    known.append(f"sigma {row.sigma_m:.1f} m" if math.isfinite(row.sigma_m) else "sigma unknown")
    stated = math.isfinite(row.confidence)
    known.append(f"confidence {row.confidence:.3f}" if stated else "confidence unknown")
    return " · ".join(known + [row.state] * bool(row.state))


def _row(
    comparison: Comparison,
    place: int,
    result: ViewResult,
    view: RecordedView | None,
    flight: Flight,
    pyramid: GreyPyramid,
    grid: TileGrid,
) -> Row:
    fix_en_m, truth_en_m = comparison.fix_en_m[place], comparison.truth_en_m[place]
    covariance = comparison.cov_en_m2[place]
    usable = bool(is_covariance(covariance[None])[0])
    shown: Cutout | None = None
    side_m, centre_en_m, why_not = USUAL_SIDE_M, np.zeros(2), "this view is not in the flight"
    if view is not None:
        try:
            side_m, centre_en_m, shown = _view_cutout(view, flight.camera, result)
            why_not = ""
        except OrthonavError as error:
            why_not = str(error).removesuffix(f": {view.where}")
    maps = [_map_cutout(pyramid, grid, at, centre_en_m, side_m) for at in (fix_en_m, truth_en_m)]
    return Row(
        frame=result.frame,
        state=result.state or "",
        error_m=float(comparison.errors_m[place]),
        sigma_m=math.sqrt(np.linalg.eigvalsh(covariance)[-1]) if usable else math.nan,
        confidence=float(comparison.criteria["confidence"][place]),
        side_m=side_m,
        shift_en_m=fix_en_m - truth_en_m,
        centre_en_m=centre_en_m,
        view=shown,
        at_estimate=maps[0],
        at_truth=maps[1],
        why_not=why_not,
        why_no_map="the view is too wide for this map",
    )


def _view_cutout(
    view: RecordedView, camera: Camera, result: ViewResult
) -> tuple[float, NDArray[np.float64], Cutout]:
    """Width of the image in metres, its middle from the camera (2,), and the image.

    Raises `OrthonavError` with the reason where there is none.
    """
    used = as_fixed(view.telemetry, result)
    refused = check_telemetry(used, camera, None, heading_known=True)
    if refused is not None:
        raise FlightError(refused.detail)
    grey = view.grey()
    longer_m = max(camera.extent) * used.agl_m
    side_m = MARGIN * longer_m
    gsd_m = side_m / SIDE_PX
    made = rectify(
        downsampled(View(grey, camera, used), gsd_m),
        gsd_m=gsd_m,
        size_px=SIDE_PX,
    )
    east, north = (float(value) for value in made.offset_en_m)
    half = side_m / 2
    extent_m = east - half, east + half, north - half, north + half
    return side_m, made.offset_en_m, Cutout(np.ma.masked_where(~made.valid, made.grey), extent_m)


def as_fixed(telemetry: Telemetry, result: ViewResult) -> Telemetry:
    """`telemetry` with the heading, height and tilt that the fix states."""
    fix = result.outcome
    if not isinstance(fix, Fix):
        return telemetry
    pitch_deg, roll_deg = fix.tilt_deg(telemetry)
    return replace(
        telemetry,
        yaw_deg=fix.heading_deg if math.isfinite(fix.heading_deg) else telemetry.yaw_deg,
        agl_m=fix.agl_m if math.isfinite(fix.agl_m) else telemetry.agl_m,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
    )


def _map_cutout(
    pyramid: GreyPyramid,
    grid: TileGrid,
    position_en_m: NDArray[np.float64],
    centre_en_m: NDArray[np.float64],
    side_m: float,
) -> Cutout | None:
    """The map `side_m` wide, at the coarsest level that is fine enough; None where none is."""
    fine = math.log2(max(side_m / SIDE_PX / grid.gsd_m, 1.0))
    level = min(int(fine), pyramid.levels - 1)
    step_m = grid.gsd_m * 2**level
    size = math.ceil(side_m / step_m) + 2  # a pixel more on either side, the window is no multiple
    if not size <= MOST_READ_PX:
        return None
    middle = position_en_m + centre_en_m
    col = math.floor((middle[0] - side_m / 2 - grid.west_m) / step_m)
    row = math.floor((grid.north_m - middle[1] - side_m / 2) / step_m)
    grey, valid = pyramid.read(level, row, col, size, size)
    west = grid.west_m + col * step_m - position_en_m[0]
    north = grid.north_m - row * step_m - position_en_m[1]
    extent_m = tuple(map(float, (west, west + size * step_m, north - size * step_m, north)))
    assert len(extent_m) == 4
    return Cutout(np.ma.masked_where(~valid, grey), extent_m)


def _draw_row(part: "SubFigure", row: Row) -> None:
    colour = WRONG if row.state == "tracking" else INK
    part.suptitle(row_text(row), fontsize=10, color=colour, parse_math=False)
    titles = ("view", "map at the fix", "map at the true position")
    why = (row.why_not, row.why_no_map, row.why_no_map)
    cutouts = (row.view, row.at_estimate, row.at_truth)
    nothing = np.zeros(2)
    marks = (
        {"estimate": nothing},
        {"estimate": nothing, "truth": -row.shift_en_m},
        {"estimate": row.shift_en_m, "truth": nothing},
    )
    for axes, title, cutout, reason, marked in zip(
        part.subplots(1, 3), titles, cutouts, why, marks, strict=True
    ):
        axes.set_title(title, fontsize=9, color=SOFT)
        axes.set(facecolor=_NOTHING, xticks=[], yticks=[])
        axes.grid(visible=False)
        if cutout is None:
            axes.text(
                *(0.5, 0.5), _wrapped(reason), ha="center", va="center", color=SOFT, fontsize=9
            )
            axes.set(aspect="equal")
            continue
        _draw_cutout(axes, row, cutout)
        _draw_marks(axes, marked)


def _draw_cutout(axes: "Axes", row: Row, cutout: Cutout) -> None:
    known = cutout.grey.compressed()
    low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 255.0)
    axes.imshow(
        cutout.grey,
        cmap=_few_greys(),
        extent=cutout.extent_m,
        vmin=float(low),
        vmax=max(float(high), float(low) + 1.0),
        interpolation="none",
    )
    (east, north), half = row.centre_en_m, row.side_m / 2
    axes.set(xlim=(east - half, east + half), ylim=(north - half, north + half), aspect="equal")
    axes.annotate(
        f"{row.side_m:.0f} m wide",
        (0.02, 0.03),
        xycoords="axes fraction",
        fontsize=8,
        bbox=BACKING,
    )


def _few_greys() -> "Colormap":
    """Few grey levels, so that the palette of the PNG has room for the colours of the marks."""
    import matplotlib

    return matplotlib.colormaps["gray"].resampled(_GREY_LEVELS)


def _draw_marks(axes: "Axes", marked: dict[str, NDArray[np.float64]]) -> None:
    """A cross at the estimate, a ring at the true position, where they lie within the picture."""
    styles = {"estimate": ("+", RIGHT, 15.0), "truth": ("o", WRONG, 10.0)}
    for name, at in marked.items():
        mark, colour, size = styles[name]
        for width, tone in ((5.0, "white"), (2.6, colour)):
            axes.plot(
                *at,
                mark,
                color=tone,
                markersize=size,
                markeredgewidth=width,
                markerfacecolor="none",
                antialiased=False,  # shades would use up the palette
                scalex=False,
                scaley=False,
            )


def _wrapped(text: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, 34))
