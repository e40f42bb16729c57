"""What is flown over: two orthophotos of two dates, generated, real or a user's own."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from lab.landscape import DEFAULT_DATES, generate_area
from numpy.typing import NDArray

from experiments.paper.methods import REDUCED_NETWORKS
from experiments.paper.trajectories import TABLE_1, TILE_PX, Setting, Trajectory, two_tiles
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route

SEED = 1
AGL_M = 2000.0
"""Told height over imagery that no trajectory of the paper is flown over; any would do."""
REAL = (
    ("naip-2012", "naip_nd/20090818.tif", "naip_nd/20120731.tif"),
    ("naip-2018", "naip_nd/20090818.tif", "naip_nd/20180716.tif"),
    ("szada-1", "airchange/szada_1_a.tif", "airchange/szada_1_b.tif"),
    ("szada-5", "airchange/szada_5_a.tif", "airchange/szada_5_b.tif"),
    ("szada-7", "airchange/szada_7_a.tif", "airchange/szada_7_b.tif"),
)
REDUCED_REAL = ("naip-2018", "szada-1", "szada-7")
OTHERS = {
    "naip-2012": ("naip_nd/20150926.tif", "naip_nd/20180716.tif"),
    "naip-2018": ("naip_nd/20120731.tif", "naip_nd/20150926.tif"),
}
"""Further dates of real scenes, for what learns from several: neither the map's nor the views'."""
UNTUNED = {
    "garching": ("2009_04", "2015_04", "2001_09", "2018_04", "2020_03"),
    "schiphol": ("2008_05", "2018_04", "2004_05", "2015_09", "2021_06"),
    "solar_farm": ("2017_12", "2020_12", "2009_12", "2012_12", "2015_12"),
    "atlanta": ("2016_12", "2021_08", "2012_11", "2024_02"),
    "aral": ("2012_12", "2020_12", "1985_12", "1995_12", "2000_12", "2006_12", "2015_12"),
    "tours": ("1964", "1976"),
}
"""Scenes on which nothing was tuned but the confidence of registered views: dates of the map, of
the views, and further ones."""


@dataclass(frozen=True)
class Scene:
    """A trajectory over the imagery of two dates: the map is made of `past`, views of `present`.

    `others`: further dates, for what learns from several; never that of the views.
    """

    name: str
    past: Path
    present: Path
    trajectory: Trajectory
    others: tuple[Path, ...] = ()

    def of(self, setting: Setting) -> "Scene":
        """The scene as a setting runs it: a dry run has two tiles."""
        return replace(self, trajectory=two_tiles(self.trajectory)) if setting.dry else self

    def area(self) -> dict[str, Any]:
        """The search band in the middle of the imagery, as `BuildRequest` takes an area.

        A rectangle; where that is narrower than a tile, a band around the trajectory.
        """
        flown, area = self.trajectory, _outline(self.past)
        west, south, east, north = area.extent_en_m
        middle = np.array([west + east, south + north]) / 2
        half = np.array([flown.length_m, flown.band_m]) / 2
        if flown.band_m < TILE_PX * flown.gsd_m:
            ends = middle + np.array([[-half[0], 0.0], [half[0], 0.0]])
            lat, lon = area.frame.latlon_from_en(ends)
            waypoints = tuple(zip(lat.tolist(), lon.tolist(), strict=True))
            return {"route": Route(waypoints), "band_m": flown.band_m}
        return {"bounds_deg": _box_deg(area.frame, middle - half, middle + half)}


def generated(setting: Setting, name: str, folder: Path, gsd_m: float | None = None) -> Scene:
    """A trajectory of Table 1 over an area that `render` generates.

    Of two dates, and a third where a triplet network is trained. `gsd_m`: another ground
    resolution; the scene is then named by it.
    """
    trajectory = setting.trajectory(name)
    title = name
    if gsd_m is not None and gsd_m != trajectory.gsd_m:
        trajectory = replace(trajectory, gsd_m=gsd_m)
        title = f"{name}-{gsd_m:g}m"
    east_m, north_m = trajectory.imagery_m
    place = folder / f"{name}-{east_m:.0f}x{north_m:.0f}m-{trajectory.gsd_m:g}m"
    reduced = "".join(REDUCED_NETWORKS["triplet"].values())
    learns = setting.name == "full" or (setting.name == "reduced" and name in reduced)
    dates = DEFAULT_DATES if learns else DEFAULT_DATES[:2]
    paths = [place / f"{date.name}.tif" for date in dates]
    return Scene(title, paths[0], paths[1], trajectory, tuple(paths[2:]))


def render(scene: Scene) -> None:
    """Generate the imagery of a scene, unless it is there."""
    paths = (scene.past, scene.present, *scene.others)
    if all(path.is_file() for path in paths):
        return
    flown, names = scene.trajectory, [path.stem for path in paths]
    dates = [date for date in DEFAULT_DATES if date.name in names]
    folder = scene.past.parent
    generate_area(folder, size_m=flown.imagery_m, gsd_m=flown.gsd_m, dates=dates, seed=SEED)


def over(
    name: str,
    past: Path,
    present: Path,
    gsd_m: float | None = None,
    others: tuple[Path, ...] = (),
) -> Scene:
    """The same protocol over two orthophotos: all of the first that holds whole views."""
    area, mosaic = _outline(past), Mosaic.open([past])
    pixel_m = gsd_m or float(f"{mosaic.gsd_m:.3g}")
    empty = Trajectory(name, AGL_M, 1.0, 1.0, TABLE_1["B"].overlap, pixel_m)
    west, south, east, north = area.extent_en_m
    sides = [side - 2 * empty.margin_m for side in (east - west, north - south)]
    if min(sides) <= 0:
        raise ValueError(
            f"imagery of {east - west:.0f} x {north - south:.0f} m is too small for tiles of "
            f"{TILE_PX * pixel_m:.0f} m and turned views; give a finer ground resolution: {past}"
        )
    length_m, band_m = (math.floor(side) for side in sides)
    made = Trajectory(name, AGL_M, length_m, band_m, empty.overlap, pixel_m)
    return Scene(name, past, present, made, others)


def real(data: Path, setting: Setting) -> Iterator[Scene]:
    """Scenes of the optional real imagery, those that are there; fewer in the reduced setting."""
    for name, past, present in REAL:
        if setting.name == "reduced" and name not in REDUCED_REAL:
            continue
        if (data / past).is_file() and (data / present).is_file():
            others = tuple(data / other for other in OTHERS.get(name, ()))
            yield over(name, data / past, data / present, others=others)


def untuned(data: Path) -> Iterator[Scene]:
    """Those of `UNTUNED` that are there."""
    for name, dates in UNTUNED.items():
        past, present, *others = (data / "scenes" / name / f"{date}.tif" for date in dates)
        if past.is_file() and present.is_file():
            yield over(name, past, present, others=tuple(others))


def _outline(path: Path) -> Area:
    outline = Mosaic.open([path]).outline_latlon_deg
    return Area.from_outline(outline[:, 0], outline[:, 1])


def _box_deg(
    frame: LocalFrame, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    middle = (low + high) / 2
    sides = np.array(
        [[low[0], middle[1]], [high[0], middle[1]], [middle[0], low[1]], [middle[0], high[1]]]
    )
    lat, lon = frame.latlon_from_en(sides)
    return float(lon[0]), float(lat[2]), float(lon[1]), float(lat[3])
