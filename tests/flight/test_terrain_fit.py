"""A terrain that does not fit the views of a flight is named once, one that fits is not."""

import logging

import numpy as np
import pytest

from orthonav.core.flight.heights import TerrainFit
from orthonav.core.records import Fix


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


def test_a_terrain_that_fits_is_not_named(caplog):
    assert said_of(hills(), caplog) == []


@pytest.mark.parametrize(
    ("terrain", "named"),
    [
        (hills(more_m=50.0), "m higher than reported over this terrain: check its vertical datum"),
        (hills(shift_deg=0.0015), "it may be displaced"),
        (hills(hole=True), "the terrain has no height below"),
    ],
)
def test_what_does_not_fit_is_named_once(terrain, named, caplog):
    said = said_of(terrain, caplog)
    assert len(said) == 1 and named in said[0]


def test_a_long_flight_is_judged_by_its_latest_views(caplog, monkeypatch):
    """A wrong datum is named once most of them lie on the part of the terrain that has it."""
    monkeypatch.setattr("orthonav.core.flight.heights.MAX_VIEWS", 40)

    def joined(lat, lon):
        return np.where(np.asarray(lon) < 2.005, 200.0, 260.0)

    fit = TerrainFit(joined)
    for number in range(240):
        if number == 200:
            assert caplog.records == []
        lon = 2.0 if number < 200 else 2.01
        fit.take(Fix(47.0, lon, np.eye(2), 0.99, 15.0, 0.0, 250.0, {}), 450.0)
    assert "m higher than reported" in caplog.records[0].getMessage()
