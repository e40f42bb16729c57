"""Parsing of `--source`: a service known by name, or an address with its protocol."""

import os
import re
from collections.abc import Callable
from dataclasses import replace

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.options import ImageryOptions, Provenance, SourceSpec
from orthonav.ground.fetch.presets import PROTOCOLS, find_preset
from orthonav.ground.fetch.service import CellSource
from orthonav.ground.fetch.stac import CatalogItem, date_of, find_items, sign
from orthonav.ground.fetch.urls import (
    KEY,
    Secret,
    checked_url,
    origin_of,
    shown,
    without_literal_keys,
)
from orthonav.ground.fetch.wms import wms_cells
from orthonav.ground.fetch.wmts import wmts_tiles
from orthonav.ground.fetch.xyz import xyz_tiles
from orthonav.ground.planning.area import Area

_DATE = re.compile(r"(1[89]\d\d|20\d\d)(-(0[1-9]|1[0-2])(-(0[1-9]|[12]\d|3[01]))?)?")


def parse_source(
    text: str,
    options: ImageryOptions,
    *,
    date: str | None = None,
    licence: str | None = None,
    attribution: str | None = None,
    key_env: str | None = None,
) -> SourceSpec:
    """`NAME[:YEAR]` of a service known by name, or `wmts|wms|xyz|tms|stac|cog:ADDRESS`.

    Raises `FetchError` for unknown names, addresses that are not http or https, and missing keys.
    """
    if date is not None:
        check_date(date)
    head, _, rest = text.partition(":")
    if head in PROTOCOLS and rest:
        url, literal = without_literal_keys(checked(rest, head))
        provenance = Provenance(shown(url), options.layer or "", date, licence, attribution)
        secrets = _secrets(url, key_env, literal)
        return SourceSpec(head, url, options, provenance, secrets)
    if head.lower() in ("http", "https", "file"):
        raise FetchError(
            f"write the protocol before the address ({'|'.join(PROTOCOLS)}:ADDRESS): {shown(text)}"
        )
    preset = find_preset(head)
    layer = preset.layer(rest or None)
    options = options.over(layer.options)
    provenance = Provenance(
        shown(preset.url),
        options.layer or options.collection or "",
        date or layer.date,
        licence or f"{preset.licence} ({preset.licence_url})",
        attribution or preset.attribution,
        "; ".join(note for note in (layer.note, preset.note) if note) or None,
        preset.datum,
    )
    secrets = _secrets(preset.url, key_env or preset.key_env, None)
    return SourceSpec(preset.protocol, preset.url, options, provenance, secrets, preset.token_url)


def checked(url: str, protocol: str) -> str:
    """An http or https address, which may hold `{parts}`. Raises `FetchError`."""
    checked_url(re.sub(r"\{[^{}]*\}", "0", url))
    if protocol not in ("xyz", "tms") and set(re.findall(r"\{[^{}]*\}", url)) - {KEY}:
        raise FetchError(f"only {KEY} may stand in this address: {shown(url)}")
    return url


def check_date(text: str) -> None:
    """Raise `FetchError` unless a date is YYYY[-MM[-DD]], or two with a slash between."""
    if not all(_DATE.fullmatch(part) for part in text.split("/", 1)):
        raise FetchError(f"date must be YYYY, YYYY-MM or YYYY-MM-DD, or two with /, got '{text}'")


def open_cells(client: Client, spec: SourceSpec, area: Area) -> CellSource:
    """The cells of the imagery requested, after reading the service's capabilities.

    Raises `FetchError` with the available choices where it has no such layer, style, zoom or time.
    """
    openers: dict[str, Callable[[Client, SourceSpec, Area], CellSource]] = {
        "wmts": wmts_tiles,
        "wms": wms_cells,
        "xyz": xyz_tiles,
        "tms": xyz_tiles,
        "stac": _stac,
        "cog": lambda client, spec, area: _cogs(client, spec, area, [spec.url]),
    }
    return openers[spec.protocol](client, spec, area)


def _stac(client: Client, spec: SourceSpec, area: Area) -> CellSource:
    west, south, east, north = area.extent_en_m
    lat, lon = area.frame.latlon_from_en(
        [(west, south), (west, north), (east, south), (east, north)]
    )
    box = (float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max()))
    items = _newest_by_place(find_items(client, spec.url, box, spec.options))
    if spec.token_url is not None:
        items = sign(client, spec.token_url, items)
    provenance = replace(spec.provenance, date=date_of(items) or spec.provenance.date)
    spec = replace(spec, provenance=provenance)
    return _cogs(client, spec, area, [item.url for item in items])


def _newest_by_place(items: list[CatalogItem]) -> list[CatalogItem]:
    """The newest of the items whose names differ by a year only."""
    newest: dict[str, CatalogItem] = {}
    for item in items:  # newest first
        newest.setdefault(re.sub(r"(?<!\d)(19|20)\d\d(?!\d)", "", item.name), item)
    return list(newest.values())


def _cogs(client: Client, spec: SourceSpec, area: Area, urls: list[str]) -> CellSource:
    from orthonav.ground.fetch.cog import cog_source  # imports GDAL

    return cog_source(client, spec, area, urls)


def _secrets(url: str, key_env: str | None, literal: str | None) -> tuple[Secret, ...]:
    """The key for `{key}` in an address. Raises `FetchError` where it is missing."""
    if literal is not None:
        return (Secret(KEY, origin_of(url), literal),)
    if key_env is None:
        if KEY in url:
            raise FetchError(
                f"address contains {KEY}; name the environment variable with --key-env"
            )
        return ()
    if KEY not in url:
        raise FetchError(f"--key-env needs {KEY} in the address, where the key goes: {shown(url)}")
    value = os.environ.get(key_env, "").strip()
    if not value:
        raise FetchError(
            f"this service needs a key; put yours into the environment variable {key_env}"
        )
    return (Secret(KEY, origin_of(url), value),)
