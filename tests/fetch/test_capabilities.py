"""Documents in the form that real services send are understood, down to the address of a tile.

Written by hand to the form that the services document, with the quirks that public code works
around: limits of zooms, names of grids, rows before columns, rounded scales.
"""

from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.fetch import wms, wmts
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.crs import MERCATOR_HALF_M
from orthonav.ground.fetch.documents import parse_xml
from orthonav.ground.fetch.options import ImageryOptions, Provenance, SourceSpec
from orthonav.ground.fetch.presets import presets

FOLDER = Path(__file__).parent / "capabilities"
PROVENANCE = Provenance("", "")
PLACES = {
    "ign": LocalFrame(46.5, 3.0),
    "pdok": LocalFrame(52.1, 5.1),
    "swisstopo": LocalFrame(46.95, 7.45),
    "basemap": LocalFrame(48.2, 16.4),
}


CLIENT = Client()


def document(name):
    return parse_xml((FOLDER / f"{name}.xml").read_bytes())


def answering(module, found):
    """The service answers with this document."""
    return mock.patch.object(module, "get_xml", lambda client, url: found)


def asked(protocol, url, options, place):
    """What is asked for, and an area of which only the place matters."""
    return SourceSpec(protocol, url, options, PROVENANCE), SimpleNamespace(frame=place)


def tiles(name, options, url="https://a.example/wmts"):
    with answering(wmts, document(f"{name}_wmts")):
        place = PLACES.get(name, PLACES["ign"])
        return wmts.wmts_tiles(CLIENT, *asked("wmts", url, options, place))


def cells(name, url, options, place):
    with answering(wms, document(name)):
        return wms.wms_cells(CLIENT, *asked("wms", url, options, place))


def of_preset(name, id_, **rest):
    preset = presets()[name]
    return ImageryOptions(**rest).over(preset.layer(id_).options)


def test_ign_by_parameters():
    source = tiles("ign", of_preset("ign", "2021", gsd_m=0.25))
    assert source.address(363000, 265000) == (
        "https://data.geopf.fr/wmts?SERVICE=WMTS&REQUEST=GetTile&VERSION=1.0.0"
        "&LAYER=ORTHOIMAGERY.ORTHOPHOTOS2021&STYLE=normal&FORMAT=image/jpeg"
        "&TILEMATRIXSET=PM_0_19&TILEMATRIX=19&TILEROW=363000&TILECOL=265000"
    )
    assert source.grid.res_x == 2 * MERCATOR_HALF_M / 256 / 2**19
    row0, col0, row1, col1 = source.grid.limits
    assert 0 < row0 < row1 < 2**19 and 0 < col0 < col1 < 2**19  # the layer's own


def test_ign_limits_of_zooms_and_styles():
    assert "TILEMATRIX=18" in tiles("ign", of_preset("ign", "2000-2005")).address(1, 1)
    with pytest.raises(FetchError, match=r"no zoom 19; available: 6 .*18 \(0.411 m\)"):
        tiles("ign", of_preset("ign", "2000-2005", zoom="19"))
    with pytest.raises(FetchError, match=r"the finest is 0.411 m"):
        tiles("ign", of_preset("ign", "2000-2005", gsd_m=0.2))
    old = tiles("ign", of_preset("ign", "1965-1980", gsd_m=1.0))
    assert "STYLE=BDORTHOHISTORIQUE&FORMAT=image/png" in old.address(1, 1)
    with pytest.raises(FetchError, match="no style normal; available: BDORTHOHISTORIQUE"):
        tiles("ign", of_preset("ign", "1965-1980", style="normal"))


def test_an_unknown_year_lists_the_available_ones():
    words = "no layer ORTHOIMAGERY.ORTHOPHOTOS2020; available: .*ORTHOPHOTOS2021"
    with pytest.raises(FetchError, match=words):
        tiles("ign", of_preset("ign", "2020"))
    with pytest.raises(FetchError, match=r"ign has no '1999'; available: .*1950-1965.*2021"):
        presets()["ign"].layer("1999")


def test_a_preferred_style_that_is_missing_is_ignored():
    options = ImageryOptions(
        layer="ORTHOIMAGERY.ORTHOPHOTOS2021", preferred_style="BDORTHOHISTORIQUE"
    )
    assert "STYLE=normal" in tiles("ign", options).address(1, 1)


def test_pdok_by_templates_in_both_grids():
    source = tiles("pdok", of_preset("pdok", "2022"))
    assert source.address(7, 5) == (
        "https://service.pdok.nl/hwh/luchtfotorgb/wmts/v1_0/2022_ortho25/EPSG:3857/18/5/7.jpeg"
    )
    national = tiles("pdok", of_preset("pdok", "2022", crs="EPSG:28992", gsd_m=0.25))
    assert national.address(7, 5).endswith("/2022_ortho25/EPSG:28992/14/5/7.jpeg")
    assert national.grid.res_x == pytest.approx(0.21, rel=1e-9)
    assert national.grid.corner(0, 0) == (-285401.92, 903401.92)


