"""The catalogue: scenes of several dates, maps and views of them. Experiments use it too.

Real imagery is optional: it is looked for beside the checkout (`../shared/data`), or in the folder
that ORTHONAV_DATA names. Orthophotos are named by their file below it, generated ones by
`generated:SEED[:GSD[:SIDE_M]]:DATE`, of 1 m and 2000 x 2000 px unless they say otherwise. Maps,
generated areas and flights stay in a folder of work: use another one after the code that makes them
has changed.
"""

import hashlib
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, zip_longest
from pathlib import Path
from typing import Any

import rasterio
from lab.landscape import DEFAULT_DATES, OTHER_LIGHT, generate_area

from orthonav.core.errors import OutputError
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.records import View
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors, SimulateRequest, simulate_flight

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
DATA = Path(os.environ.get("ORTHONAV_DATA", BESIDE))
"""Folder of the optional real imagery."""
FAR_M, FAR_PX = 35.0, 10.0
"""A position is wrong beyond both."""
SIDE_PX = 2000
PAST, PRESENT, OTHER = (date.name for date in DEFAULT_DATES)
TILT_STD_DEG = 1.0
"""Of the mount and of the horizon, in pitch and in roll, unreported."""
USUAL = Errors(
    yaw_std_deg=10.0, agl_std=0.1, mount_std_deg=TILT_STD_DEG, horizon_std_deg=TILT_STD_DEG
)
WIDE = Errors(yaw_std_deg=10.0, agl_std=0.1)


@dataclass(frozen=True)
class Scene:
    """One place at several dates.

    - `name`, `folder`: name, and folder below `DATA`, or `generated:SEED[:GSD[:SIDE_M]]`.
    - `gsd_m`: metres per pixel, nominal.
    - `dates`: names of the orthophotos, in order.
    """

    name: str
    folder: str
    gsd_m: float
    dates: tuple[str, ...]

    def file(self, date: str) -> str:
        """Name of an orthophoto, as `ortho` takes it."""
        return f"{self.folder}:{date}" if _generated(self.folder) else f"{self.folder}/{date}.tif"

    def pair(self, past: str, present: str) -> "Pair":
        """A map of one date and views of another."""
        return Pair(self.name, self.file(past), self.file(present), self.gsd_m)


@dataclass(frozen=True)
class Pair:
    """A map and an orthophoto of another date, that views are taken of."""

    scene: str
    map: str
    views: str
    gsd_m: float

    @property
    def name(self) -> str:
        """Such as `schiphol 2004_05 > 2018_04`."""
        past, present = (Path(each.rpartition(":")[2]).stem for each in (self.map, self.views))
        return f"{self.scene} {past} > {present}"

    @property
    def is_there(self) -> bool:
        """Whether both exist, or can be generated."""
        return is_there(self.map, self.views)


SCENES = {
    each.name: each
    for each in (
        Scene("naip", "naip_nd", 5.0, ("20090818", "20120731", "20150926", "20180716")),
        *(
            Scene(f"szada_{n}", "airchange", 1.5, (f"szada_{n}_a", f"szada_{n}_b"))
            for n in ("1", "5", "7", "mosaic")
        ),
        Scene(
            "garching", "scenes/garching", 1.5,
            ("2001_09", "2009_04", "2015_04", "2018_04", "2020_03"),
        ),
        Scene(
            "schiphol", "scenes/schiphol", 1.5,
            ("2004_05", "2008_05", "2015_09", "2018_04", "2021_06"),
        ),
        Scene(
            "solar_farm", "scenes/solar_farm", 1.5,
            ("2009_12", "2012_12", "2015_12", "2017_12", "2020_12"),
        ),
        Scene("atlanta", "scenes/atlanta", 9.35, ("2012_11", "2016_12", "2021_08", "2024_02")),
        Scene(
            "aral", "scenes/aral", 1.5,
            ("1985_12", "1995_12", "2000_12", "2006_12", "2012_12", "2015_12", "2020_12"),
        ),
        Scene("tours", "scenes/tours", 1.0, ("1964", "1976")),
        *(
            Scene(f"generated_{seed}", f"generated:{seed}", 1.0, (OTHER, PAST, PRESENT))
            for seed in (1, 31, 32)
        ),
    )
}  # fmt: skip


def leave_one_out_pairs() -> list[Pair]:
    """19 pairs of nine places; `place_of` names the place, which is left out as a whole."""
    dates = {
        "naip": (("20090818", "20120731"), ("20090818", "20180716")),
        **{f"szada_{n}": ((f"szada_{n}_a", f"szada_{n}_b"),) for n in ("1", "5", "7", "mosaic")},
        "garching": (("2001_09", "2015_04"), ("2020_03", "2009_04")),
        "schiphol": (("2004_05", "2018_04"), ("2021_06", "2008_05")),
        "solar_farm": (("2009_12", "2017_12"), ("2012_12", "2015_12")),
        "atlanta": (("2012_11", "2021_08"), ("2024_02", "2016_12")),
        "aral": (("1985_12", "2012_12"), ("2000_12", "2015_12")),
        "tours": (("1964", "1976"),),
        "generated_31": ((PAST, PRESENT),),
        "generated_32": ((OTHER, PAST),),
    }
    return [SCENES[name].pair(*each) for name, both in dates.items() for each in both]


