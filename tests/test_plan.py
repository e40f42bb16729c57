"""`orthonav plan`: routes, views, maps, sheets and terrain, as text and as JSON."""

import json

import pytest

from helpers import waypoints, write_dem
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.planning.route import Height, read_route

FRAME = LocalFrame(46.5, 2.5)
CORNERS_EN_M = [(-1500.0, -1500.0), (-1500.0, 1500.0), (1500.0, 1500.0)]


@pytest.fixture
def camera(tmp_path):
    path = tmp_path / "flight.json"
    plain = {"width_px": 1280, "height_px": 960, "fx_px": 1000, "fy_px": 1000}
    path.write_text(json.dumps({"camera": plain | {"cx_px": 640, "cy_px": 480}}))
    return path


@pytest.fixture
def dem(tmp_path):
    """Terrain of 6 x 6 km, 300 m high in the middle, 5 m more every 100 m to the north."""

    def pierced(heights):
        heights[:5, :5] = -9999
        return heights

    def slope(east_m, north_m):
        return 300 + 0.05 * north_m + 0 * east_m

    return write_dem(tmp_path / "dem.tif", FRAME, slope, 3000.0, 10.0, pierced)


@pytest.fixture
def table(tmp_path):
    """An L of 3 + 3 km, flown 700 m above the sea, the first leg with a band of its own."""
    path = tmp_path / "route.csv"
    rows = [f"{lat},{lon},700" for lat, lon in waypoints(FRAME, CORNERS_EN_M)]
    lines = [f"{row},{band}" for row, band in zip(rows, (300, "", ""), strict=True)]
    path.write_text("\n".join(["lat,lon,amsl_m,band_m", *lines]))
    return path


@pytest.fixture
def planned(run, camera, table, dem):
    """Function that plans the table from 400 m, with more options."""
    terrain = ("--dem", dem, "--dem-datum", "msl")
    asked = ("--route", table, "--band-m", 500, "--camera", camera, "--agl-m", 400, *terrain)
    return lambda *more: run("plan", *asked, *more)


def test_a_plan_for_people(planned, table, tmp_path):
    out = tmp_path / "route.geojson"
    done = planned("--speed-mps", 25, "--out", out)
    assert (done.code, done.err) == (0, "")
    assert "3 waypoints, 6.00 km, 240 s, heights above amsl, 1 leg with a band" in done.out
    assert "512 x 384 m from 400 m, 0.4 m per pixel" in done.out
    assert "--gsd-m 1.5 --tile-px 256" in done.out
    assert "225..375      325..475" in done.out and "sheets" not in done.out
    assert read_route(out) == read_route(table)


def test_a_plan_for_programs(planned):
    plain = json.loads(planned("--json").out)
    assert plain["route"]["length_m"] == pytest.approx(6000, abs=1)
    assert plain["route"]["heights_above"] == ["amsl"]
    across_px = plain["view"]["width_m"] * 0.75**0.5 / 1.5
    assert plain["view"]["across_px"] == pytest.approx(across_px, 0.01)
    made = plain["map"]
    assert made["tiles"] > 400 and made["map_mb"][0] < made["map_mb"][1]
    assert made["area_km2"] < made["imagery_km2"] and len(made["sheets"]) == 1
    legs = plain["terrain"]
    assert legs[1]["agl_m"] == pytest.approx([325, 325], abs=1)
    assert legs[0]["relief"] == pytest.approx(0.05 * 384 / 325, rel=0.1)
    assert [each["code"] for each in plain["cautions"]] == ["relief"]


def test_the_height_is_that_of_the_route_over_terrain(run, camera, table, dem, tmp_path):
    sizes, over = ["--camera", camera, "--json"], ("--dem", dem, "--dem-datum", "msl")
    plain = json.loads(run("plan", "--route", table, *over, *sizes).out)
    assert plain["view"]["agl_m"] == pytest.approx(325, abs=1)
    assert run("plan", "--route", table, *sizes).code == 2  # above the sea says nothing alone
    low = tmp_path / "low.csv"
    low.write_text("lat,lon,agl_m\n46.5,2.5,40\n46.5,2.502,40\n")
    plain = json.loads(run("plan", "--route", low, *sizes).out)
    assert plain["view"]["agl_m"] == 40 and plain["map"]["tile_px"] == 128
    assert [each["code"] for each in plain["cautions"]] == ["low"]


def test_a_large_area_is_cut_into_sheets(run, camera, tmp_path):
    out, route = tmp_path / "c.geojson", tmp_path / "long.csv"
    route.write_text("lat,lon,agl_m,band_m\n46.6,1.574,4000,5000\n46.6,2.227,4000,\n")
    done = run("plan", "--route", route, "--camera", camera, "--out", out)
    assert done.code == 0 and f"--route {out}#sheet-2" in done.out
    assert read_route(f"{out}#sheet-2").heights == (Height(4000, "agl"),) * 2
    done = run("plan", "--bounds=2,46,2.5,46.3", "--gsd-m", 2, "--json")
    (sheet,) = json.loads(done.out)["map"]["sheets"]
    assert sheet["bounds_deg"] == [2, 46, 2.5, 46.3]


OVER_DEM = "--dem", "DEM", "--dem-datum", "msl"


@pytest.mark.parametrize(
    "arguments, code, message",
    [
        (["--route", "TABLE"], 1, "resolution of the map is unknown"),
        (["--bounds", "-1,46,2,47", "--gsd-m", 1], 1, "or as an atlas"),
        (["--bounds", "1,46,2,47", "--gsd-m", 1, "--band-m", 5], 2, "need a route"),
        (["--bounds", "1,46,1.5,46.3", "--gsd-m", 0], 2, "--gsd-m must be above 0"),
        (["--route", "TABLE", "--band-m", 99, "--camera", "CAMERA"], 2, "needs a height above"),
        (["--route", "TABLE", "--gsd-m", 1, "--speed-mps", 0], 2, "--speed-mps must be above"),
        (["--route", "TABLE", "--gsd-m", 1, "--dem-datum", "msl"], 2, "give --dem too"),
        (["--route", "FAR", "--gsd-m", 1, *OVER_DEM], 1, "outside the terrain"),
    ],
)
def test_impossible_plans_are_refused(run, table, camera, dem, tmp_path, arguments, code, message):
    far = tmp_path / "far.csv"
    far.write_text(table.read_text().replace("46.", "40."))
    files = {"TABLE": table, "CAMERA": camera, "DEM": dem, "FAR": far}
    done = run("plan", *(files.get(argument, argument) for argument in arguments))
    assert done.code == code and message in done.err and done.out == ""
