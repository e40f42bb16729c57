"""A view is registered on the part of a sheet around a place, as on all of the sheet."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("faiss", reason="searching an atlas needs FAISS")

from orthonav.atlas import find
from orthonav.atlas.matches import ViewMatches, against
from orthonav.atlas.sheet_registration import SearchRegion, SheetMatch, SheetRegistrar, part_of
from orthonav.flight.folder import open_flight
from orthonav.geo.frames import LocalFrame, distances_m
from orthonav.records import PRIOR_SIGMAS, Prior, View

SIDE_M = 300.0


@pytest.fixture
def registrar(atlas):
    return SheetRegistrar(atlas)


@pytest.fixture(scope="module")
def views(flown):
    flight = open_flight(flown)
    lines = (flown / "truth.csv").read_text().splitlines()
    rows = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    first, last = ((float(row["lat_deg"]), float(row["lon_deg"])) for row in (rows[0], rows[-1]))
    east_m, north_m = LocalFrame(*first).en_from_latlon(*last)
    rows = [row | {"yaw_deg": math.degrees(math.atan2(east_m, north_m))} for row in rows]
    return [
        (View(view.grey(), flight.camera, view.telemetry), row)
        for view, row in zip(itertools.islice(flight.views, 2), rows, strict=False)
    ]


def region(truth, *, east_m=0.0, reach_m=80.0, turn_rad=0.05):
    """A region whose middle is off by `east_m`, of a view straight down."""
    lat, lon = float(truth["lat_deg"]), float(truth["lon_deg"])
    at = LocalFrame(lat, lon).latlon_from_en(np.array([east_m, 0.0]))
    place = float(at[0]), float(at[1])
    turn = math.radians(float(truth["yaw_deg"])) + turn_rad
    return SearchRegion(*place, turn, 0.0, place, reach_m, find.TURN_STD_RAD)


def off_m(match, truth):
    return distances_m([match.latlon_deg], [(float(truth["lat_deg"]), float(truth["lon_deg"]))])[0]


def whole(atlas, view, where):
    """The view registered on all of the first sheet that may show it, as far as `where` reaches."""
    found = []
    for sheet in SheetRegistrar(atlas).near(where, SIDE_M):
        telemetry = replace(view.telemetry, yaw_deg=math.degrees(where.turn_rad))
        prior = Prior(*where.latlon_deg, where.reach_m / PRIOR_SIGMAS)
        turned = replace(view, telemetry=telemetry)
        seen = sheet.register(turned, prior, heading_std_rad=where.turn_std_rad)
        pose = seen.found.placed.pose
        place = sheet.sheet.frame.latlon_from_en(sheet.camera_en_m(seen.prepared, pose))
        found.append((seen.found.score, tuple(map(float, place))))
    return max(found)


@pytest.mark.parametrize("east_m", [0.0, 40.0])
def test_a_part_of_a_sheet_gives_the_place_of_the_whole_sheet(atlas, registrar, views, east_m):
    for view, truth in views:
        where = region(truth, east_m=east_m)
        found = registrar.of_view(view, SIDE_M).searched(where)
        score, place = whole(atlas, view, where)
        assert off_m(found, truth) < 10
        assert distances_m([found.latlon_deg], [place])[0] < 0.5
        assert found.evidence["strength"] == pytest.approx(score, rel=0.02)


def test_a_candidate_is_judged_and_finished_at_the_place_of_the_search(registrar, views):
    view, truth = views[0]
    of_view = registrar.of_view(view, SIDE_M)
    judged = of_view.judged(region(truth, east_m=30.0))
    searched = of_view.searched(region(truth, east_m=30.0))
    assert distances_m([judged.latlon_deg], [searched.latlon_deg])[0] < 25
    finished = judged.finished()
    assert distances_m([finished.latlon_deg], [searched.latlon_deg])[0] < 1
    assert finished.evidence["strength"] == pytest.approx(searched.evidence["strength"], rel=0.02)


def test_places_without_a_sheet_have_no_match(registrar, views):
    view, truth = views[0]
    of_view = registrar.of_view(view, SIDE_M)
    nowhere = replace(region(truth), lat_deg=10.0, middle_latlon_deg=(10.0, 10.0))
    assert of_view.judged(nowhere) is None and of_view.searched(nowhere) is None


def test_the_part_of_a_pyramid_shows_what_the_whole_shows(registrar, views):
    _, truth = views[0]
    sheet = registrar.near(region(truth), SIDE_M)[0]
    middle = (sheet.grid.width_px / 2, sheet.grid.height_px / 3)
    part = part_of(sheet, middle, 90.0)
    east_px = (part.grid.west_m - sheet.grid.west_m) / sheet.grid.gsd_m
    south_px = (sheet.grid.north_m - part.grid.north_m) / sheet.grid.gsd_m
    for level in range(sheet.pyramid.levels):
        rows, cols = part.pyramid.shape(level)
        row, col = (round(at) >> level for at in (south_px, east_px))
        for mine, theirs in zip(
            part.pyramid.read(level, 0, 0, rows, cols),
            sheet.pyramid.read(level, row, col, rows, cols),
            strict=True,
        ):
            assert np.array_equal(mine, theirs)
    assert part_of(sheet, (-500.0, -500.0), 90.0) is None
    corner = part_of(sheet, (0.0, 0.0), 90.0)
    assert corner.pyramid.shape(0)[0] < part.pyramid.shape(0)[0]


class Judged:
    """A candidate whose searches are counted."""

    def __init__(self, place, look, strength, searches):
        self.latlon_deg, self.look, self._strength = (48.0 + place / 100, 11.0), look, strength
        self._searches = searches

    def finished(self):
        evidence = {
            **{"strength": self._strength, "rival": 0.0, "look": self.look, "look_rival": 0.0},
            **{"fine": math.nan, "fine_rival": math.nan, "detail_ratio": 1.4},
            **{"local_phase": 9.0, "local_gradients": 9.0},
        }
        return SheetMatch(*self.latlon_deg, 0.0, 0.0, evidence, None)

    def searched(self):
        self._searches.append(self.look)
        return self.finished()


class Registrar:
    """Judges regions that are candidates already."""

    def judged(self, region):
        return region


def found_among(*candidates):
    """What is found among candidates (place, look, strength), and which were searched."""
    searches = []
    found = ViewMatches(300.0)
    found.add_candidates(Registrar(), [Judged(*each, searches) for each in candidates])
    return found, searches


def test_a_proven_match_ends_the_search_of_candidates():
    weak = [(place, 14.0, 30.0) for place in range(2, 9)]
    found, searches = found_among(*weak, (1, 60.0, 120.0))
    assert searches == [60.0] and found.found[0].evidence["strength"] == 120.0
    assert found.proves((48.01, 11.0), 1.0) and not found.proves((48.05, 11.0), 1000.0)


def test_without_a_proven_match_the_strongest_candidates_are_searched():
    alike = [(place, 15.0 - place / 10, 30.0 - place) for place in range(8)]
    found, searches = found_among(*alike)
    assert searches == [15.0, 14.9, 14.8, 14.7] and len(found.found) == 8
    assert not found.proves(found.found[0].latlon_deg, 1e6)


def test_candidates_that_were_not_finished_are_rivals_too():
    weak = [(place, 14.0, 30.0) for place in range(2, 9)]
    alone, _ = found_among((1, 60.0, 120.0))
    beside, _ = found_among((1, 60.0, 120.0), *weak)
    assert len(beside.found) < 1 + len(weak)
    assert beside.log_odds(0) <= alone.log_odds(0)
    assert against(beside.found[0].evidence, [], [14.0])["look_rival"] == 14.0
