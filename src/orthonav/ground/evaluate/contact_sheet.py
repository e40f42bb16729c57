"""Contact sheet: the worst views beside the map at the fix and at the true position, at one scale.

A view is rectified to nadir, north up, with the heading and height of its fix.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import OrthonavError
from orthonav.core.flight.recording import Flight, RecordedView
from orthonav.core.geo.camera import Camera
from orthonav.core.records import ViewResult
from orthonav.ground.evaluate.calibration import is_covariance
from orthonav.ground.evaluate.metrics import Comparison
from orthonav.ground.report.drawing import BACKING, INK, RIGHT, SOFT, WRONG, Drawing, draw_figure
from orthonav.ground.report.imagery import (
    GroundWindow,
    SheetImagery,
    as_fixed,
    rectified,
    window_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

N_ROWS = 6
SIDE_PX = 260
UNKNOWN = GroundWindow(200.0, SIDE_PX, (0.0, 0.0))
_NOTHING = "#F0E6D2"
_GREY_LEVELS = 40

Picture = np.ma.MaskedArray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True, eq=False)
class Row:
    """One view of the contact sheet, with three images (H, W), masked where there is no imagery.

    `shift_en_m` (2,): from the true to the estimated position; `why_not`: why `view` is None.
    """

    frame: str
    state: str
    error_m: float
    sigma_m: float
    confidence: float
    window: GroundWindow
    shift_en_m: NDArray[np.float64]
    view: Picture | None
    at_estimate: Picture
    at_truth: Picture
    why_not: str = ""


def worst_rows(
    comparison: Comparison,
    results: Sequence[ViewResult],
    flight: Flight,
    sheet: SheetImagery,
    count: int = N_ROWS,
) -> list[Row]:
    """The `count` fixes with the largest errors, those of state tracking first, in the plane of
    `sheet`."""
    by_frame = {result.frame: result for result in results}
    chosen = worst_first(comparison, results, count)
    wanted = {comparison.frames[i] for i in chosen}
    views = {view.frame: view for view in flight.views if view.frame in wanted}
    return [
        _row(comparison, i, by_frame[frame], views.get(frame), flight.camera, sheet)
        for i, frame in ((i, comparison.frames[i]) for i in chosen)
    ]


def worst_first(
    comparison: Comparison, results: Sequence[ViewResult], count: int = N_ROWS
) -> list[int]:
    states = {result.frame: result.state for result in results}
    fixes = [i for i, error_m in enumerate(comparison.errors_m) if math.isfinite(error_m)]
    fixes.sort(key=lambda i: (states[comparison.frames[i]] != "tracking", -comparison.errors_m[i]))
    return fixes[:count]


def _row(
    comparison: Comparison,
    place: int,
    result: ViewResult,
    view: RecordedView | None,
    camera: Camera,
    sheet: SheetImagery,
) -> Row:
    fix_en_m, truth_en_m = comparison.fix_en_m[place], comparison.truth_en_m[place]
    covariance = comparison.cov_en_m2[place]
    usable = bool(is_covariance(covariance[None])[0])
    window, shown, why_not = UNKNOWN, None, "this view is not in the flight"
    if view is not None:
        try:
            telemetry = as_fixed(view.telemetry, result)
            window = replace(window_of(telemetry, camera, sheet.grid.gsd_m), size_px=SIDE_PX)
            shown, why_not = _picture(*rectified(view.grey(), telemetry, camera, window)), ""
        except OrthonavError as error:
            why_not = str(error).removesuffix(f": {view.where}")
    at_estimate, at_truth = (
        _picture(*sheet.crop(window.box_at(at), (SIDE_PX, SIDE_PX)))
        for at in (fix_en_m, truth_en_m)
    )
    return Row(
        frame=result.frame,
        state=result.state or "",
        error_m=float(comparison.errors_m[place]),
        sigma_m=math.sqrt(np.linalg.eigvalsh(covariance)[-1]) if usable else math.nan,
        confidence=float(comparison.criteria["confidence"][place]),
        window=window,
        shift_en_m=fix_en_m - truth_en_m,
        view=shown,
        at_estimate=at_estimate,
        at_truth=at_truth,
        why_not=why_not,
    )


def _picture(grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> Picture:
    return np.ma.masked_where(~valid, grey)


def row_text(row: Row) -> str:
    known = [row.frame, f"error {row.error_m:.1f} m"]
    known.append(f"sigma {row.sigma_m:.1f} m" if math.isfinite(row.sigma_m) else "sigma unknown")
    stated = math.isfinite(row.confidence)
    known.append(f"confidence {row.confidence:.3f}" if stated else "confidence unknown")
    return " · ".join(known + [row.state] * bool(row.state))


def sheet_picture(rows: Sequence[Row]) -> Drawing:
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


def _draw_row(part: "SubFigure", row: Row) -> None:
    colour = WRONG if row.state == "tracking" else INK
    part.suptitle(row_text(row), fontsize=10, color=colour, parse_math=False)
    nothing = np.zeros(2)
    drawn = (
        ("view", row.view, nothing, None),
        ("map at the fix", row.at_estimate, nothing, -row.shift_en_m),
        ("map at the true position", row.at_truth, row.shift_en_m, nothing),
    )
    for axes, (title, picture, estimate, truth) in zip(part.subplots(1, 3), drawn, strict=True):
        axes.set_title(title, fontsize=9, color=SOFT)
        axes.set(facecolor=_NOTHING, xticks=[], yticks=[], aspect="equal")
        axes.grid(visible=False)
        if picture is None:
            why = "\n".join(textwrap.wrap(row.why_not, 34))
            axes.text(0.5, 0.5, why, ha="center", va="center", color=SOFT, fontsize=9)
            continue
        _draw_picture(axes, row.window, picture)
        _draw_mark(axes, "+", estimate, RIGHT, 15.0)
        if truth is not None:
            _draw_mark(axes, "o", truth, WRONG, 10.0)


def _draw_picture(axes: "Axes", window: GroundWindow, picture: Picture) -> None:
    import matplotlib

    known = picture.compressed()
    low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 255.0)
    west, south, east, north = window.box_at(np.zeros(2))
    axes.imshow(
        picture,
        # Few grey levels leave the palette of the PNG room for the colours of the marks.
        cmap=matplotlib.colormaps["gray"].resampled(_GREY_LEVELS),
        extent=(west, east, south, north),
        vmin=float(low),
        vmax=max(float(high), float(low) + 1.0),
        interpolation="none",
    )
    width = f"{window.side_m:.0f} m wide"
    axes.annotate(width, (0.02, 0.03), xycoords="axes fraction", fontsize=8, bbox=BACKING)


def _draw_mark(axes: "Axes", mark: str, at: NDArray[np.float64], colour: str, size: float) -> None:
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
