"""Heights above ground from heights above sea, take-off and the ellipsoid."""

import logging
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.flight.heights import (
    LIMITS,
    FlownHeights,
    TerrainFit,
    assumed_heights,
    is_measured,
    needs_datum,
)
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, Prior, Telemetry

FRAME = LocalFrame(46.5, 2.5)
SLOPE = 0.1
HOLE_M = 3000.0


def terrain(lat_deg, lon_deg):
    """300 m in the middle, a metre more every 10 m to the north; a hole east of `HOLE_M`."""
    east, north = np.moveaxis(FRAME.en_from_latlon(lat_deg, lon_deg), -1, 0)
    return np.where(east > HOLE_M, np.nan, 300 + SLOPE * north)


def place(east_m, north_m):
    return tuple(float(value) for value in FRAME.latlon_from_en([east_m, north_m]))


def reported(time_s=0.0, agl_m=math.nan, prior=None, **heights):
    return Telemetry(round(time_s * 1e9), 0.0, 0.0, 0.0, agl_m, prior=prior, **heights)


def area(half_m=2000.0):
    east, north = np.meshgrid(*[np.linspace(-half_m, half_m, 21)] * 2)
    return FRAME.latlon_from_en(np.stack([east.ravel(), north.ravel()], axis=1))


def flown(**options):
    return FlownHeights(terrain, area(), **options)


def fix(east_m, north_m, confidence=0.95, std_m=5.0):
    cov = np.eye(2) * std_m**2
    return Fix(*place(east_m, north_m), cov, confidence, 35.0, 0.0, 100.0)


@pytest.mark.parametrize(
    "heights, expected_m",
    [
        ({"amsl_m": 700.0}, 300.0),
        ({"home_m": 250.0}, 170.0),  # took off at 320 m
        ({"home_m": 250.0, "agl_m": 250.0}, 170.0),  # level ground was assumed
        ({"hae_m": 747.0}, 300.0),
        ({"amsl_m": 700.0, "home_m": 250.0, "hae_m": 1.0}, 300.0),
        ({"agl_m": 123.0, "amsl_m": 700.0, "home_m": 250.0}, 123.0),  # measured
    ],
)
def test_each_height_becomes_one_above_ground(heights, expected_m):
    telemetry = reported(prior=Prior(*place(0, 1000), 0.0), **heights)  # over ground at 400 m
    start = {"take_off": (*place(0, 200), 0.0), "geoid": lambda lat, lon: 0 * lat + 47.0}
    found = flown(**start).corrected(telemetry)
    assert found.agl_m == pytest.approx(expected_m, abs=0.01) and found.agl_std_m is None
    if heights.keys() == {"hae_m"}:  # it is not taken for another one
        assert math.isnan(flown().corrected(telemetry).agl_m)


def test_an_unknown_place_has_the_geoid_of_the_area_also_across_the_antimeridian():
    fiji = LocalFrame(-17.0, 180.0)
    east, north = np.meshgrid(*[np.linspace(-2000, 2000, 21)] * 2)
    around = fiji.latlon_from_en(np.stack([east.ravel(), north.ravel()], axis=1))
    options = {"geoid": lambda lat, lon: np.where(np.abs(lon) > 170, 56.0, 15.0)}
    heights = FlownHeights(lambda lat, lon: 0 * lat + 300.0, around, **options)
    assert heights.corrected(reported(hae_m=656.0)).agl_m == pytest.approx(300.0)


def test_over_an_unknown_datum_only_heights_above_take_off_are_converted():
    over = flown(take_off=(*place(0, 200), 0.0), datum_known=False)  # took off at 320 m
    both = over.corrected(reported(amsl_m=1.0, home_m=250.0, hae_m=1.0))
    assert both.agl_m == pytest.approx(270.0, abs=0.1)
    for heights in ({"amsl_m": 700.0}, {"hae_m": 700.0}):
        assert needs_datum(reported(**heights))
        assert math.isnan(over.corrected(reported(**heights)).agl_m)
    assert over.corrected(reported(agl_m=123.0, amsl_m=700.0)).agl_m == 123.0
    assert not needs_datum(reported(agl_m=123.0, amsl_m=700.0))
    assert math.isnan(over.ground_m(fix(0, 0)))


def test_a_flight_without_a_position_uses_the_area_searched():
    found = flown().corrected(reported(amsl_m=700.0))
    std_m = SLOPE * np.std(np.linspace(-2000, 2000, 21))
    assert found.agl_m == pytest.approx(400, abs=0.1)
    assert found.agl_std_m == pytest.approx(math.hypot(0.08 * 400, std_m), rel=1e-3)


def test_a_flight_uses_its_prior_and_its_last_confident_fix():
    heights = flown()
    near = reported(amsl_m=700.0, prior=Prior(*place(0, 1000), 50.0))
    assert heights.corrected(near).agl_m == pytest.approx(300, abs=0.1)
    assert flown(use_prior=False).corrected(near).agl_m == pytest.approx(400, abs=1)
    heights.observe(10**9, fix(0, -1000), "tracking")
    found = heights.corrected(reported(2.0, amsl_m=700.0))
    assert found.agl_m == pytest.approx(500, abs=0.2)
    assert found.agl_std_m == pytest.approx(math.hypot(40, SLOPE * 35), rel=0.02)
    moved = heights.corrected(reported(21.0, amsl_m=700.0, vel_en_mps=(0.0, 50.0)))
    assert moved.agl_m == pytest.approx(400, abs=0.5)  # 1 km farther north
    far = heights.corrected(reported(100.0, amsl_m=700.0))
    assert far.agl_std_m > 5 * found.agl_std_m  # a place ages
    wide = reported(1e4, amsl_m=700.0, prior=Prior(*place(0, 1500), 1e6))
    assert heights.corrected(wide).agl_m == pytest.approx(400, abs=1)  # neither is known any more


