"""What `--source` means: a service known by name, from `presets.toml`, or an address.

`ImageryOptions` is what a service is asked for, `Provenance` what travels with the imagery.
Needs no extra.
"""

import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from functools import cache
from importlib import resources
from typing import Any

from orthonav.core.errors import FetchError, UsageError
from orthonav.ground.fetch.urls import KEY, Secret, checked_url, holds_key, origin_of, shown

DEFAULT_GSD_M = 0.5
"""Ground resolution where none is given: half that of a usual map (1 m), so nothing is lost."""
GSD_TOLERANCE = 1.05
"""A level counts as fine enough when it is at most this much coarser than requested (zoom levels
are powers of two and do not fall on round numbers)."""
FORMATS = ("image/jpeg", "image/png", "image/webp")
"""Media types that can be read, the usual one of orthophotos first."""
HEIGHTS_FORMAT = "image/geotiff"
"""Media type of heights, numbers of 32 bits. Taken where a preset or user names it."""
TERRAIN_GSD_M = 5.0
"""Ground resolution of heights where neither user nor preset says: half the posting of a map's
terrain."""
DEFAULT_TERRAIN = "copernicus-dem"
MAX_COARSER = 1.5
"""Where no level is fine enough, the finest one is taken if it is at most this much coarser."""
_DATE = re.compile(r"(1[89]\d\d|20\d\d)(-(0[1-9]|1[0-2])(-(0[1-9]|[12]\d|3[01]))?)?")
PROTOCOLS = ("wmts", "wms", "wcs", "xyz", "tms", "stac", "cog")
CURRENT = "current"


