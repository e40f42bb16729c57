"""Maps of an evaluation: what part is seen, the picture below, scale bar and north arrow."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from orthonav.evaluate.canvas import DPI, INK, OFFSET
from orthonav.evaluate.figures import BoolArray, FloatArray
from orthonav.evaluate.metrics import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BACKGROUND_LEVELS = 16  # few grey levels keep the PNG small


@dataclass(frozen=True, eq=False)
class Background:
    """A grey picture under the map: `grey` (rows, columns) uint8, north up.

    Its outer edges are in metres east and north in the plane of the comparison it is drawn under.
    """

    grey: NDArray[np.uint8]
    west_m: float
    south_m: float
    east_m: float
    north_m: float


def view_box(comparison: Comparison, radius_m: float) -> tuple[float, float, float, float]:
    """West, east, south, north: the flight, and what of its fixes is near to it."""
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


def draw_background(axes: "Axes", background: Background, box: tuple[float, ...]) -> None:
    """The part of the picture that is seen, pale and in few grey levels."""
    rows, columns = background.grey.shape
    west, south = background.west_m, background.south_m
    east_step = (background.east_m - west) / columns
    north_step = (background.north_m - south) / rows
    left, right = (int(np.clip((x - west) / east_step, 0, columns)) for x in box[:2])
    below, above = (int(np.clip((y - south) / north_step, 0, rows)) for y in box[2:])
    right, above = min(right + 1, columns), min(above + 1, rows)
    seen = background.grey[rows - above : rows - below, left:right]
    if seen.size == 0:
        return
    step = max(1, math.ceil(max(seen.shape) / (7.5 * DPI)))
    seen = seen[: seen.shape[0] // step * step, : seen.shape[1] // step * step]
    coarse = seen.reshape(seen.shape[0] // step, step, -1, step).mean(axis=(1, 3))
    levels = np.round(coarse / 255 * (_BACKGROUND_LEVELS - 1)) / (_BACKGROUND_LEVELS - 1)
    extent = (
        west + left * east_step,
        west + (left + coarse.shape[1] * step) * east_step,
        south + (above - coarse.shape[0] * step) * north_step,
        south + above * north_step,
    )
    axes.imshow(
        0.45 + 0.55 * levels, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest"
    )
    axes.grid(visible=False)


def draw_scale_bar(axes: "Axes", box: tuple[float, ...]) -> None:
    """A bar of a round length in the corner at the bottom left."""
    width_m, height_m = box[1] - box[0], box[3] - box[2]
    length_m = _round_length(0.25 * min(width_m, height_m))
    x, y = box[0] + 0.04 * width_m, box[2] + 0.04 * height_m
    for width, colour in ((6, "white"), (3, INK)):
        axes.plot([x, x + length_m], [y, y], color=colour, linewidth=width, zorder=8)
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    backing = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5}
    axes.annotate(
        text, (x + length_m / 2, y), (0, 6), **OFFSET, ha="center", zorder=8, bbox=backing
    )


def draw_north(axes: "Axes") -> None:
    """An arrow to the north in the corner at the top right."""
    axes.annotate(
        "N",
        xy=(0.965, 0.975),
        xytext=(0.965, 0.89),
        xycoords="axes fraction",
        ha="center",
        weight="bold",
        zorder=8,
        arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.6, "shrinkA": 1},
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5},
    )


def _round_length(length_m: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above `length_m`."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= length_m * (1 + 1e-9))
