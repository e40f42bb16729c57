"""A floor under what real imagery gives: orthophotos of two dates, where they are at hand.

Looked for in `../shared/data` beside the checkout, or in the folder that ORTHONAV_DATA names.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build.layer import terrain_of_dem
from orthonav.ground.evaluate.metrics import compare
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area
from orthonav.ground.recordings.localize import localize_flight
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import SingleViews

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
DATA = Path(os.environ.get("ORTHONAV_DATA", BESIDE))
VIEWS = 10
WITHIN_STRIDES = 0.75
ERRORS = Errors(yaw_std_deg=5.0, agl_std=0.05)
PAIRS = {
    "naip": ("naip_nd/20090818.tif", "naip_nd/20180716.tif", 0.9),
    "szada": ("airchange/szada_5_a.tif", "airchange/szada_5_b.tif", 0.8),
}


@pytest.mark.parametrize(
    "past, present, least",
    [
        pytest.param(*pair, marks=pytest.mark.slow if name == "szada" else (), id=name)
        for name, pair in PAIRS.items()
    ],
)
def test_views_of_another_year_are_placed(tmp_path, monkeypatch, past, present, least):
    for name in (past, present):
        if not (DATA / name).is_file():
            pytest.skip(f"optional real imagery is not there (see ORTHONAV_DATA): {DATA / name}")
    # Few crops and views for its confidence, which is not looked at here.
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 16)
    build_map(BuildRequest([DATA / past], tmp_path / "map.onav", calibration_views=2))
    flight = tmp_path / "flight"
    simulate_flight(SimulateRequest([DATA / present], flight, random=VIEWS, errors=ERRORS, seed=1))
    opened = open_map(tmp_path / "map.onav")
    results = list(localize_flight(SingleViews(Localizer(opened)), open_flight(flight)))
    sheet = opened.manifest.sheets[0]
    comparison = compare(read_truth(flight / "truth.csv"), results, sheet.frame)
    right = comparison.errors_m <= WITHIN_STRIDES * sheet.grid.stride_m
    assert len(right) == VIEWS and np.mean(right) >= least


def test_a_terrain_model_of_mountains_is_small_in_a_map():
    path = DATA / "relief_ngi/dem.tif"
    if not path.is_file():
        pytest.skip(f"optional real imagery is not there (see ORTHONAV_DATA): {path}")
    dem = open_dem(path)
    assert dem.datum.name == "EGM2008 height"
    area = Area.from_bounds((24.37, -33.70, 24.41, -33.66))
    grid = TileGrid.covering(area.extent_en_m, gsd_m=2.0, tile_px=256, overlap=0.875)
    made = terrain_of_dem(dem, area, grid)
    info = made.info
    km2 = info.known * info.posting_m**2 / 1e6
    assert made.arrays["sheet0/terrain/bytes"].size < 0.004e6 * km2
    assert 149 <= info.low_m < info.high_m <= 782 and info.known == info.rows * info.cols
