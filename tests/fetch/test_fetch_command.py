"""`orthonav fetch` from end to end: its output, its file, and the map built from it."""

import json
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import servers
import terrain

from orthonav.cli import main
from orthonav.ground.fetch.presets import ImageryOptions, parse_source, presets, terrain_preset
from orthonav.ground.fetch.run import holds_heights
from orthonav.ground.imagery.source import open_sources
from orthonav.ground.imagery.terrain import open_dem

SECRET = "t0ken-of-mine"
OWN = """[survey]
title = "Survey of the ground"
protocol = "xyz"
url = "URL/{z}/{x}/{y}.png"
licence = "CC BY 4.0"
attribution = "Ground Survey"
[[survey.layers]]
years = [2020, 2021]
id = "{year}"
date = "{year}-06"
"""


@pytest.fixture
def command(capsys):
    """Function that runs the command and gives exit code, stdout and stderr."""

    def run(*arguments, terrain=False):
        more = [] if terrain else ["--heights", "none"]
        code = main(["fetch", *map(str, arguments), *more])
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def area():
    return f"--bounds={','.join(map(str, terrain.bounds(60)))}"


def test_an_orthophoto_with_its_terms(command, area, tmp_path):
    out = tmp_path / "ortho.tif"
    with servers.serving(servers.tiles) as server:
        table = tmp_path / "mine.toml"
        table.write_text(OWN.replace("URL", server.url))
        own = ("--services", table, "--source", "survey:2021")
        code, stdout, stderr = command(area, *own, "--out", out, "--margin-m", 0)
        assert "survey: Survey of the ground" in command("--list", *own[:2])[1]
    assert code == 0 and "fetching" in stderr and "Ground Survey" in stdout and "2021-06" in stdout
    tags = terrain.tags(out)
    assert tags["TIFFTAG_COPYRIGHT"] == tags["ORTHONAV_ATTRIBUTION"] == "Ground Survey"
    assert tags["ORTHONAV_LICENCE"] == "CC BY 4.0" and tags["ACQUISITION_DATE"] == "2021-06"
    assert tags["ORTHONAV_SOURCE"].startswith(server.url) and "ORTHONAV_FETCHED" in tags
    assert "TIFFTAG_DATETIME" not in tags  # the day is not known
    found = open_sources([out])[0]
    assert found.date == "2021-06" and found.bands == (1, 2, 3) and found.gsd_m < 0.5
    with rasterio.open(out) as data:
        assert data.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert data.compression.name.lower() == "jpeg" and data.photometric.name.lower() == "ycbcr"
        assert data.mask_flag_enums[0] == [rasterio.enums.MaskFlags.per_dataset]


def test_a_route_and_its_band(command, tmp_path):
    west, south, east, north = terrain.bounds(60)
    line = {"type": "LineString", "coordinates": [[west, south], [east, north]]}
    (tmp_path / "route.geojson").write_text(json.dumps(line))
    with servers.serving(servers.tiles) as server:
        source = ["--source", server.tiles, "--gsd-m", "1"]
        out = ["--out", tmp_path / "o.tif", "--json"]
        route = ["--route", tmp_path / "route.geojson"]
        code, stdout, _ = command(*route, "--band-m", "50", *source, *out)
        assert code == 0 and json.loads(stdout)["images"] > 0
        code, _, stderr = command(*route, *source, *out)
    assert code == 2 and "--band-m" in stderr


def test_a_dry_run_fetches_no_tile(command, area, tmp_path, names_in):
    with servers.serving(servers.tiles) as server:
        dry = (area, "--source", server.tiles, "--dry-run")
        code, stdout, _ = command(*dry)
        assert code == 0 and "would fetch" in stdout and "tiles" in stdout and "MB" in stdout
        code, stdout, _ = command(*dry, "--json")
        assert json.loads(stdout)["tiles"] > 0 and not server.log
    assert names_in(tmp_path) == []


@pytest.fixture
def offered(monkeypatch):
    """Function that puts the heights known by name at an address, and those of a source at one."""

    def put(url, surface_of=()):
        terrain_, surface = (
            replace(presets()[name], url=f"{url}/api/", token_url=None)
            for name in ("copernicus-dem", "swisssurface3d")
        )
        found = presets() | {"copernicus-dem": terrain_, "swisssurface3d": surface}
        for name, address in surface_of:
            ours = replace(presets()["swissimage-stac"], protocol="xyz", url=address, terrain=None)
            found[name] = ours
        monkeypatch.setattr("orthonav.ground.fetch.presets.presets", lambda *_: found)
        monkeypatch.setattr("orthonav.ground.fetch.web.RequestLimits.pause", lambda *_: None)

    return put


