"""Who made the imagery and under which terms travels from the file into the map."""

import json

import rasterio
from geotiffs import smooth_scene, write

from orthonav.cli.info import imagery_text
from orthonav.ground.imagery.source import open_sources

TAGS = {
    "ORTHONAV_ATTRIBUTION": "IGN,  BD\nORTHO",
    "ORTHONAV_LICENCE": "Licence Ouverte 2.0",
    "ORTHONAV_SOURCE": "https://example.org/wmts",
    "ORTHONAV_DATES": "2021/2023",
    "TIFFTAG_COPYRIGHT": "somebody",
}


def ortho(path, tags):
    with rasterio.open(write(path, smooth_scene()), "r+") as data:
        data.update_tags(**tags)
    return open_sources([path])[0].describe()


def test_terms_of_a_fetched_file(tmp_path):
    entry = ortho(tmp_path / "recent_2021.tif", TAGS)
    assert entry["attribution"] == "IGN, BD ORTHO" and entry["licence"] == "Licence Ouverte 2.0"
    assert entry["source"] == "https://example.org/wmts" and entry["dates"] == "2021/2023"
    assert "layer" not in entry and json.loads(json.dumps(entry)) == entry
    assert imagery_text([entry]) == "recent_2021.tif 2021 (IGN, BD ORTHO, Licence Ouverte 2.0)"


def test_copyright_without_attribution_and_long_texts_are_cut(tmp_path):
    entry = ortho(tmp_path / "a.tif", {"TIFFTAG_COPYRIGHT": "x" * 1000})
    assert entry["attribution"] == "x" * 300
    assert not {"attribution", "licence"} & set(ortho(tmp_path / "b.tif", {}))
