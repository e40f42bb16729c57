"""A sheet of an atlas as a STAC item (https://stacspec.org), and back.

Items are canonical JSON: the same sheet gives the same bytes. An item is accepted only if writing
the sheet read from it gives the same bytes again, so that an untrusted item can hold nothing that
this program would not write. PySTAC is not used for it: it rewrites items to its own STAC version,
checks no values, and takes three times as long (184 instead of 64 us per item, of which a country
has 140,000). Tests validate items and catalogue with it.
"""

import hashlib
import json
import re
from calendar import monthrange
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import date
from typing import Any

from orthonav.errors import AtlasError, described
from orthonav.geo.area import Extent

SCHEMA = 1
STAC_VERSION = "1.0.0"
COLLECTION = "orthonav-atlas"
MAX_ITEM_BYTES = 2**20
"""A guard for memory: items have some 2 kB, 60 bytes more for each further orthophoto."""
MAX_REVISION = 9999
"""What four digits of a file name hold."""
MAX_DIGITS = 20
"""Digits of an integer: 64 bits. Python needs quadratic time for longer ones."""
MAX_TILES = 10**9
"""A guard against impossible values: tiles 1.5 m apart on a sheet of 45 km."""
FILES = {
    "map": ("sheets", ".onav", "application/octet-stream"),
    "coarse": ("coarse", ".safetensors", "application/octet-stream"),
}
"""Folder, suffix and media type of the files that a sheet may have."""
_FILE_EXTENSION = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
_SHA256_MULTIHASH = "1220"
_SHEET = re.compile(r"r[0-9]{6}c[0-9]{6}")
_ITEM_NAME = re.compile(r"(r[0-9]{6}c[0-9]{6})\.([0-9]{4})\.([0-9a-f]{12})\.json")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False)
_KINDS = {str: "text", int: "a whole number", dict: "an object"}
_DATE = re.compile(r"([0-9]{4})(?:-([0-9]{2})(?:-([0-9]{2}))?)?")


