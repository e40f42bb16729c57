"""Terrain models in files: place, vertical reference, units, voids, size."""

import re
import struct

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT

from orthonav.core.errors import ImageryError, MissingFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.imagery import terrain as datums
from orthonav.ground.imagery.terrain import open_dem

FRAME = LocalFrame(46.5, 2.5)
SIDE, PX_M = 600, 10.0


def slope(east_m, north_m):
    return 300 + 0.05 * np.asarray(north_m) - 0.02 * np.asarray(east_m)


@pytest.fixture
def make_dem(tmp_path):
    """Function that writes a plane that rises to the north, 6 x 6 km around the frame's centre."""

    def make(name="dem.tif", *, crs=None, change=lambda heights: heights, unit=None, **profile):
        centres = (np.arange(SIDE) + 0.5) * PX_M - 3000
        heights = change(slope(centres[None, :], -centres[:, None]).astype(np.float32))
        path = tmp_path / name
        profile = {"transform": Affine(PX_M, 0, -3000, 0, -PX_M, 3000), "nodata": None, **profile}
        with rasterio.open(
            path, "w", driver="GTiff", count=1, height=heights.shape[0], width=heights.shape[1],
            dtype=heights.dtype, crs=crs or FRAME.proj4, **profile,
        ) as data:  # fmt: skip
            data.write(heights[None])
            if unit:
                data.units = (unit,)
        return path

    return make


def places(east_m, north_m):
    return FRAME.latlon_from_en(np.stack(np.broadcast_arrays(east_m, north_m), axis=-1))


def error_m(dem, east_m=(-2000.0, 0.0, 1234.5), north_m=(-1500.0, 0.0, 2222.2)):
    """Largest error of the heights at some positions."""
    found = dem(*places(np.array(east_m), np.array(north_m)))
    return float(np.max(np.abs(found - slope(east_m, north_m))))


def test_heights_are_read_where_they_are(make_dem):
    dem = open_dem(make_dem(), "egm2008")
    assert error_m(dem) < 0.01 and dem.gsd_m == pytest.approx(10, rel=1e-3)
    grid = np.meshgrid(np.linspace(-2900, 2900, 40), np.linspace(-2900, 2900, 40))
    assert error_m(dem, *grid) < 0.01  # across the windows that are cached
    assert np.isnan(dem(*places(3100.0, 0.0)))
    assert np.isnan(dem(np.array([np.nan, 95.0]), np.array([2.5, 2.5]))).all()
    assert dem.covers(46.5, 2.5) and not dem.covers(2.5, 46.5)


def test_heights_in_a_plane_are_means_of_squares(make_dem):
    dem = open_dem(make_dem(), "msl")
    found = dem.in_plane(FRAME, -3200.0, 1000.0, 100.0, 20, 30)
    east, north = np.meshgrid(-3150 + 100 * np.arange(30), 950 - 100 * np.arange(20))
    np.testing.assert_allclose(found[:, 2:], slope(east, north)[:, 2:], atol=0.05)
    assert np.isnan(found[:, 0]).all()
    assert np.isnan(dem.in_plane(FRAME, 9000.0, 0.0, 10.0, 5, 5)).all()


@pytest.mark.parametrize("code", [32631, 4326, 2154])
def test_any_coordinate_system_and_a_raster_that_begins_in_the_south(make_dem, tmp_path, code):
    system = {"crs": f"EPSG:{code}", "nodata": np.nan, "resampling": Resampling.bilinear}
    with rasterio.open(make_dem()) as data, WarpedVRT(data, **system) as turned:
        heights, profile, step = turned.read(), turned.profile, turned.transform
    upward = Affine(step.a, 0, step.c, 0, -step.e, step.f + turned.height * step.e)
    profile |= {"driver": "GTiff", "transform": upward}
    with rasterio.open(tmp_path / "turned.tif", "w", **profile) as data:
        data.write(heights[:, ::-1])
    dem = open_dem(tmp_path / "turned.tif", "egm96")
    assert error_m(dem) < 0.2
    assert np.nanmax(np.abs(dem.in_plane(FRAME, 0, 0, 50, 3, 3)[1, 1] - slope(75, -75))) < 0.3


def test_the_vertical_datum_is_that_of_the_file_or_asked_for(make_dem):
    unknown = open_dem(make_dem())
    assert unknown.datum.name == "unknown" and not unknown.datum.is_known
    assert error_m(unknown) < 0.01
    with pytest.raises(ImageryError, match=r"a reason, .* datum .* is not known .* --dem-datum"):
        unknown.require_datum("a reason")
    compound = "EPSG:32631+5773"
    corner = Affine(10, 0, 458_000, 0, -10, 5_152_000)
    dem = open_dem(make_dem("a.tif", crs=compound, transform=corner))
    assert dem.datum.name == "EGM96 height" and not dem.datum.above_ellipsoid
    with pytest.raises(ImageryError, match="contradicts"):
        open_dem(dem.path, "ellipsoid")
    with pytest.raises(ImageryError, match="unknown vertical datum 'EPSG:4326'; give --dem-datum"):
        open_dem(make_dem(), "EPSG:4326")
    with pytest.raises(ImageryError, match="count down"):
        open_dem(make_dem(), "EPSG:5715")


