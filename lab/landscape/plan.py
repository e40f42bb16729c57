"""Content of one macro-cell in landscape coordinates, with the years of its changes."""

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lab.landscape.lines import Line, dense, make_line
from lab.landscape.network import CELL_M, Network
from lab.landscape.noise import Float64, UInt32, hash_u32, key_of, noise_at
from lab.landscape.parcels import (
    FIRST_YEAR,
    Boundary,
    LandCover,
    Parcel,
    ParcelCutter,
    Point,
    area_and_centre,
    long_axis,
)
from lab.landscape.plants import Trees, plant
from lab.landscape.roofs import Buildings, build
from lab.landscape.window import Box, box_of


@dataclass(frozen=True, eq=False)
class Pond:
    """Standing water: centre (2,) and shore (N, 2) at the usual water level."""

    centre_m: Float64
    shore_m: Float64
    box_m: Box


@dataclass(frozen=True, eq=False)
class CellPlan:
    """Content of one macro-cell.

    polygons_m: borders of its M parcels, each (N, 2).
    identity, twin (M,): numbers that crops are drawn from, before and after `merge_year` (M,).
    cover (M,): `Cover`; felled_year (M,): when a wood is cut.
    angle_rad (M,): direction of the longer side.
    """

    polygons_m: list[Float64]
    boxes_m: list[Box]
    identity: UInt32
    twin: UInt32
    merge_year: Float64
    cover: NDArray[np.int8]
    felled_year: Float64
    angle_rad: Float64
    lines: list[Line]
    ponds: list[Pond]
    trees: Trees
    buildings: Buildings


def outline_box(network: Network, i: int, j: int) -> Box:
    """Return the box around macro-cell (i, j) and the objects on its border."""
    return box_of(network.warp(dense(network.outline(i, j), closed=True)), 40.0)


def make_plan(network: Network, i: int, j: int) -> CellPlan:
    """Return the plan of macro-cell (i, j); a pure function of the network and the cell."""
    rng = np.random.default_rng([network.seed, i & 0xFFFFFFFF, j & 0xFFFFFFFF, 1])
    outline = network.outline(i, j)
    cutter = ParcelCutter(network, i, j, rng)
    pieces = cutter.cut([(float(x), float(y)) for x, y in outline])
    boundaries = pieces.boundaries + [
        Boundary(
            [(float(x), float(y)) for x, y in network.edge(i, j, up)], network.edge_kind(i, j, up)
        )
        for up in (False, True)
    ]
    polygons = _warped(network, [dense(np.array(p.polygon), True) for p in pieces.parcels])
    centres = np.array([area_and_centre([*map(tuple, polygon)])[1] for polygon in polygons])
    cover = _covers(network.seed, pieces.parcels, centres, rng)
    ponds = _ponds(network, i, j, pieces.parcels, cover, rng)
    wet = _Wet(network, i, j, ponds)
    boundary_points = _warped(network, [dense(np.array(cut.points)) for cut in boundaries])
    angles = np.array([long_axis([*map(tuple, polygon)])[0] for polygon in polygons])
    areas = np.array([parcel.area_m2 for parcel in pieces.parcels])
    towns = [parcel.settlement for parcel in pieces.parcels]
    buildings = build(centres, angles, areas, cover, towns, rng)
    trees = plant(boundary_points, boundaries, polygons, centres, areas, cover, rng)
    salt = key_of(network.seed, "parcel", i, j)
    numbers = np.array([parcel.number for parcel in pieces.parcels])
    twins = np.array([parcel.twin for parcel in pieces.parcels])
    return CellPlan(
        polygons_m=polygons,
        boxes_m=[box_of(polygon) for polygon in polygons],
        identity=hash_u32(salt, numbers, 0),
        twin=hash_u32(salt, twins, 1),
        merge_year=np.array([parcel.merge_year for parcel in pieces.parcels]),
        cover=cover,
        felled_year=FIRST_YEAR + rng.exponential(80.0, len(areas)),
        angle_rad=angles,
        lines=[
            make_line(cut.kind, points, cut.gone_year)
            for cut, points in zip(boundaries, boundary_points, strict=True)
        ],
        ponds=ponds,
        trees=trees.where(~wet(trees.centre_m, 1.0)),
        buildings=buildings.where(~wet(buildings.centre_m, 14.0)),
    )


def _warped(network: Network, lines: list[Float64]) -> list[Float64]:
    """Bend many lines at once from the sheet into the landscape."""
    ends = np.cumsum([len(line) for line in lines])[:-1]
    return np.split(network.warp(np.concatenate(lines)), ends)