@dataclass(frozen=True)
class StoredFile:
    """A file of an atlas: its name in the atlas, its size in bytes and its SHA-256 (hex)."""

    name: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class SheetDescription:
    """What is known of a sheet when it is put into an atlas. Independent of place and time of
    building, so that the same sheet is the same bytes everywhere.

    `id`: name in the lattice, as r001526c001392.
    `bounds_deg`: its box in the lattice: west, south, east, north.
    `gsd_m`: ground resolution of its map, metres per pixel.
    `tiles`: tiles of its map, 1 or more.
    `area_km2`: area of its tile centres.
    `dates`: dates of its imagery, YYYY[-MM[-DD]].
    `imagery`: its orthophotos, as the manifest of a map describes them.
    `request`: digest of all that it was made from and how.
    `made_by`: programs and versions that made it.
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
class Sheet(SheetDescription):
    """A sheet in an atlas: its description, its revision (from 1) and its files by kind."""

    revision: int
    files: Mapping[str, StoredFile]

    @classmethod
    def of(
        cls, described: SheetDescription, revision: int, files: Mapping[str, StoredFile]
    ) -> "Sheet":
        """The sheet as it would be read back; raises `AtlasError` where it could not be."""
        values = {each.name: getattr(described, each.name) for each in fields(SheetDescription)}
        values |= {
            "bounds_deg": tuple(float(each) for each in described.bounds_deg),
            "gsd_m": float(described.gsd_m),
            "area_km2": float(described.area_km2),
            "tiles": int(described.tiles),
        }
        data = canonical(cls(**values, revision=revision, files=files).to_item())
        return cls.from_item(json.loads(data), data)

    @property
    def size_bytes(self) -> int:
        """Bytes of all its files."""
        return sum(file.size_bytes for file in self.files.values())

    @property
    def item_name(self) -> str:
        """File name of its item in the folder `items`."""
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
            "assets": {
                key: {
                    "href": f"../{file.name}",
                    "type": FILES[key][2],
                    "roles": ["data"],
                    "file:size": file.size_bytes,
                    "file:checksum": _SHA256_MULTIHASH + file.sha256,
                }
                for key, file in self.files.items()
            },
        }

    @classmethod
    def from_item(cls, plain: Any, data: bytes) -> "Sheet":
        """Inverse of `to_item`; `data` are the bytes that `plain` was parsed from.

        Raises `AtlasError` unless every value is possible and the bytes are canonical.
        """
        try:
            properties = plain["properties"]
            own = properties["orthonav:sheet"]
            if type(own["schema"]) is int and own["schema"] > SCHEMA:
                raise AtlasError(
                    f"an item has schema {own['schema']}, this program reads up to {SCHEMA}; "
                    "update orthonav"
                )
            west, south, east, north = (float(each) for each in plain["bbox"])
            sheet = cls(
                id=_of_type(str, plain["id"]),
                bounds_deg=(west, south, east, north),
                gsd_m=float(properties["gsd"]),
                tiles=_of_type(int, own["tiles"]),
                area_km2=float(own["area_km2"]),
                dates=tuple(_of_type(str, each) for each in own["dates"]),
                imagery=tuple(_of_type(dict, each) for each in own["imagery"]),
                request=_of_type(str, own["request"]),
                made_by={key: _of_type(str, value) for key, value in own["made_by"].items()},
                revision=_of_type(int, own["revision"]),
                files=_files(plain["assets"], plain["id"]),
            )
            possible = (
                _SHEET.fullmatch(sheet.id)
                and -180 <= west < east <= 180
                and -90 <= south < north <= 90
                and 1 <= sheet.revision <= MAX_REVISION
                and sheet.gsd_m > 0
                and 1 <= sheet.tiles <= MAX_TILES
                and sheet.area_km2 >= 0
            )
        except AtlasError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise AtlasError(f"damaged, or not an item of orthonav ({reason(error)})") from error
        if not possible or canonical(sheet.to_item()) != data:
            raise AtlasError(f"damaged, altered or not an item of orthonav: {sheet.id:.40}")
        return sheet


def reason(error: Exception) -> str:
    """What is wrong with plain values that could not be read, for people."""
    if isinstance(error, TypeError | AttributeError):
        return "a value is of another kind than expected"
    return described(error)


def canonical(plain: Any) -> bytes:
    """Plain values as canonical JSON. Raises `AtlasError` for values that JSON cannot hold."""
    try:
        return _ENCODER.encode(plain).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise AtlasError(f"cannot be written into the catalogue of an atlas: {error}") from error


def parsed(data: bytes, what: str) -> Any:
    """Plain values of JSON; raises `AtlasError` naming `what` where it is not JSON.

    The caller must compare the bytes with the canonical ones, which also excludes repeated keys
    and numbers that are not finite.
    """
    try:
        return json.loads(data.decode(), parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise AtlasError(f"damaged, not JSON ({error}): {what}") from error


def item_name(sheet_id: str, revision: int, data: bytes) -> str:
    """File name of an item: sheet, revision, and the first digits of the digest of its bytes."""
    return f"{sheet_id}.{revision:04d}.{hashlib.sha256(data).hexdigest()[:12]}.json"


def split_name(name: str) -> tuple[str, int, str] | None:
    """Sheet, revision and digest in the file name of an item; None for any other file."""
    match = _ITEM_NAME.fullmatch(name)
    return (match.group(1), int(match.group(2)), match.group(3)) if match else None


def read_item(name: str, data: bytes, plain: Any = None) -> Sheet:
    """The sheet in the item file `name`; `plain` are its values if already parsed.

    Raises `AtlasError` where the file is damaged or does not agree with its name.
    """
    if len(data) > MAX_ITEM_BYTES:
        raise AtlasError(f"{len(data)} bytes, at most {MAX_ITEM_BYTES} are allowed: items/{name}")
    plain = parsed(data, f"items/{name}") if plain is None else plain
    try:
        sheet = Sheet.from_item(plain, data)
    except AtlasError as error:
        raise AtlasError(f"{error}: items/{name}") from error
    if item_name(sheet.id, sheet.revision, data) != name:
        raise AtlasError(f"damaged or altered: items/{name}")
    return sheet


def file_name(key: str, sheet_id: str, sha256: str) -> str:
    """Name in the atlas of a file of a sheet with that content."""
    folder, suffix, _ = FILES[key]
    return f"{folder}/{sheet_id}.{sha256[:12]}{suffix}"


def sheet_of_file(name: str) -> str | None:
    """The sheet that a file name in any folder of the atlas begins with; None for other names."""
    sheet = name.rpartition("/")[2].partition(".")[0]
    return sheet if _SHEET.fullmatch(sheet) else None


def _files(assets: Any, sheet_id: str) -> dict[str, StoredFile]:
    found = {}
    for key, entry in sorted(assets.items()):
        sha256 = entry["file:checksum"].removeprefix(_SHA256_MULTIHASH)
        size = _of_type(int, entry["file:size"])
        if key not in FILES or not _SHA256.fullmatch(sha256) or size < 0:
            raise AtlasError(f"an item names an impossible file: {key:.40} {entry!r:.200}")
        name = file_name(key, sheet_id, sha256)
        if entry["href"] != f"../{name}":
            raise AtlasError(f"an item names a file of another sheet: {entry['href']!r:.120}")
        found[key] = StoredFile(name, size, sha256)
    if "map" not in found:
        raise AtlasError("an item names no map")
    return found


def _times(dates: tuple[str, ...]) -> dict[str, Any]:
    """`datetime` and related properties, one of which STAC requires.

    A single day is a date; a year, a month or several dates are a range; unknown dates are the
    epoch, marked as unknown.
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
    """First and last day of YYYY[-MM[-DD]], None for an invalid date."""
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


def _of_type(kind: type, value: Any) -> Any:
    """`value` if it is exactly of that type; raises `ValueError`."""
    if type(value) is not kind:
        raise ValueError(f"{value!r:.80} where {_KINDS[kind]} is expected")
    return value