def test_heights_above_the_ellipsoid_need_a_geoid(make_dem, tmp_path, monkeypatch, caplog):
    datums.geoid.cache_clear()
    monkeypatch.setattr(datums, "GEOIDS", ("none_such.tif",))
    without = open_dem(make_dem(), "ellipsoid")
    assert re.search(r"need a geoid.* none_such\.tif in .*projsync", caplog.text)
    assert not without.datum.is_known and error_m(without) < 0.01
    before = pyproj.datadir.get_data_dir()
    try:
        head = struct.pack(">4d2i", 40.0, 0.0, 1.0, 1.0, 11, 11)
        grid = np.full((11, 11), 45.0) + np.arange(11)  # a metre more each degree to the east
        (tmp_path / "made_up.gtx").write_bytes(head + grid.astype(">f4").tobytes())
        pyproj.datadir.append_data_dir(str(tmp_path))
        monkeypatch.setattr(datums, "GEOIDS", ("none_such.tif", "made_up.gtx"))
        dem = open_dem(make_dem(), "ellipsoid")
        assert dem(*places(0.0, 0.0)) == pytest.approx(300 - 47.5, abs=0.02)
        assert dem.in_plane(FRAME, -50, 50, 100, 1, 1)[0, 0] == pytest.approx(252.5, abs=0.05)
    finally:
        pyproj.datadir.set_data_dir(before)
        datums.geoid.cache_clear()


def test_feet_are_metres_and_other_units_are_refused(make_dem):
    feet = {"change": lambda heights: (heights / 0.3048).astype(np.float32)}
    assert error_m(open_dem(make_dem("ft.tif", unit="ft", **feet), "msl")) < 0.02
    corner = Affine(10, 0, 458_000, 0, -10, 5_152_000)
    dem = open_dem(make_dem("us.tif", crs="EPSG:32631+6360", transform=corner, **feet))
    assert dem.datum.unit_m == pytest.approx(1200 / 3937)
    plane = {"crs": "EPSG:2277", "transform": Affine(33, 0, 3_100_000, 0, -33, 10_100_000)}
    with pytest.raises(ImageryError, match=r"in no unit, and its coordinates in feet: .*state"):
        open_dem(make_dem("none.tif", **plane), "msl")
    assert open_dem(make_dem("m.tif", unit="m", **plane), "msl").datum.unit_m == 1
    with pytest.raises(ImageryError, match="are in furlong: metres or feet"):
        open_dem(make_dem("odd.tif", unit="furlong"), "msl")


def holes(value, kind=np.float32):
    def change(heights):
        changed = heights.astype(kind)
        changed[100:140, 100:140] = value
        return changed

    return change


@pytest.mark.parametrize(
    "change, profile",
    [
        (holes(-9999), {"nodata": -9999}),
        (holes(np.nan), {}),
        (holes(-32768, np.int16), {}),
        (holes(3.4e38), {}),
    ],
)
def test_holes_stay_holes(make_dem, change, profile):
    dem = open_dem(make_dem(change=change, **profile), "msl")
    east, north = -3000 + 1200, 3000 - 1200
    assert np.isnan(dem(*places(float(east), float(north))))
    around = dem.in_plane(FRAME, east - 400.0, north + 400.0, 20.0, 40, 40)
    assert np.isnan(around[20, 20]) and np.nanmin(around) > 350
    assert error_m(dem) < 0.6


@pytest.mark.parametrize("low_m, said", [(0.0, True), (-130.0, False)])
def test_heights_of_0_are_doubted_unless_the_ground_reaches_the_sea(make_dem, caplog, low_m, said):
    open_dem(make_dem(change=lambda heights: holes(0)(heights + low_m)), "msl")
    assert ("heights of 0 beside others from 90 m on" in caplog.text) == said


@pytest.mark.parametrize("posting_m", [10.0, 20.0])
def test_a_stray_value_for_no_data_is_not_averaged(make_dem, posting_m):
    def change(heights):
        heights[100, 100] = -1500.0  # -9999 is stated
        return heights

    dem = open_dem(make_dem(change=change, nodata=-9999), "msl")
    east, north = -3000 + 1005, 3000 - 1005
    around = dem.in_plane(FRAME, east - 400.0, north + 400.0, posting_m, 60, 40)
    assert 0 < np.isnan(around).sum() <= 9 and np.nanmin(around) > 350


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda heights: np.full_like(heights, -9999), "holds no height"),
        (lambda heights: heights * 100, "are 9035 to 50965 m: .* expected; state its unit"),
        (lambda heights: heights.astype(np.uint8), "is a picture"),
    ],
)
def test_files_that_are_no_terrain_are_refused(make_dem, change, words):
    with pytest.raises(ImageryError, match=words):
        open_dem(make_dem(change=change), "msl")


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("place", [(1e-300, 0, -3000, 0, -1e-300, 3000), (1, 0, 0, 0, 1, 0)])
def test_a_file_without_a_place_is_refused(make_dem, place):
    with pytest.raises(ImageryError, match="no georeference"):
        open_dem(make_dem(transform=Affine(*place)), "msl")


def test_files_that_cannot_be_read(tmp_path, make_dem):
    with pytest.raises(MissingFileError, match="terrain file does not exist"):
        open_dem(tmp_path / "none.tif")
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    with pytest.raises(ImageryError, match="terrain file cannot be read"):
        open_dem(tmp_path / "broken.tif", "msl")
    path = make_dem()
    path.write_bytes(path.read_bytes().replace(b"unknown|", b"unkno\xb1n|"))
    with pytest.raises(ImageryError, match=r"terrain file cannot be read .*utf-8"):
        open_dem(path, "msl")
    path = make_dem()
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ImageryError, match="terrain file cannot be read"):
        open_dem(path, "msl")(*places(0.0, -2000.0))