def test_terrain_comes_with_the_imagery(command, area, tmp_path, offered):
    found, step, west, north = terrain.height_files(tmp_path)
    out = tmp_path / "ortho.tif"
    with servers.searching(found) as heights, servers.serving(servers.tiles) as server:
        offered(heights.url)
        fetch = (area, "--source", server.tiles, "--out", out)
        code, stdout, _ = command(*fetch, "--gsd-m", 1, terrain=True)
        assert code == 0 and "Copernicus" not in stdout and "COPERNICUS" in stdout
        (line,) = [each.strip() for each in stdout.splitlines() if "orthonav build" in each]
        code, stdout, _ = command(*fetch, "--gsd-m", 1, "--json", terrain=True)  # replaces its own
        plain = json.loads(stdout)["terrain"]
        code, stdout, _ = command(*fetch, "--dry-run", terrain=True)
        assert code == 0 and "terrain from copernicus-dem" in stdout
    dem_path = tmp_path / "ortho_dem.tif"
    assert plain["out"] == str(dem_path) and plain["datum"] == "egm2008"
    words = shlex.split(line)
    assert words[:6] == ["orthonav", "build", "--ortho", str(out), "--dem", str(dem_path)]
    assert area in words and words[-1] == str(tmp_path / "ortho.onav")
    box = heights.searches[0]["bbox"]  # beyond the imagery by what oblique views see
    assert (box[3] - terrain.LAT_DEG) * terrain.NORTH_M > 1200
    dem = open_dem(dem_path)  # its datum is not asked for
    assert dem.datum.name == "EGM2008 height" and not dem.datum.above_ellipsoid
    lat = terrain.LAT_DEG + np.linspace(-5, 5, 11) * step
    lon = west - np.linspace(0.5, 8, 11) * step
    np.testing.assert_allclose(dem(lat, lon), terrain.heights(lat, lon), atol=0.05)
    assert np.isnan(dem(np.array([north - 19 * step]), np.array([west + 6.5 * step])))


@pytest.mark.parametrize("broken", [False, True])
def test_a_surface_comes_with_the_imagery(command, area, tmp_path, offered, caplog, broken):
    """In place of a terrain of Copernicus, which is fetched where the surface cannot be."""
    out, dem_path, dsm_path = (tmp_path / f"ortho{end}.tif" for end in ("", "_dem", "_dsm"))
    serving = servers.searching(terrain.surface_file(tmp_path))
    if broken:
        serving = servers.searching(terrain.height_files(tmp_path)[0], refused=b"surface3d")
    with serving as heights, servers.serving(servers.tiles) as server:
        offered(heights.url, [("town", server.tiles.removeprefix("xyz:"))])
        fetch = (area, "--source", "town", "--gsd-m", 1, "--out", out, "--heights", "surface")
        dry = json.loads(command(*fetch, "--dry-run", "--json", terrain=True)[1])
        assert dry["surface"] == "swisssurface3d" and dry["terrain"] is None
        assert "terrain from copernicus-dem where" in command(*fetch, "--dry-run", terrain=True)[1]
        code, stdout, _ = command(*fetch, "--json", terrain=True)
        plain = json.loads(stdout)
        assert code == 0 and (plain["terrain"] is None) == (plain["surface"] is not None)
        code, stdout, _ = command(*fetch, terrain=True)
        assert code == 0 and dem_path.exists() == broken
    line = f"orthonav build --ortho {out} "
    if broken:
        assert "no surface was fetched" in caplog.text and "--source swisssurf" in caplog.text
        assert out.is_file() and not dsm_path.exists() and plain["surface"] is None
        assert plain["terrain"]["out"] == str(dem_path)
        assert f"{line}--dem " in stdout and "--surface" not in stdout
        return
    assert plain["surface"]["out"] == str(dsm_path) and plain["surface"]["datum"] == "EPSG:5728"
    assert f"{line}--surface {dsm_path} " in stdout and "--dem" not in stdout
    assert heights.searches[0]["collections"] == ["ch.swisstopo.swisssurface3d-raster"]
    lat, lon = terrain.LAT_DEG + np.array([-5e-4, 5e-4]), terrain.LON_DEG + np.array([0, 9e-4])
    dsm = open_dem(dsm_path)
    assert dsm.gsd_m == pytest.approx(1, rel=0.01)
    np.testing.assert_allclose(dsm(lat, lon), terrain.heights(lat, lon), atol=0.05)


