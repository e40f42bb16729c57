"""What comes from a real WMTS and WMS is the ground, in its place to a twentieth of a pixel."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
import servers
import terrain
from pyproj import Transformer
from rasterio.io import MemoryFile

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.presets import ImageryOptions, parse_source, presets
from orthonav.ground.fetch.run import FetchRequest, fetch
from orthonav.ground.imagery.source import open_sources
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area

MAX_OFF_PX = 0.05


def placed(path, crs):
    """Check that a file shows the ground where it says."""
    with rasterio.open(path) as data:
        assert data.crs.to_string() == crs
    shift, worst, valid = terrain.offset_px(path)
    assert np.abs(shift).max() < MAX_OFF_PX
    return worst, valid


@pytest.mark.parametrize("way", ["/service", "/wmts/1.0.0/WMTSCapabilities.xml"])
def test_wmts_by_parameters_and_by_templates(mapproxy, take, way):
    result, path = take(f"wmts:{mapproxy}{way}", layer="tiles")
    worst, valid = placed(path, "EPSG:3857")
    assert worst <= 1 and valid == 1.0
    assert result.images == result.estimate.tiles and not result.failed
    assert result.estimate.gsd_m == pytest.approx(0.822, abs=0.01)  # zoom 17 at 46.5 N


@pytest.mark.parametrize("crs", ["EPSG:2154", "EPSG:32631"])
def test_wmts_in_other_grids(mapproxy, take, crs):
    _, path = take(f"wmts:{mapproxy}/service", layer="tiles", crs=crs)
    assert placed(path, crs)[0] <= 1
    with rasterio.open(path) as data:
        assert data.res == pytest.approx((1.0, 1.0), abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(
    "crs, version",
    [("EPSG:3857", "1.1.1"), ("EPSG:2154", "1.3.0"), ("EPSG:3035", "1.3.0"), ("EPSG:4326", "1.1.1"),
     ("EPSG:4326", "1.3.0")],
)  # fmt: skip
def test_wms_in_every_axis_order(mapproxy, take, version, crs):
    """3035 and 4326 have the northing first, which 1.3.0 follows and 1.1.1 does not."""
    source = f"wms:{mapproxy}/service"
    _, path = take(
        source, layer="ortho", format="image/png", crs=crs, version=version, tile_px=128, half_m=70
    )
    worst, valid = placed(path, crs)
    assert worst <= 1.5 and valid == 1.0
    assert open_sources([path])[0].gsd_m == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(
    "source",
    ["xyz:URL/xyz/{z}/{x}/{y}.png", "tms:URL/tms/{z}/{x}/{y}.png", "xyz:URL/tms/{z}/{x}/{-y}.png",
     "xyz:URL/q/{q}", "xyz:URL/xyz/{z}/{x}/{y}{r}.png"],
)  # fmt: skip
def test_tiles_rows_from_the_south_quadkeys_and_large_tiles(take, source):
    def answer(asked):
        kind, *rest = asked.path.strip("/").split("/")
        if kind == "q":
            bits = [f"{int(digit):02b}" for digit in rest[0]]
            row, col = (int("".join(pair[i] for pair in bits), 2) for i in (0, 1))
            zoom = len(bits)
        else:
            zoom, col, row = (int(part.partition("@")[0].partition(".")[0]) for part in rest)
            row = 2**zoom - 1 - row if kind == "tms" else row
        size = 512 if "@2x" in asked.path else 256
        assert asked.headers["User-Agent"].startswith("orthonav/")
        return servers.Answer(terrain.encoded(terrain.mercator_tile(zoom, row, col, size)))

    with servers.serving(answer) as server:
        _, path = take(source.replace("URL", server.url), half_m=60)
        assert {"@2x" in asked.path for asked in server.log} == {"{r}" in source}
    assert placed(path, "EPSG:3857")[0] <= 1


@pytest.mark.parametrize(
    "options, words",
    [
        ({"layer": "tile"}, "no layer tile; available: tiles"),
        ({"style": "winter"}, "no style winter; available: default"),
        ({"crs": "EPSG:3006"}, "does not come in EPSG:3006; available:"),
        ({"matrix_set": "PM"}, "no grid PM; available: .*lambert"),
        ({"zoom": "33"}, r"no zoom 33; available: 00 \(.*19 \(0.206 m"),
        ({"crs": "EPSG:32631", "gsd_m": 0.2}, "the finest is 1 m"),
        ({"time": "2021"}, "no time to choose"),
        ({"format": "image/jpeg"}, "no format image/jpeg; available: image/png"),
    ],
)
def test_what_a_wmts_does_not_have_is_listed(mapproxy, take, options, words):
    with pytest.raises(FetchError, match=words):
        take(f"wmts:{mapproxy}/service", **{"layer": "tiles"} | options)


CAPABILITIES = """<WMS_Capabilities version="1.3.0" xmlns="http://www.opengis.net/wms"
 xmlns:xlink="http://www.w3.org/1999/xlink"><Service><Name>WMS</Name><Title>t</Title></Service>
