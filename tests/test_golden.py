"""A map file of version 1 stays readable and flies as it did.

`data/make_golden.py` made both files and printed the numbers here.
"""

from dataclasses import replace
from pathlib import Path

import make_golden
import numpy as np
import pytest

from orthonav.core.flight import read_image
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import GreyInfo, GreyLayer, SheetInfo, open_map
from orthonav.core.records import Fix, View

DATA = Path(__file__).parent / "data"
SHEET = SheetInfo(
    frame=LocalFrame(46.5, 3.0),
    grid=TileGrid(-192.00000000000392, 192.0000002679686, 1.0, 96, 12, rows=25, cols=25),
    tiles=585,
    area_km2=0.08424,
    grey=GreyInfo(chunk_px=256, levels=4, quality=70, valid_px=82944),
)
FIRST_EMBEDDING = [0.11407470703125, -0.51220703125, -0.1380615234375, -0.1754150390625]
LAST_CENTRE_EN_M = [96.0, -144.0]
GREY_ROW = [139, 112, 81, 64, 87, 114, 131, 152]
FIX_DEG = (46.499855897, 2.999830477)
TILE_RADIUS_M = 9.0
RADIUS_M = 35.0
CONFIDENCE = 1.0


@pytest.fixture(scope="module")
def golden():
    """The map as it was stored."""
    return open_map(DATA / "golden_v1.onav")


def test_the_manifest_says_what_was_built(golden):
    manifest = golden.manifest
    assert manifest.sheets == (SHEET,)
    assert manifest.created_by == "orthonav 0.1.0" and manifest.radius_m == TILE_RADIUS_M
    assert manifest.recipe["method"] == manifest.recipe["represent"]["name"] == "gradient"
    assert manifest.recipe["embed"]["dims"] == 16 and manifest.recipe["overlap"] == 0.875
    source = manifest.imagery[0]
    assert (source["name"], source["date"], source["gsd_m"]) == ("golden.tif", "2021-06-17", 1.0009)
    assert manifest.confidence is not None and golden.size_bytes < 150_000


def test_the_parts_hold_the_same_numbers(golden):
    embeddings = golden.array("sheet0/embeddings", np.float16, 2)
    centres = golden.array("sheet0/centres_en_m", np.float32, 2)
    assert embeddings.shape == (SHEET.tiles, 16) and centres.shape == (SHEET.tiles, 2)
    assert embeddings[0, :4].tolist() == FIRST_EMBEDDING
    assert centres[-1].tolist() == LAST_CENTRE_EN_M
    assert np.linalg.norm(embeddings.astype(float), axis=1) == pytest.approx(1, abs=2e-3)


def test_the_layer_shows_the_ground(golden):
    layer = GreyLayer.of(golden)
    shapes = [layer.shape(level) for level in range(layer.levels)]
    assert shapes == [(side, side) for side in (384, 192, 96, 48)]
    corner = (384 - make_golden.SIZE_PX) // 2
    grey, valid = layer.read(0, corner, corner, make_golden.SIZE_PX, make_golden.SIZE_PX)
    assert valid.all() and valid.sum() == SHEET.grey.valid_px
    assert np.corrcoef(grey.ravel(), make_golden.ground().ravel())[0, 1] > 0.98
    row = layer.read(1, 96, 60, 1, 8)[0][0]
    np.testing.assert_allclose(row, GREY_ROW, atol=2)


def test_the_view_is_placed_where_it_was(golden):
    grey = read_image(DATA / "golden_view.png")
    unknown = replace(make_golden.TELEMETRY, tilt_std_deg=None)
    for telemetry, most_m in ((make_golden.TELEMETRY, 0.05), (unknown, 1.0)):
        fix = Localizer(golden).locate(View(grey, make_golden.CAMERA, telemetry))
        assert isinstance(fix, Fix)
        off_m = SHEET.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
        off_m = off_m - SHEET.frame.en_from_latlon(*FIX_DEG)
        assert np.hypot(*off_m) < most_m
        assert fix.confidence == pytest.approx(CONFIDENCE, abs=0.02) and fix.radius_m == RADIUS_M
