"""One view beside the map: how well they agree in every cell of the ground.

Two kinds of evidence. *Structure*: the correlation of grey levels without local mean and contrast,
as registration compares them. *Tone*: the mean grey levels of view and map, from which
`orthonav.ground.changes.ground` takes light and exposure out.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, OrthonavError
from orthonav.core.flight.recording import Flight
from orthonav.core.geo.camera import Camera
from orthonav.core.localize.localizer import Localizer, RegistrationLocalizer
from orthonav.core.localize.view import PreparedView, check_view
from orthonav.core.mapfile import MapFile
from orthonav.core.mapfile.signature import map_digest
from orthonav.core.records import Fix, NoFix, Prior, View, ViewResult
from orthonav.core.register.channels import channels_of
from orthonav.core.register.pose import Pose
from orthonav.ground.changes.record import ChangedGround, ChangeGrid

CELLS_PER_VIEW = 8.0
"""Cells along the side of a view: each has some 16 x 16 pixels of the level it is compared at."""
MIN_COVER = 0.5
"""A view counts in the cells of which it shows at least this share."""
MIN_MOVE = 0.25
"""A view counts only if it moved by this share of its side since the last one that counted: views
of one place under one light are one view."""
MIN_BLOCKS_T = 2.5
"""Views whose blocks agree less at their place are left out (blur, cloud, a wrong position). Chance
reaches this in 0.6 % of views."""
TILT_DEG = 5.0
"""Unreported tilt that a view may be displaced by from where its fix puts it."""
AGL_STD, YAW_STD_DEG = 0.03, 2.0
"""Standard deviations of the height (a fraction of it) and heading of a fix."""
_GREY, _VALID = 2, 3

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SeenCells:
    """Cells (N,) that one view shows, as numbers row by row, and what it says of each.

    `structure`: correlation with the map, -1 to 1; `view_tone`, `map_tone`: mean grey levels.
    """

    cells: NDArray[np.intp]
    structure: Array
    view_tone: Array
    map_tone: Array


def cell_side_m(flights: Sequence[tuple[Camera, Sequence[ViewResult]]]) -> float | None:
    sides = [
        result.outcome.agl_m * math.sqrt(math.prod(camera.extent))
        for camera, results in flights
        for result in results
        if isinstance(result.outcome, Fix) and result.is_confident
    ]
    return float(np.median(sides)) / CELLS_PER_VIEW if sides else None


def views_beside_map(
    registration: RegistrationLocalizer,
    grid: ChangeGrid,
    flight: Flight,
    results: Sequence[ViewResult],
    progress: Callable[[float], None] = lambda share: None,
) -> Iterator[SeenCells]:
    """The confident views of a flight beside the map, without those that hardly moved or cannot be
    decoded. Raises `CameraError` where one has not the camera's size."""
    confident: Mapping[str, Fix] = {
        result.frame: result.outcome
        for result in results
        if isinstance(result.outcome, Fix) and result.is_confident
    }
    last, done = None, 0
    for view in flight.views:
        fix = confident.get(view.frame)
        if fix is None:
            continue
        done += 1
        progress(done / len(confident))
        place = grid.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
        side_m = fix.agl_m * math.sqrt(math.prod(flight.camera.extent))
        if last is not None and math.dist(place, last) < MIN_MOVE * side_m:
            continue
        try:
            shown = View(view.grey(), flight.camera, view.telemetry)
        except OrthonavError:
            continue
        seen = beside_map(registration, grid, shown, fix)
        if seen is not None:
            last = place
            yield seen


def beside_map(
    registration: RegistrationLocalizer, grid: ChangeGrid, view: View, fix: Fix
) -> SeenCells | None:
    pitch_deg, roll_deg = fix.tilt_deg(view.telemetry)
    telemetry = replace(
        view.telemetry,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
        yaw_deg=fix.heading_deg,
        agl_m=fix.agl_m,
        yaw_std_deg=YAW_STD_DEG,
        agl_std_m=AGL_STD * fix.agl_m,
    )
    view = replace(view, telemetry=telemetry)
    if check_view(view, registration.grid.gsd_m, heading_known=True) is not None:
        return None
    # Fixes of tiles and of earlier versions may not state the tilt.
    tilt_m = fix.agl_m * math.tan(math.radians(TILT_DEG))
    std_m = math.hypot(math.sqrt(float(np.trace(fix.cov_en_m2)) / 2), tilt_m)
    if not math.isfinite(std_m):
        return None
    found = registration.found(view, Prior(fix.lat_deg, fix.lon_deg, std_m))
    if isinstance(found, NoFix) or not found.place.fit.blocks_t >= MIN_BLOCKS_T:
        return None
    return _compared(registration, grid, found.search.view, found.place.pose)


