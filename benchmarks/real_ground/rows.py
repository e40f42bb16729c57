"""The rows: which views on which map, single or tracked."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

from benchmarks.closed_loop.replays import MIRRORED, SHIFTED
from benchmarks.real_ground.mapping import STRIPS, Windows
from benchmarks.real_ground.maps import (
    BARE,
    COARSE,
    DISPLACED,
    DRAPED,
    FLAT,
    HIGH,
    HOLES,
    OUTDATED,
    SURFACE,
    Map,
)
from benchmarks.real_ground.pairs import SINGLE, TRACKED
from benchmarks.real_ground.score import Row, Source, placed
from benchmarks.real_ground.views import OverLevel, OverRelief, Recording, Replay
from benchmarks.scenes import DATA, PAST, PRESENT, SCENES, Pair, Scene, leave_one_out_pairs
from orthonav.cli.demo import IMAGERY
from orthonav.core.track.tracker import Tracker
from orthonav.onboard.run import Locator, SingleViews

PARTS = (
    *("flights", "replays", "oblique", "flat", "relief", "hills", "houses", "towns", "lens"),
    "mapping",
)
REPLAYED = (
    *("px4_plane", "px4_quad", "px4_plane_on_e05f2ea8", "px4_quad_on_e05f2ea8"),
    *("px4_plane_dead_reckoning", "px4_plane_no_velocity"),
    *("ardupilot_plane_odometry", "ardupilot_plane_gps_input"),
)
DISTURBED = (
    *product(("px4_plane", "ardupilot_plane_gps_input"), (SHIFTED, MIRRORED)),
    ("px4_plane_no_velocity", SHIFTED),
)
ARROIO_STD_M = 5.0
"""The truth is good to 7 to 10 m (README of the data): 5 to 7 m per axis. The smaller, so that the
error of the truth hides less of the localizer's."""
TAICHUNG_STD_M = 4.0
"""The truth is good to about 5 m (README of the data): 4 m per axis, rounded up."""
TOURS_STD_M = 4.0
"""The photographs of both dates agree within about 6 px of 1 m (README of the data)."""
TILTED_STD_M, TILTED_GROUND_STD_M = 2.5, 0.5
"""By registration and PnP: 2 to 3 m, the ground in the middle 0.5 m (README of the data)."""
SUBURB_GSD_M = 0.52
"""At this scale 256 px are seen from 133 m; the nominal scale of the imagery is a stand-in."""
SUBURB = ("2020_03", "2009_04"), ("2001_09", "2015_04")
SLOPES = (2.0, 5.0, 10.0)
LAND = {2.0: "level", 5.0: "rolling", 10.0: "hills"}
TILTS = (0.0, None), (0.0, 0.5), (1.0, None), (3.0, None)
"""Standard deviations of the true pitch and roll, and as stated, degrees."""
TOWN_GSD_M, TOWN_SEEDS, TOWN_SIDE_M, TOWN_WITHIN_M = 0.2, (253, 286, 288), 1000, 250.0
"""Of seeds 1 to 300 those whose first square kilometre has a town, and nearest to its middle; its
side, and how far from the middle of it the views look."""
TOWN_LOOKS = *product((120.0, 80.0, 50.0), (0.0, 30.0, 45.0)), (250.0, 0.0), (250.0, 30.0)
"""Heights of views, and how far they look ahead; farther ahead they would show land beyond the
map."""
TOWN_NOMINAL = 80.0, 30.0
"""The same of views by a lens of which only the field of view is known."""


@dataclass(frozen=True)
class Question:
    """One row of the table.

    `legs`: maps with their views; several where each picture has a map of its own. `prior`: whether
    single views use that of the telemetry.
    """

    name: str
    part: str
    legs: tuple[tuple[Map, Source], ...]
    tracked: bool = False
    prior: bool = False

    def of_each(self, views: int) -> int:
        """Views of each leg."""
        return math.ceil(views / len(self.legs))

    def measured(self, work: Path, views: int) -> Row:
        """Place the views, as many of each leg."""
        found, share = Row([], []), self.of_each(views)
        for built, source in self.legs:
            localizer = built.localizer(work)
            locator: Locator = SingleViews(localizer, use_prior=self.prior)
            if self.tracked:
                locator = Tracker(localizer)
            seen = source.seen(work, localizer, share, self.tracked)
            found += placed(locator, seen, localizer.sheet.frame, source.std_m)
        return found


def questions() -> list[Question]:
    """All rows whose imagery is there, those of real flights first."""
    made = [
        *(*_flights(), *_replays(), *_oblique(), *_steady(), *_known()),
        *(*_relief(), *_hills(), *_lens(), *_mapping()),
    ]
    return [each for each in made if all(_is_there(*leg) for leg in each.legs)]