def test_no_terrain_comes_with_heights(tmp_path):
    path = tmp_path / "a.tif"
    for dtype, heights in (("float32", True), ("int16", True), ("uint8", False)):
        with rasterio.open(path, "w", driver="GTiff", width=8, height=8, count=1, dtype=dtype):
            pass
        assert holds_heights(path) == heights


@pytest.mark.parametrize("fault", ["down", "another file"])
def test_imagery_is_kept_where_terrain_fails(command, area, tmp_path, offered, caplog, fault):
    out, other = tmp_path / "ortho.tif", tmp_path / "ortho_dem.tif"
    if fault == "another file":
        other.write_text("mine")
    with (
        servers.serving(lambda _: servers.Answer(b"no", 503)) as heights,
        servers.serving(servers.tiles) as server,
    ):
        offered(heights.url)
        code, stdout, _ = command(area, "--source", server.tiles, "--out", out, terrain=True)
    assert code == 0 and out.is_file() and "no terrain was fetched" in caplog.text
    assert "--source copernicus-dem" in caplog.text and "--dem" not in stdout
    assert f"orthonav build --ortho {out}" in stdout
    assert (other.read_text() == "mine") if fault == "another file" else not other.exists()


@pytest.mark.parametrize(
    "source, name",
    [
        ("ign:2021", "ign-terrain"), ("naip:2020", "usgs-3dep"), ("swissimage", "swissalti3d"),
        ("pdok", "copernicus-dem"), ("wms:https://a.example/wms", "copernicus-dem"),
        ("nasadem", None),
    ],
)  # fmt: skip
def test_the_terrain_is_that_of_the_country_or_of_copernicus(source, name):
    assert terrain_preset(source) == name
    if name is not None:
        spec = parse_source(name, ImageryOptions())
        assert spec.provenance.datum
        assert spec.options.gsd_m == (5.0 if name in ("ign-terrain", "swissalti3d") else None)


@pytest.mark.long
def test_keys_never_appear(command, area, tmp_path, monkeypatch):
    """Not in messages, tags, names of the cache, nor with -v in what libraries say."""
    monkeypatch.setenv("MY_KEY", SECRET)

    def answer(asked):
        assert asked.query.pop("TOKEN") == SECRET
        return servers.tiles(asked) if len(server.log) > 3 else servers.Answer(b"no", 503)

    with servers.serving(answer) as server:
        source, out = f"{server.tiles}?token={{key}}", tmp_path / "ortho.tif"
        keep = ["--key-env", "MY_KEY", "-v"]
        code, stdout, stderr = command(area, "--source", source, "--out", out, "--gsd-m", 1, *keep)
    assert code == 0 and SECRET not in stdout + stderr
    everything = b"".join(p.read_bytes() for p in tmp_path.rglob("*") if p.is_file())
    assert SECRET.encode() not in everything
    assert not any(SECRET in str(p) for p in tmp_path.rglob("*"))
    assert "token={key}" in terrain.tags(out)["ORTHONAV_SOURCE"]


def test_services_known_by_name_are_listed(command):
    code, stdout, _ = command("--list")
    assert (
        code == 0 and "ign: IGN" in stdout and "1950-1965" in stdout and "DATAFORSYNINGEN" in stdout
    )
    assert "--heights surface fetches swisssurface3d" in stdout
    code, stdout, _ = command("--list", "--json")
    assert code == 0 and json.loads(stdout)[0]["licence"]
    assert json.loads(stdout)[0]["surface"] == "ign-surface"


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "give a --source"),
        (["--source", "ign:2021"], "give a --source .* and an --out"),
        (["--source", "ign:2021", "--out", "o.tif"], "give one area"),
        (["--source", "file:///etc/passwd", "--out", "o.tif"], "write the protocol"),
        (["--bounds=3,46,3.1,46.1", "--source", "nrw", "--out", "o.tif", "--heights", "surface"],
         "no surface model is known for 'nrw'; sources with one: .*ign.*swissimage"),
        (["--bounds=3,46,3.1,46.1", "--source", "xyz:http://a/{z}/{x}/{y}", "--out", "o.jpg"],
         "must be a .tif"),
        (["--services", "no.toml", "--source", "ign", "--out", "o.tif"], "table of services does"),
        (["--gsd-m", "0", "--source", "ign", "--out", "o.tif"], "--gsd-m must be above 0"),
    ],
)  # fmt: skip
def test_wrong_usage_is_reported_on_one_line(command, arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, stdout, stderr = command(*arguments, terrain=True)
    wanted = 1 if words.startswith(("table", "no surface")) else 2
    assert code == wanted and not stdout and stderr.count("\n") == 1
    assert len(re.findall(words, stderr)) == 1
    assert not list(tmp_path.iterdir())
