"""A map that is cut out of an atlas shows what its sheets show, and flies."""

import math
import shutil
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest

from helpers import box_deg, textured, waypoints, write_dem
from orthonav.core.errors import (
    AreaError,
    AtlasError,
    MapFileError,
    StorageError,
    VariantError,
)
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import GreyLayer, open_map, write_map
from orthonav.core.mapfile.terrain import SURFACE, TerrainLayer
from orthonav.core.records import Fix, Telemetry, View
from orthonav.ground.atlas.build import AtlasRequest, build_atlas
from orthonav.ground.atlas.catalog import Atlas, AtlasRecipe, CoarseRecipe
from orthonav.ground.atlas.cluster import SerialRunner
from orthonav.ground.atlas.cut import (
    Warp,
    cut_heights,
    cut_map,
    least_roughness_m,
    opened_sheets,
    steepest,
)
from orthonav.ground.build.sheet import Block
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route

COARSE = CoarseRecipe(gsd_m=4.0, tile_px=32, overlap=0.5)
RECIPE = AtlasRecipe(
    gsd_m=1.0, tile_px=64, overlap=0.75, calibration_views=2, sheet_km=0.3, coarse=COARSE
)
SIDE_PX = 1100


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    return make_ortho(tmp_path_factory.mktemp("ortho") / "2019-06.tif", textured((SIDE_PX,) * 2))


@pytest.fixture(scope="module")
def middle(ortho):
    """The plane around a corner of sheets: two to the south, two or three to the north of it."""
    lat, lon = Mosaic.open([ortho]).outline_latlon_deg.mean(axis=0)
    west, south, _, _ = RECIPE.sheets.bounds_deg(RECIPE.sheets.name_at(lat, lon))
    west, _, _, north = RECIPE.sheets.bounds_deg(RECIPE.sheets.name_at(2 * south - lat, lon))
    return LocalFrame(north, west)


@pytest.fixture(scope="module")
def names(middle):
    found = sorted(RECIPE.sheets.over(bounds_around(middle, 190)))
    assert len(found) in (4, 5)
    return found


@pytest.fixture(scope="module")
def folder(ortho, names, middle, tmp_path_factory):
    folder = tmp_path_factory.mktemp("atlas") / "atlas"
    request = AtlasRequest(
        str(folder),
        [ortho],
        asdict(RECIPE),
        bounds_around(middle, 190),
        index=False,
        dem=write_dem(folder.parent / "dem.tif", middle, ground, half_m=900.0),
        surface=[write_dem(folder.parent / "trees.tif", middle, wooded, half_m=900.0, px_m=2.0)],
        dem_datum="msl",
    )
    with SerialRunner() as runner:
        assert sorted(build_atlas(request, runner).built) == names
    return folder


@pytest.fixture(scope="module")
def crops():
    return 12


def ground(east_m, north_m):
    return 200 + 0.1 * np.asarray(east_m) - 0.2 * np.asarray(north_m)


def above(east_m, north_m):
    return 5 + 5 * np.sin(np.asarray(east_m) / 8) * np.cos(np.asarray(north_m) / 8)


def wooded(east_m, north_m):
    return ground(east_m, north_m) + above(east_m, north_m)


@pytest.fixture
def atlas(folder, tmp_path):
    return Atlas.open(str(shutil.copytree(folder, tmp_path / "atlas")))


def bounds_around(frame, half_m):
    return box_deg(frame, -half_m, -half_m, half_m, half_m)


def area_around(frame, half_m):
    return Area.from_bounds(bounds_around(frame, half_m))


def line(frame, *points_en_m):
    return Route(waypoints(frame, points_en_m))


@pytest.fixture(scope="module")
def cut(folder, middle, tmp_path_factory):
    out = tmp_path_factory.mktemp("cut") / "cut.onav"
    cut_map(Atlas.open(str(folder)), out, area_around(middle, 150), workers=1)
    return open_map(out)


def test_terrain_is_that_of_the_sheets(cut, middle):
    layer = TerrainLayer.of(cut)
    assert (layer.info.name, layer.info.datum, layer.info.posting_m) == (
        "dem.tif",
        "MSL height",
        25,
    )
    assert (layer.info.source_posting_m, layer.info.roughness_m) == (25, None)
    points = np.random.default_rng(0).uniform(-150, 150, (300, 2))
    found = layer(*middle.latlon_from_en(points))
    np.testing.assert_allclose(found, ground(*points.T), atol=0.2)  # two times rounded


