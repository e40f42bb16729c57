"""A map with terrain: built from a model, read without GDAL, used to place views."""

import csv
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from helpers import waypoints, write_dem
from orthonav.cli.source import map_heights
from orthonav.core.errors import AreaError
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile import open_map, write_map
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.records import Fix
from orthonav.ground.build.layer import terrain_of_dem
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route
from orthonav.ground.recordings.localize import localize_flight

FRAME = LocalFrame(46.5, 2.5)
LOCAL_DEG = 46.4982, 3.0026
"""The middle of the picture that `make_ortho` writes."""


def hill(east_m, north_m):
    """100 to 240 m high, with a wavelength of 2.5 km."""
    return 170 + 70 * np.sin(np.asarray(east_m) / 400 + 0.3) * np.cos(np.asarray(north_m) / 400)


@pytest.fixture(scope="module")
def frame(localizer):
    return localizer.sheet.frame


@pytest.fixture(scope="module")
def dem(frame, tmp_path_factory):
    return write_dem(tmp_path_factory.mktemp("dem") / "hill.tif", frame, hill)


def with_terrain(path, dem, out):
    """The map of the session with terrain."""
    opened = open_map(path)
    sheet = opened.manifest.sheets[0]
    low, high = [sheet.grid.west_m, -500.0], [-sheet.grid.west_m, 500.0]
    made = terrain_of_dem(dem, Area(sheet.frame, (*low, *high)), sheet.grid)
    manifest = replace(opened.manifest, sheets=(replace(sheet, terrain=made.info),))
    write_map(out, manifest, {**opened.arrays, **made.arrays})
    return made.info


@pytest.fixture(scope="module")
def hill_map(map_path, dem, tmp_path_factory):
    out = tmp_path_factory.mktemp("map") / "hill.onav"
    with_terrain(map_path, open_dem(dem, "msl"), out)
    return out


def test_terrain_is_all_that_a_map_gains(run, make_ortho, tmp_path, monkeypatch):
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 16)
    ortho = make_ortho(tmp_path / "past.tif")
    frame = LocalFrame(*LOCAL_DEG)
    dem = write_dem(tmp_path / "dem.tif", frame, hill)
    maps = []
    for name, more in (("flat", ()), ("hill", ("--dem", dem, "--dem-datum", "msl"))):
        out = tmp_path / f"{name}.onav"
        sizes = ("--tile-px", 64, "--overlap", 0.5, "--no-registration", "--out", out)
        assert run("build", "--ortho", ortho, *sizes, *more).code == 0
        maps.append(open_map(out))
    flat, hilly = maps
    more = {"sheet0/terrain/bytes", "sheet0/terrain/offsets"}
    assert set(hilly.arrays) - set(flat.arrays) == more
    for name in flat.arrays:
        np.testing.assert_array_equal(hilly.arrays[name], flat.arrays[name])
    sheet = hilly.manifest.sheets[0]
    assert replace(sheet, terrain=None) == flat.manifest.sheets[0]
    assert b"terrain" not in flat.path.read_bytes()
    assert (sheet.terrain.name, sheet.terrain.posting_m) == ("dem.tif", 25.0)
    lat, lon = sheet.frame.latlon_from_en(np.random.default_rng(0).uniform(-180, 180, (99, 2)))
    # Bilinear between samples of 25 m of a wave of 2.5 km.
    found = TerrainLayer.of(hilly)(lat, lon)
    np.testing.assert_allclose(found, hill(*frame.en_from_latlon(lat, lon).T), atol=1)