<Capability><Request><GetMap><Format>image/jpeg</Format><Format>image/geotiff</Format>
<DCPType><HTTP><Get><OnlineResource xlink:href="URL/map"/></Get></HTTP></DCPType></GetMap></Request>
<Layer><Title>t</Title><CRS>EPSG:2154</CRS>
<Layer><Name>ELEVATION.ELEVATIONGRIDCOVERAGE.HIGHRES</Name><Title>t</Title></Layer></Layer>
</Capability></WMS_Capabilities>"""


@pytest.mark.parametrize("broken", ["", "cut", "page"])
def test_heights_of_a_wms(tmp_path, monkeypatch, broken):
    """Numbers of 32 bits, as the preset of IGN asks for them; -99999 is no data."""
    url = []

    def answer(asked):
        if asked.query["REQUEST"] == "GetCapabilities":
            return servers.Answer(CAPABILITIES.replace("URL", url[0]).encode(), kind="text/xml")
        assert asked.query["FORMAT"] == "image/geotiff" and asked.query["CRS"] == "EPSG:2154"
        west, south, east, north = (float(v) for v in asked.query["BBOX"].split(","))
        width, height = int(asked.query["WIDTH"]), int(asked.query["HEIGHT"])
        x = west + (np.arange(width) + 0.5) * (east - west) / width
        y = north - (np.arange(height) + 0.5) * (north - south) / height
        values = (0.01 * (x - 700_000)[None, :] + 0.02 * (y - 6_600_000)[:, None]).astype("f4")
        values[abs(y - middle_y) < 8] = -99999
        if broken == "page":
            return servers.Answer(b"<html>busy</html>", kind="text/html")
        with MemoryFile() as file:
            profile = {"driver": "GTiff", "count": 1, "dtype": "float32"}
            with file.open(width=width, height=height, **profile) as data:
                data.write(values[None])
            body = file.read()
        return servers.Answer(body[:-400] if broken else body, kind="image/geotiff")

    middle_x, middle_y = Transformer.from_crs(4326, 2154, always_xy=True).transform(
        terrain.LON_DEG, terrain.LAT_DEG
    )
    with servers.serving(answer) as server:
        url.append(server.url)
        known = replace(presets()["ign-terrain"], url=server.url)
        monkeypatch.setattr("orthonav.ground.fetch.presets.presets", lambda: {"ign-terrain": known})
        area = Area.from_bounds(terrain.bounds(60))
        spec = parse_source("ign-terrain", ImageryOptions(tile_px=128))
        request = FetchRequest(spec, area, tmp_path / "dem.tif", margin_m=0, limits=servers.QUICK)
        if broken:
            with pytest.raises(FetchError, match="tiles failed"):
                fetch(request)
            return
        fetch(request)
    dem = open_dem(tmp_path / "dem.tif")
    assert dem.datum.name == "NGF-IGN69 height" and dem.gsd_m == pytest.approx(5, rel=0.01)
    x, y = middle_x + np.array([-40.0, 31.5]), middle_y + np.array([-30.0, 44.0])
    lon, lat = Transformer.from_crs(2154, 4326, always_xy=True).transform(x, y)
    expected = 0.01 * (x - 700_000) + 0.02 * (y - 6_600_000)
    np.testing.assert_allclose(dem(lat, lon), expected, atol=0.02)
    assert np.isnan(dem(np.array([terrain.LAT_DEG]), np.array([terrain.LON_DEG])))
