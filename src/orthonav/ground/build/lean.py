"""How houses and trees lean in an orthophoto made over bare earth, and heights where it shows them.

A point at a height above the terrain is displaced by that height times the lean: away from below
the camera, by the tangent of the angle at which it was seen."""

import math
from collections.abc import Callable, Iterator
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.ground import UNKNOWN_LEAN
from orthonav.core.mapfile.manifest import Lean
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area

TRUE_ORTHO = Lean(0.0, 0.0, 0.0)
STEP = 0.05
"""Of the leans per axis that are looked for; half of it is the least error."""
POSTING_M = 0.5  # where it is looked for
HIGHEST_M = 100.0
MIN_EDGES = 2000  # pixels on edges of houses
Array = NDArray[np.float64]
PlaneSampler = Callable[[float, float, float, int, int], Array]
"""Takes the arguments of `Dem.in_plane`, without the plane: west and north of a corner, posting,
rows, columns; NaN where unknown."""


def visible_lean(imagery: Mosaic, above: PlaneSampler, area: Area) -> Lean | None:
    """The lean at which edges of the picture fit those of houses best; None where none stands out,
    or where windows differ as much as leans that are not known.

    Shadows end along displaced edges too, but on two sides of a house only."""
    leans = np.arange(-0.5, 0.5 + STEP / 2, STEP)
    total, edges, alone = np.zeros((len(leans), len(leans))), 0, []
    for grey, high in _windows(imagery, above, area):
        strength, count = _fits(grey, high, leans)
        total += strength
        edges += count
        if count >= MIN_EDGES and (best := _best(strength, leans)) is not None:
            alone.append(best)
    found = _best(total, leans) if edges >= MIN_EDGES else None
    if found is None:
        return None
    spread = max((max(abs(e - found[0]), abs(n - found[1])) for e, n in alone), default=0.0)
    if spread >= UNKNOWN_LEAN.std:
        return None
    return Lean(*found, max(spread, STEP))


def _best(strength: Array, leans: Array) -> tuple[float, float] | None:
    """East and north, of sums of `_fits`; None where the best is less than 1.3 of the median.

    The best must also be 1.1 of that of upright houses. In generated towns and a real wooded valley
    it is 1.4 to 1.9 of the first, and 1.15 to 1.4 of the second where they lean by 0.15 or more."""
    scores, upright = cv2.blur(strength, (3, 3)), len(leans) // 2
    row, col = divmod(int(scores.argmax()), len(leans))
    if scores[row, col] < 1.1 * scores[upright, upright]:
        row = col = upright
    at_rim = {row, col} & {0, len(leans) - 1}
    if at_rim or not scores[row, col] > 1.3 * float(np.median(scores)):
        return None
    east, north = (round(float(leans[each]), 2) + 0.0 for each in (col, row))  # no -0.0
    return east, north


def _windows(
    imagery: Mosaic, above: PlaneSampler, area: Area
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Grey and heights (H, W), NaN where unknown, of windows spread over the area: at most three
    of 600 px along each side."""
    west, south, east, north = area.extent_en_m
    sides_m = np.array([east - west, north - south])
    cols, rows = (min(round(side / POSTING_M), 600) for side in sides_m.tolist())
    if min(rows, cols) < 2:
        return
    left_m = sides_m - np.array([cols, rows]) * POSTING_M
    counts = np.minimum(np.ceil(sides_m / (600 * POSTING_M)), 3).astype(int)
    for down, right in product(_spread(counts[1]), _spread(counts[0])):
        corner = west + right * left_m[0], north - down * left_m[1]
        high = above(*corner, POSTING_M, rows, cols)
        with imagery.sheet(
            area.frame,
            west_m=corner[0],
            north_m=corner[1],
            width_px=cols,
            height_px=rows,
            gsd_m=POSTING_M,
        ) as sheet:
            read = sheet.read_grey(0, 0, cols, rows)
        grey = np.where(read.valid, read.grey, np.nan).astype(np.float32)
        yield grey, high.astype(np.float32)


def _spread(count: int) -> list[float]:
    """From 0 to 1; in the middle where it is one."""
    return [0.5] if count == 1 else np.linspace(0, 1, count).tolist()


def _fits(grey: NDArray[np.float32], high: NDArray[np.float32], leans: Array) -> tuple[Array, int]:
    """Sums (leans, leans), north by east, of the picture's gradients across edges of heights, each
    displaced, over those around; and the number of edge pixels."""
    right, up = (np.nan_to_num(each) for each in _gradients(grey))
    size = np.hypot(right, up)
    usual = cv2.blur(size, (31, 31)) + 0.2 * float(size.mean()) + 1e-6
    low = cv2.erode(np.nan_to_num(high, nan=np.inf), np.ones((3, 3), np.uint8))
    # The upper side of edges that are higher than 2 m.
    rows, cols = np.nonzero((high - low > 2.0) & np.isfinite(grey))
    across_right, across_up = (np.nan_to_num(each)[rows, cols] for each in _gradients(high))
    steep = np.maximum(np.hypot(across_right, across_up), 1e-6)
    moved_px = high[rows, cols] / POSTING_M
    strength = np.zeros((len(leans), len(leans)))
    for (row, north), (col, east) in product(enumerate(leans), enumerate(leans)):
        y = np.clip(np.rint(rows - north * moved_px), 0, len(grey) - 1).astype(np.intp)
        x = np.clip(np.rint(cols + east * moved_px), 0, grey.shape[1] - 1).astype(np.intp)
        across = (across_right * right[y, x] + across_up * up[y, x]) / (steep * usual[y, x])
        strength[row, col] = np.abs(across).sum()
    return strength, len(rows)


def _gradients(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """To the right and up."""
    return (
        np.asarray(cv2.Sobel(values, cv2.CV_32F, 1, 0), np.float32),
        -np.asarray(cv2.Sobel(values, cv2.CV_32F, 0, 1), np.float32),
    )


def as_shown(above: PlaneSampler, lean: Lean) -> PlaneSampler:
    """Heights where a picture with this lean shows them: the higher of two at one place; NaN for
    walls. Heights above `HIGHEST_M` are displaced as these."""
    if not (lean.east or lean.north):
        return above

    def shown(west_m: float, north_m: float, posting_m: float, rows: int, cols: int) -> Array:
        rim = math.ceil(max(abs(lean.east), abs(lean.north)) * HIGHEST_M / posting_m)
        corner = west_m - rim * posting_m, north_m + rim * posting_m
        high = above(*corner, posting_m, rows + 2 * rim, cols + 2 * rim)
        moved = np.clip(np.nan_to_num(high), 0.0, HIGHEST_M) / posting_m
        down, right = np.indices(high.shape)
        row = np.rint(down - lean.north * moved).astype(np.intp) - rim
        col = np.rint(right + lean.east * moved).astype(np.intp) - rim
        inside = np.isfinite(high) & (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        made = np.full((rows, cols), -np.inf)
        np.maximum.at(made, (row[inside], col[inside]), high[inside])
        return _filled(np.where(np.isinf(made), np.nan, made))

    return shown


def _filled(high: Array) -> Array:
    """With means in holes among known neighbours, which sloping roofs leave."""
    known = np.isfinite(high)
    share = cv2.blur(known.astype(np.float64), (3, 3))
    mean = cv2.blur(np.where(known, high, 0.0), (3, 3)) / np.maximum(share, 1e-9)
    return np.where(~known & (share > 0.5), mean, high)