def test_swisstopo_by_time_and_on_https():
    where = "https://wmts.geo.admin.ch/EPSG/3857/1.0.0/WMTSCapabilities.xml"
    source = tiles("swisstopo", of_preset("swissimage", "2021", gsd_m=0.12), where)
    assert source.address(7, 5) == (
        "https://wmts.geo.admin.ch/1.0.0/ch.swisstopo.swissimage-product/default/2021/3857/20/5/7.jpeg"
    )
    current = tiles("swisstopo", of_preset("swissimage", None), where)
    assert "/ch.swisstopo.swissimage/default/current/3857/" in current.address(1, 1)
    with pytest.raises(
        FetchError, match="no time 1999; available: 2020, 2021, 2022, 2023, current"
    ):
        tiles("swisstopo", of_preset("swissimage", "2021", time="1999"), where)


def test_basemap_rows_before_columns_and_rounded_scales():
    source = tiles("basemap", of_preset("basemap-at", None, gsd_m=0.25))
    assert source.address(7, 5) == (
        "https://mapsneu.wien.gv.at/basemap/bmaporthofoto30cm/normal/google3857/19/7/5.jpeg"
    )
    assert source.grid.res_x == 2 * MERCATOR_HALF_M / 256 / 2**19  # not 0.1 m off at Vienna
    assert source.grid.corner(0, 0) == (-MERCATOR_HALF_M, MERCATOR_HALF_M)


def test_a_grid_in_degrees_has_the_latitude_first():
    source = tiles("degrees", ImageryOptions(gsd_m=1.0))
    assert source.grid.corner(0, 0) == (-180.0, 90.0)
    assert source.grid.res_x == pytest.approx(360 / 512 / 2**16, rel=1e-8)


def test_ign_wms_in_lambert():
    url = "https://data.geopf.fr/wms-r/wms"
    source = cells("ign_wms", url, of_preset("ign-wms", "2021", gsd_m=0.5), PLACES["ign"])
    assert source.address(-12891, 1367) == (
        "https://data.geopf.fr/wms-r/wms?SERVICE=WMS&VERSION=1.3.0&REQUEST=GetMap"
        "&LAYERS=ORTHOIMAGERY.ORTHOPHOTOS2021&STYLES=&CRS=EPSG:2154&WIDTH=1024&HEIGHT=1024"
        "&FORMAT=image/jpeg&TRANSPARENT=FALSE&BBOX=699904,6599680,700416,6600192"
    )
    degrees = of_preset("ign-wms", "2021", crs="EPSG:4326", format="image/png")
    source = cells("ign_wms", url, degrees, PLACES["ign"])
    south, west, _, _ = map(
        float, source.address(*cell_at(source, 3.0, 46.5))[-80:].split("=")[-1].split(",")
    )
    assert west == pytest.approx(3.0, abs=0.01) and south == pytest.approx(46.5, abs=0.01)


def cell_at(source, x, y):
    grid = source.grid
    col = np.floor((x - grid.west) / (grid.cell_w_px * grid.res_x))
    row = np.floor((grid.north - y) / (grid.cell_h_px * grid.res_y))
    return int(row), int(col)


def test_an_old_wms_with_times():
    url, place = "http://maps.example/wms", LocalFrame(51.5, 8.0)
    options = ImageryOptions(layer="ortho", time="2018", gsd_m=0.5)
    source = cells("old_wms", url, options, place)
    address = source.address(0, 0)
    start = "http://maps.example/cgi?map=/srv/ortho.map&SERVICE=WMS&VERSION=1.1.1"
    assert address.startswith(start)
    assert "SRS=EPSG:25832" in address and "TIME=2018" in address
    with pytest.raises(FetchError, match="no time 2019; available: 2015, 2018, 2021"):
        cells("old_wms", url, ImageryOptions(layer="ortho", time="2019"), place)


BOMB = b"""<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "bbbbbbbbbb"><!ENTITY c "&b;&b;&b;">]>
<Capabilities version="1.0.0">&c;</Capabilities>"""
OUTSIDE = b"""<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>
<Capabilities version="1.0.0">&b;</Capabilities>"""


@pytest.mark.parametrize(
    "body, words",
    [
        (BOMB, "entities"),
        (BOMB.decode().encode("utf-16"), "entities|not an XML"),
        (OUTSIDE, "entities"),
        (b"<html><p>no", "not an XML"),
        (b"", "not an XML"),
    ],
)
def test_harmful_documents_are_rejected(body, words):
    with pytest.raises(FetchError, match=words):
        parse_xml(body)


def refused(module, body, words):
    opened = wms.wms_cells if module is wms else wmts.wmts_tiles
    place = PLACES["ign"]
    with answering(module, parse_xml(body)), pytest.raises(FetchError, match=words):
        opened(CLIENT, *asked("", "http://a/b", ImageryOptions(), place))


def test_a_deeply_nested_document_is_rejected():
    layers = b"<Layer>" * 5000 + b"</Layer>" * 5000
    body = b"<WMS_Capabilities version='1.3.0'>" + layers + b"</WMS_Capabilities>"
    refused(wms, body, "cannot be read")
    refused(wmts, b"<Capabilities version='1.0.0'>" + layers + b"</Capabilities>", "cannot be read")


@pytest.mark.parametrize("body", [b"<a/>", b"<WMS_Capabilities version='2.0'/>"])
def test_other_documents_are_rejected(body):
    refused(wmts, body, "cannot be read|lists no layer")
    refused(wms, body, r"supported versions of WMS are 1\.1\.1 and 1\.3\.0")
