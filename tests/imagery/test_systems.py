"""Coordinate systems: how well PROJ converts them, and those that move with a plate."""

import re

import numpy as np
import pytest
from geotiffs import FRAME, LAMBERT, placed, read, sheet_of, smooth_scene, write
from pyproj import Transformer
from pyproj.transformer import TransformerGroup

from orthonav.core.errors import ImageryError, UsageError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.imagery import systems
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.systems import plate_shift_deg, plate_shift_m
from orthonav.ground.imagery.terrain import open_dem

SCENE = smooth_scene()
HEIGHTS = np.linspace(10, 400, 120 * 120, dtype=np.float32).reshape(1, 120, 120)


def made(path, crs, lat, lon, bands=SCENE):
    return write(path, bands, crs=crs, transform=placed(crs, frame=LocalFrame(lat, lon)))


@pytest.mark.parametrize(
    "crs, lat, lon, words",
    [
        ("EPSG:2436", 40, 117, r"cannot convert 'Beijing 1954 .*gdalwarp -s_srs .*EPSG:32650"),
        ("+proj=utm +zone=21 +south +ellps=intl", -30, -57, "cannot convert .*EPSG:32721"),
        ("+proj=utm +zone=50 +ellps=krass +towgs84=0,0,0", 40, 117, "cannot convert"),
    ],
)
def test_a_system_that_proj_cannot_convert_is_refused(tmp_path, crs, lat, lon, words):
    with pytest.raises(ImageryError, match=words) as caught:
        Mosaic.open([made(tmp_path / "a.tif", crs, lat, lon)])
    assert str(caught.value).endswith("a.tif")
    with pytest.raises(ImageryError, match=words):
        open_dem(made(tmp_path / "dem.tif", crs, lat, lon, HEIGHTS))


@pytest.mark.parametrize(
    "crs, lat, lon, accuracy_m, words",
    [
        ("EPSG:4131", 16, 106, 44, "'Indian 1960' .* accuracy of 44 m only"),
        ("EPSG:26716", 40, -87, 10, "of 10 m only; install the grid .*sync --file us_noaa_conus"),
        ("EPSG:27700", 52, -1, 2, None),
        ("EPSG:32631", 48, 2, None, None),
        ("EPSG:2193", -40, 180, 1, None),
        (LAMBERT, 46, 3, None, None),  # its plate says how far off it is
        ("EPSG:26917", 35, -79, None, None),
        ("EPSG:4490", 40, 116, None, "'China Geodetic .* taken as WGS 84, .* by 1 to 2 m"),
        ("+proj=utm +zone=50 +ellps=krass +towgs84=12,-113,-41", 40, 117, None, "how accurately"),
    ],
)
def test_the_accuracy_that_proj_states(tmp_path, caplog, crs, lat, lon, accuracy_m, words):
    mosaic = Mosaic.open([made(tmp_path / "a.tif", crs, lat, lon)])
    assert mosaic.describe()[0].get("crs_accuracy_m") == accuracy_m
    said = "".join(each.getMessage() for each in caplog.records)
    assert re.search(words, said) if words else not said


@pytest.mark.filterwarnings("ignore:Best transformation")
@pytest.mark.parametrize("crs, lat, lon", [("EPSG:27700", 52, -1), ("EPSG:31467", 50, 9)])
def test_the_picture_lies_where_the_operation_that_is_named_puts_it(tmp_path, crs, lat, lon):
    """A second operation puts it some metres beside."""
    group = TransformerGroup(crs, "EPSG:4326", always_xy=True)
    frame = LocalFrame(lat, lon)
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    best = next(each for each in group.transformers if each.transform(x, y) == pytest.approx(
        (lon, lat), abs=1e-7))  # fmt: skip
    assert best.accuracy <= 3
    pixels = read(made(tmp_path / "a.tif", crs, lat, lon), size=60, frame=frame)
    off = np.abs(pixels.rgb.astype(int) - SCENE[:, 30:90, 30:90].transpose(1, 2, 0))
    assert off.mean() < 3


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
    assert moved.sources[0].stamp != as_it_is.sources[0].stamp, (
        "sheets of an atlas are of one epoch"
    )
    east_m, north_m = FRAME.en_from_latlon(FRAME.lat_deg + expected[0], FRAME.lon_deg + expected[1])
    shift = moved.sources[0].transform.c - as_it_is.sources[0].transform.c
    assert shift == pytest.approx(east_m, abs=0.01) and 0.5 < north_m < 0.7
    with pytest.raises(UsageError, match="epoch must be a year"):
        Mosaic.open([path], 20.5)
    other = write(tmp_path / "b.tif", smooth_scene(), crs="EPSG:32631")
    with pytest.raises(ImageryError, match="not for EPSG:32631"):
        Mosaic.open([other], 2026.9)


def test_an_epoch_moves_imagery_across_the_antimeridian_alike(tmp_path):
    def moves_m(lon_deg):
        path = made(tmp_path / f"{lon_deg}.tif", "EPSG:26901", 52.0, lon_deg)
        there, before = (Mosaic.open([path], *epoch).sources[0] for epoch in ((2026.9,), ()))
        return there.transform.c - before.transform.c, there.transform.f - before.transform.f

    assert moves_m(180.0) == pytest.approx(moves_m(-179.99), abs=0.01)


def test_a_conversion_that_fails_is_an_error_and_no_hole(tmp_path, monkeypatch):
    path = write(tmp_path / "a.tif", smooth_scene())
    sheet, sources = sheet_of(path), Mosaic.open([path]).sources

    def fails(*args):
        raise RuntimeError("PROJ: no grid")

    monkeypatch.setattr(systems, "transform_coordinates", fails)
    with pytest.raises(ImageryError, match=r"does not fit its coordinate system.*a\.tif"):
        sheet.read(0, 0, 8, 8)
    with pytest.raises(ImageryError, match=r"does not fit its coordinate system.*a\.tif"):
        systems.at_epoch(sources, 2026.9)


@pytest.mark.long
@pytest.mark.parametrize(
    "crs, lat, lon, said",
    [
        ("EPSG:27700", 52, -1, "EPSG:27700 is converted to WGS 84 to 2 m, as PROJ states"),
        (LAMBERT, 46, 3, "EPSG:2154 is taken as WGS 84, from which its tectonic plate has moved"),
    ],
)
def test_build_says_one_thing_about_a_system(run, tmp_path, monkeypatch, crs, lat, lon, said):
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
    path = made(tmp_path / "a.tif", crs, lat, lon)
    more = ("--tile-px", 64, "--overlap", 0.5, "--workers", 2)
    out = run("build", "--ortho", path, *more, "--out", tmp_path / "a.onav").out
    assert said in out and out.count("WGS 84") == 1
