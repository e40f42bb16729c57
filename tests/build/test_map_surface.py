"""A map with a surface model: houses and trees above its terrain."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from builders import built

from helpers import box_deg, write_dem
from orthonav.core.errors import AreaError, ImageryError, MapFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.terrain import SURFACE, TERRAIN, TerrainLayer
from orthonav.ground.build.layer import height_layers
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area

LOCAL = LocalFrame(46.4982, 3.0026)
"""The middle of the picture that `make_ortho` writes."""
HOUSE_M, ROOF_M = 12.0, 7.0


def slope(east_m, north_m):
    return 200.0 + 0.02 * (np.asarray(east_m) + np.asarray(north_m))


def houses(east_m, north_m):
    """Heights above the slope: a house of `HOUSE_M` every 60 m."""
    inside = (np.mod(east_m, 60.0) < HOUSE_M) & (np.mod(north_m, 60.0) < HOUSE_M)
    return np.where(inside, ROOF_M, 0.0)


def town(east_m, north_m):
    return slope(east_m, north_m) + houses(east_m, north_m)


@pytest.fixture(scope="module")
def area():
    return Area.from_bounds(box_deg(LOCAL, -200.0, -200.0, 200.0, 200.0))


@pytest.fixture(scope="module")
def grid(area):
    return TileGrid.covering(area.extent_en_m, gsd_m=1.0, tile_px=64, overlap=0.5)


@pytest.fixture(scope="module")
def surface(tmp_path_factory):
    path = tmp_path_factory.mktemp("surface") / "town.tif"
    return write_dem(path, LOCAL, town, half_m=400.0, px_m=0.5)


@pytest.fixture(scope="module")
def town_map(make_ortho, surface, tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    ortho = make_ortho(folder / "past.tif")
    return built(ortho, folder, overlap=0.5, surface=[surface], dem_datum="msl")


def test_houses_stand_on_the_lower_envelope(town_map):
    points = np.random.default_rng(0).uniform(-150, 150, (2000, 2))
    layers = (TerrainLayer.of(town_map, layer=each) for each in (TERRAIN, SURFACE))
    ground, above = (each.at_en_m(points) for each in layers)
    there = LOCAL.en_from_latlon(*town_map.manifest.sheets[0].frame.latlon_from_en(points))
    np.testing.assert_allclose(ground, slope(*there.T), atol=0.2)
    np.testing.assert_allclose(np.median(ground + above - town(*there.T)), 0.0, atol=0.3)
    inside = (np.mod(there, 60.0) > 2.0).all(axis=1) & (np.mod(there, 60.0) < 10.0).all(axis=1)
    np.testing.assert_allclose((ground + above)[inside], slope(*there[inside].T) + ROOF_M, atol=0.4)
    between = (np.mod(there, 60.0) > HOUSE_M + 2.0) & (np.mod(there, 60.0) < 58.0)
    assert (above[between.any(axis=1)] < 1.0).all()


def test_the_layer_is_described_and_small(run, town_map):
    info = town_map.manifest.sheets[0].surface
    assert (info.posting_m, info.name, info.datum) == (1.0, "town.tif", "terrain")
    size = town_map.arrays["sheet0/surface/bytes"].size
    assert size < 0.3e6 * info.known * info.posting_m**2 / 1e6  # 0.3 MB per km2
    told = run("info", town_map.path).out
    assert "surface    houses and trees up to 7 m, every 1 m (town.tif)" in told


def test_without_a_surface_a_map_is_as_before(town_map):
    sheet = town_map.manifest.sheets[0]
    assert "surface" not in replace(sheet, surface=None).to_plain()
    plain = sheet.to_plain()
    assert SheetInfo.from_plain(plain) == sheet
    del plain["terrain"]
    with pytest.raises(MapFileError, match="without the terrain that it stands on"):
        SheetInfo.from_plain(plain)


def test_above_a_terrain_of_another_datum(area, grid, surface, tmp_path, caplog):
    """45 m between the two, as between ellipsoid and sea: bare ground decides."""

    def raised(east_m, north_m):
        return slope(east_m, north_m) + 45.0

    caplog.set_level(logging.INFO)
    dem = write_dem(tmp_path / "dem.tif", LOCAL, raised, half_m=400.0, px_m=10.0)
    made = height_layers(open_dem(dem), [open_dem(surface)], area, grid)
    assert "-45.0 m above the terrain on bare ground" in caplog.text
    assert made.surface.info.low_m >= -1.0 and made.surface.info.high_m <= ROOF_M + 1.0
    with pytest.raises(ImageryError, match="lies -45 m above the terrain"):
        height_layers(open_dem(dem, "msl"), [open_dem(surface, "msl")], area, grid)
    in_feet = write_dem(
        tmp_path / "ft.tif", LOCAL, lambda *en: slope(*en) / 0.3048, half_m=400.0, px_m=10.0
    )
    with pytest.raises(ImageryError, match="m above the terrain: check unit and vertical datum"):
        height_layers(open_dem(in_feet), [open_dem(surface)], area, grid)


def test_a_surface_that_shows_no_houses_is_refused(area, grid, tmp_path):
    coarse = write_dem(tmp_path / "coarse.tif", LOCAL, town, half_m=400.0, px_m=10.0)
    with pytest.raises(ImageryError, match=r"every 10 m, which shows no houses; give it as --dem"):
        height_layers(None, [open_dem(coarse)], area, grid)


def test_earlier_models_come_first_and_holes_stay_holes(area, grid, surface, tmp_path, caplog):
    def western(heights):
        heights[:, heights.shape[1] // 2 :] = -9999
        return heights

    def high(east_m, north_m):
        return slope(east_m, north_m) + 20.0 + 0.0 * east_m

    west = write_dem(tmp_path / "west.tif", LOCAL, town, 400.0, 0.5, western)
    rest = write_dem(tmp_path / "rest.tif", LOCAL, high, 400.0, 2.0)
    dem = write_dem(tmp_path / "dem.tif", LOCAL, slope, 400.0, 10.0)
    opened = [open_dem(each, "msl") for each in (dem, west, rest)]
    both = height_layers(opened[0], opened[1:], area, grid)
    assert both.surface.info.name == "west.tif, rest.tif"
    assert both.surface.info.high_m == pytest.approx(20.0, abs=0.5)
    alone = height_layers(opened[0], opened[1:2], area, grid)
    assert alone.surface.info.high_m == pytest.approx(ROOF_M, abs=0.5)
    assert "surface has no height for" in caplog.text


def test_a_surface_elsewhere(grid, surface, tmp_path):
    far = Area.from_bounds((3.46, 46.47, 3.47, 46.48))
    there = TileGrid.covering(far.extent_en_m, gsd_m=1.0, tile_px=64, overlap=0.5)
    with pytest.raises(AreaError, match=r"surface has no height in the area"):
        height_layers(None, [open_dem(surface)], far, there)
    assert height_layers(None, [open_dem(surface)], far, there, needed=False)[:2] == (None, None)


def test_options_that_need_or_exclude_a_surface(run, make_ortho, surface, tmp_path):
    ortho = make_ortho(tmp_path / "past.tif")
    build = ("build", "--ortho", ortho, "--out", tmp_path / "a.onav")
    alone = run(*build, "--true-ortho")
    assert alone.code != 0 and "--surface" in alone.err
    told = run(*build, "--surface", surface, "--relief", "level").err
    assert "--dem, --surface or --relief" in told
    assert "would replace" in run(*build[:4], surface, "--surface", surface).err


def test_a_damaged_layer_is_named(town_map):
    info = town_map.manifest.sheets[0].surface
    arrays = dict(town_map.arrays)
    data = arrays["sheet0/surface/bytes"].copy()
    data[:] = 0
    arrays["sheet0/surface/bytes"] = data
    broken = TerrainLayer.of(replace(town_map, arrays=arrays), layer=SURFACE)
    with pytest.raises(MapFileError, match="map's surface layer is damaged"):
        broken.at_en_m([info.west_m + 50.0, info.north_m - 50.0])