@pytest.mark.parametrize(
    "outcome, state",
    [
        (fix(0, 1000, confidence=0.5), None),
        (fix(0, 1000, confidence=math.nan), None),
        (fix(0, 1000), "searching"),
        (NoFix("blank", "nothing to see"), None),
    ],
)
def test_doubtful_positions_say_nothing_about_the_ground(outcome, state):
    heights = flown()
    heights.observe(0, outcome, state)
    assert heights.corrected(reported(amsl_m=700.0)).agl_m == pytest.approx(400, abs=0.1)


def test_a_track_that_is_lost_forgets_its_place():
    heights = flown()
    heights.observe(0, fix(0, 1000), "tracking")
    heights.observe(10**9, NoFix("blank", "nothing to see"), "coasting")
    assert heights.corrected(reported(1.0, amsl_m=700.0)).agl_m == pytest.approx(300, abs=1)
    heights.observe(2 * 10**9, NoFix("lost", "no position"), "lost")
    assert heights.corrected(reported(2.0, amsl_m=700.0)).agl_m == pytest.approx(400, abs=1)


def test_a_hole_below_is_filled_by_the_area():
    heights = flown()
    found = heights.corrected(reported(amsl_m=700.0, prior=Prior(*place(5000, 0), 10.0)))
    assert found.agl_m == pytest.approx(400, abs=0.1) and found.agl_std_m > 100
    nothing = FlownHeights(lambda lat, lon: np.full(np.shape(lat), np.nan), area())
    assert math.isnan(nothing.corrected(reported(amsl_m=700.0)).agl_m)


def test_heights_that_disagree_are_named_once(caplog):
    start = (*place(0, 0), 5.0)
    heights = flown(take_off=start)
    for _ in range(3):
        heights.corrected(reported(home_m=100.0, amsl_m=400.0 - LIMITS.mismatch_m - 5))
    assert caplog.text.count("differ by 25 m over this terrain") == 1
    caplog.clear()
    flown(take_off=start).corrected(reported(home_m=100.0, amsl_m=405.0))
    assert not caplog.text


@pytest.mark.parametrize(
    "telemetry, terrain_name, words",
    [
        (reported(agl_m=100.0), None, None),
        (reported(agl_m=100.0, home_m=101.0), "dem", None),
        (reported(), None, None),
        (reported(agl_m=100.0, home_m=100.0), None, "level ground is assumed.*--dem"),
        (reported(amsl_m=100.0), None, "only heights above sea level are known.*--dem"),
        (reported(hae_m=100.0), None, "only heights above the ellipsoid are known"),
        (reported(agl_m=9.0, home_m=9.0), "dem", "above take-off plus the terrain there minus dem"),
        (reported(amsl_m=9.0), "dem", "is the height above sea level minus dem"),
    ],
)
def test_what_is_assumed_is_said(telemetry, terrain_name, words):
    said = assumed_heights(telemetry, terrain_name)
    assert (said is None) if words is None else re.search(words, said)
    assert is_measured(telemetry) == (telemetry.agl_m == 100.0 and telemetry.home_m != 100.0)


def hills(shift_deg=0.0, more_m=0.0, hole=False):
    def heights(lat, lon):
        made = 200 + 30 * np.sin((np.asarray(lon) + shift_deg) * 1200) + more_m
        return np.where(np.asarray(lon) > 2.01, np.nan, made) if hole else made

    return heights


def said_of(terrain, caplog, baro_m=10.0):
    rng = np.random.default_rng(3)
    fit = TerrainFit(terrain)
    with caplog.at_level(logging.WARNING):
        for lon in np.linspace(2.0, 2.02, 60):
            agl_m = 450.0 - float(hills()(47.0, lon))
            found_m = agl_m * (1 + float(rng.normal(0, 0.01)))
            fix = Fix(47.0, float(lon), np.eye(2), 0.99, 15.0, 0.0, found_m, {})
            fit.take(fix, 450.0 + baro_m)
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize(
    ("terrain", "named"),
    [
        (hills(), []),
        (hills(more_m=50.0), ["higher than reported over this terrain: check its vertical datum"]),
        (hills(shift_deg=0.0015), ["it may be displaced"]),
        (hills(hole=True), ["the terrain has no height below"]),
    ],
)
def test_what_does_not_fit_is_named_once(terrain, named, caplog):
    said = said_of(terrain, caplog)
    assert len(said) == len(named) and all(words in said[0] for words in named)


def test_a_long_flight_is_judged_by_its_latest_views(caplog, monkeypatch):
    """A wrong datum is named once most of them lie on the part of the terrain that has it."""
    monkeypatch.setattr("orthonav.core.flight.heights.LIMITS", replace(LIMITS, max_views=40))

    def joined(lat, lon):
        return np.where(np.asarray(lon) < 2.005, 200.0, 260.0)

    fit = TerrainFit(joined)
    for number in range(240):
        if number == 200:
            assert caplog.records == []
        lon = 2.0 if number < 200 else 2.01
        fit.take(Fix(47.0, lon, np.eye(2), 0.99, 15.0, 0.0, 250.0, {}), 450.0)
    assert "m higher than reported" in caplog.records[0].getMessage()
