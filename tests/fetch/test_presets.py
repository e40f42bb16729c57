"""The services known by name: whole, of open terms, and as the documentation says."""

import re
from pathlib import Path

import pytest

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.options import ImageryOptions
from orthonav.ground.fetch.presets import (
    CURRENT,
    PROTOCOLS,
    check_date,
    find_preset,
    parse_source,
    presets,
)
from orthonav.ground.fetch.urls import checked_url
from orthonav.ground.imagery.terrain import datum_of

DOCUMENTATION = Path(__file__).parents[2] / "docs" / "imagery.md"


@pytest.mark.parametrize("name", presets())
def test_a_service_is_complete(name):
    preset = presets()[name]
    assert re.fullmatch(r"[a-z][a-z0-9-]+", name) and name not in PROTOCOLS
    assert preset.protocol in PROTOCOLS and preset.title and preset.country
    for url in (preset.url, preset.licence_url, preset.source_page):
        assert checked_url(url.replace("{key}", "0")).startswith("https://")
    assert preset.licence and preset.attribution
    assert ("{key}" in preset.url) == (preset.key_env is not None)
    assert all(
        re.fullmatch(r"EPSG:\d+", layer.options.crs or "EPSG:1") for layer in preset.layers.values()
    )
    assert preset.protocol != "stac" or all(
        layer.options.collection for layer in preset.layers.values()
    )
    assert preset.layers


@pytest.mark.parametrize("name", presets())
def test_its_layers_are_complete(name, monkeypatch):
    preset = presets()[name]
    coarsest_m = 1 if preset.datum is None else 30
    for id_, layer in preset.layers.items():
        assert "{" not in f"{layer}" and 0.05 <= layer.gsd_m <= coarsest_m, id_
        assert layer.options.layer or preset.protocol == "stac", id_
        assert layer.options.empty in (None, "black", "white"), id_
        assert 0 <= (layer.options.min_zoom or 0) <= (layer.options.max_zoom or 22) <= 22, id_
        if layer.date is None:
            assert id_ == CURRENT
        else:
            check_date(layer.date)
            assert layer.date.partition("/")[0] in id_
        if preset.key_env:
            monkeypatch.setenv(preset.key_env, "x" * 8)
        source = name if id_ == CURRENT else f"{name}:{id_}"
        spec = parse_source(source, ImageryOptions())
        assert spec.provenance.licence and spec.provenance.attribution, id_
        assert spec.provenance.date == layer.date, id_
        assert spec.options.layer == layer.options.layer, id_


def test_terrain_names_the_datum_of_its_heights():
    terrain = {name: preset.datum for name, preset in presets().items() if preset.datum}
    assert set(terrain) == {
        "copernicus-dem", "nasadem", "usgs-3dep", "swissalti3d", "ign-terrain",
    }  # fmt: skip
    for name, datum in terrain.items():
        assert not datum_of(datum).above_ellipsoid
        assert parse_source(name, ImageryOptions()).provenance.datum == datum


def test_express_layers_warn_that_they_are_no_other_date():
    for name in ("ign", "ign-wms"):
        layers = presets()[name].layers
        express = [id_ for id_ in layers if "express" in id_]
        assert express
        for id_ in express:
            assert "no other date" in layers[id_].note
            spec = parse_source(f"{name}:{id_}", ImageryOptions())
            assert "no other date" in spec.provenance.note


def test_unknown_names_list_the_known_ones():
    with pytest.raises(FetchError, match=r"unknown service 'ing'; available: .*ign"):
        find_preset("ing")
    with pytest.raises(FetchError, match="write the protocol"):
        parse_source("https://a.example/wmts", ImageryOptions())
    with pytest.raises(FetchError, match=r"add a year: naip:YEAR; available: 2010"):
        parse_source("naip", ImageryOptions())


def test_options_of_the_user_take_precedence():
    spec = parse_source(
        "ign:2021",
        ImageryOptions(style="other", crs="EPSG:2154", gsd_m=1.0),
        date="2021-07",
        licence="mine",
        attribution="me",
    )
    assert (
        spec.options.style == "other"
        and spec.options.crs == "EPSG:2154"
        and spec.options.gsd_m == 1.0
    )
    assert (spec.provenance.date, spec.provenance.licence, spec.provenance.attribution) == (
        "2021-07",
        "mine",
        "me",
    )


def test_keys_come_from_the_environment_only(monkeypatch):
    monkeypatch.delenv("DATAFORSYNINGEN_TOKEN", raising=False)
    with pytest.raises(FetchError, match="environment variable DATAFORSYNINGEN_TOKEN"):
        parse_source("dataforsyningen", ImageryOptions())
    monkeypatch.setenv("DATAFORSYNINGEN_TOKEN", "abcdef")
    spec = parse_source("dataforsyningen", ImageryOptions())
    assert "abcdef" not in repr(spec) and spec.secrets[0].value == "abcdef"
    with pytest.raises(FetchError, match="--key-env"):
        parse_source("wmts:https://a.example/?token={key}", ImageryOptions())
    with pytest.raises(FetchError, match=r"needs \{key\} in the address"):
        parse_source("wmts:https://a.example/", ImageryOptions(), key_env="DATAFORSYNINGEN_TOKEN")
    literal = parse_source("wms:https://a.example/?apikey=abcdef", ImageryOptions())
    assert "abcdef" not in repr(literal) and literal.url == "https://a.example/?apikey={key}"


@pytest.mark.parametrize("date", ["21", "2021-13", "2021-02-40", "June", "2021/2022/2023", ""])
def test_dates_are_checked(date):
    with pytest.raises(FetchError, match="date must be"):
        parse_source("ign", ImageryOptions(), date=date)


@pytest.mark.parametrize(
    "source", ["wmts:file:///etc/passwd", "cog:/etc/passwd", "xyz:ftp://a/{z}/{x}/{y}", "stac:x"]
)
def test_only_http_is_a_source(source):
    with pytest.raises(FetchError, match="only http"):
        parse_source(source, ImageryOptions())


def test_the_documentation_lists_the_same_services():
    text = DOCUMENTATION.read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    listed = {row[0].strip("`"): row for row in rows if row[0].strip("`") in presets()}
    assert set(listed) == set(presets())
    for name, preset in presets().items():
        _, country, protocol, ids, gsds, licence, attribution = (
            cell.strip() for cell in listed[name]
        )
        assert country == preset.country and protocol == preset.protocol.upper()
        assert ids.replace("`", "") == table_ids(preset)
        assert gsds == " to ".join(f"{g:g}" for g in extremes(preset))
        assert licence == preset.licence and attribution == preset.attribution


def extremes(preset):
    gsds = sorted({layer.gsd_m for layer in preset.layers.values()})
    return gsds if len(gsds) == 1 else [gsds[0], gsds[-1]]


def table_ids(preset):
    """Ids in order, with runs of years as FIRST to LAST."""
    shown, run = [], []
    for id_ in [*preset.layers, ""]:
        if id_.isdecimal() and (not run or int(id_) == int(run[-1]) + 1):
            run.append(id_)
            continue
        if run:
            shown.append(run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}")
        run = [id_] if id_.isdecimal() else []
        if id_ and not id_.isdecimal():
            shown.append(id_)
    return ", ".join(shown)
