"""What comes from a real WMTS and WMS is the ground, in its place to a twentieth of a pixel."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import servers
import terrain
from pyproj import Transformer
from rasterio.io import MemoryFile

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.presets import CURRENT, ImageryOptions, parse_source, presets
from orthonav.ground.imagery.source import open_sources
from orthonav.ground.imagery.terrain import open_dem

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
@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:2154", "EPSG:3035", "EPSG:4326"])
def test_wms_in_every_axis_order(mapproxy, take, crs):
    """3035 and 4326 have the northing first."""
    source = f"wms:{mapproxy}/service"
    _, path = take(source, layer="ortho", format="image/png", crs=crs, tile_px=128, half_m=70)
    worst, valid = placed(path, crs)
    assert worst <= 1.5 and valid == 1.0
    assert open_sources([path])[0].gsd_m == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(
    "template", ["xyz/{z}/{x}/{y}.png", "south/{z}/{x}/{-y}.png", "xyz/{z}/{x}/{y}@2x.png"]
)
def test_tiles_rows_from_the_south_and_large_tiles(take, template):
    def answer(asked):
        kind, *rest = asked.path.strip("/").split("/")
        zoom, col, row = (int(part.partition("@")[0].partition(".")[0]) for part in rest)
        row = 2**zoom - 1 - row if kind == "south" else row
        size = 512 if "@2x" in asked.path else 256
        assert asked.headers["User-Agent"].startswith("orthonav/")
        return servers.Answer(terrain.encoded(terrain.mercator_tile(zoom, row, col, size)))

    with servers.serving(answer) as server:
        _, path = take(f"xyz:{server.url}/{template}", half_m=60)
    assert placed(path, "EPSG:3857")[0] <= 1


@pytest.mark.parametrize(
    "options, words",
    [
        ({"layer": "tile"}, "no layer tile; available: tiles"),
        ({"style": "winter"}, "no style winter; available: default"),
        ({"crs": "EPSG:3006"}, "does not come in EPSG:3006; available:"),
        ({"crs": "EPSG:32631", "gsd_m": 0.2}, r"the finest is 1 m; available: zoom 0.* \(1 m\)"),
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
<Layer><Title>t</Title><CRS>CODE</CRS>
<Layer><Name>LAYER</Name><Title>t</Title></Layer></Layer>
</Capability></WMS_Capabilities>"""
COVERAGE = """<CoverageDescription version="1.0.0" xmlns="http://www.opengis.net/wcs"
 xmlns:gml="http://www.opengis.net/gml"><CoverageOffering><name>LAYER</name><label>t</label>
<domainSet><spatialDomain><gml:Envelope srsName="CODE"><gml:pos>0 0</gml:pos></gml:Envelope>
</spatialDomain></domainSet><rangeSet><RangeSet><name>1</name><label>t</label></RangeSet></rangeSet>
<supportedCRSs><requestResponseCRSs>EPSG:4326 CODE</requestResponseCRSs>
<nativeCRSs>CODE</nativeCRSs></supportedCRSs><supportedFormats nativeFormat="image/tiff">
<formats>GEOTIFF JPEG2000</formats><formats>GEOTIFF_FLOAT32</formats></supportedFormats>
</CoverageOffering></CoverageDescription>"""
EXCEPTION = """<ServiceExceptionReport version="1.2.0"><ServiceException code="CoverageNotDefined">
no such coverage</ServiceException></ServiceExceptionReport>"""
SLOPES = 0.01, 0.02
"""Rise of the ground per metre to the east and north, from the point where it is 0."""
DESCRIBED = {"GetCapabilities": CAPABILITIES, "DescribeCoverage": COVERAGE}


@pytest.fixture
def heights_service(monkeypatch):
    """Function that serves the heights of a preset of WMS or WCS: its spec and the requests."""

    @contextmanager
    def served(name, broken="", no_data_m=-99999.0, **options):
        preset, url = presets()[name], []
        known = preset.layers[CURRENT].options
        middle = Transformer.from_crs(4326, known.crs, always_xy=True).transform(
            terrain.LON_DEG, terrain.LAT_DEG
        )

        def answer(asked):
            assert preset.key_env is None or asked.query["TOKEN"] == "abcdef"
            text = DESCRIBED.get(asked.query["REQUEST"])
            if text is not None:
                if asked.query.get("COVERAGE", known.layer) != known.layer:
                    return servers.Answer(EXCEPTION.encode(), kind="text/xml")
                for part, value in (("CODE", known.crs), ("LAYER", known.layer), ("URL", url[0])):
                    text = text.replace(part, value)
                return servers.Answer(text.encode(), kind="text/xml")
            if broken == "page":
                return servers.Answer(b"<html>busy</html>", kind="text/html")
            body = height_tiff(asked.query, middle, no_data_m)
            return servers.Answer(body[:-400] if broken else body, kind="image/tiff")

        with servers.serving(answer) as server:
            url.append(server.url)
            ours = replace(preset, url=server.url + preset.url.partition(".dk")[2])
            monkeypatch.setenv("DATAFORSYNINGEN_TOKEN", "abcdef")
            monkeypatch.setattr("orthonav.ground.fetch.presets.presets", lambda *_: {name: ours})
            yield parse_source(name, ImageryOptions(tile_px=128, **options)), middle, server.log

    return served


