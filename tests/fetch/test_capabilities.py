"""Documents in the form that real services send are understood, down to the address of a tile.

Written by hand to the form that the services document, with the quirks that public code works
around: limits of zooms, names of grids, rows before columns, rounded scales.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
import servers
import terrain
from pyproj import Transformer

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.presets import ImageryOptions, Provenance, SourceSpec, presets
from orthonav.ground.fetch.run import FetchRequest, estimate_fetch, fetch
from orthonav.ground.planning.area import Area

FOLDER = Path(__file__).parent / "capabilities"
PLACES = {
    "ign": (3.0, 46.5),
    "pdok": (5.1, 52.1),
    "swisstopo": (7.45, 46.95),
    "basemap": (16.4, 48.2),
    "old": (8.0, 51.5),
    "degrees": (3.0, 46.5),
}
NOISE = np.random.default_rng(1).integers(1, 255, (1024, 1024, 3), dtype=np.uint8)


def requested(tmp_path, name, options, protocol="wmts", suffix=""):
    """The request of the one tile at a place, and the estimate; the service is on the loopback."""
    text = (FOLDER / f"{name}.xml").read_text(encoding="utf-8")
    lon, lat = PLACES[name.partition("_")[0]]
    url = []

    def answer(asked):
        if asked.path.endswith(".xml") or asked.query.get("REQUEST") == "GetCapabilities":
            ours = re.sub(r'(href|template)="https?://[\w.-]+', rf'\1="{url[0]}', text)
            return servers.Answer(ours.encode(), kind="text/xml")
        width, height = (int(asked.query.get(name, 256)) for name in ("WIDTH", "HEIGHT"))
        return servers.Answer(terrain.encoded(np.resize(NOISE, (height, width, 3))))

    with servers.serving(answer) as server:
        url.append(server.url)
        spec = SourceSpec(protocol, f"{server.url}/{suffix}", options, Provenance("", ""))
        area = Area.from_bounds((lon, lat, lon + 1e-6, lat + 1e-6))
        request = FetchRequest(spec, area, tmp_path / "o.tif", 0.0, limits=servers.QUICK)
        estimate = estimate_fetch(request)
        fetch(request)
        return server.log[-1], estimate


def of_preset(name, id_, **rest):
    return ImageryOptions(**rest).over(presets()[name].layers[id_ or "current"].options)


def web_tile(name, zoom):
    """Row and column of the tile of the web grid at a place."""
    x, y = Transformer.from_crs(4326, 3857, always_xy=True).transform(*PLACES[name])
    half = np.pi * 6378137
    return int((half - y) / (2 * half) * 2**zoom), int((x + half) / (2 * half) * 2**zoom)


def test_ign_by_parameters(tmp_path):
    asked, estimate = requested(tmp_path, "ign_wmts", of_preset("ign", "2021", gsd_m=0.25))
    row, col = web_tile("ign", 19)
    assert asked.query == {
        "SERVICE": "WMTS", "REQUEST": "GetTile", "VERSION": "1.0.0", "STYLE": "normal",
        "LAYER": "ORTHOIMAGERY.ORTHOPHOTOS2021", "FORMAT": "image/jpeg",
        "TILEMATRIXSET": "PM_0_19", "TILEMATRIX": "19", "TILEROW": f"{row}", "TILECOL": f"{col}",
    }  # fmt: skip
    assert estimate.gsd_m == pytest.approx(0.2055, abs=5e-4)


def test_ign_limits_of_zooms_and_styles(tmp_path):
    asked, _ = requested(tmp_path, "ign_wmts", of_preset("ign", "2000-2005"))
    assert asked.query["TILEMATRIX"] == "18"
    with pytest.raises(FetchError, match=r"the finest is 0.411 m; .* 6 .*18 \(0.411 m\)"):
        requested(tmp_path, "ign_wmts", of_preset("ign", "2000-2005", gsd_m=0.2))
    old, _ = requested(tmp_path, "ign_wmts", of_preset("ign", "1965-1980", gsd_m=1.0))
    assert (old.query["STYLE"], old.query["FORMAT"]) == ("BDORTHOHISTORIQUE", "image/png")
    with pytest.raises(FetchError, match="no style normal; available: BDORTHOHISTORIQUE"):
        requested(tmp_path, "ign_wmts", of_preset("ign", "1965-1980", style="normal"))


def test_pdok_by_templates_in_both_grids(tmp_path):
    asked, _ = requested(tmp_path, "pdok_wmts", of_preset("pdok", "2022"))
    row, col = web_tile("pdok", 18)
    assert asked.path.endswith(f"/2022_ortho25/EPSG:3857/18/{col}/{row}.jpeg")
    options = of_preset("pdok", "2022", crs="EPSG:28992", gsd_m=0.25)
    national, estimate = requested(tmp_path, "pdok_wmts", options)
    x, y = Transformer.from_crs(4326, 28992, always_xy=True).transform(*PLACES["pdok"])
    row, col = int((903401.92 - y) / 0.21 / 256), int((x + 285401.92) / 0.21 / 256)
    assert national.path.endswith(f"/2022_ortho25/EPSG:28992/14/{col}/{row}.jpeg")
    assert estimate.gsd_m == pytest.approx(0.21, rel=1e-3)


def test_swisstopo_by_time(tmp_path):
    row, col = web_tile("swisstopo", 20)
    options = of_preset("swissimage", "2021", gsd_m=0.12)
    asked, _ = requested(tmp_path, "swisstopo_wmts", options, suffix="EPSG/3857/1.0.0/c.xml")
    layer = "ch.swisstopo.swissimage"
    assert asked.path == f"/1.0.0/{layer}-product/default/2021/3857/20/{col}/{row}.jpeg"
    current, _ = requested(tmp_path, "swisstopo_wmts", of_preset("swissimage", None))
    assert f"/{layer}/default/current/3857/" in current.path
    words = "no time 1999; available: 2020, 2021, 2022, 2023, current"
    with pytest.raises(FetchError, match=words):
        requested(tmp_path, "swisstopo_wmts", of_preset("swissimage", "2021", time="1999"))


def test_basemap_rows_before_columns_and_rounded_scales(tmp_path):
    asked, _ = requested(tmp_path, "basemap_wmts", of_preset("basemap-at", None, gsd_m=0.25))
    row, col = web_tile("basemap", 19)
    assert asked.path == f"/basemap/bmaporthofoto30cm/normal/google3857/19/{row}/{col}.jpeg"
    half = np.pi * 6378137
    with rasterio.open(tmp_path / "o.tif") as data:  # not 0.1 m off at Vienna
        assert data.res[0] == 2 * half / 256 / 2**19
        assert data.bounds.left == pytest.approx(col * 256 * data.res[0] - half, abs=1e-6)


def test_a_grid_in_degrees_has_the_latitude_first(tmp_path):
    requested(tmp_path, "degrees_wmts", ImageryOptions(gsd_m=1.0))
    lon, lat = PLACES["degrees"]
    with rasterio.open(tmp_path / "o.tif") as data:
        assert data.res[0] == pytest.approx(360 / 512 / 2**16, rel=1e-8)
        assert data.bounds.left <= lon <= data.bounds.right
        assert data.bounds.bottom <= lat <= data.bounds.top
        assert ((data.bounds.left + 180) / data.res[0]) % 256 == pytest.approx(0, abs=1e-3)


def test_ign_wms_in_lambert(tmp_path):
    options = of_preset("ign-wms", "2021", gsd_m=0.5)
    asked, _ = requested(tmp_path, "ign_wms", options, "wms", "wms-r/wms")
    west, south, east, north = map(float, asked.query.pop("BBOX").split(","))
    assert (east - west, north - south) == pytest.approx((512, 512), rel=2e-3)
    x, y = Transformer.from_crs(4326, 2154, always_xy=True).transform(*PLACES["ign"])
    assert west <= x <= east and south <= y <= north
    assert asked.path == "/wms-r/wms" and asked.query == {
        "SERVICE": "WMS", "VERSION": "1.3.0", "REQUEST": "GetMap", "STYLES": "",
        "LAYERS": "ORTHOIMAGERY.ORTHOPHOTOS2021", "CRS": "EPSG:2154", "WIDTH": "1024",
        "HEIGHT": "1024", "FORMAT": "image/jpeg", "TRANSPARENT": "FALSE",
    }  # fmt: skip


def test_an_old_wms(tmp_path):
    options = ImageryOptions(layer="ortho", crs="EPSG:25832", gsd_m=0.5)
    asked, _ = requested(tmp_path, "old_wms", options, "wms", "wms")
    assert asked.query["MAP"] == "/srv/ortho.map" and asked.query["VERSION"] == "1.1.1"
    assert asked.query["SRS"] == "EPSG:25832"


NESTED = b"<Layer>" * 5000 + b"</Layer>" * 5000


@pytest.mark.parametrize(
    "protocol, body, words",
    [
        ("wmts", b"<a/>", "lists no layer"),
        ("wmts", b"<?xml version='1.0' encoding='UTF-88'?><a/>", "not an XML document"),
        ("wmts", b"<Capabilities version='1.0.0'>" + NESTED + b"</Capabilities>", "no layer"),
        ("wms", b"<a/>", r"supported versions of WMS are 1\.1\.1 and 1\.3\.0"),
        ("wms", b"<WMS_Capabilities version='2.0'/>", r"supported versions of WMS"),
        ("wms", b"<WMS_Capabilities version='1.3.0'/>", "no address of GetMap"),
        ("stac", b"{}", "not a STAC API"),
    ],
)
def test_other_documents_are_rejected(tmp_path, protocol, body, words):
    with servers.serving(lambda _: servers.Answer(body)) as server:
        spec = SourceSpec(protocol, server.url, ImageryOptions(), Provenance("", ""))
        area = Area.from_bounds(terrain.bounds(10))
        with pytest.raises(FetchError, match=words):
            estimate_fetch(FetchRequest(spec, area, tmp_path / "o.tif", limits=servers.QUICK))