def all_pairs() -> list[Pair]:
    """Every map with the views of every other date, places in turn."""
    by_place: dict[str, list[Pair]] = {}
    for scene in SCENES.values():
        for both in permutations(scene.dates, 2):
            pair = scene.pair(*both)
            by_place.setdefault(place_of(pair), []).append(pair)
    return [each for turn in zip_longest(*by_place.values()) for each in turn if each is not None]


def place_of(pair: Pair) -> str:
    """Scenes of one place or generator together: `szada`, `generated`."""
    return pair.scene if pair.scene == "solar_farm" else pair.scene.partition("_")[0]


def _generated(name: str) -> bool:
    return name.startswith("generated:")


def is_there(*names: str) -> bool:
    """Whether all files are there or can be generated; a line says which are not."""
    missing = [name for name in names if not _generated(name) and not (DATA / name).exists()]
    for name in missing:
        print(f"not there, left out: {DATA / name}")
    return not missing


def ortho(name: str, work: Path) -> Path:
    """The orthophoto of a name; generated ones lie in `work`."""
    if not _generated(name):
        return DATA / name
    seed, gsd_m, side_m, date = generated(name)
    return area(work, date, side_m=side_m, gsd_m=gsd_m, seed=seed)


def generated(name: str) -> tuple[int, float, int, str]:
    """Seed, metres per pixel, side in metres (`SIDE_PX` pixels without) and date of a generated
    orthophoto's name."""
    _, seed, *more, date = name.split(":")
    gsd_m = float(more[0]) if more else 1.0
    return int(seed), gsd_m, int(more[1]) if more[1:] else round(SIDE_PX * gsd_m), date


def area(
    work: Path, date: str, *, side_m: int = SIDE_PX, gsd_m: float = 1.0, seed: int = 1
) -> Path:
    """A generated orthophoto of a square."""
    folder = work / f"area-{seed}-{side_m}m-{gsd_m:g}m"
    path = folder / f"{date}.tif"
    if not path.is_file():
        dates = [each for each in DEFAULT_DATES + OTHER_LIGHT if each.name == date]
        generate_area(folder, size_m=(side_m, side_m), gsd_m=gsd_m, dates=dates, seed=seed)
    return path


def gsd_of(path: Path) -> float:
    """Metres per pixel of an orthophoto."""
    with rasterio.open(path) as source:
        return float(abs(source.transform.a))


def map_of(
    path: Path,
    work: Path,
    bounds_deg: tuple[float, float, float, float] | None = None,
    overlap: float = 0.875,
    dem: Path | None = None,
    relief: str | None = None,
) -> Path:
    """The map of an orthophoto as `orthonav build` makes it, built once; of a part within bounds
    (west, south, east, north), with the terrain `dem` or of land like `relief`."""
    part = "" if bounds_deg is None else "-part"
    part += "" if overlap == 0.875 else f"-{overlap:g}"
    part += "" if dem is None else f"-{dem.stem}"
    part += "" if relief is None else f"-{relief}"
    out = work / f"{path.parent.name}-{path.stem}{part}.onav"
    if not out.is_file():
        how: dict[str, Any] = {"bounds_deg": bounds_deg, "overlap": overlap}
        build_map(BuildRequest([path], out, dem=dem, relief=relief, **how))
    return out


def agl_of(width_px: float, gsd_m: float) -> float:
    """Height from which the shorter side of a view covers so many pixels of the map."""
    return width_px * gsd_m / min(DEFAULT_CAMERA.extent)


def flight(path: Path, work: Path, *, views: int, errors: Errors, seed: int, agl_m: float) -> Path:
    """Folder of a flight with views at random places over an orthophoto, flown once."""
    settings = repr((views, errors, seed, round(agl_m, 6)))
    digest = hashlib.sha256(settings.encode()).hexdigest()[:10]
    folder = work / f"{path.parent.name}-{path.stem}-{digest}"
    if not folder.is_dir():
        request = SimulateRequest(
            [path], folder, random=views, agl_m=agl_m, errors=errors, seed=seed
        )
        try:
            simulate_flight(request)
        except OutputError:
            if not folder.is_dir():  # else another process has made the same flight meanwhile
                raise
    return folder


@dataclass(frozen=True, eq=False)
class FlownView:
    """A view, the name of its image, and where it was taken."""

    frame: str
    view: View
    truth_latlon_deg: tuple[float, float]


def views_in(folder: Path) -> Iterator[FlownView]:
    """Views of a flight folder, each read on demand."""
    recorded, truth = open_flight(folder), read_truth(folder / "truth.csv")
    for each in recorded.views:
        if each.frame in truth:
            view = View(each.grey(), recorded.camera, each.telemetry)
            yield FlownView(each.frame, view, truth[each.frame])


def chosen(pairs: Sequence[Pair], only: Sequence[str] | None) -> list[Pair]:
    """Pairs whose imagery is there and whose name contains one of some texts."""
    wanted = [each for each in pairs if not only or any(text in each.name for text in only)]
    return [each for each in wanted if each.is_there]


def far_m(gsd_m: float) -> float:
    """Error beyond which a position is wrong."""
    return max(FAR_M, FAR_PX * gsd_m)


def root_agl_of(width_px: float, gsd_m: float) -> float:
    """Height from which the root of the area of a view is so many pixels of the map."""
    return width_px * gsd_m / math.sqrt(math.prod(DEFAULT_CAMERA.extent))