@pytest.mark.long
def test_terrain_of_a_corridor_is_small_and_holes_are_named(tmp_path, caplog):
    def holed(heights):
        heights[100:104, 100:104] = -9999
        return heights

    path = write_dem(tmp_path / "dem.tif", FRAME, hill, half_m=4000, px_m=10, change=holed)
    route = Route(waypoints(FRAME, [[-3500.0, -3500.0], [3500.0, 3500.0]]))
    sizes = {}
    for name, area in (("all", Area.from_bounds((2.46, 46.47, 2.54, 46.53))),
                       ("band", Area.from_route(route, 300))):  # fmt: skip
        grid = TileGrid.covering(area.extent_en_m, gsd_m=1.0, tile_px=256, overlap=0.875)
        made = terrain_of_dem(open_dem(path, "msl"), area, grid)
        sizes[name] = made.info.known, made.arrays["sheet0/terrain/bytes"].size
        assert sizes[name][1] < 0.02e6 * made.info.known * made.info.posting_m**2 / 1e6
    assert sizes["band"][0] < 0.6 * sizes["all"][0]
    assert "these holes stay holes in the map (dem.tif)" in caplog.text


def test_what_the_samples_of_a_map_do_not_show_is_its_roughness(tmp_path):
    """Houses of 4 m on a twentieth of the ground: 0.87 m RMS, of which some is in the means."""

    def houses(heights):
        rows, cols = np.indices(heights.shape) // 4
        return heights + 4 * (np.random.default_rng(0).random(heights.shape)[rows, cols] < 0.05)

    area = Area.from_bounds((2.494, 46.496, 2.506, 46.504))
    grid = TileGrid.covering(area.extent_en_m, gsd_m=1.0, tile_px=256, overlap=0.875)
    found = {}
    for name, px_m, change in (("bare", 1.0, lambda heights: heights), ("town", 1.0, houses),
                               ("coarse", 10.0, houses)):  # fmt: skip
        path = write_dem(tmp_path / f"{name}.tif", FRAME, hill, 1000, px_m, change)
        info = terrain_of_dem(open_dem(path, "msl"), area, grid).info
        found[name] = info.roughness_m
        assert (info.source_posting_m, info.posting_m) == (px_m, 10.0)
    assert found["bare"] < 0.05 and 0.7 < found["town"] < 0.87 and found["coarse"] is None


def test_heights_over_an_unknown_datum(run, map_path, flown, dem, tmp_path):
    """Those above ground and take-off are used, those above the sea are refused."""
    info = with_terrain(map_path, open_dem(dem), tmp_path / "a.onav")
    assert info.datum == "unknown" and not info.is_above_sea
    few = shutil.copytree(flown, tmp_path / "flight")
    table = rows(few)[:2]

    def write(**changed):
        with (few / "telemetry.csv").open("w", newline="") as stream:
            writer = csv.DictWriter(stream, table[0])
            writer.writeheader()
            writer.writerows(row | changed for row in table)

    write()
    localize = ("localize", tmp_path / "a.onav", few, "--out", tmp_path / "fixes.jsonl")
    assert table[0]["home_m"] and table[0]["amsl_m"] and run(*localize).code == 0
    write(agl_m="", home_m="")
    refused = run(*localize)
    assert refused.code == 1 and "vertical datum" in refused.err and "--dem-datum" in refused.err
    for more in ((), ("--dem-datum", "msl")):  # the map's stays unknown
        with_dem = run(*localize, "--dem", dem, *more)
        assert with_dem.code == 1 and "different levels" in with_dem.err
    flat = ("localize", map_path, few, "--out", tmp_path / "fixes.jsonl", "--dem", dem)
    assert "vertical datum" in run(*flat).err
    assert run(*flat, "--dem-datum", "msl").code == 0
    flying = run("fly", tmp_path / "a.onav", few, "--recorded-telemetry", "--height", "amsl")
    assert flying.code == 2 and "--height amsl" in flying.err and "--dem-datum" in flying.err


def test_terrain_elsewhere_is_refused(tmp_path):
    path = write_dem(tmp_path / "dem.tif", FRAME, hill)
    area = Area.from_bounds((3.46, 46.47, 3.47, 46.48))
    grid = TileGrid.covering(area.extent_en_m, gsd_m=1.0, tile_px=256, overlap=0.875)
    with pytest.raises(AreaError, match=r"no height in the area, at 46\.4750, 3\.4650: .*dem\.tif"):
        terrain_of_dem(open_dem(path, "msl"), area, grid)


