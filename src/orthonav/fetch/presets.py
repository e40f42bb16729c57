"""Services known by name, read from `presets.toml` beside this file."""

import tomllib
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any

from orthonav.errors import FetchError
from orthonav.fetch.service import Wish, listed

PROTOCOLS = ("wmts", "wms", "xyz", "tms", "stac", "cog")
CURRENT = "current"


@dataclass(frozen=True)
class PresetLayer:
    """One layer of a service, chosen by `id` after the colon; `date` as in `About`."""

    id: str
    layer: str
    date: str | None
    gsd_m: float
    style: str | None = None
    format: str | None = None
    min_zoom: int | None = None
    max_zoom: int | None = None
    time: str | None = None
    empty: str | None = None
    note: str | None = None


@dataclass(frozen=True)
class Preset:
    """A service: how it is asked, what it has, and under which terms."""

    name: str
    title: str
    country: str
    protocol: str
    url: str
    licence: str
    licence_url: str
    attribution: str
    source_page: str
    crs: str | None = None
    format: str | None = None
    style: str | None = None
    collection: str | None = None
    asset: str | None = None
    bands: tuple[int, ...] | None = None
    token_url: str | None = None
    key_env: str | None = None
    empty: str | None = None
    note: str | None = None
    layers: dict[str, PresetLayer] = field(default_factory=dict)

    def layer(self, id_: str | None) -> PresetLayer:
        """The layer of that id, or the current one. Raises `FetchError` listing what there is."""
        found = self.layers.get(id_ or CURRENT)
        if found is None:
            asked = f"{self.name} has no '{id_}'" if id_ else f"name a year: {self.name}:YEAR"
            raise FetchError(f"{asked}; there is {listed(list(self.layers), id_ or '', most=40)}")
        return found

    def wish(self, layer: PresetLayer) -> Wish:
        """What this preset asks for, where the user asks for nothing else."""
        return Wish(
            layer=layer.layer or None,
            usual_style=layer.style or self.style,
            usual_format=layer.format or self.format,
            crs=self.crs,
            time=layer.time,
            min_zoom=layer.min_zoom,
            max_zoom=layer.max_zoom,
            empty=layer.empty or self.empty,
            collection=self.collection,
            asset=self.asset,
            bands=self.bands,
        )


@cache
def presets() -> dict[str, Preset]:
    """All services by name."""
    text = resources.files("orthonav.fetch").joinpath("presets.toml").read_text(encoding="utf-8")
    return {name: _preset(name, plain) for name, plain in tomllib.loads(text).items()}


def find_preset(name: str) -> Preset:
    """The service of that name. Raises `FetchError` listing what there is."""
    known = presets()
    if name not in known:
        raise FetchError(
            f"no service is known as '{name}'; there is {listed(list(known), name, 40)}"
        )
    return known[name]


def _preset(name: str, plain: dict[str, Any]) -> Preset:
    layers: dict[str, PresetLayer] = {}
    values = dict(plain)
    for told in values.pop("layer"):
        for layer in _layers(dict(told)):
            if layer.id in layers:
                raise ValueError(f"preset {name} has {layer.id} twice")
            layers[layer.id] = layer
    if "bands" in values:
        values["bands"] = tuple(values["bands"])
    return Preset(name=name, layers=layers, **values)


def _layers(told: dict[str, Any]) -> list[PresetLayer]:
    """One layer, or one for each of its years."""
    made = []
    for year in told.pop("years", [None]):
        one: dict[str, Any] = {
            key: value.replace("{year}", str(year)) if isinstance(value, str) else value
            for key, value in told.items()
        }
        one["date"] = one["date"] or None
        made.append(PresetLayer(**one))
    return made
