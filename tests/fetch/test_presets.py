"""The services known by name: whole, of open terms, and as the documentation says."""

import pytest

from orthonav.core.errors import FetchError, UsageError
from orthonav.ground.fetch.presets import (
    CURRENT,
    PROTOCOLS,
    ImageryOptions,
    parse_source,
    presets,
    surface_preset,
)
from orthonav.ground.fetch.urls import checked_url
from orthonav.ground.imagery.terrain import datum_of


@pytest.mark.parametrize("name", presets())
def test_a_service_and_its_layers_are_complete(name, monkeypatch):
    preset = presets()[name]
    assert name not in PROTOCOLS and preset.protocol in PROTOCOLS
    assert preset.title and preset.country and preset.layers
    for url in (preset.url, preset.licence_url, preset.source_page):
        assert checked_url(url.replace("{key}", "0")).startswith("https://")
    assert ("{key}" in preset.url) == (preset.key_env is not None)
    if preset.key_env:
        monkeypatch.setenv(preset.key_env, "x" * 8)
    assert all(presets()[each].datum for each in (preset.terrain, preset.surface) if each)
    coarsest_m = 1 if preset.datum is None else 30
    for id_, layer in preset.layers.items():
        assert "{" not in f"{layer}" and 0.05 <= layer.finest_m <= coarsest_m, id_
        assert layer.options.layer, id_
        assert layer.options.empty in (None, "black", "white"), id_
        assert (layer.options.max_zoom or 22) <= 22, id_
        assert (layer.date is None) == (id_ == CURRENT) or layer.date.partition("/")[0] in id_
        source = name if id_ == CURRENT else f"{name}:{id_}"
        spec = parse_source(source, ImageryOptions())
        assert spec.provenance.licence and spec.provenance.attribution, id_
        assert spec.options.layer == layer.options.layer, id_
        assert "express" not in id_ or "no other date" in spec.provenance.note


def test_terrain_names_the_datum_of_its_heights(monkeypatch):
    monkeypatch.setenv("DATAFORSYNINGEN_TOKEN", "x" * 8)
    terrain = {name: preset.datum for name, preset in presets().items() if preset.datum}
    assert len(terrain) == 12
    for name, datum in terrain.items():
        assert not datum_of(datum).above_ellipsoid
        assert parse_source(name, ImageryOptions()).provenance.datum == datum


def test_surfaces_are_fetched_as_finely_as_a_map_takes_them(monkeypatch):
    monkeypatch.setenv("DATAFORSYNINGEN_TOKEN", "x" * 8)
    for name in filter(None, (preset.surface for preset in presets().values())):
        assert parse_source(name, ImageryOptions()).options.gsd_m == 1
        assert parse_source(name, ImageryOptions(gsd_m=2)).options.gsd_m == 2


def test_sources_without_a_surface_are_told_those_with_one():
    assert surface_preset("ign:2021") == "ign-surface" and surface_preset("pdok") == "ahn-surface"
    for source in ("naip:2020", "ahn-surface", "wms:https://a.example/wms?token=abcdef"):
        with pytest.raises(FetchError, match=r"no surface model .* one: dataforsyningen") as no:
            surface_preset(source)
        assert "ign-wms, pdok, swissimage" in str(no.value) and "abcdef" not in str(no.value)


def test_unknown_names_list_the_known_ones():
    with pytest.raises(UsageError, match=r"unknown service 'ing'; available: .*ign"):
        parse_source("ing", ImageryOptions())
    with pytest.raises(UsageError, match="write the protocol"):
        parse_source("https://a.example/wmts", ImageryOptions())
    with pytest.raises(FetchError, match=r"add a year: naip:YEAR; available: 2010"):
        parse_source("naip", ImageryOptions())


def test_options_of_the_user_take_precedence():
    asked = ImageryOptions(style="other", crs="EPSG:2154", gsd_m=1.0)
    spec = parse_source("ign:2021", asked)
    assert (spec.options.style, spec.options.crs, spec.options.gsd_m) == ("other", "EPSG:2154", 1)


def test_rows_of_an_own_table_replace_those_of_the_same_name(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('[ign]\nprotocol = "wms"\nurl = "https://a.example/"\ncrs = "EPSG:2154"')
    spec = parse_source("ign", ImageryOptions(), own=path)
    assert spec.options.crs == "EPSG:2154" and spec.provenance.licence is None
    assert parse_source("pdok", ImageryOptions(), own=path).protocol == "wmts"


@pytest.mark.parametrize(
    "text, words",
    [
        ("[a", "cannot be used"),
        ('[a]\nurl = "https://a/"', "protocol"),
        ('[a]\nprotocol = "ftp"\nurl = "https://a/"', "protocol of a must be one of wmts"),
        ('[a]\nprotocol = "wms"\nurl = "https://a/"\nlair = "b"', "lair"),
        ('[a]\nprotocol = "wms"\nurl = "file:///etc/passwd"', "only http"),
        *(
            (f'[a]\nprotocol = "wms"\nurl = "https://a/"\n{line}', words)
            for line, words in (
                ("url = 1", "cannot be used"),
                ("gsd = 1", "unexpected keyword argument 'gsd'"),
                ("style = 1", "a: style must be a text, got 1"),
                ('gsd_m = "fine"', "a: gsd_m must be a number above 0, got 'fine'"),
                ("max_zoom = true", "max_zoom must be a whole number from 1, got True"),
                ('empty = "red"', "empty must be black or white, got 'red'"),
                ("bands = [0]", "bands must be a list of numbers from 1"),
                ('layers = ["x"]', "layers must be tables"),
                (
                    '[[a.layers]]\nid = "x"\nyears = 2020',
                    r"a\.layers: years must be a list of years",
                ),
                *(
                    (f'[[a.layers]]\nid = "x"\ndate = "{date}"', "date must be YYYY")
                    for date in ("21", "2021-13", "2021-02-40", "June", "2021/2022/2023", "")
                ),
            )
        ),
    ],
)
def test_unusable_tables_are_errors(tmp_path, text, words):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(FetchError, match=words):
        parse_source("a", ImageryOptions(), own=path)


def test_keys_come_from_the_environment_only(monkeypatch):
    monkeypatch.delenv("DATAFORSYNINGEN_TOKEN", raising=False)
    with pytest.raises(FetchError, match="environment variable DATAFORSYNINGEN_TOKEN"):
        parse_source("dataforsyningen", ImageryOptions())
    monkeypatch.setenv("DATAFORSYNINGEN_TOKEN", "abcdef")
    spec = parse_source("dataforsyningen", ImageryOptions())
    assert "abcdef" not in repr(spec) and spec.secrets[0].value == "abcdef"
    with pytest.raises(FetchError, match="--key-env"):
        parse_source("wmts:https://a.example/?token={key}", ImageryOptions())
    with pytest.raises(FetchError, match=r"\{key\} in the address"):
        parse_source("wmts:https://a.example/", ImageryOptions(), key_env="DATAFORSYNINGEN_TOKEN")
    with pytest.raises(FetchError, match=r"write \{key\} for the key") as raised:
        parse_source("wms:https://a.example/?apikey=abcdef", ImageryOptions())
    assert "abcdef" not in str(raised.value)


@pytest.mark.parametrize(
    "source", ["wmts:file:///etc/passwd", "cog:/etc/passwd", "xyz:ftp://a/{z}/{x}/{y}", "stac:x"]
)
def test_only_http_is_a_source(source):
    with pytest.raises(FetchError, match="only http"):
        parse_source(source, ImageryOptions())
