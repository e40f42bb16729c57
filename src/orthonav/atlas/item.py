"""A sheet of an atlas as a STAC item (https://stacspec.org), and back.

Items are canonical JSON: the same sheet is the same bytes. Reading checks every value, because an
atlas may come from a stranger.
"""

import hashlib
import json
import math
import re
from calendar import monthrange
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import date
from typing import Any

from orthonav.errors import AtlasError
from orthonav.geo.area import Extent

SCHEMA = 1
STAC_VERSION = "1.0.0"
COLLECTION = "orthonav-atlas"
MAX_ITEM_BYTES = 2**20
MAX_REVISION = 9999
MAX_DIGITS = 20
MAX_TILES = 10**9
ASSETS = {
    "map": ("sheets", ".onav", "application/octet-stream"),
    "coarse": ("coarse", ".safetensors", "application/octet-stream"),
}
"""Folder, suffix and media type of what a sheet may have."""
_FILE_EXTENSION = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
_SHA256_MULTIHASH = "1220"
_SHEET = re.compile(r"r[0-9]{6}c[0-9]{6}")
_ITEM_NAME = re.compile(r"(r[0-9]{6}c[0-9]{6})\.([0-9]{4})\.([0-9a-f]{12})\.json")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False)
_DATE = re.compile(r"([0-9]{4})(?:-([0-9]{2})(?:-([0-9]{2}))?)?")


@dataclass(frozen=True)
class Asset:
    """A file of a sheet: its name in the atlas, its bytes and their SHA-256 (hex)."""

    name: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class NewSheet:
    """What is told of a sheet when it is put into an atlas.

    `bounds_deg` is the box of the lattice; `dates` those of the imagery, as YYYY[-MM[-DD]];
    `request` a digest of all that it was made from and how; `made_by` program and version. Nothing
    here may depend on when or where it was made.
    """

    id: str
    bounds_deg: Extent
    gsd_m: float
    tiles: int
    area_km2: float
    dates: tuple[str, ...]
    imagery: tuple[Mapping[str, Any], ...]
    request: str
    made_by: Mapping[str, str]


@dataclass(frozen=True)
class Sheet(NewSheet):
    """A sheet that is in an atlas: what was told of it, its revision and its files."""

    revision: int
    assets: Mapping[str, Asset]

    @classmethod
    def of(cls, new: NewSheet, revision: int, assets: Mapping[str, Asset]) -> "Sheet":
        """The sheet as it would be read back. Raises `AtlasError` where it would not be."""
        told = {each.name: getattr(new, each.name) for each in fields(NewSheet)}
        told["bounds_deg"] = tuple(float(each) for each in new.bounds_deg)
        told |= {
            "gsd_m": float(new.gsd_m),
            "area_km2": float(new.area_km2),
            "tiles": int(new.tiles),
        }
        sheet = cls(**told, revision=revision, assets=assets)
        return cls.from_item(json.loads(canonical(sheet.to_item())))

    @property
    def size_bytes(self) -> int:
        """Bytes of all its files."""
        return sum(asset.size_bytes for asset in self.assets.values())

    @property
    def item_name(self) -> str:
        """Name of the file of its item in the folder `items`."""
        return item_name(self.id, self.revision, canonical(self.to_item()))

    def to_item(self) -> dict[str, Any]:
        """The STAC item, as plain values."""
        west, south, east, north = self.bounds_deg
        ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        return {
            "type": "Feature",
            "stac_version": STAC_VERSION,
            "stac_extensions": [_FILE_EXTENSION],
            "id": self.id,
            "collection": COLLECTION,
            "geometry": {"type": "Polygon", "coordinates": [ring]},
            "bbox": [west, south, east, north],
            "properties": {
                **_times(self.dates),
                "gsd": self.gsd_m,
                "orthonav:sheet": {
                    "schema": SCHEMA,
                    "revision": self.revision,
                    "tiles": self.tiles,
                    "area_km2": self.area_km2,
                    "dates": list(self.dates),
                    "imagery": [dict(each) for each in self.imagery],
                    "request": self.request,
                    "made_by": dict(self.made_by),
                },
            },
            "links": [
                {"rel": rel, "href": "../atlas.json", "type": "application/json"}
                for rel in ("root", "parent", "collection")
            ],
            "assets": {key: _asset_to_plain(key, asset) for key, asset in self.assets.items()},
        }

    @classmethod
    def from_item(cls, plain: Any, data: bytes | None = None) -> "Sheet":
        """Inverse of `to_item`. Raises `AtlasError` on anything impossible.

        `data` are the bytes that `plain` was read from, which must be the canonical ones.
        """
        properties = _get(plain, "properties", dict)
        own = _get(properties, "orthonav:sheet", dict)
        schema = _get(own, "schema", int)
        if schema > SCHEMA:
            raise AtlasError(
                f"an item has schema {schema}, this program reads up to {SCHEMA}; update orthonav"
            )
        sheet = cls(
            id=_get(plain, "id", str),
            bounds_deg=_bounds(plain),
            gsd_m=_number(properties, "gsd"),
            tiles=_get(own, "tiles", int),
            area_km2=_number(own, "area_km2"),
            dates=tuple(_all(own, "dates", str)),
            imagery=tuple(_all(own, "imagery", dict)),
            request=_get(own, "request", str),
            made_by=_made_by(own),
            revision=_get(own, "revision", int),
            assets=_assets(plain, _get(plain, "id", str)),
        )
        sane = (
            _SHEET.fullmatch(sheet.id)
            and schema == SCHEMA
            and 1 <= sheet.revision <= MAX_REVISION
            and sheet.gsd_m > 0
            and 1 <= sheet.tiles <= MAX_TILES
            and sheet.area_km2 >= 0
        )
        data = canonical(plain) if data is None else data
        if not sane or canonical(sheet.to_item()) != data:
            raise AtlasError(f"damaged, altered or not an item of orthonav: {sheet.id:.40}")
        return sheet