def _covers(
    seed: int, parcels: list[Parcel], centres_m: Float64, rng: np.random.Generator
) -> NDArray[np.int8]:
    """Return the `Cover` (M,) of parcels: woods and vineyards are clustered, the rest is drawn."""
    wooded = noise_at(key_of(seed, "wood"), centres_m, 1300.0)
    wooded += 0.6 * noise_at(key_of(seed, "grove"), centres_m, 330.0)
    vine = noise_at(key_of(seed, "vine"), centres_m, 2100.0)
    area = np.array([parcel.area_m2 for parcel in parcels])
    town = np.array([parcel.settlement is not None for parcel in parcels])
    draw = rng.uniform(size=len(parcels))
    cover = np.full(len(parcels), LandCover.ARABLE, np.int8)
    cover[draw < 0.25] = LandCover.MEADOW
    cover[(draw > 0.25) & (draw < 0.275)] = LandCover.ROUGH
    cover[(draw > 0.275) & (draw < 0.295) & (area < 40000.0)] = LandCover.FOREST
    cover[(draw > 0.295) & (draw < 0.34) & (area < 30000.0)] = LandCover.ORCHARD
    cover[(vine > 0.45) & (draw > 0.5) & (area < 40000.0)] = LandCover.VINEYARD
    cover[(wooded > 1.05) & (draw > 0.08)] = LandCover.FOREST
    cover[town] = np.where(draw[town] < 0.06, LandCover.YARD, LandCover.GARDEN)
    cover[town & (area > 2600.0)] = LandCover.MEADOW
    return cover


def _ponds(
    network: Network,
    i: int,
    j: int,
    parcels: list[Parcel],
    cover: NDArray[np.int8],
    rng: np.random.Generator,
) -> list[Pond]:
    """Return a rare lake in the middle of the cell, and ponds in some meadows."""
    places: list[tuple[Point, float]] = []
    lake, lake_radius = rng.uniform(), rng.uniform(90.0, 190.0)
    if lake < 0.06:
        places.append((((i + 0.5) * CELL_M, (j + 0.5) * CELL_M), lake_radius))
    for parcel, kind in zip(parcels, cover.tolist(), strict=True):
        if kind == LandCover.MEADOW and rng.uniform() < 0.07:
            radius = 0.25 * parcel.area_m2**0.5
            places.append((area_and_centre(parcel.polygon)[1], min(radius, 35.0)))
    ponds = []
    turn = np.linspace(0.0, 2.0 * pi, 145)[:-1]
    for centre, radius in places:
        wobble = np.ones_like(turn)
        for wave in range(2, 7):
            phase, size = rng.uniform(0.0, 2.0 * pi), rng.uniform(0.0, 0.45 / wave)
            wobble += size * np.cos(wave * turn + phase)
        shore = radius * wobble[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        bent = network.warp(np.concatenate([[centre], np.array(centre) + shore]))
        ponds.append(Pond(bent[0], bent[1:], box_of(bent[1:], 4.0)))
    return ponds


class _Wet:
    """Mask of points of a cell in water or within a margin of it."""

    def __init__(self, network: Network, i: int, j: int, ponds: list[Pond]) -> None:
        low, high = (
            ((i - 0.5) * CELL_M, (j - 0.5) * CELL_M),
            ((i + 1.5) * CELL_M, (j + 1.5) * CELL_M),
        )
        self._rivers = [
            (cKDTree(network.warp(line)), width) for line, width in network.rivers(low, high)
        ]
        self._ponds = ponds

    def __call__(self, points_m: Float64, margin_m: float) -> NDArray[np.bool_]:
        """Return (N,) for points (N, 2)."""
        wet = np.zeros(len(points_m), np.bool_)
        for tree, width_m in self._rivers:
            distance, nearest = tree.query(points_m)
            wet |= distance < width_m[nearest] + margin_m
        for pond in self._ponds:
            offset = points_m - pond.centre_m
            shore = pond.shore_m - pond.centre_m
            reach = np.hypot(shore[:, 0], shore[:, 1])
            bearing = np.arctan2(shore[:, 1], shore[:, 0])
            order = np.argsort(bearing)
            at = np.arctan2(offset[:, 1], offset[:, 0])
            limit = np.interp(at, bearing[order], reach[order], period=2.0 * pi)
            wet |= np.hypot(offset[:, 0], offset[:, 1]) < limit + margin_m
        return wet