@dataclass(frozen=True)
class ImageryOptions:
    """Which imagery a service is asked for; None leaves the choice to the preset or the service."""

    layer: str | None = None
    style: str | None = None
    format: str | None = None  # media type, such as image/jpeg
    crs: str | None = None  # as EPSG:CODE
    matrix_set: str | None = None  # of a WMTS
    zoom: str | None = None  # zoom level, or name of a tile matrix
    gsd_m: float | None = None  # metres on the ground per pixel
    time: str | None = None  # ISO 8601; for STAC an interval with a slash
    tile_px: int | None = None  # width of tiles (XYZ) or of the images requested (WMS, WCS)
    max_zoom: int | None = None  # finest zoom level, where the service does not say
    empty: str | None = None  # colour of missing imagery: "black" or "white"
    collection: str | None = None  # of a STAC API
    asset: str | None = None  # of each STAC item
    bands: tuple[int, ...] | None = None  # of a file, from 1
    version: str | None = None  # of the WMS protocol, 1.1.1 or 1.3.0

    def over(self, preset: "ImageryOptions") -> "ImageryOptions":
        """These options where they are set, else those of the preset."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        return replace(preset, **given)

    @property
    def wanted_gsd_m(self) -> float:
        """Metres per pixel requested, or the default."""
        return self.gsd_m if self.gsd_m is not None else DEFAULT_GSD_M


@dataclass(frozen=True)
class Provenance:
    source: str  # address without keys
    layer: str  # or STAC collection
    date: str | None = None  # acquisition: YYYY[-MM[-DD]], or first and last with a slash between
    licence: str | None = None
    attribution: str | None = None
    note: str | None = None  # what a user should know, such as resampling
    datum: str | None = None  # what the heights of a terrain model count from


@dataclass(frozen=True)
class SourceSpec:
    protocol: str  # one of `PROTOCOLS`
    url: str  # with `{key}` in place of a key
    options: ImageryOptions
    provenance: Provenance  # as far as it is known before the service is asked
    secrets: tuple[Secret, ...] = ()  # the key, if the address holds one
    token_url: str | None = None  # address of a signing service for files


def finest_fitting(gsds_m: list[float], wanted_m: float, levels: str) -> int:
    """Index of the coarsest level that is as fine as wanted, else of the finest if nearly so.

    Raises `FetchError` with the available `levels`.
    """
    fitting = [gsd_m for gsd_m in gsds_m if gsd_m <= wanted_m * GSD_TOLERANCE]
    finest_m = min(gsds_m)
    if not fitting and finest_m > wanted_m * MAX_COARSER:
        raise FetchError(
            f"no imagery of {wanted_m:g} m per pixel: the finest is {finest_m:.3g} m; "
            f"available: {levels}"
        )
    return gsds_m.index(max(fitting, default=finest_m))


def choose(names: Sequence[str], wanted: str | None, what: str) -> str:
    """`wanted` if it is one of `names`, else `FetchError` that lists the names; None: the first."""
    if wanted in names:
        return str(wanted)
    if wanted is None and names:
        return names[0]
    raise FetchError(f"{what} {wanted}; available: {listed(names, wanted or '')}")


def choose_layer(names: list[str], wanted: str | None, url: str) -> str:
    """The layer of that name; without a name the only one. Raises `FetchError` with the choices."""
    if not names:
        raise FetchError(f"document lists no layer: {url}")
    if wanted is None and len(names) > 1:
        raise FetchError(f"choose one with --layer; available: {listed(names, 'ortho')}")
    return choose(names, wanted, "no layer")


def choose_format(offered: Sequence[str], options: ImageryOptions, what: str) -> str:
    """The media type requested, else the first of `FORMATS` on offer."""
    if options.format is not None:
        return choose(offered, options.format, f"{what} has no format")
    found = next((name for name in FORMATS if name in offered), None)
    if found is None:
        raise FetchError(f"{what} comes as {listed(offered)}; supported are JPEG, PNG, WebP")
    return found


def listed(names: Sequence[str], wanted: str = "", most: int = 12) -> str:
    """Names for an error: if there are many, those that resemble the wanted one."""
    chosen = get_close_matches(wanted, names, most, cutoff=0.0) if wanted else names
    chosen = sorted(chosen)[:most]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(chosen) + more if names else "none"


_OPTIONS = {field.name for field in fields(ImageryOptions)}


@dataclass(frozen=True)
class PresetLayer:
    """One layer of a service, selected by `id` after the colon."""

    id: str
    date: str | None  # as in `Provenance`
    gsd_m: float  # ground resolution of the imagery, metres per pixel
    options: ImageryOptions  # of the service and the layer
    note: str | None = None


@dataclass(frozen=True)
class Preset:
    """A service: how it is asked, its layers, and its terms."""

    name: str
    title: str
    country: str
    protocol: str
    url: str
    licence: str
    licence_url: str
    attribution: str
    source_page: str  # documentation that the preset was collected from
    layers: dict[str, PresetLayer]
    token_url: str | None = None  # address of a signing service for files
    key_env: str | None = None  # environment variable that holds the key
    note: str | None = None
    datum: str | None = None  # as in `Provenance`
    terrain: str | None = None  # preset of the terrain of the same country
    surface: str | None = None  # preset of the surface of the same country


@cache
def presets() -> dict[str, Preset]:
    text = resources.files(__package__).joinpath("presets.toml").read_text(encoding="utf-8")
    return {name: _preset(name, values) for name, values in tomllib.loads(text).items()}


def terrain_preset(text: str) -> str | None:
    """The terrain that belongs to the imagery of a source; None where that is a terrain itself."""
    preset = presets().get(text.partition(":")[0])
    if preset is None:
        return DEFAULT_TERRAIN
    return None if preset.datum is not None else preset.terrain or DEFAULT_TERRAIN


def surface_preset(text: str) -> str:
    """The surface that belongs to the imagery of a source. Raises `FetchError` if it has none."""
    preset = presets().get(text.partition(":")[0])
    if preset is None or preset.surface is None:
        names = [name for name, each in presets().items() if each.surface is not None]
        raise FetchError(
            f"no surface model is known for '{shown(text)}'; sources with one: {listed(names)}; "
            "for others, fetch or download one yourself and give it to build --surface"
        )
    return preset.surface


def parse_source(
    text: str,
    options: ImageryOptions,
    *,
    date: str | None = None,
    licence: str | None = None,
    attribution: str | None = None,
    key_env: str | None = None,
) -> SourceSpec:
    """`NAME[:YEAR]` of a service known by name, or `PROTOCOL:ADDRESS`, see `PROTOCOLS`.

    Raises `FetchError` for unknown names, addresses that are not http or https, and missing keys.
    """
    if date is not None:
        check_date(date)
    head, _, rest = text.partition(":")
    if head in PROTOCOLS and rest:
        checked_url(re.sub(r"\{[^{}]*\}", "0", rest))
        if head not in ("xyz", "tms") and set(re.findall(r"\{[^{}]*\}", rest)) - {KEY}:
            raise FetchError(f"only {KEY} may stand in this address: {shown(rest)}")
        provenance = Provenance(shown(rest), options.layer or "", date, licence, attribution)
        return SourceSpec(head, rest, options, provenance, _secrets(rest, key_env))
    if head.lower() in ("http", "https", "file"):
        raise UsageError(
            f"--source: write the protocol before the address ({'|'.join(PROTOCOLS)}:ADDRESS): "
            f"{shown(text)}"
        )
    if head not in presets():
        raise UsageError(
            f"--source: unknown service '{head}'; available: {listed(list(presets()), head, 40)}"
        )
    preset = presets()[head]
    layer = preset.layers.get(rest or CURRENT)
    if layer is None:
        problem = f"{head} has no '{rest}'" if rest else f"add a year: {head}:YEAR"
        available = listed(list(preset.layers), rest, most=40)
        raise FetchError(f"{problem}; available: {available}")
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
    secrets = _secrets(preset.url, key_env or preset.key_env)
    return SourceSpec(preset.protocol, preset.url, options, provenance, secrets, preset.token_url)


def check_date(text: str) -> None:
    """Raise `FetchError` unless a date is YYYY[-MM[-DD]], or two with a slash between."""
    if not all(_DATE.fullmatch(part) for part in text.split("/", 1)):
        raise UsageError(f"date must be YYYY, YYYY-MM or YYYY-MM-DD, or two with /, got '{text}'")


def _preset(name: str, values: dict[str, Any]) -> Preset:
    layers: dict[str, PresetLayer] = {}
    for entry in values["layer"]:
        for year in map(str, entry.get("years", [""])):
            filled: dict[str, Any] = {
                key: value.replace("{year}", year) if isinstance(value, str) else value
                for key, value in entry.items()
            }
            options = _options(filled).over(_options(values))
            options = replace(options, gsd_m=filled.get("default_gsd_m"))
            if filled["id"] in layers:
                raise ValueError(f"preset {name} has {filled['id']} twice")
            layers[filled["id"]] = PresetLayer(
                filled["id"], filled["date"] or None, filled["gsd_m"], options, filled.get("note")
            )
    rest = {key: value for key, value in values.items() if key not in _OPTIONS}
    return Preset(name=name, layers=layers, **rest)


def _options(values: dict[str, Any]) -> ImageryOptions:
    """The options among the values of a table; `gsd_m` describes the imagery and is not one."""
    chosen: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value or None
        for key, value in values.items()
        if key in _OPTIONS and key != "gsd_m" and not (key == "layer" and isinstance(value, list))
    }
    return ImageryOptions(**chosen)


def _secrets(url: str, key_env: str | None) -> tuple[Secret, ...]:
    if holds_key(url):
        raise FetchError(
            f"write {KEY} for the key in the address and name the environment variable that holds "
            f"it with --key-env: {shown(url)}"
        )
    if (key_env is None) != (KEY not in url):
        raise FetchError(f"{KEY} in the address and --key-env need each other: {shown(url)}")
    if key_env is None:
        return ()
    value = os.environ.get(key_env, "").strip()
    if not value:
        raise FetchError(
            f"this service needs a key; put yours into the environment variable {key_env}"
        )
    return (Secret(KEY, origin_of(url), value),)
