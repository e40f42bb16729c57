"""Files on servers: only the window's bytes, in their place, alone or as a catalogue has them."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
import servers
import terrain
from pyproj import Transformer

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.files import _asset
from orthonav.ground.fetch.presets import ImageryOptions, parse_source
from orthonav.ground.planning.area import Area

UTM = "EPSG:32631"


@pytest.fixture
def placed():
    """Function that checks a file against the ground and gives the share that is valid."""

    def check(path, crs=UTM, worst=1.0):
        with rasterio.open(path) as data:
            assert data.crs.to_string() == crs
        shift, off, valid = terrain.offset_px(path)
        assert np.abs(shift).max() < 0.05 and off <= worst
        return valid

    return check


def test_a_window_of_a_file_as_it_is(take, placed, cog_bytes, tmp_path):
    with servers.serving(servers.files(cog_bytes)) as server:
        table = tmp_path / "own.toml"
        table.write_text(
            f'[mine]\nprotocol = "cog"\nurl = "{server.url}/a.tif"\n'
            '[[mine.layers]]\nid = "a"\ndate = "2021-07-04"\n'
        )
        result, path = take("mine:a", gsd_m=None, terms={"own": table})
        assert all("bytes=" in asked.headers["Range"] for asked in server.log[1:])
        before, outside = len(server.log), Area.from_bounds((3.5, 46.5, 3.501, 46.501))
        with pytest.raises(FetchError, match="no imagery of this area"):
            take(server.file, gsd_m=None, area=outside)
        assert len(server.log) - before <= 2  # its head
    assert placed(path) > 0.4  # the file is smaller than the cell
    assert result.estimate.gsd_m == pytest.approx(1, rel=0.01)
    assert terrain.tags(path)["TIFFTAG_DATETIME"] == "2021:07:04 00:00:00"


def test_only_the_bytes_of_the_window_are_fetched(take, placed, tmp_path):
    large = terrain.write_tif(tmp_path / "large.tif", UTM, size=1100, driver="COG").read_bytes()
    with servers.serving(servers.files(large)) as server:
        _, path = take(server.file, gsd_m=None, half_m=20)
        # The first request asks for the size, and ends after the head of the answer.
        ranges = [asked.headers["Range"][6:].split("-") for asked in server.log[1:]]
    assert placed(path) == 1.0
    assert {asked.headers["User-Agent"].partition("/")[0] for asked in server.log} == {"orthonav"}
    received = sum(int(last) + 1 - int(first) for first, last in ranges)
    assert received < len(large) * 0.7  # one cell of nine, or two


@pytest.mark.parametrize("gsd_m, res", [(2.0, 2.0), (3.0, 2.0)])
def test_overviews_serve_coarser_pixels(take, placed, cog_bytes, gsd_m, res):
    with servers.serving(servers.files(cog_bytes)) as server:
        _, path = take(server.file, gsd_m=gsd_m)
        with pytest.raises(FetchError, match="the finest is 1 m; available: 1 m, 2 m"):
            take(server.file, gsd_m=0.3)
    with rasterio.open(path) as data:
        assert data.res == (res, res)
    placed(path, worst=30)  # averages of four


def test_masks_are_preserved(take, tmp_path):
    hole = np.s_[200:300, 220:280]
    holed = terrain.write_tif(tmp_path / "hole.tif", UTM, hole=hole, size=500, driver="COG")
    with servers.serving(servers.files(holed.read_bytes())) as server:
        _, path = take(server.file, gsd_m=None)
    with rasterio.open(path) as found, rasterio.open(holed) as data:
        window = found.window(*data.bounds)
        expected = np.ones(data.shape, bool)
        expected[hole] = False
        assert ((found.dataset_mask(window=window) > 0) == expected).all()


@pytest.mark.parametrize("bands, wanted, count", [(4, None, 3), (4, (4,), 1), (1, None, 1)])
def test_bands_are_chosen(take, tmp_path, bands, wanted, count):
    made = terrain.write_tif(tmp_path / "b.tif", UTM, size=300, bands=bands, driver="COG")
    with servers.serving(servers.files(made.read_bytes())) as server:
        _, path = take(server.file, gsd_m=None, bands=wanted, compress="jpeg")
        with pytest.raises(FetchError, match="different kinds"):
            take(server.file, gsd_m=None, bands=(9,))
    with rasterio.open(path) as data:
        assert data.count == count and data.compression.name.lower() == "jpeg"


def breaking(fault):
    """A server of a file of which each part is first sent as it is, and broken later on."""

    def serve(body):
        whole = servers.files(body)
        return lambda asked: fault(whole(asked)) if asked.before >= 2 else whole(asked)

    return serve


VRT = b'<VRTDataset rasterXSize="9" rasterYSize="9"/>'
FILE_FAULTS = {
    "no ranges": (lambda body: servers.files(body, ranges=False), "not an image"),
    "missing": (lambda body: servers.files({}), "HTTP 404"),
    "a page": (lambda body: servers.files(b"<html>" * 99), "not an image"),
    "half a file": (lambda body: servers.files(body[: len(body) // 2]), "tiles failed"),
    "a VRT": (lambda body: servers.files(VRT), "not an image"),
    "500": (breaking(lambda good: servers.Answer(b"oops", 500)), "tiles failed"),
    "short": (breaking(lambda good: replace(good, body=good.body[:-9])), "tiles failed"),
    "cut": (breaking(lambda good: replace(good, cut=100)), "tiles failed"),
    "reset": (breaking(lambda good: replace(good, reset=True)), "tiles failed"),
}


@pytest.mark.parametrize("name", FILE_FAULTS)
def test_files_that_cannot_be_read(take, tmp_path, cog_bytes, name, capfd):
    answer, words = FILE_FAULTS[name]
    with servers.serving(answer(cog_bytes)) as server, pytest.raises(FetchError, match=words):
        take(server.file, gsd_m=None)
    assert not (tmp_path / "ortho.tif").exists()
    assert "Traceback" not in capfd.readouterr().err


@pytest.fixture
def catalogue(tmp_path):
    """Files and items of two overlapping squares in one zone, one off the grid, in two years."""
    contents = {}
    for name, shift in (("west_2021", -200), ("east_2021", 200), ("odd_2019", 0.37)):
        path = terrain.write_tif(
            tmp_path / f"{name}.tif", UTM, size=400, driver="COG", east_m=shift
        )
        contents[f"/{name}.tif"] = path.read_bytes()
        with rasterio.open(path) as data:
            to_degrees = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
            box = to_degrees.transform_bounds(*data.bounds)
        time = f"{name[-4:]}-06-{15 if 'w' in name[:1] else 16}T10:00:00Z"
        contents[name] = terrain.item(name, f"./{name}.tif", box, time)
    return contents


def test_an_interface_with_a_search_in_pages(take, placed, catalogue):
    time = "2021-01-01T00:00:00Z/2021-12-31T23:59:59Z"
    with servers.searching(catalogue) as server:
        result, path = take(server.catalogue, gsd_m=None, time=time, layer="dop")
    assert placed(path) > 0.2 and result.estimate.provenance.date == "2021-06-15/2021-06-16"
    assert terrain.tags(path)["ACQUISITION_DATE"] == "2021-06-15"
    assert len(server.searches) == 2
    for body in server.searches:
        assert body["collections"] == ["dop"] and body["datetime"] == time
        west, south, east, north = body["bbox"]
        assert west < terrain.LON_DEG < east and south < terrain.LAT_DEG < north


def test_a_file_off_the_grid_is_resampled(take, placed, catalogue):
    with servers.searching(catalogue) as server:
        _, path = take(server.catalogue, gsd_m=None)
    placed(path, worst=8)


def test_the_picture_of_several_files_is_that_of_the_usual_name():
    kinds = {"B04": "image/tiff", "B08": "image/tiff", "visual": "image/tiff"}
    assets = {name: {"type": kind, "gsd": 10} for name, kind in kinds.items()}
    assert _asset(assets, ImageryOptions(gsd_m=10), "one") == "visual"
    del assets["visual"]["gsd"]
    assert _asset(assets, ImageryOptions(), "one") == "visual"


def test_signed_files(take, catalogue):
    """A query string that a signing service gives goes to the files' server, and nowhere else."""
    with servers.searching(catalogue) as server:
        spec = parse_source(server.catalogue, ImageryOptions(time="2021"))
        _, path = take(replace(spec, token_url=f"{server.url}/api/token"))
        files = [asked for asked in server.log if asked.path.endswith(".tif")]
    assert files and all(asked.query["SIG"] == "abcdefg" for asked in files)
    assert "abcdefg" not in str(terrain.tags(path))


@pytest.mark.parametrize(
    "body, options, words",
    [
        (None, {"time": "1999"}, "no imagery of the area at 1999"),
        (None, {"asset": "visual"}, "no asset visual; available: data"),
        (b"<html>", {}, "not JSON"),
        (b"[1]", {}, "not a JSON object"),
        (b"{}", {}, "not a STAC API with a search"),
    ],
)
def test_missing_items_and_invalid_catalogues_are_errors(take, catalogue, body, options, words):
    serving = servers.searching(catalogue)
    if body is not None:
        serving = servers.serving(lambda _: servers.Answer(body))
    with serving as server, pytest.raises(FetchError, match=words):
        take(server.catalogue, gsd_m=None, **options)
