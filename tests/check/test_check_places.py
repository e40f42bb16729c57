"""Cells and places of trials: where the map shows coverage and the band lies."""

import math

import numpy as np
import pytest
from made_check import area_of

from orthonav.core.errors import AreaError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.cells import CellGrid, MapCoverage, checked_m2, trial_places

FRAME = LocalFrame(46.0, 3.0)


def covering(west_m, north_m, pixel_m, valid):
    return MapCoverage(CellGrid(west_m, north_m, pixel_m, *valid.shape), valid)


WHOLE = covering(-1000.0, 1000.0, 2.0, np.ones((1000, 1000), np.bool_))


@pytest.mark.parametrize(
    "points, bands, expected_m2",
    [
        ([[0, 0]], [400.0], math.pi * 200**2),
        ([[-600, 0], [600, 0]], [20.0], 1200 * 20 + math.pi * 10**2),
        ([[-600, -600], [600, 600]], [20.0], 1200 * math.sqrt(2) * 20),
        ([[-600, 0], [0, 0], [0, 600]], [20.0, 100.0], 600 * 120 + math.pi * 50**2 / 2),
        ([[800, 0], [4000, 0]], [200.0], 200 * 200 + math.pi * 100**2 / 2),
    ],
    ids=["one waypoint", "thin", "thin and slanting", "a band per leg", "half beyond the map"],
)
def test_ground_of_a_band(points, bands, expected_m2):
    area = area_of(FRAME, points, bands)
    assert checked_m2(WHOLE, area) == pytest.approx(expected_m2, rel=0.1)


def test_a_band_outside_the_map_is_refused():
    with pytest.raises(AreaError, match=r"does not touch the map, \d\.\d km from it"):
        checked_m2(WHOLE, area_of(FRAME, [[5000, 0], [6000, 0]], [300.0]))
    holes = covering(-1000.0, 1000.0, 2.0, np.zeros((1000, 1000), np.bool_))
    with pytest.raises(AreaError, match="no imagery"):
        checked_m2(holes, area_of(FRAME, [[0, 0], [100, 0]], [300.0]))


def places(area=None, coverage=WHOLE, count=32, seed=1):
    extent = coverage.extent_en_m if area is None else area.extent_en_m
    rng, wanted_m2 = np.random.default_rng(seed), checked_m2(coverage, area)
    return trial_places(coverage, area, extent, wanted_m2, count, rng)


@pytest.mark.parametrize("band_m", [2.0, 60.0, 500.0])
def test_places_lie_in_the_band_and_on_the_map(band_m):
    valid = np.ones((1000, 1000), np.bool_)
    valid[400:600, 300:700] = False
    coverage = covering(-1000.0, 1000.0, 2.0, valid)
    area = area_of(FRAME, [[-1500, -900], [900, 800]], [band_m])
    found = places(area, coverage)
    assert 16 < len(found) <= 32
    assert area.contains(found).all() and coverage.covers(found).all()
    assert np.ptp(found, axis=0) == pytest.approx([1900, 1350], rel=0.25)  # over all of it