def _compared(
    registration: RegistrationLocalizer, grid: ChangeGrid, view: PreparedView, pose: Pose
) -> SeenCells | None:
    level = view.levels.final
    rectified = view.rectified_at(level)
    shape = rectified.grey.shape
    map_grey, map_valid = _map_under(registration, pose, level, (shape[0], shape[1]))
    mine = channels_of(rectified.grey, rectified.valid)
    theirs = channels_of(map_grey, map_valid)
    counts = (mine[..., _VALID] > 0) & (theirs[..., _VALID] > 0)
    numbers = _cell_numbers(registration, grid, pose, 2.0**level, (shape[0], shape[1]))
    inside = counts & (numbers >= 0)
    if not inside.any():
        return None
    used, index = np.unique(numbers[inside], return_inverse=True)

    def sums(values: NDArray[np.generic]) -> Array:
        weights = values[inside].astype(np.float64)
        return np.asarray(np.bincount(index, weights, len(used)), np.float64)

    a, b = mine[..., _GREY], theirs[..., _GREY]
    pixels = sums(np.ones(shape))
    structure = sums(a * b) / np.sqrt(np.maximum(sums(a * a) * sums(b * b), 1e-9))
    pixel_m = registration.grid.gsd_m * 2**level * math.exp(pose.log_scale)
    kept = pixels >= MIN_COVER * (grid.side_m / pixel_m) ** 2
    if not kept.any():
        return None
    tones = [sums(each) / pixels for each in (rectified.grey, map_grey)]
    return SeenCells(used[kept], structure[kept], tones[0][kept], tones[1][kept])