def _is_there(built: Map, source: Source) -> bool:
    """Whether the files of a leg are there, or are generated."""
    names = [each for each in (built.ortho, source.imagery()) if "generated:" not in each]
    return all((DATA / name.rpartition(":")[2]).exists() for name in names)


def both(name: str, part: str, *legs: tuple[Map, Source]) -> Iterator[Question]:
    """Single views and a track."""
    yield Question(f"{name}{SINGLE}", part, legs)
    yield Question(f"{name}{TRACKED}", part, legs, tracked=True)


def _flights() -> Iterator[Question]:
    for month in ("2014-01", "2014-03"):
        flown = Recording("arroio_drone_1", ARROIO_STD_M, track=9)  # all its views, as single ones
        yield from both(f"arroio on {month}", "flights", (Map(f"arroio_maps/{month}.tif"), flown))
    taichung = Recording("taichung_drone", TAICHUNG_STD_M)
    yield from both("taichung", "flights", (Map("taichung_drone/map.tif"), taichung))
    tilted = Recording("tilted_mount", TILTED_STD_M)
    ground = Recording("tilted_mount", TILTED_GROUND_STD_M, "truth_ground.csv", of_ground=True)
    on = Map("scaled:0.5:tilted_mount/map.tif")
    yield from both("tilted_mount", "flights", (on, tilted))
    yield Question("tilted_mount, middle of the picture", "flights", ((on, ground),))


def _replays() -> Iterator[Question]:
    on = Map(str(IMAGERY / f"{PAST}.tif"), str(IMAGERY / "dem.tif"), datum=None)
    for flight, with_stds in product(REPLAYED, (False, True)):
        name = f"{flight}, {'deviations stated' if with_stds else 'nothing stated'}"
        single, tracked = both(name, "replays", (on, Replay(f"closed_loop/{flight}", with_stds)))
        yield from (replace(single, prior=True), tracked)
    for flight, phase in DISTURBED:
        leg = on, Replay(f"closed_loop/{flight}", True, phase)
        yield from both(f"{flight}, camera {phase}", "replays", leg)


def _oblique() -> Iterator[Question]:
    files = {"no terrain": None, "bare earth": "bare_earth.tif", "surface": "surface.tif"}
    for kind, file in files.items():
        ground = None if file is None else f"oblique_surface/{file}"
        legs = tuple(
            (
                Map(f"oblique_surface/map_for_{number}.tif", ground),
                Recording("oblique_surface", 0.0, only=number),
            )
            for number in ("0136", "0142")
        )
        yield Question(f"oblique_surface, {kind}", "oblique", legs)


def _grounds(name: str, slope: float) -> Iterator[tuple[str, Map]]:
    """Maps over relief, by what they know of it."""
    yield "no terrain", Map(name, relief=slope)
    if slope in LAND:
        yield f"no terrain, {LAND[slope]}", Map(name, relief=slope, land=LAND[slope])
    if name.startswith("generated:"):
        kinds = {"bare earth": BARE, "surface": SURFACE, "surface of another year": OUTDATED}
    else:
        kinds = {"30 m terrain": COARSE, "bare earth": BARE}
    for kind, ground in kinds.items():
        yield kind, Map(name, ground, slope)


def _farmland() -> list[Pair]:
    return [SCENES[f"szada_{n}"].pair(f"szada_{n}_a", f"szada_{n}_b") for n in ("1", "5", "7")]


def _rendered(
    name: str,
    part: str,
    pairs: list[Pair],
    slope: float,
    nominal: bool = False,
) -> Iterator[Question]:
    """Rows over one relief: true and stated tilt, and what the map knows of the ground."""
    for tilt, stated in TILTS:
        tilt_text = "" if stated is None else f" stated {stated:g}"
        maps = [dict(_grounds(pair.map, slope)) for pair in pairs]
        for ground in maps[0]:
            legs = tuple(
                (on[ground], OverRelief(pair, slope, tilt, stated, nominal))
                for on, pair in zip(maps, pairs, strict=True)
            )
            yield Question(f"{name} {slope:g} %, tilt {tilt:g}{tilt_text}, {ground}", part, legs)


def _relief() -> Iterator[Question]:
    farmland = _farmland()
    for slope in SLOPES:
        yield from _rendered("farmland", "relief", farmland, slope)
    yield from _rendered("naip", "relief", [SCENES["naip"].pair("20090818", "20180716")], 5.0)
    lab = SCENES["generated_31"].pair(PAST, PRESENT)
    yield from _rendered("houses and trees", "houses", [lab], 5.0)
    yield from _towns()


