"""What `--source` names: a service known by name, or the address of one with its protocol."""

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.presets import PROTOCOLS, find_preset
from orthonav.fetch.service import About, CellSource, Wish
from orthonav.fetch.stac import Item, date_of, find_items, sign
from orthonav.fetch.urls import KEY, Secret, checked_url, origin_of, shown, without_literal_keys
from orthonav.fetch.wms import open_wms, wms_cells
from orthonav.fetch.wmts import open_wmts
from orthonav.fetch.wmts_tiles import wmts_tiles
from orthonav.fetch.xyz import xyz_tiles
from orthonav.geo.area import Area

_DATE = re.compile(r"(1[89]\d\d|20\d\d)(-(0[1-9]|1[0-2])(-(0[1-9]|[12]\d|3[01]))?)?")


@dataclass(frozen=True)
class SourceSpec:
    """A service to ask: its protocol, its address with `{key}` for a key, and what is wished."""

    protocol: str
    url: str
    wish: Wish
    about: About
    secrets: tuple[Secret, ...] = ()
    token_url: str | None = None


def parse_source(
    text: str,
    wish: Wish,
    *,
    date: str | None = None,
    licence: str | None = None,
    attribution: str | None = None,
    key_env: str | None = None,
    environ: Mapping[str, str] | None = None,
) -> SourceSpec:
    """`NAME[:YEAR]` of a service known by name, or `wmts|wms|xyz|tms|stac|cog:ADDRESS`.

    Raises `FetchError` for unknown names, addresses that are not http or https, and missing keys.
    """
    environ = os.environ if environ is None else environ
    if date is not None:
        check_date(date)
    head, _, rest = text.partition(":")
    if head in PROTOCOLS and rest:
        url, literal = without_literal_keys(checked(rest, head))
        about = About(shown(url), wish.layer or "", date, licence, attribution)
        secrets = _secrets(url, key_env, literal, environ)
        return SourceSpec(head, url, wish, about, secrets)
    if head.lower() in ("http", "https", "file"):
        raise FetchError(
            f"say what kind of service it is: {'|'.join(PROTOCOLS)}:ADDRESS, got: {shown(text)}"
        )
    preset = find_preset(head)
    layer = preset.layer(rest or None)
    about = About(
        shown(preset.url),
        wish.layer or layer.layer or preset.collection or "",
        date or layer.date,
        licence or f"{preset.licence} ({preset.licence_url})",
        attribution or preset.attribution,
        "; ".join(note for note in (layer.note, preset.note) if note) or None,
    )
    secrets = _secrets(preset.url, key_env or preset.key_env, None, environ)
    return SourceSpec(
        preset.protocol, preset.url, wish.over(preset.wish(layer)), about, secrets, preset.token_url
    )


def checked(url: str, protocol: str) -> str:
    """An address, perhaps with `{parts}`, that is http or https. Raises `FetchError`."""
    checked_url(re.sub(r"\{[^{}]*\}", "0", url))
    if protocol not in ("xyz", "tms") and set(re.findall(r"\{[^{}]*\}", url)) - {KEY}:
        raise FetchError(f"only {KEY} may stand in this address: {shown(url)}")
    return url


def check_date(text: str) -> None:
    """Raise `FetchError` unless a date is YYYY[-MM[-DD]], or two with a slash between."""
    if not all(_DATE.fullmatch(part) for part in text.split("/", 1)):
        raise FetchError(f"date must be YYYY, YYYY-MM or YYYY-MM-DD, or two with /, got '{text}'")


def open_cells(client: Client, spec: SourceSpec, area: Area) -> CellSource:
    """The cells of what is wished, after asking the service what it has.

    Raises `FetchError` listing what there is where it has no such layer, style, zoom or time.
    """
    frame = area.frame
    openers: dict[str, Callable[[], CellSource]] = {
        "wmts": lambda: wmts_tiles(open_wmts(client, spec.url), spec.wish, frame, spec.about),
        "wms": lambda: wms_cells(
            open_wms(client, spec.url, spec.wish.version), spec.wish, frame, spec.about
        ),
        "xyz": lambda: xyz_tiles(spec.url, spec.wish, frame, spec.about),
        "tms": lambda: xyz_tiles(spec.url, spec.wish, frame, spec.about, rows_from_south=True),
        "stac": lambda: _stac(client, spec, area),
        "cog": lambda: _cogs(client, spec, [spec.url], spec.about, area),
    }
    return openers[spec.protocol]()


def _stac(client: Client, spec: SourceSpec, area: Area) -> CellSource:
    west, south, east, north = area.extent_en_m
    lat, lon = area.frame.latlon_from_en(
        [(west, south), (west, north), (east, south), (east, north)]
    )
    box = (float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max()))
    items = _one_per_place(find_items(client, spec.url, box, spec.wish))
    if spec.token_url is not None:
        items = sign(client, spec.token_url, items)
    about = replace(spec.about, date=date_of(items) or spec.about.date)
    return _cogs(client, spec, [item.url for item in items], about, area)


def _one_per_place(items: list[Item]) -> list[Item]:
    """Items whose names differ by more than a year: of each place the newest."""
    newest: dict[str, Item] = {}
    for item in items:  # newest first
        newest.setdefault(re.sub(r"(?<!\d)(19|20)\d\d(?!\d)", "", item.name), item)
    return list(newest.values())


def _cogs(
    client: Client, spec: SourceSpec, urls: list[str], about: About, area: Area
) -> CellSource:
    from orthonav.fetch.cog import cog_source  # brings GDAL

    return cog_source(client, urls, spec.wish, area.frame, about)


def _secrets(
    url: str, key_env: str | None, literal: str | None, environ: Mapping[str, str]
) -> tuple[Secret, ...]:
    """The key for `{key}` in an address. Raises `FetchError` where it is not to be had."""
    if literal is not None:
        return (Secret(KEY, origin_of(url), literal),)
    if key_env is None:
        if KEY in url:
            raise FetchError(f"address holds {KEY}; name the environment variable with --key-env")
        return ()
    if KEY not in url:
        raise FetchError(f"--key-env needs {KEY} in the address, where the key goes: {shown(url)}")
    value = environ.get(key_env, "").strip()
    if not value:
        raise FetchError(f"this service wants a key; put yours into the variable {key_env}")
    return (Secret(KEY, origin_of(url), value),)
