"""The skeleton of the landscape: a warped road network, settlements at crossings, and rivers.

The plan lives in *sheet* coordinates, where roads follow a jittered square lattice of macro-cells.
`Network.warp` bends the sheet into the landscape, smoothly and without folds, so everything drawn
through it meets at its borders whatever cell it came from.
"""

from dataclasses import dataclass
from enum import IntEnum
from math import atan2, cos, hypot, pi

import numpy as np

from lab.landscape.noise import Float64, key_of, noise_at, uniform_at

CELL_M = 800.0
"""Side of a macro-cell."""

_JITTER = 0.2
_TOWN_BLOCK = 4
_RIVER_SPACING_M = 5200.0
# (wavelength, amplitude) of the bending; the sum of 2 * amplitude / wavelength stays well below 1
_BENDS_M = ((1700.0, 190.0), (520.0, 42.0), (130.0, 4.0), (48.0, 0.8))


class LineKind(IntEnum):
    """Kinds of lines in the landscape, from a main road to an invisible border."""

    MAIN = 0
    MINOR = 1
    STREET = 2
    TRACK = 3
    HEDGE = 4
    STRIP = 5
    NONE = 6


@dataclass(frozen=True)
class Settlement:
    """Houses around a road crossing: centre in sheet coordinates, mean reach, area of one plot.

    `turn_rad` turns its outline, which bulges to three sides and is longer than wide.
    """

    centre_m: tuple[float, float]
    radius_m: float
    plot_m2: float
    turn_rad: float

    def depth_m(self, east_m: float, north_m: float) -> float:
        """Return the distance inside the outline of a point in sheet coordinates."""
        x, y = east_m - self.centre_m[0], north_m - self.centre_m[1]
        bearing = atan2(y, x) - self.turn_rad
        bulge = 1.0 + 0.26 * cos(2.0 * bearing) + 0.18 * cos(3.0 * bearing + 2.0 * self.turn_rad)
        return self.radius_m * bulge - hypot(x, y)


