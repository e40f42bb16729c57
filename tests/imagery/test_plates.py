"""Orthophotos in systems that move with a tectonic plate."""

import numpy as np
import pytest
from geotiffs import FRAME, LAMBERT, smooth_scene, write

from orthonav.core.errors import ImageryError
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.plates import plate_shift_deg, plate_shift_m


@pytest.mark.parametrize(
    "crs, lat, lon, shift_m",
    [
        ("EPSG:25832", 50, 10, (0.58, 0.71)),  # 25 mm a year to the north-east since 1989
        ("EPSG:28355", -37, 145, (1.86, 0.67)),  # 67 mm a year since 1994
        ("EPSG:26917", 35, -79, (0.89, -0.70)),
        (LAMBERT, 46, 3, (0.61, 0.71)),
    ],
)
def test_a_plate_moves_as_geodesists_say(crs, lat, lon, shift_m):
    north, east = np.multiply(plate_shift_deg(crs, lat, lon, 2026.9), 111_320)
    east *= np.cos(np.radians(lat))
    assert (north, east) == pytest.approx(shift_m, abs=0.05)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:3857", "EPSG:27700", "no system"])
def test_other_systems_do_not_move(crs):
    assert plate_shift_m(crs, 50, 10, 2026.9) == 0


def test_an_epoch_moves_the_imagery(tmp_path):
    path = write(tmp_path / "a.tif", smooth_scene())
    as_it_is, moved = Mosaic.open([path]), Mosaic.open([path], 2026.9)
    expected = plate_shift_deg(LAMBERT, FRAME.lat_deg, FRAME.lon_deg, 2026.9)
    outlines = moved.outline_latlon_deg - as_it_is.outline_latlon_deg
    assert outlines == pytest.approx(np.broadcast_to(expected, outlines.shape), abs=1e-12)
    assert moved.describe()[0]["epoch"] == "2026.9"
    assert moved.sources[0].stamp != as_it_is.sources[0].stamp, "cached blocks are of one epoch"
    east_m, north_m = FRAME.en_from_latlon(FRAME.lat_deg + expected[0], FRAME.lon_deg + expected[1])
    shift = moved.sources[0].transform.c - as_it_is.sources[0].transform.c
    assert shift == pytest.approx(east_m, abs=0.01) and 0.5 < north_m < 0.7
    with pytest.raises(ImageryError, match="epoch must be a year"):
        Mosaic.open([path], 20.5)
    other = write(tmp_path / "b.tif", smooth_scene(), crs="EPSG:32631")
    with pytest.raises(ImageryError, match="not for EPSG:32631"):
        Mosaic.open([other], 2026.9)
