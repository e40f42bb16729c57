"""Candidates: where, and how turned and scaled, a view might lie in a window of the map.

The view's channels are laid at every position by FFT, for each heading and scale of a bank.
Channels of the map are divided by their local energy beforehand: one backward transform gives the
sum of all kinds. Correlation times the root of its pixels makes chance alike at every scale."""

import math
import threading
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import counted_from_centres
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.template import (
    GROUPS,
    ChannelRecipe,
    Template,
    energy_of,
    turned_planes,
)
from orthonav.core.register.window import (
    MAX_SIDE_PX,
    DirectionPrior,
    Pose,
    Reference,
    ScaleMap,
    cut,
    even_scale,
    rotation,
)

Array = NDArray[np.float32]
Direction = tuple[float, float]
"""Heading (rad, clockwise from north) and natural logarithm of the scale."""
Steps = tuple[float, float]  # of headings (rad) and log scales
DIRECTIONS_AT_ONCE = 6
PLACES_AT_ONCE = 50
WIDE = 8  # columns or rows that the kernel transforms together


@dataclass(frozen=True)
class EnergyFloor:
    """Least values that channels of the map are divided by."""

    share: float = 0.3  # of the typical energy, so that blank ground is not amplified
    count: float = 0.1  # of the valid share around a pixel, so that none is divided by zero


FLOOR = EnergyFloor()


def bank(
    heading_std_rad: float | None,
    log_scale_std: float,
    *,
    heading_step_rad: float,
    scale_step: float,
    sigmas: float,
) -> list[tuple[float, float]]:
    """Turns (rad) and log scales within `sigmas`, each with each; all turns where `None`."""
    if heading_std_rad is None or sigmas * heading_std_rad + heading_step_rad / 2 >= math.pi:
        count = math.ceil(2 * math.pi / heading_step_rad)
        turns = np.arange(count, dtype=np.float64) * (2 * math.pi / count)
    else:
        turns = _spread(sigmas * heading_std_rad, heading_step_rad)
    scales = _spread(sigmas * log_scale_std, scale_step)
    return [(float(turn), float(scale)) for scale in scales for turn in turns]


def _spread(reach: float, step: float) -> NDArray[np.float64]:
    """Around 0, so that nothing within `reach` is farther than half a step."""
    count = max(1, math.ceil(2 * reach / step))
    return (np.arange(count, dtype=np.float64) - (count - 1) / 2) * step


def rated_directions(
    prior: DirectionPrior, steps: Steps, sigmas: float, max_penalty: float
) -> list[tuple[Direction, float]]:
    """Directions within `sigmas`, with penalties by the prior up to `max_penalty`, the most likely
    first."""
    heading_std_rad = None if prior.heading_rad is None else prior.heading_std_rad
    reported = prior.heading_rad or 0.0
    return [
        ((reported + turn, log_scale), penalty)
        for turn, log_scale, penalty in _rated(heading_std_rad, prior.log_scale_std, steps, sigmas)
        if penalty <= max_penalty
    ]


@lru_cache(64)
def _rated(
    heading_std_rad: float | None, log_scale_std: float, steps: Steps, sigmas: float
) -> list[tuple[float, float, float]]:
    """Cached: the standard deviations are mostly those of the view before."""
    made = bank(
        heading_std_rad,
        log_scale_std,
        heading_step_rad=steps[0],
        scale_step=steps[1],
        sigmas=sigmas,
    )
    known = heading_std_rad is not None
    prior = DirectionPrior(0.0 if known else None, heading_std_rad or 0.0, log_scale_std)
    cell = steps[0] / 2, steps[1] / 2
    rated = [(*offset, prior.penalty(*offset, within=cell)) for offset in made]
    return sorted(rated, key=lambda each: each[2])


class Peak(NamedTuple):
    score: float
    pose: Pose


