"""Services known by name, read from `presets.toml` in this package. Needs no extra."""

import tomllib
from dataclasses import dataclass, fields
from functools import cache
from importlib import resources
from typing import Any

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.options import ImageryOptions, listed

PROTOCOLS = ("wmts", "wms", "xyz", "tms", "stac", "cog")
CURRENT = "current"
_OPTIONS = {field.name for field in fields(ImageryOptions)}
_RENAMED = {"style": "preferred_style", "format": "preferred_format"}
"""A preset prefers a style or format; a user who names one wants no other."""


@dataclass(frozen=True)
class PresetLayer:
    """One layer of a service, selected by `id` after the colon."""

    id: str
    date: str | None
    """As in `Provenance`."""
    gsd_m: float
    """Ground resolution of the imagery, metres per pixel."""
    options: ImageryOptions
    """Options of the service and the layer."""
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
    source_page: str
    """Documentation that the preset was collected from."""
    layers: dict[str, PresetLayer]
    token_url: str | None = None
    """Address of a signing service for files."""
    key_env: str | None = None
    """Environment variable that holds the key."""
    note: str | None = None
    datum: str | None = None
    """What the heights of a terrain model count from (`--dem-datum`); None for imagery."""

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
                **{name: value for name, value in vars(layer).items() if name != "options"},
                **{
                    name: value
                    for name, value in vars(layer.options).items()
                    if value != getattr(ImageryOptions, name)
                },
            }
            for layer in self.layers.values()
        ]
        return {**vars(self), "layers": layers}


@cache
def presets() -> dict[str, Preset]:
    """All services by name."""
    text = (
        resources.files("orthonav.ground.fetch")
        .joinpath("presets.toml")
        .read_text(encoding="utf-8")
    )
    return {name: _preset(name, values) for name, values in tomllib.loads(text).items()}


def find_preset(name: str) -> Preset:
    """The service of that name. Raises `FetchError` with the available ones."""
    known = presets()
    if name not in known:
        raise FetchError(f"unknown service '{name}'; available: {listed(list(known), name, 40)}")
    return known[name]


def _preset(name: str, values: dict[str, Any]) -> Preset:
    shared = _options(values)
    layers: dict[str, PresetLayer] = {}
    for entry in values["layer"]:
        for layer in _layers(entry, shared):
            if layer.id in layers:
                raise ValueError(f"preset {name} has {layer.id} twice")
            layers[layer.id] = layer
    rest = {key: value for key, value in values.items() if key not in _OPTIONS}
    return Preset(name=name, layers=layers, **rest)


def _layers(entry: dict[str, Any], shared: ImageryOptions) -> list[PresetLayer]:
    """One layer, or one for each of its years."""
    made = []
    for year in entry.get("years", [None]):
        values: dict[str, Any] = {
            key: value.replace("{year}", str(year)) if isinstance(value, str) else value
            for key, value in entry.items()
        }
        date, note = values["date"] or None, values.get("note")
        options = _options(values).over(shared)
        made.append(PresetLayer(values["id"], date, values["gsd_m"], options, note))
    return made


def _options(values: dict[str, Any]) -> ImageryOptions:
    """The options among the values of a table; `gsd_m` describes the imagery and is not one."""
    chosen: dict[str, Any] = {
        _RENAMED.get(key, key): tuple(value) if isinstance(value, list) else value or None
        for key, value in values.items()
        if key in _OPTIONS and key != "gsd_m" and not (key == "layer" and isinstance(value, list))
    }
    return ImageryOptions(**chosen)