def height_tiff(query, middle, no_data_m):
    """The heights of a box (x before y), without a strip through the middle."""
    west, south, east, north = (float(v) for v in query["BBOX"].split(","))
    width, height = int(query["WIDTH"]), int(query["HEIGHT"])
    x = west + (np.arange(width) + 0.5) * (east - west) / width - middle[0]
    y = north - (np.arange(height) + 0.5) * (north - south) / height - middle[1]
    values = (SLOPES[0] * x[None, :] + SLOPES[1] * y[:, None]).astype("f4")
    values[abs(y) < 8] = no_data_m
    with MemoryFile() as file:
        profile = {"driver": "GTiff", "count": 1, "dtype": "float32"}
        with file.open(width=width, height=height, **profile) as data:
            data.write(values[None])
        return file.read()


@pytest.mark.parametrize(
    "name, datum, gsd_m, no_data_m, asked_for",
    [
        ("ign-terrain", "NGF-IGN69", 5, -99999, {"FORMAT": "image/geotiff", "CRS": "EPSG:2154"}),
        ("ign-surface", "NGF-IGN69", 1, -9999, {"FORMAT": "image/geotiff", "CRS": "EPSG:2154"}),
        ("ahn-surface", "NAP", 1, 3.4028235e38, {"COVERAGE": "dsm_05m", "CRS": "EPSG:28992"}),
        ("dhm-surface", "DVR90", 1, -9999, {"FORMAT": "GEOTIFF_FLOAT32", "VERSION": "1.0.0"}),
        ("kartverket-surface", "NN2000", 1, -3.4028235e38, {"COVERAGE": "nhm_dom_topo_25833"}),
    ],
)  # fmt: skip
def test_heights_of_a_wms_and_of_a_wcs(
    take, heights_service, name, datum, gsd_m, no_data_m, asked_for
):
    """Numbers of 32 bits at the resolution of the preset; impossible heights are no data."""
    with heights_service(name, no_data_m=no_data_m) as (spec, middle, requests):
        dem = open_dem(take(spec, half_m=60)[1])
    assert asked_for.items() <= requests[-1].query.items()
    assert dem.datum.name == f"{datum} height" and dem.gsd_m == pytest.approx(gsd_m, rel=0.01)
    off = np.array([[-40.0, 31.5], [-30.0, 44.0]])
    x, y = np.array(middle)[:, None] + off
    lon, lat = Transformer.from_crs(spec.options.crs, 4326, always_xy=True).transform(x, y)
    np.testing.assert_allclose(dem(lat, lon), SLOPES @ off, atol=0.02)
    assert np.isnan(dem(np.array([terrain.LAT_DEG]), np.array([terrain.LON_DEG])))


@pytest.mark.parametrize("name", ["ign-terrain", "ahn-surface"])
@pytest.mark.parametrize("broken", ["cut", "page"])
def test_broken_heights_are_not_written(take, tmp_path, heights_service, name, broken):
    with heights_service(name, broken) as (spec, _, _), pytest.raises(FetchError, match="tiles fa"):
        take(spec, half_m=60)
    assert not (tmp_path / "ortho.tif").exists()


@pytest.mark.parametrize(
    "options, words",
    [
        ({"layer": "dsm_5m"}, "an error of the service .*no such coverage"),
        ({"crs": "EPSG:3006"}, "does not come in EPSG:3006; available: .*EPSG:28992"),
        ({"format": "image/jpeg"}, "not come as image/jpeg; available: GEOTIFF, GEOTIFF_FLOAT32"),
    ],
)
def test_what_a_wcs_does_not_have_is_listed(take, heights_service, options, words):
    with (
        heights_service("ahn-surface", **options) as (spec, _, _),
        pytest.raises(FetchError, match=words),
    ):
        take(spec)