class SearchWindow:
    """Channels (H, W, 4) of the map at a level, first pixel (`row`, `col`), ready to be searched
    for views of about `view_px`, none within `margin_px` of the border; `half_px`: largest
    `posed_half_px`."""

    def __init__(
        self,
        made: Array,
        level: int,
        row: int,
        col: int,
        view_px: int,
        margin_px: int = 0,
        half_px: int | None = None,
    ) -> None:
        self.level, self.row, self.col, self.margin_px = level, row, col, margin_px
        self.height, self.width = made.shape[:2]
        if half_px is None:
            # Beyond the border the other side shows: harmless where the window is far larger.
            pad, least = view_px if min(self.height, self.width) < 3 * view_px else 0, view_px
        else:
            # A view reaches so far beyond the border; beyond it is nothing.
            pad, least = max(half_px - margin_px, 0), 2 * half_px
        self.size = (
            cv2.getOptimalDFTSize(max(self.height + pad, least)),
            cv2.getOptimalDFTSize(max(self.width + pad, least)),
        )
        self._made, self._view_px = made, view_px

    @classmethod
    def around(
        cls,
        reference: Reference,
        template: Template,
        view_px: float,
        centre_px: tuple[float, float],
        reach_px: float,
        half_px: int | None = None,
    ) -> "SearchWindow":
        """The square whose middles of views reach `reach_px` (level 0) around a point (x, y)."""
        unit = 2.0**template.level
        margin = math.ceil(view_px / 2 / unit)
        rows, cols = reference.shape(template.level)
        low, size = [], []
        for middle, extent in zip(centre_px, (cols, rows), strict=True):
            # Middles farther out than half a view see nothing of the sheet.
            first = math.floor(max((middle - reach_px) / unit, -margin))
            last = math.ceil(min((middle + reach_px) / unit + 2, extent + margin))
            low.append(first - margin)
            size.append(max(last - first, 1) + 2 * margin)
        (col, row), (width, height) = low, size
        made = reference.window(template.level, row, col, height, width, template.recipe)
        return cls(made, template.level, row, col, _rounded_side(view_px / unit), margin, half_px)

    @cached_property
    def channels(self) -> Array:
        """Divided by their local energy."""
        return self._normalized()

    @cached_property
    def spectra(self) -> NDArray[np.complex64]:
        """Padded to `size`; the channels are not kept."""
        return self._transformed()

    @cached_property
    def spectra_by_columns(self) -> Array:
        """As the kernel takes them (G, 3, h, 16): eight columns, real parts first."""
        spectra = self._transformed()
        channels, rows, cols = spectra.shape
        out = np.zeros((-(-cols // WIDE), channels, rows, 2, WIDE), np.float32)
        for group, into in enumerate(out):
            some = spectra[..., WIDE * group : WIDE * (group + 1)]
            into[..., 0, : some.shape[2]], into[..., 1, : some.shape[2]] = some.real, some.imag
        return out.reshape(len(out), channels, rows, 2 * WIDE)

    @property
    def by_kernel(self) -> bool:
        return KERNEL is not None and max(self.size) <= MAX_SIDE_PX

    def prepare(self, template: Template) -> None:
        """What threads share, once."""
        _ = self.spectra_by_columns if self.by_kernel else (self.spectra, template.interleaved)

    def prepare_near(self, template: Template) -> None:
        _ = self.channels
        if KERNEL is None:
            _ = template.interleaved

    def _transformed(self) -> NDArray[np.complex64]:
        planes = np.moveaxis(self._normalized(), 2, 0)
        return np.asarray(np.fft.rfft2(planes, s=self.size, axes=(1, 2)), np.complex64)

    def _normalized(self) -> Array:
        groups = (self._made[..., group] for group in GROUPS)
        made = [_by_local_energy(group, self._made[..., 3], self._view_px) for group in groups]
        return np.concatenate(made, axis=2)


def _by_local_energy(channels: Array, counts: Array, view_px: int) -> Array:
    """Root of the mean energy in windows as large as views."""
    energy = np.einsum("ijc,ijc->ij", channels, channels)
    side = min(max(3, view_px // 2), 2 * min(energy.shape) - 1)
    valid = np.maximum(cv2.blur(counts, (side, side)), FLOOR.count)
    local = cv2.blur(energy, (side, side)) / valid
    typical = float(energy.sum() / max(counts.sum(), 1.0))
    return np.asarray(channels / np.sqrt(local + FLOOR.share * typical + 1e-12)[..., None])


class SearchWindows:
    """Of one whole sheet; threads may share it."""

    def __init__(self, reference: Reference) -> None:
        self._reference = reference
        self._windows: dict[tuple[int, ChannelRecipe, int], SearchWindow] = {}
        self._lock = threading.Lock()

    def whole(self, template: Template, view_px: float) -> SearchWindow:
        """Views of about the same size share it."""
        level, recipe = template.level, template.recipe
        side = _rounded_side(view_px / 2**level)
        key = (level, recipe, side)
        with self._lock:
            found = self._windows.pop(key, None)
            if found is None:
                found = SearchWindow(self._reference.whole(level, recipe), level, 0, 0, side)
                while len(self._windows) >= 4:
                    self._windows.pop(next(iter(self._windows)))
            self._windows[key] = found  # the least recently used one is the first
        return found


def _rounded_side(side: float) -> int:
    """By steps of about a quarter, so that views of like size share a window."""
    return math.ceil(2 ** (math.ceil(4 * math.log2(max(side, 8.0))) / 4))


def search(
    template: Template,
    window: SearchWindow,
    directions: list[Direction],
    count: int,
    scales: ScaleMap | None = None,
    pool: Executor | None = None,
) -> list[Peak]:
    """The `count` best candidates, best first, at least an eighth of the view apart.

    `scales`: only those expected at a place are compared. Results do not depend on `pool`."""
    share = max(1, len(directions)) if pool is None else DIRECTIONS_AT_ONCE
    parts = [range(at, min(at + share, len(directions))) for at in range(0, len(directions), share)]
    window.prepare(template)
    surfaces = (pool.map if pool else map)(
        lambda part: _best_of(template, window, directions, part, scales), parts
    )
    best, which = next(surfaces)
    for scores, numbers in surfaces:
        better = cv2.compare(scores, best, cv2.CMP_GT)
        cv2.copyTo(scores, better, best)
        cv2.copyTo(numbers, better, which)
    if window.margin_px:
        inner = np.zeros(best.shape, np.bool_)
        inner[window.margin_px : -window.margin_px, window.margin_px : -window.margin_px] = True
        best[~inner] = -np.inf
    apart = max(1, round(math.sqrt(template.pixels) / 8))
    peaks = _peaks(best, count, apart)
    unit = 2.0**template.level
    found = []
    for row, col in peaks:
        x, y = _between(best, row, col)
        turn, log_scale = directions[int(which[row, col])]
        pose = Pose((window.col + x) * unit, (window.row + y) * unit, turn, log_scale)
        found.append(Peak(float(best[row, col]), pose))
    return found


def search_around(
    template: Template,
    reference: Reference,
    directions: list[Direction],
    centre_px: tuple[float, float],
    reach_px: float,
    view_px: float,
    count: int,
    scales: ScaleMap | None = None,
) -> list[Peak]:
    """`search` for views whose middles lie within `reach_px` of a point (x, y), level 0."""
    half_px = largest_half_px(template, directions)
    window = SearchWindow.around(reference, template, view_px, centre_px, reach_px, half_px)
    return search(template, window, directions, count, scales)


def best_near(
    template: Template, window: SearchWindow, poses: Sequence[Pose], reach_px: float
) -> list[Peak]:
    """Within `reach_px` (level 0) of each pose, along each axis, under its heading and scale."""
    unit = 2.0**template.level
    reach = math.ceil(reach_px / unit)
    places = np.array(
        [
            (p.x_px / unit - window.col, p.y_px / unit - window.row, p.heading_rad, p.log_scale)
            for p in poses
        ]
    ).reshape(-1, 4)
    found = np.empty((len(places), 3))
    if KERNEL is None:
        for place, into in zip(places, found, strict=True):
            into[:] = _best_near(template, window, place, reach)
    else:
        KERNEL.near(window.channels, template.values, template.weights, places, reach, found)
    found[:, 1] = (window.col + found[:, 1]) * unit
    found[:, 2] = (window.row + found[:, 2]) * unit
    return [
        Peak(score, Pose(x, y, pose.heading_rad, pose.log_scale))
        for (score, x, y), pose in zip(found.tolist(), poses, strict=True)
    ]


def _best_near(
    template: Template, window: SearchWindow, place: NDArray[np.float64], reach: int
) -> tuple[float, float, float]:
    """Score, x and y near (x, y, turn, log scale), pixels of the window; without the kernel."""
    x, y, turn, log_scale = place.tolist()
    half = posed_half_px(template, log_scale)
    # Middles of views lie on first corners of pixels, from these on.
    row, col = round(y) - reach, round(x) - reach
    posed = posed_channels(template, turn, log_scale)
    around = cut(window.channels, row - half, col - half, *2 * [2 * (half + reach)])
    surface = np.asarray(
        cv2.matchTemplate(around, np.ascontiguousarray(np.moveaxis(posed, 0, 2)), cv2.TM_CCORR),
        np.float32,
    )
    down, right = divmod(int(surface.argmax()), surface.shape[1])
    x, y = _between(surface, down, right)
    return float(surface[down, right]), col + x, row + y


def _best_of(
    template: Template,
    window: SearchWindow,
    directions: list[Direction],
    part: range,
    scales: ScaleMap | None,
) -> tuple[Array, NDArray[np.int32]]:
    """Best score (H, W) at every place, and the number of its direction."""
    shape = window.height, window.width
    expected = None if scales is None else scales.over(window.level, window.row, window.col, shape)
    if window.by_kernel:
        return _best_by_kernel(template, window, directions, part, scales, expected)
    best = np.full(shape, -np.inf, np.float32)
    which = np.zeros(shape, np.int32)
    numbers = np.empty(shape, np.int32)
    for number in part:
        turn, log_scale = directions[number]
        scores = _scores(template, window, turn, log_scale)
        if scores is None:
            continue
        better = cv2.compare(scores, best, cv2.CMP_GT)
        if scales is not None and expected is not None:
            low, high = scales.reach(log_scale)
            better = cv2.bitwise_and(better, cv2.inRange(expected, low, high))
        numbers.fill(number)
        cv2.copyTo(scores, better, best)
        cv2.copyTo(numbers, better, which)
    return best, which


def _best_by_kernel(
    template: Template,
    window: SearchWindow,
    directions: list[Direction],
    part: range,
    scales: ScaleMap | None,
    expected: Array | None,
) -> tuple[Array, NDArray[np.int32]]:
    """The same; `expected` (H, W): log scales."""
    bands = -(-window.height // (2 * WIDE))
    best = np.full((bands, window.size[1], 2 * WIDE), -np.inf, np.float32)
    which = np.zeros(best.shape, np.int32)
    reach = (-math.inf, math.inf)
    tried = np.array(
        [
            (turn, log_scale, *(scales.reach(log_scale) if scales else reach))
            for turn, log_scale in (directions[number] for number in part)
        ]
    )
    KERNEL.search(
        *(window.spectra_by_columns, template.values, template.weights, tried, part.start),
        *(best, which, None if expected is None else _in_bands(expected, best.shape)),
    )
    return _from_bands(best, window), _from_bands(which, window)


def _in_bands(values: Array, shape: tuple[int, ...]) -> Array:
    """(B, C, 16) for the kernel: bands of sixteen rows, column by column; NaN beyond."""
    bands, cols, rows = shape
    out = np.full((bands * rows, cols), np.nan, np.float32)
    out[: values.shape[0], : values.shape[1]] = values
    return np.ascontiguousarray(out.reshape(bands, rows, cols).swapaxes(1, 2))


def _from_bands(values: NDArray[Any], window: SearchWindow) -> NDArray[Any]:
    """The inverse."""
    rows = values.swapaxes(1, 2).reshape(-1, values.shape[1])
    return np.ascontiguousarray(rows[: window.height, : window.width])


def _scores(
    template: Template, window: SearchWindow, turn: float, log_scale: float
) -> Array | None:
    """Of the view's middle on each pixel's first corner; None if it does not fit."""
    side = 2 * posed_half_px(template, log_scale)
    if side > min(window.size):
        return None
    total = np.zeros(window.spectra.shape[1:], np.complex64)
    posed = posed_channels(template, turn, log_scale)
    for spectrum, channel in zip(window.spectra, posed, strict=True):
        canvas = np.zeros(window.size, np.float32)
        canvas[:side, :side] = channel
        # The middle goes to the first pixel, what lies before it wraps to the end.
        canvas = np.roll(canvas, (-side // 2, -side // 2), axis=(0, 1))
        total += spectrum * np.conj(np.fft.rfft2(canvas))
    surface = np.fft.irfft2(total, s=window.size)
    return np.asarray(surface, np.float32)[: window.height, : window.width]


def posed_half_px(template: Template, log_scale: float) -> int:
    """Half the side of the square in which a template fits under any turn."""
    return math.ceil(math.exp(log_scale) * math.hypot(*template.mask.shape) / 2) + 1


def largest_half_px(template: Template, directions: Sequence[Direction]) -> int:
    return posed_half_px(template, max(log_scale for _, log_scale in directions))


def posed_channels(template: Template, turn: float, log_scale: float) -> Array:
    """(3, P, P), its middle in theirs, each kind with the norm of its weight over `even_scale`."""
    height, width = template.mask.shape
    half = posed_half_px(template, log_scale)
    linear = rotation(turn, math.exp(log_scale))
    move = np.array([half, half]) - linear @ [width / 2, height / 2]
    matrix = np.vstack([np.column_stack([linear, move]), [0, 0, 1]])
    centred = counted_from_centres(matrix)
    size = 2 * half, 2 * half
    warped = np.asarray(cv2.warpAffine(template.interleaved, centred[:2], size), np.float32)
    posed = turned_planes(warped, turn)
    for group, weight in zip(GROUPS, template.weights, strict=True):
        energy = energy_of(posed[group])
        even = even_scale(-log_scale)
        posed[group] *= np.float32(even * weight / math.sqrt(energy) if energy > 0 else 0.0)
    return posed


def _peaks(scores: Array, count: int, apart: int) -> list[tuple[int, int]]:
    """Rows and columns of the `count` highest local maxima, at least `apart` from each other."""
    side = 2 * apart + 1
    highest = cv2.dilate(scores, np.ones((side, side), np.uint8))
    rows, cols = np.nonzero((scores >= highest) & np.isfinite(scores))
    values = scores[rows, cols]
    if len(values) > count:
        kept = np.argpartition(-values, count)[:count]
        rows, cols, values = rows[kept], cols[kept], values[kept]
    order = np.argsort(-values, kind="stable")
    return [(int(rows[i]), int(cols[i])) for i in order]


def _between(scores: Array, row: int, col: int) -> tuple[float, float]:
    """(x, y) in pixels, by a parabola on each axis."""

    def offset(before: float, at: float, after: float) -> float:
        bend = before - 2 * at + after
        return max(-0.5, min(0.5, (before - after) / (2 * bend))) if bend < 0 else 0.0

    height, width = scores.shape
    x, y = float(col), float(row)
    if 0 < col < width - 1:
        x += offset(*(float(v) for v in scores[row, col - 1 : col + 2]))
    if 0 < row < height - 1:
        y += offset(*(float(v) for v in scores[row - 1 : row + 2, col]))
    return x, y