def _hills() -> Iterator[Question]:
    """Steep ground; terrain that is wrong, where heights above sea are reported; and far ahead."""
    places = {"farmland": _farmland(), "naip": [SCENES["naip"].pair("20090818", "20180716")]}
    asked = (
        *(("farmland", *each, False) for each in product((20.0, 30.0), (None, BARE))),
        *((*each, BARE, True) for each in product(places, (20.0, 30.0))),
        *(("farmland", 20.0, ground, True) for ground in (DISPLACED, HIGH, HOLES)),
    )
    for place, slope, ground, above_sea in asked:
        legs = tuple(
            (Map(pair.map, ground, slope), OverRelief(pair, slope, above_sea=above_sea))
            for pair in places[place]
        )
        height = ", height above sea" * above_sea
        yield Question(f"{place} {slope:g} %{height}, {ground or 'no'} terrain", "hills", legs)
    pair = Scene("hills", "generated:3", 1.0, (PAST, PRESENT)).pair(PAST, PRESENT)
    for ahead_deg, ground in product((30.0, 45.0, 60.0), (None, DRAPED)):
        ahead = OverRelief(
            pair, 15.0, agl_m=250.0, ahead_deg=ahead_deg, within_m=500.0, draped=True
        )
        name = f"hills 15 %, {ahead_deg:g} deg ahead, {'bare' if ground else 'no'} terrain"
        yield Question(name, "hills", ((Map(pair.map, ground, 15.0), ahead),))


def _towns() -> Iterator[Question]:
    folder = f"generated:{{}}:{TOWN_GSD_M}:{TOWN_SIDE_M}"
    dates = PAST, PRESENT
    towns = [
        Scene(f"town_{seed}", folder.format(seed), TOWN_GSD_M, dates).pair(*dates)
        for seed in TOWN_SEEDS
    ]
    maps = [dict(_grounds(pair.map, 2.0)) for pair in towns]
    asked = [*((*each, False) for each in TOWN_LOOKS), (*TOWN_NOMINAL, True)]
    for agl_m, ahead_deg, nominal in asked:
        for ground in ("no terrain", "bare earth", "surface", "surface of another year"):
            views = partial(
                OverRelief,
                agl_m=agl_m,
                ahead_deg=ahead_deg,
                nominal=nominal,
                within_m=TOWN_WITHIN_M,
            )
            legs = tuple(
                (on[ground], views(pair, 2.0, 1.0)) for on, pair in zip(maps, towns, strict=True)
            )
            lens = ", nominal lens" * nominal
            name = f"town from {agl_m:g} m, {ahead_deg:g} deg ahead{lens}, {ground}"
            yield Question(name, "towns", legs)


def _known() -> Iterator[Question]:
    """Flat ground that the map knows, and a tilt that is not reported."""
    for tilt in (0.0, 3.0):
        legs = tuple((Map(pair.map, FLAT, 0.0), OverLevel(pair, tilt)) for pair in _farmland())
        yield Question(f"farmland flat, tilt {tilt:g}, flat terrain", "flat", legs)
    for pair in leave_one_out_pairs():
        std_m = TOURS_STD_M if pair.scene == "tours" else 0.0
        leg = Map(pair.map, FLAT, 0.0), OverLevel(pair, 3.0, std_m=std_m)
        yield Question(f"{pair.name} flat, tilt 3, flat terrain", "flat", (leg,))


def _lens() -> Iterator[Question]:
    for slope in (0.0, 5.0):
        yield from _rendered("nominal lens", "lens", _farmland(), slope, nominal=True)


def _mapping() -> Iterator[Question]:
    """Orientation exact, or pitch and roll off by 1 deg."""
    for tilt in (0.0, 1.0):
        for name, dem in (("no terrain", None), ("24 m terrain", "relief_ngi/dem.tif")):
            legs = tuple(
                (Map(f"strip:{strip}:relief_ngi", dem, datum=None), Windows(strip, tilt))
                for strip in range(len(STRIPS))
            )
            yield Question(f"relief_ngi, tilt off by {tilt:g}, {name}", "mapping", legs)


def _steady() -> Iterator[Question]:
    naip = SCENES["naip"]
    for date in ("20120731", "20180716"):
        pair = naip.pair("20090818", date)
        for stated in (None, 0.5):
            tilt_text = "default" if stated is None else f"tilt stated {stated:g}"
            leg = Map(pair.map), OverLevel(pair, 0.0, stated)
            yield Question(f"naip {date}, steady, {tilt_text}", "flat", (leg,))
    folder = f"scaled:{SUBURB_GSD_M}:scenes/garching"
    suburb = [
        Pair("garching", f"{folder}/{past}.tif", f"{folder}/{present}.tif", SUBURB_GSD_M)
        for past, present in SUBURB
    ]
    legs = tuple((Map(pair.map), OverLevel(pair, 3.0)) for pair in suburb)
    yield Question("garching from 133 m, tilt 3", "flat", legs)
