"""What `--source` means: a service known by name, from `presets.toml`, or an address.

Needs no extra.
"""

import os
import re
import tomllib
from dataclasses import dataclass, fields
from functools import cache
from importlib import resources
from typing import Any

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.options import ImageryOptions, Provenance, SourceSpec, listed
from orthonav.ground.fetch.urls import (
    KEY,
    Secret,
    checked_url,
    origin_of,
    shown,
    without_literal_keys,
)

_DATE = re.compile(r"(1[89]\d\d|20\d\d)(-(0[1-9]|1[0-2])(-(0[1-9]|[12]\d|3[01]))?)?")
PROTOCOLS = ("wmts", "wms", "xyz", "tms", "stac", "cog")
CURRENT = "current"
_OPTIONS = {field.name for field in fields(ImageryOptions)}
_RENAMED = {"style": "preferred_style", "format": "preferred_format"}
"""A preset prefers a style or format; a user who names one wants no other."""


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

    def layer(self, id_: str | None) -> PresetLayer:
        """The layer of that id, or the current one. Raises `FetchError` with the available ones."""
        found = self.layers.get(id_ or CURRENT)
        if found is None:
            problem = f"{self.name} has no '{id_}'" if id_ else f"add a year: {self.name}:YEAR"
            available = listed(list(self.layers), id_ or "", most=40)
            raise FetchError(f"{problem}; available: {available}")
        return found

    def describe(self) -> dict[str, Any]:
        """Plain values for JSON; options that are not set are left out."""
        layers = [
            {
                name: value
                for name, value in (vars(layer) | vars(layer.options)).items()
                if name != "options" and (value is not None or name in ("date", "note"))
            }
            | {"gsd_m": layer.gsd_m}
            for layer in self.layers.values()
        ]
        return {**vars(self), "layers": layers}


@cache
def presets() -> dict[str, Preset]:
    """All services by name."""
    text = resources.files(__package__).joinpath("presets.toml").read_text(encoding="utf-8")
    return {name: _preset(name, values) for name, values in tomllib.loads(text).items()}


def find_preset(name: str) -> Preset:
    """The service of that name. Raises `FetchError` with the available ones."""
    known = presets()
    if name not in known:
        raise FetchError(f"unknown service '{name}'; available: {listed(list(known), name, 40)}")
    return known[name]


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
        checked_url(re.sub(r"\{[^{}]*\}", "0", rest))
        if head not in ("xyz", "tms") and set(re.findall(r"\{[^{}]*\}", rest)) - {KEY}:
            raise FetchError(f"only {KEY} may stand in this address: {shown(rest)}")
        url, literal = without_literal_keys(rest)
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


def check_date(text: str) -> None:
    """Raise `FetchError` unless a date is YYYY[-MM[-DD]], or two with a slash between."""
    if not all(_DATE.fullmatch(part) for part in text.split("/", 1)):
        raise FetchError(f"date must be YYYY, YYYY-MM or YYYY-MM-DD, or two with /, got '{text}'")


def _preset(name: str, values: dict[str, Any]) -> Preset:
    layers: dict[str, PresetLayer] = {}
    for entry in values["layer"]:
        for year in map(str, entry.get("years", [""])):
            filled: dict[str, Any] = {
                key: value.replace("{year}", year) if isinstance(value, str) else value
                for key, value in entry.items()
            }
            options = _options(filled).over(_options(values))
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
        _RENAMED.get(key, key): tuple(value) if isinstance(value, list) else value or None
        for key, value in values.items()
        if key in _OPTIONS and key != "gsd_m" and not (key == "layer" and isinstance(value, list))
    }
    return ImageryOptions(**chosen)


def _secrets(url: str, key_env: str | None, literal: str | None) -> tuple[Secret, ...]:
    if literal is None and key_env is None:
        if KEY in url:
            raise FetchError(
                f"address contains {KEY}; name the environment variable with --key-env"
            )
        return ()
    if KEY not in url:
        raise FetchError(f"--key-env needs {KEY} in the address, where the key goes: {shown(url)}")
    value = literal or os.environ.get(key_env or "", "").strip()
    if not value:
        raise FetchError(
            f"this service needs a key; put yours into the environment variable {key_env}"
        )
    return (Secret(KEY, origin_of(url), value),)
