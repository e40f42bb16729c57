"""The whole check of a small map with real and synthetic trials, and as a command."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from made_check import FILES, lost, right, route_of

from helpers import write_dem
from orthonav.cli import main
from orthonav.core.errors import AreaError, CameraError, UsageError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check import run as check_run
from orthonav.ground.check.layers import check_to_plain
from orthonav.ground.check.records import CheckRequest, Verdict, Word
from orthonav.ground.check.run import check_map
from orthonav.ground.planning.route import Route

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)


def halves(cells):
    """Mean probability well inside the west and the east half of the map."""
    east_m = cells.grid.centres_en_m[: cells.grid.cols, 0]
    west, east = (east_m < -80) & (east_m > -400), (east_m > 80) & (east_m < 400)
    inner = cells.probability[2:-2]
    return float(np.nanmean(inner[:, west])), float(np.nanmean(inner[:, east]))


# With trials.


@pytest.fixture(scope="module")
def tried(half_blank):
    """The map checked with its own date alone."""
    said = []
    request = CheckRequest(
        half_blank.map,
        camera=CAMERA,
        agl_m=130.0,
        prior_std_m=50.0,
        effort=0.05,
        workers=1,
    )
    result, _ = check_map(request, lambda what, share: said.append((what, share)))
    return result, said


@pytest.mark.long
def test_the_half_that_shows_something_is_where_views_are_placed(tried):
    result, said = tried
    west, east = halves(result.cells)
    assert west > 0.5 and east < 0.3 and west > 2 * east
    assert east < result.mean.median < west
    assert {what for what, _ in said} == {"trials"} and said[-1][1] == 1.0


# With synthetic trials.


def made_up(request, conditions, batches, workers, progress):
    """Views of the west are placed, those of the east and of a second date are not."""
    for places in batches:
        own = [
            right(tuple(place), expected=0.6) if place[0] < 0 else lost(tuple(place), expected=0.1)
            for place in places
        ]
        other = [] if request.other_date is None else [lost(tuple(place)) for place in places]
        yield len(places), own, other


@pytest.fixture
def untried(monkeypatch):
    monkeypatch.setattr(check_run, "run_trials", made_up)


@pytest.fixture
def checked(untried, half_blank):
    """Function that checks the map with made-up trials."""

    def check(**changed):
        usual = {"camera": CAMERA, "agl_m": 130.0, "prior_std_m": 50.0, "effort": 0.5}
        return check_map(CheckRequest(half_blank.map, **(usual | changed)))[0]

    return check


@pytest.mark.parametrize("kind", ["other", "near-infrared", "thermal"])
def test_other_light_lowers_what_is_predicted(checked, kind):
    usual, other = checked(), checked(camera_kind=kind)
    assert halves(other.cells)[0] < halves(usual.cells)[0] - 0.02
    thermal = [each.word for each in other.verdict.reasons if each.code == "thermal"]
    assert thermal == [Word.MARGINAL] * (kind == "thermal")
    low, lower = (np.nanmean(each.cells.low) for each in (usual, other))
    assert lower < low - 0.05


def test_a_route_over_both_halves(checked, frame):
    route = route_of(frame, [[-350, 0], [350, 0]])
    result = checked(route=route, band_m=200.0, alert_limit_m=25.0)
    along = result.along
    assert along.probability[0] > 0.8 and along.probability[-1] < 0.2
    assert along.distance_m[-1] - 100 < result.outages[-1].end_m <= along.distance_m[-1]
    assert result.outages[-1].start_m > 250 and result.flights.availability.low < 0.6
    assert result.verdict.word is not Word.GO and result.band_m == 200.0
    cells, (west, _, _, north) = result.cells, result.cells.grid.extent_en_m
    assert (west, north) == pytest.approx((-450, 100), abs=1)
    corners = cells.probability[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert np.isnan(corners).all()  # of the box, outside the round ends of the band


def code_of(result):
    """That of the finding on houses and trees."""
    codes = {"surface", "no_surface", "houses"} & {each.code for each in result.verdict.reasons}
    return codes.pop()


def test_what_the_map_knows_of_houses_and_trees(checked, monkeypatch):
    """Blocks of 10 m, 30 m apart, in the west; nothing known in the north."""
    assert code_of(checked()) == "no_surface" and code_of(checked(relief_m=0.0)) == "surface"
    assert code_of(checked(agl_m=80.0)) == "houses"

    class Surface:
        def __init__(self, west_m, south_m):
            self.west_m, self.south_m = west_m, south_m

        def at_en_m(self, points_en_m):
            east, north = np.moveaxis(points_en_m, -1, 0)
            block = (np.mod(east, 30.0) < 15.0) & (np.mod(north, 30.0) < 15.0)
            known = np.where(block & (east < self.west_m), 10.0, 0.25)
            return np.where(north < self.south_m, known, np.nan)

    def found(*shape, **changed):
        layer = SimpleNamespace(of=lambda *_, **__: Surface(*shape))
        monkeypatch.setattr(check_run, "TerrainLayer", layer)
        result = checked(**changed)
        text = next(each.text for each in result.verdict.reasons if each.code == code_of(result))
        return code_of(result), text

    code, text = found(0.0, 1e9, agl_m=80.0)
    assert code == "houses"
    assert 45 < float(re.search(r"at ([\d.]+) % of the places\.", text)[1]) < 60
    assert found(-1e9, 1e9, agl_m=80.0)[0] == "surface"
    code, text = found(-1e9, 0.0)
    assert code == "no_surface"
    assert 40 < float(re.search(r"does not know them at ([\d.]+) %", text)[1]) < 60


def test_trials_end_when_the_answer_holds(checked):
    few, many = (checked(effort=each).cells.trials.sum() for each in (0.25, 1.0))
    assert 20 <= few < many < 500


def test_progress_counts_all_that_will_be_tried(untried, half_blank, monkeypatch):
    """Two batches at least: a quick check of 64 trials is half done after 32."""
    shares = []

    def tried(request, conditions, batches, workers, progress):
        for number, found in enumerate(made_up(request, conditions, batches, workers, progress), 1):
            progress(32 * number)
            yield found

    monkeypatch.setattr(check_run, "run_trials", tried)
    request = CheckRequest(half_blank.map, camera=CAMERA, agl_m=130.0, effort=0.05)
    check_map(request, lambda _, share: shares.append(share))
    assert shares[0] == 0.5 and shares[-1] == 1.0 and shares.count(0.99) <= 1


@pytest.mark.parametrize(
    "points, changed",
    [
        ([[-200, 0]], {}),
        ([[-200, 0], [-199, 0]], {"band_m": 0.01}),
        ([[-200, 0], [200, 0]], {"prior_std_m": None, "yaw_std_deg": None, "agl_std": 0.0}),
        ([[-9000, 0], [9000, 0]], {"band_m": 20.0}),
        ([[-200, 0], [200, 0]], {"agl_m": 1.0, "effort": 0.05}),
    ],
    ids=lambda each: str(each) if isinstance(each, dict) else f"{len(each)} from {each[0][0]}",
)
def test_odd_routes(checked, frame, points, changed):
    result = checked(route=route_of(frame, points), **changed)
    cells, along = result.cells, result.along
    assert np.isfinite(cells.probability).any() and cells.trials.sum() >= 20
    assert np.isfinite(along.probability).all() and (result.flights.protection_m > 0).all()
    assert (along.across_low <= along.probability).all()
    assert cells.probability.size < 300_000
    json.dumps(check_to_plain(result), allow_nan=False)


def test_views_that_fit_on_no_map(checked):
    with pytest.raises(AreaError, match="do not fit on the map"):
        checked(agl_m=50_000.0)
    wide = Camera(65_535, 65_535, 20_000.0, 20_000.0, 1.0, 1.0, unusual=True)
    assert checked(agl_m=None, camera=wide).conditions.width_m == pytest.approx(128.0)
    with pytest.raises(CameraError, match="long as wide"):
        checked(camera=Camera(65_535, 1, 1000.0, 1000.0, 32_767.5, 0.5))
    many = checked(camera=Camera(65_535, 49_151, 51_200.0, 51_200.0, 32_768.0, 24_576.0))
    assert many.conditions.width_m == pytest.approx(166.4, abs=0.1)


def test_routes_outside_the_map(checked, frame):
    for points in ([[20_000, 0], [20_500, 0]], [[-200, 5000]]):
        with pytest.raises(AreaError, match="does not touch the map"):
            checked(route=route_of(frame, points))
    with pytest.raises(AreaError, match="does not touch the map"):
        checked(route=Route(((-40.0, 170.0), (-40.0, 170.01))))
    with pytest.raises(UsageError, match="wider than 0 m"):
        checked(route=route_of(frame, [[-200, 0], [200, 0]]), band_m=-5.0)
    with pytest.raises(AreaError, match="km across"):
        checked(route=route_of(frame, [[-40_000, 0], [40_000, 0]]))


# As a command.


@pytest.fixture
def written_route(frame, tmp_path):
    """Function that writes a route, with a column of heights where one is given."""

    def write(*column):
        lat, lon = np.round(frame.latlon_from_en([[-350.0, -50.0], [-100.0, 60.0]]), 7).tolist()
        columns = [("lat_deg", *lat), ("lon_deg", *lon), *([column] if column else [])]
        path = tmp_path / "route.csv"
        rows = zip(*columns, strict=True)
        path.write_text("".join(f"{','.join(map(str, row))}\n" for row in rows))
        return path

    return write


VIEWS = ("--agl-m", "170", "--prior-std-m", "50", "--workers", "1")


@pytest.mark.long
def test_command(run, untried, half_blank, written_route, tmp_path):
    out = tmp_path / "report"
    done = run(
        *("check", half_blank.map, "--route", written_route(), "--other-date", half_blank.present),
        *(*VIEWS, "--effort", "0.05", "--out", out),
    )
    assert done.code in (0, 3, 4) and done.err == ""
    assert f"report: {out / 'index.html'}" in done.out
    assert {path.name for path in out.iterdir()} == FILES
    plain = json.loads((out / "check.json").read_text())
    assert plain["verdict"]["exit_code"] == done.code
    assert plain["about"]["other_date"] == half_blank.present.name
    assert plain["conditions"]["agl_m"] == 170
    with rasterio.open(out / "check.tif") as raster:
        assert raster.shape == (plain["cells"]["rows"], plain["cells"]["cols"])


@pytest.fixture
def unwritten(untried, monkeypatch):
    """Nothing is written."""
    monkeypatch.setattr("orthonav.ground.check.write.write_check", lambda result, opened, out: out)


@pytest.mark.parametrize("word", list(Word), ids=lambda word: word.value)
def test_exit_codes(run, unwritten, half_blank, tmp_path, monkeypatch, word):
    judge = check_run.verdict_of
    monkeypatch.setattr(check_run, "verdict_of", lambda found: Verdict(word, judge(found).reasons))
    more = ("--camera-pitch-deg", "30", "--json", "--out", tmp_path / "report")
    done = run("check", half_blank.map, *VIEWS, *more)
    assert (done.code, done.err) == (word.exit_code, "")
    plain = json.loads(done.out)
    assert plain["verdict"]["word"] == word.value
    assert {"no_surface", "oblique"} < {each["code"] for each in plain["verdict"]["reasons"]}
    assert plain["conditions"]["camera_pitch_deg"] == 30.0


@pytest.mark.parametrize("more, agl_m", [((), 150), (("--agl-m", "160"), 160)])
def test_the_height_of_a_route(run, unwritten, half_blank, written_route, tmp_path, more, agl_m):
    """The lowest above ground, landings left out; --agl-m comes before it."""
    route = written_route("agl_m", 150, 180)
    out = ("--json", "--out", tmp_path / "report")
    done = run("check", half_blank.map, "--route", route, *more, *out)
    assert json.loads(done.out)["conditions"]["agl_m"] == agl_m


def test_heights_above_sea_need_a_terrain(
    run, unwritten, half_blank, frame, written_route, tmp_path
):
    """The heights of the route as written are never taken for heights above ground."""
    route = written_route("home_m", 120, 120)
    check = ("check", half_blank.map, "--route", route, "--out", tmp_path / "report")
    done = run(*check)
    assert done.code == 1 and "not above ground: give the terrain (--dem" in done.err
    assert "Checked at 160 m above ground, as given." in run(*check, "--agl-m", 160).out
    # The ground falls by 100 m from the first waypoint to the second.
    dem = write_dem(tmp_path / "dem.tif", frame, lambda east, north: 300 - 0.4 * east + 0 * north)
    over = run(*check, "--dem", dem, "--dem-datum", "msl")
    assert (
        "Checked at 120 m above ground, the lowest over the terrain of dem.tif (220 m" in over.out
    )
    without = run(*check, "--dem", dem)  # only differences of its heights count
    assert without.out == over.out
    written_route("amsl_m", 420, 420)
    refused = run(*check, "--dem", dem)
    assert refused.code == 1 and "above the sea" in refused.err and "--dem-datum" in refused.err
    assert "lowest over the terrain" in run(*check, "--dem", dem, "--dem-datum", "msl").out
    far = write_dem(
        tmp_path / "far.tif", LocalFrame(1, 1), lambda east, north: 0.1 * east + north * 0
    )
    done = run(*check, "--dem", far, "--dem-datum", "msl")
    assert done.code == 1 and "the route lies outside the terrain" in done.err


@pytest.mark.parametrize(
    "options, said",
    [
        (["--workers", "0"], "workers must be"),
        (["--other-date", "no.tif"], "no.tif"),
        (["--camera", "no.json"], "no.json"),
        (["--agl-m", "40000"], "do not fit on the map"),
    ],
    ids=lambda each: " ".join(each) if isinstance(each, list) else "",
)
def test_bad_input_is_one_line(run, half_blank, tmp_path, names_in, options, said):
    done = run("check", half_blank.map, *options, "--out", tmp_path / "report")
    assert done.code == (2 if "--workers" in options else 1)
    assert done.out == "" and done.err.count("\n") == 1
    assert done.err.startswith("orthonav: error: ") and said in done.err
    assert names_in(tmp_path) == []


def test_the_imagery_of_the_map_is_no_other_date(run, half_blank, tmp_path):
    past = half_blank.past
    done = run("check", half_blank.map, "--other-date", past, "--out", tmp_path / "report")
    assert done.code == 1 and "the map was built from this orthophoto; name one" in done.err


def test_an_interrupt_writes_nothing(run, half_blank, tmp_path, names_in, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(check_run, "run_trials", interrupted)
    done = run("check", half_blank.map, *VIEWS, "--out", tmp_path / "report")
    assert (done.code, done.err) == (130, "orthonav: error: interrupted; nothing was written\n")
    assert names_in(tmp_path) == []
    assert main(["check", str(half_blank.map), "--out", str(tmp_path / "report")]) == 130
