"""Roads and borders as polygons: lines divided into short pieces, with a width."""

from dataclasses import dataclass

import numpy as np

from lab.landscape.network import LineKind
from lab.landscape.noise import Float64
from lab.landscape.window import Box, box_of

_STEP_M = 12.0  # longest straight piece of a border; must be below the margin of a drawing
HALF_WIDTH_M = {
    LineKind.MAIN: 5.5,
    LineKind.MINOR: 2.9,
    LineKind.STREET: 2.8,
    LineKind.TRACK: 1.6,
    LineKind.HEDGE: 1.8,
    LineKind.STRIP: 0.9,
    LineKind.NONE: 0.35,
}
_VERGE_M = 2.2


@dataclass(frozen=True, eq=False)
class Line:
    """A road or border: its surface and verge as polygons (N, 2), and the year it disappears."""

    kind: LineKind
    surface_m: Float64
    verge_m: Float64
    gone_year: float
    box_m: Box


def dense(points: Float64, closed: bool = False) -> Float64:
    """Return the line (N, 2) with a point at least every 12 m."""
    ends = np.roll(points, -1, axis=0) if closed else points[1:]
    starts = points if closed else points[:-1]
    length = np.hypot(*(ends - starts).T)
    counts = np.maximum(np.ceil(length / _STEP_M), 1).astype(int)
    which = np.repeat(np.arange(len(starts)), counts)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[which]
    out = starts[which] + share[:, None] * (ends - starts)[which]
    return out if closed else np.concatenate([out, points[-1:]])


def ribbon(points_m: Float64, half_width_m: float | Float64) -> Float64:
    """Return the polygon (2 N, 2) that lies within `half_width_m` of a line (N, 2)."""
    along = np.empty_like(points_m)
    along[1:-1] = points_m[2:] - points_m[:-2]
    along[0] = points_m[1] - points_m[0]
    along[-1] = points_m[-1] - points_m[-2]
    along /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    width = np.broadcast_to(np.asarray(half_width_m, np.float64), (len(points_m),))
    side = np.stack([-along[:, 1], along[:, 0]], axis=1) * width[:, None]
    return np.concatenate([points_m + side, (points_m - side)[::-1]])


def make_line(kind: LineKind, points_m: Float64, gone_year: float) -> Line:
    """Return the line through points (N, 2), its ends extended so that crossings close."""
    half = HALF_WIDTH_M[kind]
    paved = kind in (LineKind.MAIN, LineKind.MINOR, LineKind.STREET)
    verge = half + (_VERGE_M if paved else 0.9)
    stretched = points_m.copy()
    if paved or kind is LineKind.TRACK:
        for end, inner in ((0, 1), (-1, -2)):
            step = points_m[end] - points_m[inner]
            stretched[end] += step * (half * 0.7 / max(float(np.hypot(*step)), 1e-9))
    outer = ribbon(stretched, verge)
    return Line(kind, ribbon(stretched, half), outer, gone_year, box_of(outer))
