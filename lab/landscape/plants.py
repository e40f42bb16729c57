"""Single trees and the bushes of hedges: positions, sizes and years."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lab.landscape.network import LineKind
from lab.landscape.noise import Float64
from lab.landscape.parcels import FIRST_YEAR, Boundary, LandCover


@dataclass(frozen=True, eq=False)
class Trees:
    """N crowns: centre (N, 2), radius, height (N,), first and last year (N,)."""

    centre_m: Float64
    radius_m: Float64
    height_m: Float64
    born_year: Float64
    gone_year: Float64

    def where(self, keep: NDArray[np.bool_]) -> "Trees":
        """Return the crowns for which `keep` (N,) is true."""
        return Trees(*(getattr(self, field.name)[keep] for field in fields(self)))

    def at(self, time_years: float) -> "Trees":
        """Return the crowns that stand at a time."""
        return self.where((self.born_year <= time_years) & (time_years < self.gone_year))


def join(groups: Sequence[Trees]) -> Trees:
    """Return all crowns of several groups, low ones first; high ones are drawn on top."""
    columns = [np.concatenate([getattr(g, field.name) for g in groups]) for field in fields(Trees)]
    order = np.lexsort((columns[0][:, 0], columns[2]))
    return Trees(*(column[order] for column in columns))


def plant(
    boundary_points: list[Float64],
    boundaries: list[Boundary],
    polygons: list[Float64],
    centres_m: Float64,
    area_m2: Float64,
    cover: NDArray[np.int8],
    rng: np.random.Generator,
) -> Trees:
    """Return the trees of a cell: hedges, trees along roads, in gardens, meadows and fields."""
    groups = [_empty()]
    for points, cut in zip(boundary_points, boundaries, strict=True):
        if cut.kind is LineKind.HEDGE:
            groups.append(_hedge(points, cut.gone_year, rng))
        elif rng.uniform() < {
            LineKind.MAIN: 0.5,
            LineKind.MINOR: 0.25,
            LineKind.TRACK: 0.2,
            LineKind.STRIP: 0.05,
        }.get(cut.kind, 0.0):
            groups.append(_row(points, rng))
    for polygon, centre, area, kind in zip(
        polygons, centres_m, area_m2.tolist(), cover.tolist(), strict=True
    ):
        mean = _mean_count(kind, area)
        count = int(rng.poisson(mean)) if mean > 0.0 else 0
        if count:
            corner = polygon[rng.integers(len(polygon), size=count)]
            share = np.sqrt(rng.uniform(0.1, 0.95, size=count))[:, None]
            groups.append(_crowns(centre + share * (corner - centre), 2.0, 5.0, rng))
    return join(groups)


def _mean_count(kind: int, area_m2: float) -> float:
    if kind == LandCover.GARDEN:
        return min(area_m2 / 350.0, 6.0)
    if kind == LandCover.MEADOW:
        return min(area_m2 / 9000.0, 6.0)
    if kind == LandCover.ROUGH:
        return min(area_m2 / 400.0, 60.0)
    return 0.15 if kind == LandCover.ARABLE else 0.0


def _empty() -> Trees:
    none = np.zeros(0)
    return Trees(np.zeros((0, 2)), none, none, none, none)


def _along(points: Float64, spacing_m: float, rng: np.random.Generator) -> Float64:
    """Return places about every `spacing_m` along a line (N, 2)."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    if length[-1] < spacing_m:
        return np.zeros((0, 2))
    at = np.arange(rng.uniform(0.0, spacing_m), length[-1], spacing_m)
    at = at + rng.normal(0.0, 0.15 * spacing_m, len(at))
    return np.stack([np.interp(at, length, points[:, axis]) for axis in (0, 1)], axis=1)


def _hedge(points: Float64, gone_year: float, rng: np.random.Generator) -> Trees:
    """Return bushes along a line, with gaps and some trees."""
    places = _along(points, 2.6, rng)
    count = len(places)
    dense = rng.uniform(0.5, 1.0)
    gap = np.repeat(rng.uniform(size=count // 6 + 1), 6)[:count]
    places = places + rng.normal(0.0, 0.5, (count, 2))
    high = rng.uniform(size=count) < 0.10
    radius = np.where(high, rng.uniform(2.5, 5.0, count), rng.uniform(1.2, 2.4, count))
    height = radius * np.where(high, 2.3, 1.3)
    born = np.full(count, -np.inf)
    trees = Trees(places, radius, height, born, np.full(count, gone_year))
    return trees.where(gap < dense)


def _row(points: Float64, rng: np.random.Generator) -> Trees:
    """Return a row of trees along one side of a line."""
    spacing = rng.uniform(9.0, 22.0)
    places = _along(points, spacing, rng)
    step = points[-1] - points[0]
    side = np.array([-step[1], step[0]]) / max(float(np.hypot(*step)), 1.0)
    return _crowns(places + side * rng.choice([-8.0, 8.0]), 2.5, 4.5, rng)


def _crowns(places: Float64, low_m: float, high_m: float, rng: np.random.Generator) -> Trees:
    """Return trees at places (N, 2) with crown radii from low to high; some grow up or are cut."""
    count = len(places)
    radius = rng.uniform(low_m, high_m, count)
    born = FIRST_YEAR - 60.0 + rng.uniform(0.0, 95.0, count)
    gone = FIRST_YEAR + rng.exponential(90.0, count)
    born = np.where(born < FIRST_YEAR, -np.inf, born)
    return Trees(places, radius, radius * rng.uniform(1.7, 2.6, count), born, gone)