def test_build_names_what_is_wrong_before_the_work(run, area, dem, tmp_path):
    build = ("build", "--ortho", area.past, "--out", tmp_path / "a.onav", "--dem")
    assert "--dem, --surface or --relief" in run(*build, dem, "--relief", "level").err
    assert "is a picture" in run(*build, area.past, "--dem-datum", "msl").err
    assert "does not exist: no.tif" in run(*build, "no.tif").err
    done = run("build", "--ortho", area.past, "--dem", dem, "--dem-datum", "msl", "--out", dem)
    assert "would replace an input" in done.err
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def flown(area, frame, dem, tmp_path_factory):
    """A flight at a constant altitude over the hill."""
    from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

    corners = [[-350.0, -250.0], [350.0, -250.0], [350.0, 250.0]]
    out = tmp_path_factory.mktemp("flown") / "flight"
    request = SimulateRequest(
        [area.present], out, route=Route(waypoints(frame, corners)),
        agl_m=250.0, spacing_m=70.0, camera=area.camera, errors=Errors(yaw_std_deg=3.0),
        terrain=open_dem(dem, "msl"), seed=1,
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.simulate.ground.COVERAGE_PX", 256)
        simulate_flight(request)
    return out


def rows(flight):
    with (flight / "telemetry.csv").open() as stream:
        return list(csv.DictReader(stream))


@pytest.mark.long
def test_a_terrain_places_views_that_level_ground_does_not(
    run, flown, map_path, dem, tmp_path, monkeypatch
):
    monkeypatch.setattr("orthonav.ground.recordings.setups.FEW", 0.0)  # other set-ups are not tried
    few, found = shutil.copytree(flown, tmp_path / "flight"), {}
    header, *lines = (few / "telemetry.csv").read_text().splitlines()
    (few / "telemetry.csv").write_text("\n".join([header, *lines[::3]]) + "\n")
    for name, arguments in {
        "level": [map_path],
        "terrain": [map_path, "--dem", dem, "--dem-datum", "msl"],
    }.items():
        out = tmp_path / f"{name}.jsonl"
        done = run("localize", *arguments[:1], few, *arguments[1:], "--out", out)
        assert done.code == 0
        assert ("level ground is assumed" in done.err) == (name == "level"), done.err
        scored = run("evaluate", out, "--truth", flown / "truth.csv", "--radius-m", 15, "--json")
        found[name] = json.loads(scored.out)["acc_at_15m"]
    assert found["level"] + 0.1 < found["terrain"], found


class KnowsThePlace:
    """A locator that finds every view where it was taken, and keeps the heights it was given."""

    state_name = None

    def __init__(self, truth):
        self.places, self.agl_m = iter(truth.values()), []

    def locate(self, view):
        self.agl_m.append(view.telemetry.agl_m)
        return Fix(*next(self.places), np.eye(2), 0.99, 35.0, 0.0, view.telemetry.agl_m)


def test_a_flight_is_located_with_heights_above_the_ground_where_it_is(flown, hill_map, dem):
    truth = read_truth(flown / "truth.csv")
    locator, heights = KnowsThePlace(truth), map_heights(open_map(hill_map))
    assert len(list(localize_flight(locator, open_flight(flown), heights=heights))) == len(truth)
    below = open_dem(dem, "msl")(*np.array(list(truth.values())).T)
    expected = float(rows(flown)[0]["amsl_m"]) - below
    off = np.array(locator.agl_m) / expected - 1
    assert np.ptp(expected) > 60
    assert abs(off[1:]).max() < 0.1  # by the ground of the view before, 70 m away
    assert abs(off[1:]).mean() < 0.3 * abs(250 / expected - 1).mean()


def test_terrain_is_flown_without_gdal_and_proj(hill_map, flown):
    script = f"""
import sys
for name in ("rasterio", "pyproj", "torch"): sys.modules[name] = None
from orthonav.cli.source import map_heights
from orthonav.core.flight import open_flight
from orthonav.core.mapfile import open_map, write_map
heights = map_heights(open_map({str(hill_map)!r}))
view = open_flight({str(flown)!r}).views[0]
print(heights.corrected(view.telemetry).agl_m)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=dict(os.environ)
    )
    assert 200 < float(done.stdout) < 400, done.stderr
