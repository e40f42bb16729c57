"""Division of a macro-cell into parcels, and the lines between them.

A cell is halved recursively until its pieces have the size of fields, or of house plots near a
settlement. The result holds for all dates, and includes the years in which a border disappears or
a wood is felled.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from math import cos, hypot, pi, sin

import cv2
import numpy as np

from lab.landscape.network import LineKind, Network, Settlement

Point = tuple[float, float]

FIRST_YEAR = 1995.0
"""No changes happen before this year; older dates show its state."""


class LandCover(IntEnum):
    """Land cover of a parcel, at all dates unless felled."""

    ARABLE = 0
    MEADOW = 1
    ORCHARD = 2
    VINEYARD = 3
    FOREST = 4
    GARDEN = 5
    YARD = 6
    ROUGH = 7


@dataclass
class Parcel:
    """One parcel in sheet coordinates. `twin`: the number it shares from `merge_year` on."""

    polygon: list[Point]
    area_m2: float
    number: int
    settlement: Settlement | None
    twin: int = -1
    merge_year: float = np.inf


@dataclass
class Boundary:
    """A line between parcels in sheet coordinates, and the year in which it disappears."""

    points: list[Point]
    kind: LineKind
    gone_year: float = np.inf


@dataclass
class Pieces:
    """All parcels and cuts of one macro-cell."""

    parcels: list[Parcel] = field(default_factory=list)
    boundaries: list[Boundary] = field(default_factory=list)


@dataclass(frozen=True)
class Style:
    """Style of one macro-cell: field size, hedges, narrow strips."""

    field_m2: float
    bocage: float
    strips: bool

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "Style":
        """Return a random style."""
        return cls(
            field_m2=float(np.clip(22000.0 * np.exp(0.5 * rng.standard_normal()), 7000.0, 50000.0)),
            bocage=float(rng.uniform() ** 2 * 0.6),
            strips=bool(rng.uniform() < 0.35),
        )


def halve(
    polygon: list[Point], through: Point, normal: Point
) -> tuple[list[Point], list[Point], list[Point]]:
    """Return the two sides of `polygon` along a line, and where the line crosses its border."""
    sides: tuple[list[Point], list[Point]] = ([], [])
    crossings: list[Point] = []
    distance = [(x - through[0]) * normal[0] + (y - through[1]) * normal[1] for x, y in polygon]
    for k, (x, y) in enumerate(polygon):
        here, there = distance[k - 1], distance[k]
        if (here >= 0.0) != (there >= 0.0):
            share = here / (here - there)
            before = polygon[k - 1]
            crossing = (before[0] + share * (x - before[0]), before[1] + share * (y - before[1]))
            sides[0].append(crossing)
            sides[1].append(crossing)
            crossings.append(crossing)
        sides[there < 0.0].append((x, y))
    return sides[0], sides[1], crossings


def area_and_centre(polygon: list[Point]) -> tuple[float, Point]:
    """Return the area and the centre of gravity of a polygon."""
    x0, y0 = polygon[0]
    twice = cx = cy = 0.0
    for k, (x, y) in enumerate(polygon):
        ax, ay = polygon[k - 1][0] - x0, polygon[k - 1][1] - y0
        bx, by = x - x0, y - y0
        cross = ax * by - ay * bx
        twice += cross
        cx += cross * (ax + bx)
        cy += cross * (ay + by)
    if abs(twice) < 1e-6:
        return 0.0, (x0, y0)
    return abs(twice) / 2.0, (x0 + cx / (3.0 * twice), y0 + cy / (3.0 * twice))


def long_axis(polygon: list[Point]) -> tuple[float, float, float]:
    """Return direction (rad) and length of the longer side of the tightest box, and the shorter."""
    origin = polygon[0]
    points = np.array(polygon) - origin
    box = cv2.boxPoints(cv2.minAreaRect(points.astype(np.float32)))
    (ax, ay), (bx, by) = (box[1] - box[0]).tolist(), (box[2] - box[1]).tolist()
    a, b = hypot(ax, ay), hypot(bx, by)
    if a >= b:
        return float(np.arctan2(ay, ax)), a, b
    return float(np.arctan2(by, bx)), b, a


class ParcelCutter:
    """Halves one macro-cell down to parcels."""

    def __init__(self, network: Network, i: int, j: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._settlements = network.settlements_near(i, j)
        self.style = Style.draw(rng)
        self._next_number = 0

    def cut(self, outline: list[Point]) -> Pieces:
        """Return the parcels of the cell with this outline and the cuts between them."""
        pieces = Pieces()
        stack: list[tuple[list[Point], int, Boundary | None]] = [(outline, 0, None)]
        last_of_cut: dict[int, Parcel] = {}
        while stack:
            polygon, depth, parent = stack.pop()
            area, centre = area_and_centre(polygon)
            if area < 15.0:
                continue
            settlement = self._settlement_at(centre, area)
            halves = self._halves(polygon, centre, area, depth, settlement)
            if halves is not None:
                pieces.boundaries.append(halves[2])
                stack += [(halves[0], depth + 1, halves[2]), (halves[1], depth + 1, halves[2])]
                continue
            parcel = Parcel(polygon, area, self._next_number, settlement)
            self._next_number += 1
            pieces.parcels.append(parcel)
            sibling = last_of_cut.setdefault(id(parent), parcel)
            if parent is not None and sibling is not parcel and settlement is None:
                self._maybe_merge(sibling, parcel, parent)
        return pieces

    def _settlement_at(self, centre: Point, area: float) -> Settlement | None:
        """Return the settlement that reaches a piece of this size, if any."""
        reach = 0.3 * area**0.5
        for settlement in self._settlements:
            if settlement.depth_m(*centre) > -reach:
                return settlement
        return None

    def _halves(
        self,
        polygon: list[Point],
        centre: Point,
        area: float,
        depth: int,
        settlement: Settlement | None,
    ) -> tuple[list[Point], list[Point], Boundary] | None:
        """Return two halves and their boundary, or None if the piece is small enough."""
        rng = self._rng
        wanted = settlement.plot_m2 if settlement else self.style.field_m2
        if depth >= 16 or area < wanted * rng.uniform(0.9, 2.1):
            return None
        direction, long, short = long_axis(polygon)
        narrow = settlement is None and self.style.strips and area < 90000.0
        along = narrow and short > 45.0 and long < 6.0 * short and rng.uniform() < 0.75
        if along or (long < 1.15 * short and rng.uniform() < 0.5):
            direction += pi / 2.0
        spread = 0.20 if depth < 2 else 0.07
        direction += spread * float(np.clip(rng.standard_normal(), -2.0, 2.0))
        normal = (cos(direction), sin(direction))
        offset = 0.26 * (rng.uniform() - 0.5) * long
        through = (centre[0] + offset * normal[0], centre[1] + offset * normal[1])
        left, right, crossings = halve(polygon, through, normal)
        if len(left) < 3 or len(right) < 3 or len(crossings) < 2:
            return None
        crossings.sort(key=lambda p: p[1] * normal[0] - p[0] * normal[1])
        cut = Boundary([crossings[0], crossings[-1]], self._line_kind(area, settlement))
        if cut.kind is LineKind.HEDGE:
            cut.gone_year = FIRST_YEAR + float(rng.exponential(110.0))
        return left, right, cut

    def _line_kind(self, area: float, settlement: Settlement | None) -> LineKind:
        """Draw the kind of a boundary through a piece of this area."""
        draw = self._rng.uniform()
        if settlement is not None and area < 90000.0:
            if area > 11.0 * settlement.plot_m2:
                return LineKind.STREET
            return (
                LineKind.HEDGE if draw < 0.12 else LineKind.STRIP if draw < 0.6 else LineKind.NONE
            )
        if area > 280000.0:
            return LineKind.MINOR if draw < 0.35 else LineKind.TRACK
        if area > 90000.0 and draw < 0.4:
            return LineKind.TRACK
        if self._rng.uniform() < 0.05 + self.style.bocage:
            return LineKind.HEDGE
        return LineKind.TRACK if draw < 0.06 else LineKind.STRIP if draw < 0.85 else LineKind.NONE

    def _maybe_merge(self, first: Parcel, second: Parcel, cut: Boundary) -> None:
        """Merge two halves of one field in some year, when their boundary disappears."""
        if cut.kind not in (LineKind.HEDGE, LineKind.STRIP, LineKind.NONE):
            return
        year = FIRST_YEAR + float(self._rng.exponential(75.0))
        first.merge_year = second.merge_year = year
        first.twin = second.twin = first.number
        cut.gone_year = min(cut.gone_year, year)
