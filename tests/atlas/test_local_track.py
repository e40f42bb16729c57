"""A track begins at a place found in an atlas, and follows the aircraft on maps cut for it."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthonav.core.flight.folder import open_flight, read_truth
from orthonav.core.geo.frames import LocalFrame, distances_m
from orthonav.core.records import NoFix, View
from orthonav.core.track import State
from orthonav.ground.atlas import locate
from orthonav.ground.atlas.locate import FoundPlace, LocalTrack
from orthonav.ground.atlas.search import Placement

STD_M = 12.5
BEGUN = 3
"""Views with which the track begins."""


@pytest.fixture(scope="module")
def views(flown):
    flight = open_flight(flown)
    return [View(view.grey(), flight.camera, view.telemetry) for view in flight.views]


@pytest.fixture(scope="module")
def places(flown):
    return list(read_truth(flown / "truth.csv").values())


def found(views, places, confidence=0.95, moved_m=0.0):
    seen = []
    for view, place in zip(views[:BEGUN], places, strict=False):
        lat, lon = LocalFrame(*place).latlon_from_en([moved_m, 0.0])
        seen.append((view, Placement(float(lat), float(lon), 0.0, 0.0)))
    return FoundPlace(tuple(seen), STD_M, confidence)


def test_the_track_follows_from_one_map_to_the_next(atlas, views, places, monkeypatch):
    cuts, cut = [], locate.cut_in_memory
    monkeypatch.setattr(locate, "AHEAD_M", 0.0)
    monkeypatch.setattr(locate, "cut_in_memory", lambda *args: cuts.append(args) or cut(*args))
    track = LocalTrack(atlas, found(views, places), heading_known=False)
    assert track.agrees
    assert track.fix.confidence <= 0.95  # no more than that of the place found
    along = LocalFrame(*places[0]).en_from_latlon(*places[-1])
    heading_deg = math.degrees(math.atan2(*along))  # views look along the route
    for view, place in zip(views[BEGUN:], places[BEGUN:], strict=True):
        assert track.locate(view)
        here = (track.fix.lat_deg, track.fix.lon_deg)
        assert distances_m([here], [place])[0] < 25
        assert track.state is State.TRACKING
        assert track.fix.confidence > 0.9
        assert abs((track.fix.heading_deg - heading_deg + 180) % 360 - 180) < 5
    assert len(cuts) > 1


@pytest.mark.long
def test_views_of_another_place_have_no_fix(atlas, views, places):
    track = LocalTrack(atlas, found(views, places), heading_known=False)
    rng = np.random.default_rng(1)
    view = views[BEGUN]
    other = np.ascontiguousarray(view.grey[:, ::-1])
    noise = rng.integers(0, 256, view.grey.shape).astype(np.uint8)
    assert not track.locate(replace(view, grey=other)) or track.fix is None
    assert not track.locate(replace(view, grey=cv2.blur(noise, (3, 3)))) or track.fix is None


def test_views_that_do_not_show_the_place_found_begin_no_track(atlas, views, places, monkeypatch):
    monkeypatch.setattr(locate, "AHEAD_M", 0.0)
    track = LocalTrack(atlas, found(views, places, moved_m=300.0), heading_known=False)
    assert not track.agrees


def test_a_view_that_cannot_be_used_has_no_fix_and_does_not_end_the_track(atlas, views, places):
    track = LocalTrack(atlas, found(views, places), heading_known=False)
    passed = views[BEGUN].telemetry
    assert track.passed(passed, NoFix("bad_image", "damaged"))
    assert track.fix is None
    assert track.locate(views[BEGUN + 1])
    here = (track.fix.lat_deg, track.fix.lon_deg)
    assert distances_m([here], [places[BEGUN + 1]])[0] < 25


def test_a_track_ends_where_the_aircraft_may_be_anywhere(atlas, views, places):
    track = LocalTrack(atlas, found(views, places), heading_known=False)
    late = views[BEGUN].telemetry.time_ns + 600 * 10**9
    telemetry = replace(views[BEGUN].telemetry, time_ns=late, yaw_deg=math.nan)
    assert not track.locate(replace(views[BEGUN], telemetry=telemetry))
