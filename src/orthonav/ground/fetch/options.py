"""Which imagery is requested of which service, and the provenance that travels with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.urls import Secret

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
"""Ground resolution of heights where none is given: half the posting of a map's terrain."""
MAX_COARSER = 1.5
"""Where no level is fine enough, the finest one is taken if it is at most this much coarser."""


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
    tile_px: int | None = None  # width of tiles (XYZ) or of the images requested (WMS)
    min_zoom: int | None = None  # coarsest zoom level, where the service does not say
    max_zoom: int | None = None  # finest zoom level, where the service does not say
    empty: str | None = None  # colour of missing imagery: "black" or "white"
    collection: str | None = None  # of a STAC API
    asset: str | None = None  # of each STAC item
    bands: tuple[int, ...] | None = None  # of a file, from 1
    version: str | None = None  # of the WMS protocol, 1.1.1 or 1.3.0
    preferred_style: str | None = None  # taken where the layer has it and `style` is None
    preferred_format: str | None = None  # likewise

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
    """Origin and terms of imagery, written into the file."""

    source: str  # address without keys
    layer: str  # or STAC collection
    date: str | None = None  # acquisition: YYYY[-MM[-DD]], or first and last with a slash between
    licence: str | None = None
    attribution: str | None = None
    note: str | None = None  # what a user should know, such as resampling
    datum: str | None = None  # what the heights of a terrain model count from


@dataclass(frozen=True)
class SourceSpec:
    """A service and the imagery requested of it."""

    protocol: str  # one of `orthonav.ground.fetch.presets.PROTOCOLS`
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


def choose_layer(names: list[str], wanted: str | None, url: str, *, named: bool = False) -> str:
    """The layer of that name; without a name, unless one is required (`named`), the only one.

    Raises `FetchError` with the available ones.
    """
    if not names:
        raise FetchError(f"document lists no layer: {url}")
    if wanted is None and (named or len(names) > 1):
        raise FetchError(f"choose one with --layer; available: {listed(names, 'ortho')}")
    return choose(names, wanted, "no layer")


def choose_format(offered: Sequence[str], options: ImageryOptions, what: str) -> str:
    """The media type requested, else the preferred one, else the first of `FORMATS` on offer."""
    if options.format is not None:
        return choose(offered, options.format, f"{what} has no format")
    found = next((name for name in (options.preferred_format, *FORMATS) if name in offered), None)
    if found is None:
        raise FetchError(f"{what} comes as {listed(offered)}; supported are JPEG, PNG, WebP")
    return found


def choose_time(values: Sequence[str], wanted: str, layer: str) -> str:
    """The time requested, if the layer has it; one with an interval (A/B) may have any."""
    if any("/" in value for value in values):
        return wanted
    return choose(values, wanted, f"layer {layer} has no time")


def listed(names: Sequence[str], wanted: str = "", most: int = 12) -> str:
    """Names for an error: those that begin like the wanted one or share a word first."""
    words = [word for word in wanted.lower().replace("_", ".").split(".") if len(word) > 2]
    ordered = sorted(
        names,
        key=lambda name: (
            -sum(word in name.lower() for word in [*words, wanted.lower()[:12]]),
            name,
        ),
    )
    more = f" and {len(ordered) - most} more" if len(ordered) > most else ""
    return ", ".join(ordered[:most]) + more if ordered else "none"
