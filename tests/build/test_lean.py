"""Orthophotos in which houses lean."""

import cv2
import numpy as np
import pytest

from helpers import box_deg
from orthonav.core.errors import MapFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.mapfile.manifest import Lean
from orthonav.ground.build.lean import STEP, TRUE_ORTHO, as_shown, visible_lean
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area

SIDE_M, PX_M = 400.0, 0.5
SHADOW = Lean(-0.5, 0.5, 0.0)
"""Of the sun 35 deg off the zenith."""


@pytest.fixture(scope="module")
def town():
    """Grey levels of ground and roofs, and heights of houses, (H, W)."""
    rng = np.random.default_rng(0)
    side = round(SIDE_M / PX_M)
    ground = 110 + 40 * cv2.GaussianBlur(rng.normal(0, 1, (side, side)), (0, 0), 4) * 8
    roofs, high = ground.copy(), np.zeros((side, side))
    for _ in range(150):
        row, col = rng.integers(20, side - 50, 2)
        size = np.s_[row : row + rng.integers(14, 28), col : col + rng.integers(14, 28)]
        roofs[size], high[size] = rng.uniform(40, 210), rng.uniform(4, 10)
    return ground, roofs, high


def pictured(town, lean, shadows=True):
    """The town in an orthophoto with a lean, walls in a dark grey."""
    ground, roofs, high = town
    made = ground.copy()
    if shadows:
        made = np.where(moved(high, high, SHADOW) > 2, 0.5 * made, made)
    here = moved(high, high, lean)
    walls = np.maximum.reduce(
        [moved(high, high, Lean(lean.east * at, lean.north * at, 0.0)) for at in (0, 0.3, 0.6, 0.9)]
    )
    made = np.where(walls > 2, 70.0, made)
    return np.where(here > 2, moved(roofs, high, lean), made).clip(0, 255).astype(np.uint8)


def moved(values, high, lean):
    """Values of houses where a picture shows them; else 0."""
    order = np.argsort(high, axis=None)
    rows, cols = (each.ravel()[order] for each in np.indices(high.shape))
    heights = high.ravel()[order] / PX_M
    rows_to = np.rint(rows - lean.north * heights).astype(int).clip(0, len(high) - 1)
    cols_to = np.rint(cols + lean.east * heights).astype(int).clip(0, high.shape[1] - 1)
    made = np.zeros(high.shape)
    made[rows_to, cols_to] = np.where(heights > 0, values.ravel()[order], 0.0)
    return made


def sampler(high):
    def above(west_m, north_m, posting_m, rows, cols):
        east = west_m + (np.arange(cols) + 0.5) * posting_m
        north = north_m - (np.arange(rows) + 0.5) * posting_m
        col = np.floor((east + SIDE_M / 2) / PX_M).astype(int)
        row = np.floor((SIDE_M / 2 - north) / PX_M).astype(int)
        known = (row[:, None] >= 0) & (row[:, None] < len(high)) & (col >= 0) & (col < len(high))
        inside = np.clip(row, 0, len(high) - 1)[:, None], np.clip(col, 0, len(high) - 1)
        return np.where(known, high[inside], np.nan)

    return above


@pytest.fixture
def found(make_ortho, tmp_path):
    pyproj = pytest.importorskip("pyproj")
    middle = 700_000 + SIDE_M / 2, 6_600_000 - SIDE_M / 2  # of what `make_ortho` writes
    lon, lat = pyproj.Transformer.from_crs(2154, 4326, always_xy=True).transform(*middle)
    half_m = SIDE_M / 2 - 10
    area = Area.from_bounds(box_deg(LocalFrame(lat, lon), -half_m, -half_m, half_m, half_m))

    def in_picture(grey, high):
        path = make_ortho(tmp_path / "ortho.tif", grey, gsd_m=PX_M)
        return visible_lean(Mosaic.open([path]), sampler(high), area)

    return in_picture


@pytest.mark.parametrize("east, north", [(0.2, -0.1), (-0.3, 0.15), (0.0, 0.25)])
def test_a_lean_is_found_beside_shadows(found, town, east, north):
    lean = found(pictured(town, Lean(east, north, 0.0)), town[2])
    assert (lean.east, lean.north) == pytest.approx((east, north), abs=1.01 * STEP)
    assert lean.std == STEP


def test_upright_houses_and_houses_that_are_not_seen(found, town):
    assert found(pictured(town, TRUE_ORTHO), town[2]) == Lean(0.0, 0.0, STEP)
    elsewhere = np.roll(town[2], (60, 90), (0, 1))
    assert found(pictured(town, Lean(0.2, -0.1, 0.0)), elsewhere) is None
    assert found(pictured(town, Lean(0.2, -0.1, 0.0)), 0 * town[2]) is None


def test_no_lean_is_claimed_where_it_cannot_be_told(found, town):
    high = town[2]
    blank = np.full(high.shape, 120, np.uint8)
    assert found(blank, high) is None
    assert found(pictured(town, Lean(0.7, 0.0, 0.0)), high) is None  # beyond what is looked for
    west, east = (pictured(town, Lean(lean, 0.0, 0.0)) for lean in (-0.25, 0.25))
    mixed = np.where(np.arange(high.shape[1]) < high.shape[1] // 2, west, east)
    lean = found(mixed, high)
    assert lean is None or lean.std >= 0.05


def test_a_roof_is_where_the_picture_shows_it():
    high = np.zeros((40, 40))
    high[20:30, 10:20] = 8.0
    lean = Lean(0.5, 0.25, 0.0)

    def above(west_m, north_m, posting_m, rows, cols):
        full = np.pad(high, 100, constant_values=np.nan)
        first = round(-north_m / posting_m) + 100, round(west_m / posting_m) + 100
        return full[first[0] : first[0] + rows, first[1] : first[1] + cols]

    made = as_shown(above, lean)(0.0, 0.0, 1.0, 40, 40)
    assert (made[18:28, 14:24] == 8.0).all() and np.nansum(made == 8.0) == 100
    assert np.isnan(made[23:29, 10:13]).all()  # its wall
    assert (made[30:, :] == 0.0).all() and (made[:17, :] == 0.0).all()
    part = as_shown(above, lean)(12.0, -16.0, 1.0, 10, 20)
    np.testing.assert_array_equal(part, made[16:26, 12:32])
    assert as_shown(above, TRUE_ORTHO) is above


def test_a_sloping_roof_has_no_holes():
    slope = np.tile(np.where(np.arange(60) < 30, np.arange(60) * 0.4, 0.0), (60, 1))

    def above(west_m, north_m, posting_m, rows, cols):
        rim = (rows - 60) // 2
        return np.pad(slope, rim, constant_values=np.nan) if rim else slope

    made = as_shown(above, Lean(0.4, 0.0, 0.0))(0.0, 0.0, 1.0, 60, 60)
    assert np.isfinite(made[5:55, :30]).all()


@pytest.mark.parametrize("wrong", [{"east": 2.0}, {"std": -0.1}, {"north": None}])
def test_an_impossible_lean_is_refused(wrong):
    with pytest.raises(MapFileError):
        Lean.from_plain({"east": 0.1, "north": 0.0, "std": 0.05} | wrong)