def test_surface_is_that_of_the_sheets_that_have_one(folder, cut, middle):
    layer = TerrainLayer.of(cut, layer=SURFACE)
    assert (layer.info.name, layer.info.posting_m, layer.info.unit_m) == ("trees.tif", 2, 0.25)
    points = np.random.default_rng(0).uniform(-150, 150, (300, 2))
    found = layer(*middle.latlon_from_en(points))
    np.testing.assert_allclose(found, above(*points.T), atol=0.6)  # two times between samples
    atlas, sheet = Atlas.open(str(folder)), cut.manifest.sheets[0]
    area = area_around(middle, 150)
    members = opened_sheets(atlas, atlas.over(bounds_around(middle, 150)), sheet.grid)
    whole = cut_heights(members, area, sheet.grid).surface
    members[0] = replace(members[0], surface=None)
    partly = cut_heights(members, area, sheet.grid).surface
    assert 0 < partly.info.known < whole.info.known
    without = cut_heights([replace(each, surface=None) for each in members], area, sheet.grid)
    assert without.surface is None and without.terrain is not None


def test_terrain_is_a_surface_model_only_where_all_of_it_is_one(cut):
    info = TerrainLayer.of(cut).info

    def least(*roughness_m):
        return least_roughness_m([replace(info, roughness_m=each) for each in roughness_m])

    assert (least(3.0, 2.0), least(3.0, None), least(None)) == (2.0, None, None)


def test_relief_is_the_steepest_of_the_sheets():
    def member(relief):
        return SimpleNamespace(manifest=SimpleNamespace(sheets=[SimpleNamespace(relief=relief)]))

    for stated, expected in (
        (["level", "level"], "level"), (["level", None], None), (["hills", None, "level"], "hills")
    ):  # fmt: skip
        assert steepest([member(each) for each in stated]) == expected


def test_threads_do_not_change_the_map(folder, cut, middle, tmp_path, names_in):
    again = tmp_path / "again.onav"
    stages = []
    cut_map(
        Atlas.open(str(folder)),
        again,
        area_around(middle, 150),
        workers=3,
        progress=lambda stage, share: stages.append((stage, share)),
    )
    assert again.read_bytes() == cut.path.read_bytes()
    assert names_in(tmp_path) == ["again.onav"]
    assert stages[0] == ("sheets", 0) and stages[-1] == ("learn", 0)


def test_a_cut_map_shows_its_sheets_in_its_own_plane(cut, ortho):
    sheet = cut.manifest.sheets[0]
    shape = sheet.grid.height_px, sheet.grid.width_px
    with Mosaic.open([ortho]).grid_sheet(sheet.frame, sheet.grid) as raster:
        truth = raster.read_grey(0, 0, *shape[::-1])
    grey, valid = GreyLayer.of(cut).read(0, 0, 0, *shape)
    assert valid.all() and sheet.grey.valid_px == valid.size
    off = np.abs(grey.astype(int) - truth.grey)
    assert off.mean() < 6 and np.corrcoef(grey.ravel(), truth.grey.ravel())[0, 1] > 0.97
    shifted = np.abs(grey[:, 1:].astype(int) - truth.grey[:, :-1])
    assert shifted.mean() > 2 * off.mean()


@pytest.mark.parametrize("registration", [True, False])
def test_views_are_placed_across_the_borders_of_sheets(cut, ortho, registration):
    sheet = cut.manifest.sheets[0]
    # The views are parts of the orthophoto: what a camera sees of level ground.
    localizer = Localizer(cut, registration=registration, level_ground=True)
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
    for east_m, north_m in ((0.0, 0.0), (-90.0, 20.0), (60.0, -100.0)):
        col, row = round(east_m - sheet.grid.west_m), round(sheet.grid.north_m - north_m)
        with Mosaic.open([ortho]).grid_sheet(sheet.frame, sheet.grid) as raster:
            view = raster.read_grey(col - 32, row - 32, 64, 64).grey
        telemetry = Telemetry(time_ns=0, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0, agl_m=64.0)
        fix = localizer.locate(View(view, camera, telemetry))
        assert isinstance(fix, Fix)
        place = sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
        where = sheet.grid.west_m + col, sheet.grid.north_m - row
        assert np.hypot(*(place - where)) < (2 if registration else 12)


def test_a_missing_sheet_beside_the_route_is_a_warning(atlas, names, middle, tmp_path, caplog):
    atlas.retire(names[3])
    here = middle.en_from_latlon(*centre_of(names[0]))
    route = line(middle, 1.2 * here, 0.5 * here)
    done = cut_map(atlas, tmp_path / "o.onav", Area.from_route(route, 600), workers=1)
    assert "the atlas, which lacks" in caplog.text and names[3] in caplog.text
    sheet = done.manifest.sheets[0]
    assert sheet.tiles < 0.9 * sheet.grid.rows * sheet.grid.cols


def test_a_missing_sheet_under_the_route_is_an_error(atlas, names, middle, tmp_path, names_in):
    atlas.retire(names[3])
    there = middle.en_from_latlon(*centre_of(names[3]))
    area = Area.from_route(line(middle, -there, there), 40)
    with pytest.raises(AtlasError, match=rf"{names[3]}.*--allow-holes"):
        cut_map(atlas, tmp_path / "out" / "o.onav", area, workers=1)
    assert not (tmp_path / "out").exists()
    done = cut_map(atlas, tmp_path / "o.onav", area, workers=1, allow_holes=True)
    assert done.manifest.sheets[0].tiles > 0


