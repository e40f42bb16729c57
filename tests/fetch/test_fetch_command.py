"""`orthonav fetch` from end to end: its output, its file, and the map built from it."""

import json

import pytest
import rasterio
import servers
import terrain

from orthonav.cli import main
from orthonav.ground.imagery.source import open_sources

SECRET = "t0ken-of-mine"


@pytest.fixture
def command(capsys):
    """Function that runs the command and gives exit code, stdout and stderr."""

    def run(*arguments):
        code = main(["fetch", *map(str, arguments)])
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def area():
    return f"--bounds={','.join(map(str, terrain.bounds(60)))}"


def test_an_orthophoto_with_its_terms(command, area, tmp_path):
    out = tmp_path / "ortho.tif"
    terms = ["--date", "2021-06", "--licence", "CC BY 4.0", "--attribution", "Ground Survey"]
    with servers.serving(servers.tiles) as server:
        source = f"xyz:{server.url}/{{z}}/{{x}}/{{y}}.png"
        code, stdout, stderr = command(
            area, "--source", source, "--out", out, "--margin-m", 0, *terms
        )
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
        source = ["--source", f"xyz:{server.url}/{{z}}/{{x}}/{{y}}.png", "--gsd-m", "1"]
        out = ["--out", tmp_path / "o.tif", "--json"]
        route = ["--route", tmp_path / "route.geojson"]
        code, stdout, _ = command(*route, "--band-m", "50", *source, *out)
        assert code == 0 and json.loads(stdout)["images"] > 0
        code, _, stderr = command(*route, *source, *out)
    assert code == 1 and "--band-m" in stderr


def test_a_dry_run_fetches_no_tile(command, area, tmp_path, names_below):
    with servers.serving(servers.tiles) as server:
        source = f"xyz:{server.url}/{{z}}/{{x}}/{{y}}.png"
        code, stdout, _ = command(area, "--source", source, "--dry-run")
        assert code == 0 and "would fetch" in stdout and "tiles" in stdout and "MB" in stdout
        code, stdout, _ = command(area, "--source", source, "--dry-run", "--json")
        assert json.loads(stdout)["tiles"] > 0 and not server.log
    assert names_below(tmp_path) == []


@pytest.mark.long
def test_keys_never_appear(command, area, tmp_path, monkeypatch):
    """Not in messages, tags, names of the cache, nor with -v in what libraries say."""
    monkeypatch.setenv("MY_KEY", SECRET)

    def answer(asked):
        assert asked.query.pop("TOKEN") == SECRET
        return servers.tiles(asked) if len(server.log) > 3 else servers.Answer(b"no", 503)

    with servers.serving(answer) as server:
        source = f"xyz:{server.url}/{{z}}/{{x}}/{{y}}.png?token={{key}}"
        keep = ["--cache", tmp_path / "cache", "--key-env", "MY_KEY", "-v"]
        out = tmp_path / "ortho.tif"
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
    code, stdout, _ = command("--list", "--json")
    assert code == 0 and json.loads(stdout)[0]["licence"]


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "give a --source"),
        (["--source", "ign:2021"], "give a --source .* and an --out"),
        (["--source", "ign:2021", "--out", "o.tif"], "give one area"),
        (["--source", "file:///etc/passwd", "--out", "o.tif"], "write the protocol"),
        (["--bounds=3,46,3.1,46.1", "--source", "xyz:http://a/{z}/{x}/{y}", "--out", "o.jpg"],
         "must be a .tif"),
        (["--parallel", "99", "--source", "ign", "--out", "o.tif"], "--parallel is 1 to 16"),
        (["--bands", "r,g", "--source", "ign", "--out", "o.tif"], "--bands are numbers"),
        (["--gsd-m", "0", "--source", "ign", "--out", "o.tif"], "--gsd-m must be above 0"),
    ],
)  # fmt: skip
def test_wrong_usage_is_reported_on_one_line(command, arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, stdout, stderr = command(*arguments)
    assert code == 1 and not stdout and stderr.count("\n") == 1
    assert pytest.approx(1) == len(__import__("re").findall(words, stderr))
    assert not list(tmp_path.iterdir())
