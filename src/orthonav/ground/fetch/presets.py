"""What `--source` means: a row of a table of services, or an address.

The table is `presets.toml`, with one of the user's own in the same form beside it. `ImageryOptions`
is what a service is asked for, `Provenance` what travels with the imagery. Needs no extra.
"""

import math
import os
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from orthonav.core.errors import FetchError, UsageError
from orthonav.core.files import require_file
from orthonav.ground.fetch.urls import KEY, Secret, checked_url, holds_key, origin_of, shown

HEIGHTS_FORMAT = "image/geotiff"
"""Media type of heights, numbers of 32 bits. Taken where the table or the user names it."""
DEFAULT_TERRAIN = "copernicus-dem"
PROTOCOLS = ("wmts", "wms", "wcs", "xyz", "stac", "cog")
CURRENT = "current"
_DATE = r"(1[89]\d\d|20\d\d)(-(0[1-9]|1[0-2])(-(0[1-9]|[12]\d|3[01]))?)?"


@dataclass(frozen=True)
class ImageryOptions:
    """Which imagery a service is asked for; None leaves the choice to the table or the service."""

    layer: str | None = None  # coverage of a WCS, collection of a STAC
    style: str | None = None
    format: str | None = None  # media type, such as image/jpeg
    crs: str | None = None  # as EPSG:CODE
    gsd_m: float | None = None  # metres on the ground per pixel
    time: str | None = None  # ISO 8601; for STAC an interval with a slash
    tile_px: int | None = None  # width of tiles (XYZ) or of the images requested (WMS, WCS)
    max_zoom: int | None = None  # finest zoom level, where the service does not say
    empty: str | None = None  # colour of missing imagery: "black" or "white"
    asset: str | None = None  # of each STAC item
    bands: tuple[int, ...] | None = None  # of a file, from 1

    def over(self, preset: "ImageryOptions") -> "ImageryOptions":
        """These options where they are set, else those of the preset."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        return ImageryOptions(**vars(preset) | given)

    @property
    def wanted_gsd_m(self) -> float:
        """Metres per pixel requested; by default half those of a usual map, so nothing is lost."""
        return self.gsd_m if self.gsd_m is not None else 0.5


@dataclass(frozen=True)
class Provenance:
    source: str  # address without keys
    layer: str
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


def is_fine_enough(gsd_m: float, wanted_m: float) -> bool:
    """Up to 5 % coarser: zoom levels are powers of two and do not fall on round numbers."""
    return gsd_m <= wanted_m * 1.05


def finest_fitting(gsds_m: list[float], wanted_m: float, levels: str) -> int:
    """Index of the coarsest level that is as fine as wanted, else of the finest if it is at most
    half as coarse again.

    Raises `FetchError` with the available `levels`.
    """
    fitting = [gsd_m for gsd_m in gsds_m if is_fine_enough(gsd_m, wanted_m)]
    finest_m = min(gsds_m)
    if not fitting and finest_m > wanted_m * 1.5:
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
    """The media type requested, else one on offer that can be read, the usual one first."""
    if options.format is not None:
        return choose(offered, options.format, f"{what} has no format")
    readable = ("image/jpeg", "image/png", "image/webp")
    found = next((name for name in readable if name in offered), None)
    if found is None:
        raise FetchError(f"{what} comes as {listed(offered)}; supported are JPEG, PNG, WebP")
    return found


def choose_crs(names: Sequence[str], wanted: str | None, what: str) -> str:
    """The coordinate system requested, else that of web maps, else the first."""
    if wanted is None and "EPSG:3857" in names:
        wanted = "EPSG:3857"
    return choose(names, wanted, f"{what} does not come in")


def listed(names: Sequence[str], wanted: str = "", most: int = 12) -> str:
    """Names for an error: if there are many, those that resemble the wanted one."""
    chosen = get_close_matches(wanted, names, most, cutoff=0.0) if wanted else names
    chosen = sorted(chosen)[:most]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(chosen) + more if names else "none"


@dataclass(frozen=True)
class PresetLayer:
    """One layer of a service, selected by `id` after the colon."""

    id: str
    options: ImageryOptions  # of the service and the layer
    date: str | None = None  # as in `Provenance`
    finest_m: float | None = None  # ground resolution of the imagery, metres per pixel
    note: str | None = None


@dataclass(frozen=True)
class Preset:
    """A service: how it is asked, its layers, and its terms."""

    name: str
    protocol: str
    url: str
    layers: dict[str, PresetLayer]
    title: str = ""
    country: str = ""
    licence: str | None = None
    licence_url: str | None = None
    attribution: str | None = None
    source_page: str | None = None  # documentation that the preset was collected from
    token_url: str | None = None  # address of a signing service for files
    key_env: str | None = None  # environment variable that holds the key
    note: str | None = None
    datum: str | None = None  # as in `Provenance`
    terrain: str | None = None  # preset of the terrain of the same country
    surface: str | None = None  # preset of the surface of the same country


@cache
def presets(own: Path | None = None) -> dict[str, Preset]:
    """The services known by name, those of the user's table `own` before others.

    Raises `MissingFileError`, `FetchError`."""
    text = resources.files(__package__).joinpath("presets.toml").read_text(encoding="utf-8")
    known = {name: _preset(name, values) for name, values in tomllib.loads(text).items()}
    if own is None:
        return known
    try:
        table = tomllib.loads(require_file(own, "table of services").read_text(encoding="utf-8"))
        return known | {name: _preset(name, values) for name, values in table.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        said = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise FetchError(f"table of services cannot be used ({said}): {own}") from error


def _preset(name: str, values: dict[str, Any]) -> Preset:
    options = {each.name for each in fields(ImageryOptions)}
    layers: dict[str, PresetLayer] = {}
    _require_kinds(name, values)
    for entry in values.get("layers", [{"id": CURRENT}]):
        _require_kinds(f"{name}.layers", entry)
        for year in map(str, entry.get("years", [""])):
            filled: dict[str, Any] = {
                key: value.replace("{year}", year) if isinstance(value, str) else value
                for key, value in entry.items()
                if key != "years"
            }
            asked = {key: value for key, value in (values | filled).items() if key in options}
            if "bands" in asked:
                asked["bands"] = tuple(asked["bands"])
            about = {key: value for key, value in filled.items() if key not in options}
            layer = PresetLayer(options=ImageryOptions(**asked), **about)
            if layer.date is not None and not re.fullmatch(f"{_DATE}(/{_DATE})?", layer.date):
                said = "date must be YYYY, YYYY-MM or YYYY-MM-DD, or two with /"
                raise ValueError(f"{said}, got '{layer.date}'")
            if layer.id in layers:
                raise ValueError(f"{name} has {layer.id} twice")
            layers[layer.id] = layer
    rest = {key: value for key, value in values.items() if key not in options | {"layers"}}
    preset = Preset(name=name, layers=layers, **rest)
    if preset.protocol not in PROTOCOLS:
        raise ValueError(f"protocol of {name} must be one of {', '.join(PROTOCOLS)}")
    return preset


def _is_whole(value: Any) -> bool:
    return type(value) is int and value >= 1


def _is_list(value: Any, fits: Callable[[Any], bool] = lambda _: True) -> bool:
    return isinstance(value, list) and bool(value) and all(map(fits, value))


_WHOLE = _is_whole, "a whole number from 1"
_LENGTH = lambda x: type(x) in (int, float) and 0 < x < math.inf, "a number above 0"
_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "layers": (lambda x: _is_list(x, lambda each: isinstance(each, dict)), "tables"),
    "years": (_is_list, "a list of years"),
    "bands": (lambda x: _is_list(x, _is_whole), "a list of numbers from 1"),
    "empty": (lambda x: x in ("black", "white"), "black or white"),
    **{"tile_px": _WHOLE, "max_zoom": _WHOLE, "gsd_m": _LENGTH, "finest_m": _LENGTH},
}
"""Which values a field of a table takes, and how an error names them; others are texts."""


def _require_kinds(where: str, values: dict[str, Any]) -> None:
    """Raise `ValueError` for a value of a table that its field cannot have."""
    classes = Preset, PresetLayer, ImageryOptions
    known = {"years", *(each.name for cls in classes for each in fields(cls))}
    for name, value in values.items():
        fits, expected = _KINDS.get(name, (lambda x: isinstance(x, str), "a text"))
        if name in known and not fits(value):
            raise ValueError(f"{where}: {name} must be {expected}, got {value!r}")


def terrain_preset(text: str, own: Path | None = None) -> str | None:
    """The terrain that belongs to the imagery of a source; None where that is a terrain itself."""
    preset = presets(own).get(text.partition(":")[0])
    if preset is None:
        return DEFAULT_TERRAIN
    return None if preset.datum is not None else preset.terrain or DEFAULT_TERRAIN


def surface_preset(text: str, own: Path | None = None) -> str:
    """The surface that belongs to the imagery of a source. Raises `FetchError` if it has none."""
    preset = presets(own).get(text.partition(":")[0])
    if preset is None or preset.surface is None:
        names = [name for name, each in presets(own).items() if each.surface is not None]
        raise FetchError(
            f"no surface model is known for '{shown(text)}'; sources with one: {listed(names)}; "
            "for others, fetch or download one yourself and give it to build --surface"
        )
    return preset.surface


def parse_source(
    text: str,
    options: ImageryOptions,
    *,
    key_env: str | None = None,
    own: Path | None = None,
) -> SourceSpec:
    """`NAME[:LAYER]` of a service known by name, or `PROTOCOL:ADDRESS`, see `PROTOCOLS`.

    Raises `FetchError` for unknown names, addresses that are not http or https, and missing keys.
    """
    head, _, rest = text.partition(":")
    if head in PROTOCOLS and rest:
        provenance = Provenance(shown(rest), options.layer or "")
        return SourceSpec(head, rest, options, provenance, _secrets(head, rest, key_env))
    if head.lower() in ("http", "https", "file"):
        raise UsageError(
            f"--source: write the protocol before the address ({'|'.join(PROTOCOLS)}:ADDRESS): "
            f"{shown(text)}"
        )
    known = presets(own)
    if head not in known:
        choices = listed(list(known), head, 40)
        raise UsageError(f"--source: unknown service '{head}'; available: {choices}")
    preset = known[head]
    layer = preset.layers.get(rest or CURRENT)
    if layer is None:
        problem = f"{head} has no '{rest}'" if rest else f"add a year: {head}:YEAR"
        raise FetchError(f"{problem}; available: {listed(list(preset.layers), rest, most=40)}")
    options = options.over(layer.options)
    terms = f"{preset.licence} ({preset.licence_url})" if preset.licence_url else preset.licence
    notes = "; ".join(note for note in (layer.note, preset.note) if note) or None
    provenance = Provenance(
        *(shown(preset.url), options.layer or "", layer.date),
        *(terms, preset.attribution, notes, preset.datum),
    )
    secrets = _secrets(preset.protocol, preset.url, key_env or preset.key_env)
    return SourceSpec(preset.protocol, preset.url, options, provenance, secrets, preset.token_url)


def _secrets(protocol: str, url: str, key_env: str | None) -> tuple[Secret, ...]:
    """The key of a checked address."""
    checked_url(re.sub(r"\{[^{}]*\}", "0", url))
    if protocol != "xyz" and set(re.findall(r"\{[^{}]*\}", url)) - {KEY}:
        raise FetchError(f"only {KEY} may stand in this address: {shown(url)}")
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