def canonical(plain: Any) -> bytes:
    """The one way in which plain values are written. Raises `AtlasError` on what JSON has not."""
    try:
        text = _ENCODER.encode(plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise AtlasError(f"cannot be written into the catalogue of an atlas: {error}") from error
    return text.encode()


def parsed(data: bytes, what: str) -> Any:
    """Plain values of JSON; raises `AtlasError` naming `what` where it is none.

    Whoever reads must compare the bytes with the canonical ones: that also rules out keys given
    twice and numbers that are not finite.
    """
    try:
        return json.loads(data.decode(), parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise AtlasError(f"damaged, not JSON ({error}): {what}") from error


def item_name(sheet_id: str, revision: int, data: bytes) -> str:
    """File name of an item: sheet, revision, and the beginning of the digest of its bytes."""
    return f"{sheet_id}.{revision:04d}.{hashlib.sha256(data).hexdigest()[:12]}.json"


def split_name(name: str) -> tuple[str, int, str] | None:
    """Sheet, revision and digest from the file name of an item; None where it is none."""
    match = _ITEM_NAME.fullmatch(name)
    return (match.group(1), int(match.group(2)), match.group(3)) if match else None


def read_item(name: str, data: bytes, plain: Any = None) -> Sheet:
    """The sheet in the item file `name`. Raises `AtlasError` where the two disagree.

    `plain` are its values where they have been read.
    """
    if len(data) > MAX_ITEM_BYTES:
        raise AtlasError(f"larger than an item may be ({len(data)} bytes): items/{name}")
    plain = parsed(data, f"items/{name}") if plain is None else plain
    try:
        sheet = Sheet.from_item(plain, data)
    except AtlasError as error:
        raise AtlasError(f"{error}: items/{name}") from error
    if item_name(sheet.id, sheet.revision, data) != name:
        raise AtlasError(f"damaged or altered: items/{name}")
    return sheet


def asset_name(key: str, sheet_id: str, sha256: str) -> str:
    """Name in the atlas of a file of a sheet with that content."""
    folder, suffix, _ = ASSETS[key]
    return f"{folder}/{sheet_id}.{sha256[:12]}{suffix}"


def sheet_of_file(name: str) -> str | None:
    """The sheet that a file name in any folder of the atlas speaks of, None where none."""
    sheet = name.rpartition("/")[2].partition(".")[0]
    return sheet if _SHEET.fullmatch(sheet) else None


def _asset_to_plain(key: str, asset: Asset) -> dict[str, Any]:
    return {
        "href": f"../{asset.name}",
        "type": ASSETS[key][2],
        "roles": ["data"],
        "file:size": asset.size_bytes,
        "file:checksum": _SHA256_MULTIHASH + asset.sha256,
    }


def _assets(plain: Any, sheet_id: str) -> dict[str, Asset]:
    found = {}
    for key, entry in sorted(_get(plain, "assets", dict).items()):
        sha256 = _get(entry, "file:checksum", str).removeprefix(_SHA256_MULTIHASH)
        size = _get(entry, "file:size", int)
        if key not in ASSETS or not _SHA256.fullmatch(sha256) or size < 0:
            raise AtlasError(f"an item names an impossible file: {key:.40} {entry!r:.200}")
        name = asset_name(key, sheet_id, sha256)
        if _get(entry, "href", str) != f"../{name}":
            raise AtlasError(f"an item names a file that is none of its own: {entry['href']:.120}")
        found[key] = Asset(name, size, sha256)
    if "map" not in found:
        raise AtlasError("an item names no map")
    return found


def _bounds(plain: Any) -> Extent:
    box = _all(plain, "bbox", float | int)
    if len(box) != 4 or not all(math.isfinite(each) for each in box):
        raise AtlasError(f"an item has an impossible box: {box!r:.120}")
    west, south, east, north = (float(each) for each in box)
    if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
        raise AtlasError(f"an item has an impossible box: {box!r:.120}")
    return west, south, east, north


def _made_by(own: Any) -> dict[str, str]:
    found: dict[str, str] = _get(own, "made_by", dict)
    if not all(isinstance(value, str) for value in found.values()):
        raise AtlasError(f"an item was made by what has no name: {found!r:.200}")
    return found


def _times(dates: tuple[str, ...]) -> dict[str, Any]:
    """`datetime` and its like, of which STAC demands one.

    A day is itself; a year, a month or several dates are a range; unknown is the epoch, said so.
    """
    spans = [span for span in map(_span, dates) if span is not None]
    if not spans:
        return {"datetime": "1970-01-01T00:00:00Z", "orthonav:date_known": False}
    first, last = min(start for start, _ in spans), max(end for _, end in spans)
    if first == last:
        return {"datetime": f"{first}T00:00:00Z"}
    return {
        "datetime": None,
        "start_datetime": f"{first}T00:00:00Z",
        "end_datetime": f"{last}T23:59:59Z",
    }


def _span(text: str) -> tuple[date, date] | None:
    """First and last day of YYYY[-MM[-DD]], None where it is no date."""
    match = _DATE.fullmatch(text)
    if match is None:
        return None
    year, month, day = (None if part is None else int(part) for part in match.groups())
    try:
        first = date(year or 0, month or 1, day or 1)
    except ValueError:
        return None
    if day is not None:
        return first, first
    last_month = month or 12
    return first, date(first.year, last_month, monthrange(first.year, last_month)[1])


def _integer(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number has {len(text)} digits")
    return int(text)


def _all(plain: Any, name: str, kind: Any) -> list[Any]:
    values: list[Any] = _get(plain, name, list)
    if not all(isinstance(value, kind) and not isinstance(value, bool) for value in values):
        raise AtlasError(f"catalogue of the atlas: {name} is impossible: {values!r:.120}")
    return values


def _get(plain: Any, name: str, kind: type) -> Any:
    value = plain.get(name) if isinstance(plain, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise AtlasError(
            f"catalogue of the atlas: {name} must be {kind.__name__}, got {value!r:.80}"
        )
    return value


def _number(plain: Any, name: str) -> float:
    value = plain.get(name) if isinstance(plain, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise AtlasError(
            f"catalogue of the atlas: {name} must be a finite number, got {value!r:.80}"
        )
    return float(value)