def test_missing_sheets_are_named_where_the_others_show_nothing(
    atlas, names, middle, tmp_path, caplog, monkeypatch
):
    atlas.retire(names[3])
    there = 0.4 * middle.en_from_latlon(*centre_of(names[3]))
    area, out = Area.from_route(line(middle, there, there + 10), 40), tmp_path / "o.onav"
    monkeypatch.setattr(Warp, "reaches", lambda *_: False)
    with pytest.raises(AtlasError, match=rf"100 % of the route .*{names[3]}.*--allow-holes"):
        cut_map(atlas, out, area, workers=1)
    with pytest.raises(AreaError, match="no tile"):
        cut_map(atlas, out, area, workers=1, allow_holes=True)
    assert names[3] in caplog.text


def centre_of(name):
    west, south, east, north = RECIPE.sheets.bounds_deg(name)
    return (south + north) / 2, (west + east) / 2


def test_areas_outside_the_atlas_are_refused(folder, names, tmp_path):
    area = Area.from_bounds((12.0, 50.0, 12.01, 50.01))
    empty = Atlas.open_or_create(str(tmp_path / "empty"), RECIPE)
    for atlas, count in ((Atlas.open(str(folder)), len(names)), (empty, 0)):
        with pytest.raises(AreaError, match=f"{count} sheets"):
            cut_map(atlas, tmp_path / "o.onav", area)


@pytest.mark.parametrize("change", ["recipe", "grid", "method"])
def test_sheets_of_another_recipe_are_refused(atlas, names, middle, tmp_path, change):
    stored = atlas.sheets()[names[1]]
    opened = open_map(atlas.path(stored))
    sheet, recipe = opened.manifest.sheets[0], opened.manifest.recipe
    others = {
        "recipe": {"recipe": {**recipe, "represent": {**recipe["represent"], "sigma_px": 2.0}}},
        "grid": {"sheets": (replace(sheet, grid=replace(sheet.grid, gsd_m=1.5)),)},
        "method": {"recipe": {**recipe, "embed": {"name": "bovw"}}},
    }
    write_map(tmp_path / "s.onav", replace(opened.manifest, **others[change]), opened.arrays)
    atlas.put({"map": tmp_path / "s.onav"}, stored)
    with pytest.raises(AtlasError, match=names[1]):
        cut_map(atlas, tmp_path / "o.onav", area_around(middle, 100), workers=1)


def test_a_damaged_sheet_or_chunk_is_named(atlas, names, middle, tmp_path):
    area, out, sheet = area_around(middle, 100), tmp_path / "o.onav", atlas.sheets()[names[1]]
    opened = open_map(atlas.path(sheet))
    grey = np.full_like(opened.arrays["sheet0/grey/bytes"], 7)
    write_map(tmp_path / "s.onav", opened.manifest, {**opened.arrays, "sheet0/grey/bytes": grey})
    changed = atlas.put({"map": tmp_path / "s.onav"}, sheet)
    with pytest.raises(MapFileError, match=rf"damaged.*{names[1]}"):
        cut_map(atlas, out, area, workers=2)
    path = atlas.path(changed)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    with pytest.raises(StorageError, match=names[1]):
        cut_map(atlas, out, area, workers=1)


def test_impossible_requests_are_refused(folder, middle, tmp_path):
    atlas, out = Atlas.open(str(folder)), tmp_path / "o.onav"
    with pytest.raises(AreaError, match="larger than the area"):
        cut_map(atlas, out, area_around(middle, 20))
    with pytest.raises(VariantError, match="workers"):
        cut_map(atlas, out, area_around(middle, 60), workers=0)


def test_the_affine_agrees_with_the_geodesy():
    """To a fiftieth of a pixel, within a kilometre, between planes 25 km apart."""

    class Sheet:
        frame = LocalFrame(60.0, 10.4)
        grid = TileGrid(-5000.0, 5000.0, 1.0, 256, 32, 300, 300)
        bounds_deg = (10.3, 59.95, 10.5, 60.05)

    frame, grid = LocalFrame(60.02, 10.0), TileGrid(18000.0, 3000.0, 1.0, 256, 32, 300, 300)
    block = Block(1024, 2048, 1024, 1024)
    warp = Warp(Sheet, frame, grid)
    assert warp.reaches(block) and not warp.reaches(Block(1024, 12_000, 1024, 1024))
    px = np.random.default_rng(0).uniform([2048, 1024], [3072, 2048], (50, 2))
    places = np.column_stack([grid.west_m + px[:, 0], grid.north_m - px[:, 1]])
    there = Sheet.frame.en_from_latlon(*frame.latlon_from_en(places))
    expected = np.column_stack([there[:, 0] + 5000, 5000 - there[:, 1]])
    affine = warp.affine(block)
    assert np.abs(px @ affine[:, :2].T + affine[:, 2] - expected).max() < 0.02
    assert math.degrees(math.atan2(affine[1, 0], affine[0, 0])) == pytest.approx(0.346, abs=0.02)