class Network:
    """Roads, settlements and rivers of one landscape; a pure function of its seed."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        angle = 0.35 + 0.9 * (uniform_at(key_of(seed, "angle"), 0) - 0.5)
        c, s = np.cos(angle), np.sin(angle)
        self._turn = np.array([[c, -s], [s, c]])

    def warp(self, points_m: Float64) -> Float64:
        """Return landscape coordinates (N, 2) of sheet coordinates (N, 2), metres."""
        turned = points_m @ self._turn.T
        out: Float64 = turned.copy()
        for number, (wavelength_m, amplitude_m) in enumerate(_BENDS_M):
            for axis in (0, 1):
                key = key_of(self.seed, "bend", number, axis)
                out[:, axis] += amplitude_m * noise_at(key, turned, wavelength_m)
        return out

    def cells_near(self, bounds_m: tuple[float, float, float, float]) -> list[tuple[int, int]]:
        """Return the macro-cells (i, j) that may reach into (west, south, east, north)."""
        west, south, east, north = bounds_m
        corners = np.array([[west, south], [west, north], [east, south], [east, north]])
        sheet = corners @ self._turn / CELL_M
        reach = 0.75  # bending and jitter, in cells
        low = np.floor(sheet.min(axis=0) - reach).astype(int)
        high = np.floor(sheet.max(axis=0) + reach).astype(int)
        return [(i, j) for j in range(low[1], high[1] + 1) for i in range(low[0], high[0] + 1)]

    def vertex(self, i: int, j: int) -> Float64:
        """Return the crossing (2,) at lattice point (i, j), sheet coordinates."""
        jitter = [uniform_at(key_of(self.seed, "vertex", axis), i, j) - 0.5 for axis in (0, 1)]
        return np.array([i + 2 * _JITTER * jitter[0], j + 2 * _JITTER * jitter[1]]) * CELL_M

    def edge(self, i: int, j: int, upward: bool) -> Float64:
        """Return the bent line (9, 2) from crossing (i, j) to its right or upper neighbour."""
        start = self.vertex(i, j)
        end = self.vertex(i, j + 1) if upward else self.vertex(i + 1, j)
        along = np.linspace(0.0, 1.0, 9)[:, None]
        sideways = np.array([start[1] - end[1], end[0] - start[0]])
        bow = 0.22 * (uniform_at(key_of(self.seed, "bow", upward), i, j) - 0.5)
        wave = 0.10 * (uniform_at(key_of(self.seed, "wave", upward), i, j) - 0.5)
        shift = bow * np.sin(np.pi * along) + wave * np.sin(2 * np.pi * along)
        return np.asarray(start + along * (end - start) + shift * sideways)

    def edge_kind(self, i: int, j: int, upward: bool) -> LineKind:
        """Return the kind of line along an edge; main roads continue through the whole lattice."""
        line = i if upward else j
        if uniform_at(key_of(self.seed, "main", upward), line) < 0.25:
            return LineKind.MAIN
        draw = uniform_at(key_of(self.seed, "way", upward), i, j)
        if draw < 0.5:
            return LineKind.MINOR
        return LineKind.TRACK if draw < 0.85 else LineKind.HEDGE

    def outline(self, i: int, j: int) -> Float64:
        """Return the border (32, 2) of macro-cell (i, j), counter-clockwise, sheet coordinates."""
        bottom = self.edge(i, j, upward=False)
        right = self.edge(i + 1, j, upward=True)
        top = self.edge(i, j + 1, upward=False)[::-1]
        left = self.edge(i, j, upward=True)[::-1]
        return np.concatenate([bottom[:-1], right[:-1], top[:-1], left[:-1]])

    def settlements_near(self, i: int, j: int) -> list[Settlement]:
        """Return the settlements that can reach into macro-cell (i, j)."""
        found = (self._settlement(a, b) for b in range(j - 1, j + 3) for a in range(i - 1, i + 3))
        return [settlement for settlement in found if settlement is not None]

    def _settlement(self, i: int, j: int) -> Settlement | None:
        x, y = self.vertex(i, j)
        block = (i // _TOWN_BLOCK, j // _TOWN_BLOCK)
        turn = 2.0 * pi * uniform_at(key_of(self.seed, "bulge"), i, j)
        town = int(uniform_at(key_of(self.seed, "town"), *block) * _TOWN_BLOCK**2)
        if (i % _TOWN_BLOCK) + _TOWN_BLOCK * (j % _TOWN_BLOCK) == town:
            return Settlement((x, y), 360.0, 620.0, turn)
        draw = uniform_at(key_of(self.seed, "village"), i, j)
        if draw < 0.14:
            return Settlement((x, y), 130.0 + 600.0 * draw, 900.0, turn)
        if draw < 0.4:
            return Settlement((x, y), 60.0 + 60.0 * draw, 1300.0, turn)
        return None

    def rivers(
        self, low_m: tuple[float, float], high_m: tuple[float, float]
    ) -> list[tuple[Float64, Float64]]:
        """Return the rivers that may touch a box in sheet coordinates.

        Each is its middle line (N, 2), a point every 10 m over the box's width, and the distance
        (N,) from there to either bank at the usual water level.
        """
        along = np.arange(np.floor(low_m[0] / 10.0), np.ceil(high_m[0] / 10.0) + 1.0) * 10.0
        found = []
        first = int(np.floor(low_m[1] / _RIVER_SPACING_M - 0.5))
        last = int(np.ceil(high_m[1] / _RIVER_SPACING_M + 0.5))
        for number in range(first, last + 1):
            points = np.stack([along, np.full_like(along, 7777.0 * number)], axis=1)
            draw = uniform_at(key_of(self.seed, "river"), number)
            across = _RIVER_SPACING_M * (number + 0.13 + 0.3 * (draw - 0.5))
            wander = 330.0 * noise_at(key_of(self.seed, "valley"), points, 1500.0)
            wander += 125.0 * noise_at(key_of(self.seed, "meander"), points, 250.0)
            line = np.stack([along, across + wander], axis=1)
            if np.any((line[:, 1] > low_m[1] - 60.0) & (line[:, 1] < high_m[1] + 60.0)):
                width = 8.0 + 5.0 * draw + 2.5 * noise_at(key_of(self.seed, "bank"), points, 90.0)
                found.append((line, width))
        return found

    def rivers_in(
        self, bounds_m: tuple[float, float, float, float]
    ) -> list[tuple[Float64, Float64]]:
        """Return the rivers of (west, south, east, north) as `rivers` does, in the landscape."""
        west, south, east, north = bounds_m
        corners = np.array([[west, south], [west, north], [east, south], [east, north]])
        sheet = corners @ self._turn
        reach = sum(amplitude for _, amplitude in _BENDS_M) * 1.3
        low, high = sheet.min(axis=0) - reach, sheet.max(axis=0) + reach
        rivers = self.rivers((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
        return [(self.warp(line), width) for line, width in rivers]