def _map_under(
    registration: RegistrationLocalizer, pose: Pose, level: int, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Grey and valid (H, W) of the map as a view's window at `pose` shows it."""
    height, width = shape
    unit = 2.0**level
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
    at = pose.map_px(corners * unit) / unit
    low, high = np.floor(at.min(axis=0)).astype(int) - 2, np.ceil(at.max(axis=0)).astype(int) + 2
    size = high - low
    grey, valid = registration.pyramid.read(level, low[1], low[0], int(size[1]), int(size[0]))
    linear = pose.linear
    middle = np.array([pose.x_px, pose.y_px]) / unit - low
    # Pixel-is-area to pixel centres: source and target are both half a pixel off.
    move = middle - linear @ [width / 2 - 0.5, height / 2 - 0.5] - 0.5
    matrix = np.column_stack([linear, move])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(grey, matrix, (width, height), flags=flags)
    whole = cv2.warpAffine(valid.astype(np.uint8) * 255, matrix, (width, height), flags=flags)
    return np.asarray(warped, np.uint8), np.asarray(whole) > 252


def _cell_numbers(
    registration: RegistrationLocalizer,
    grid: ChangeGrid,
    pose: Pose,
    unit: float,
    shape: tuple[int, int],
) -> NDArray[np.intp]:
    """Number of the cell (H, W) under every pixel of a view's window, -1 outside the grid."""
    height, width = shape
    x = (np.arange(width) + 0.5 - width / 2) * unit
    y = (np.arange(height) + 0.5 - height / 2) * unit
    at = pose.map_px(np.stack(np.meshgrid(x, y), axis=-1))
    sheet = registration.grid
    east = sheet.west_m + at[..., 0] * sheet.gsd_m
    north = sheet.north_m - at[..., 1] * sheet.gsd_m
    return grid.numbers(np.stack([east, north], axis=-1))


# Chosen on the scenes of `benchmarks.changes` at d63ac91 (docs/changes.md).
TONE_WEIGHT, STRUCTURE_WEIGHT, BIAS = 2.0, 2.0, 3.0
"""Logit of a score: weights of the logarithm of 1 + the tone's deviation and of the correlation."""
CHANGED_SCORE = 0.5
SEVERAL_VIEWS = 2
"""With fewer views both kinds of evidence must say that a cell changed."""
LONE_STRUCTURE, LONE_TONE = 0.15, 3.0
"""A lone view shows change where structure correlates less and tone deviates more than this."""
ROUNDS = 3
"""Fits of the tone, each without the cells that changed by the one before."""
USUAL_FLOOR = 2.0
"""Least usual deviation of the tone, grey levels: noise of 8-bit pictures."""
GAINS = (0.4, 2.5)
"""Limits of the contrast of a view over that of the map."""
FLIGHT_CELLS = 2.0
"""The relation of the whole flight counts as much as so many cells that agree fully."""
_FLIGHT_SPREAD = 200.0
"""Variance of the tones (grey levels squared) that these cells stand for."""
_STEPS = 8
_LEAST_WEIGHT = 1e-3


def changed_ground(
    views: Sequence[SeenCells], grid: ChangeGrid, *, map_name: str = "", map_sha256: str = ""
) -> ChangedGround:
    count = grid.rows * grid.cols
    shown = np.zeros(count, np.int32)
    score, structure, tone = (np.full(count, np.nan) for _ in range(3))
    if views:
        cells = np.concatenate([each.cells for each in views])
        agreed = np.concatenate([each.structure for each in views])
        shown = np.bincount(cells, minlength=count).astype(np.int32)
        unchanged = np.ones(count)
        for _ in range(ROUNDS):
            off = _deviations(views, unchanged)
            logit = TONE_WEIGHT * np.log1p(off) - STRUCTURE_WEIGHT * agreed - BIAS
            score = 1 / (1 + np.exp(-_medians(logit, cells, count)))
            unchanged = 1 - np.nan_to_num(score)
        structure, tone = _medians(agreed, cells, count), _medians(off, cells, count)
    alone = (structure <= LONE_STRUCTURE) & (tone >= LONE_TONE)
    changed = (score >= CHANGED_SCORE) & ((shown >= SEVERAL_VIEWS) | alone)
    shape = grid.rows, grid.cols
    return ChangedGround(
        grid,
        score.reshape(shape),
        shown.reshape(shape),
        changed.reshape(shape),
        map_name,
        map_sha256,
    )


def _deviations(views: Sequence[SeenCells], unchanged: Array) -> Array:
    """How far the tone of every cell of every view is off, in units of what is usual."""
    weights = [
        np.clip(each.structure, 0, 1) * unchanged[each.cells] + _LEAST_WEIGHT for each in views
    ]
    mine = np.concatenate([each.view_tone for each in views])
    theirs = np.concatenate([each.map_tone for each in views])
    whole = np.concatenate(weights)
    usual = _relation(mine, theirs, whole, None)
    found = []
    for each, weight in zip(views, weights, strict=True):
        gain, offset = _relation(each.view_tone, each.map_tone, weight, usual)
        found.append(np.abs(each.view_tone - gain * each.map_tone - offset) / gain)
    off = np.concatenate(found)
    return off / max(_weighted_median(off, whole), USUAL_FLOOR)


def _relation(
    mine: Array, theirs: Array, weights: Array, usual: tuple[float, float] | None
) -> tuple[float, float]:
    """Gain and offset of tones (N,) of a view over those of the map, robust against cells that do
    not follow them (Cauchy weights)."""
    held = 0.0 if usual is None else FLIGHT_CELLS
    usual_gain, usual_offset = gain, offset = usual or (1.0, 0.0)
    now = weights
    for _ in range(_STEPS):
        total = now.sum()
        at, seen = (now @ theirs) / total, (now @ mine) / total
        spread = now @ (theirs - at) ** 2 + held * _FLIGHT_SPREAD
        product = now @ ((theirs - at) * (mine - seen)) + held * _FLIGHT_SPREAD * usual_gain
        gain = float(np.clip(product / max(spread, 1e-9), *GAINS)) if spread > 1e-9 else usual_gain
        # What the whole flight expects at the mean tone of these cells.
        expected = usual_gain * at + usual_offset
        offset = float((total * seen + held * expected) / (total + held) - gain * at)
        off = np.abs(mine - gain * theirs - offset)
        scale = float(weights @ off / weights.sum()) + USUAL_FLOOR
        now = weights / (1 + (off / scale) ** 2)
    return gain, offset


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    upto = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(upto, upto[-1] / 2)])


def _medians(values: Array, cells: NDArray[np.intp], count: int) -> Array:
    """Median (count,) of the values (N,) of each cell; NaN for cells without values.

    Of an even number of values the lower of the two in the middle: of two views both must disagree.
    """
    order = np.lexsort((values, cells))
    found = np.full(count, np.nan)
    used, first, number = np.unique(cells[order], return_index=True, return_counts=True)
    found[used] = values[order][first + (number - 1) // 2]
    return found


def changes_of_flight(
    opened: MapFile,
    flight: Flight,
    results: Sequence[ViewResult],
    progress: Callable[[float], None],
) -> ChangedGround | None:
    """Changed ground by the confident views of a flight; None without a confident view.

    Raises `MapFileError` for a map without a registration layer.
    """
    registration = Localizer(opened, level_ground=True).registration
    if registration is None:
        raise MapFileError(f"changes need a map with a registration layer: {opened.path}")
    side_m = cell_side_m([(flight.camera, results)])
    if side_m is None:
        return None
    grid = ChangeGrid.of_sheet(registration.sheet, side_m)
    views = list(views_beside_map(registration, grid, flight, results, progress))
    digest = map_digest(opened.path)
    return changed_ground(views, grid, map_name=opened.path.name, map_sha256=digest)
