"""A sheet of an atlas as a STAC item (https://stacspec.org), and back.

Items are canonical JSON: the same sheet gives the same bytes. An item is accepted only if writing
the sheet read from it gives the same bytes again, so that an untrusted item can hold nothing that
this program would not write. PySTAC is not used for it: it rewrites items to its own STAC version,
checks no values, and takes three times as long (184 instead of 64 us per item, of which a country
has 140,000). Tests validate items and catalogue with it.
"""

import hashlib
import json
import logging
import re
from calendar import monthrange
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from typing import Any

from orthonav.core.errors import AtlasError, StorageError, described
from orthonav.ground.atlas.store import Store
from orthonav.ground.planning.area import Extent

SCHEMA = 1
STAC_VERSION = "1.0.0"
COLLECTION = "orthonav-atlas"
MAX_ITEM_BYTES = 2**20  # a guard for memory: 2 kB, 60 bytes more for each further orthophoto
MAX_REVISION = 9999  # what four digits of a file name hold
MAX_DIGITS = 20  # digits of an integer: 64 bits. Python needs quadratic time for longer ones.
MAX_TILES = 10**9  # a guard against impossible values: tiles 1.5 m apart on a sheet of 45 km
FILES = {  # folder, suffix and media type of the files that a sheet may have
    "map": ("sheets", ".onav", "application/octet-stream"),
    "coarse": ("coarse", ".safetensors", "application/octet-stream"),
}
_FILE_EXTENSION = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
_SHA256_MULTIHASH = "1220"
_SHEET = re.compile(r"r[0-9]{6}c[0-9]{6}")
_ITEM_NAME = re.compile(r"(r[0-9]{6}c[0-9]{6})\.([0-9]{4})\.([0-9a-f]{12})\.json")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False)
_DATE = re.compile(r"[0-9]{4}(-[0-9]{2}){0,2}")


@dataclass(frozen=True)
class StoredFile:
    name: str
    size_bytes: int
    sha256: str

    def __post_init__(self) -> None:
        if not (isinstance(self.size_bytes, int) and self.size_bytes >= 0):
            raise AtlasError(f"size of a file is {self.size_bytes!r:.40}")
        if not (isinstance(self.sha256, str) and _SHA256.fullmatch(self.sha256)):
            raise AtlasError(f"sha256 of a file is {self.sha256!r:.80}")


@dataclass(frozen=True)
class Sheet:
    """A sheet of an atlas. All but `revision` and `files` is independent of place and time of
    building, so that the same sheet is the same bytes everywhere. `imagery`: its orthophotos, as
    the manifest of a map describes them. `files`: its files by kind: `map`, `coarse`."""

    id: str  # name in the lattice, as r001526c001392
    bounds_deg: Extent  # its box in the lattice: west, south, east, north
    gsd_m: float  # ground resolution of its map, metres per pixel
    tiles: int  # tiles of its map, 1 or more
    area_km2: float  # area of its tile centres
    dates: tuple[str, ...]  # dates of its imagery, YYYY[-MM[-DD]]
    imagery: tuple[Mapping[str, Any], ...]
    request: str  # digest of all that it was made from and how
    made_by: Mapping[str, str]  # programs and versions that made it
    revision: int = 0  # from 1; 0 for a sheet that is not in an atlas yet
    files: Mapping[str, StoredFile] = field(default_factory=dict)

    def stored(self, revision: int, files: Mapping[str, StoredFile]) -> "Sheet":
        data = canonical(replace(self, revision=revision, files=files).to_item())
        return self.from_item(json.loads(data), data)

    @property
    def size_bytes(self) -> int:
        return sum(file.size_bytes for file in self.files.values())

    @property
    def item_name(self) -> str:
        return item_name(self.id, self.revision, canonical(self.to_item()))

    def to_item(self) -> dict[str, Any]:
        west, south, east, north = map(float, self.bounds_deg)
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
                "gsd": float(self.gsd_m),
                "orthonav:sheet": {
                    "schema": SCHEMA,
                    "revision": self.revision,
                    "tiles": self.tiles,
                    "area_km2": float(self.area_km2),
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
        """Inverse of `to_item`; `data` are the bytes that `plain` was parsed from. That also
        refuses values of another type, which are converted here."""
        try:
            properties = plain["properties"]
            own = properties["orthonav:sheet"]
            if own["schema"] > SCHEMA:
                raise AtlasError(
                    f"an item has schema {own['schema']}, this program reads up to {SCHEMA}; "
                    "update orthonav"
                )
            west, south, east, north = map(float, plain["bbox"])
            sheet = cls(
                id=str(plain["id"]),
                bounds_deg=(west, south, east, north),
                gsd_m=float(properties["gsd"]),
                tiles=int(own["tiles"]),
                area_km2=float(own["area_km2"]),
                dates=tuple(map(str, own["dates"])),
                imagery=tuple(own["imagery"]),
                request=str(own["request"]),
                made_by={key: str(value) for key, value in own["made_by"].items()},
                revision=int(own["revision"]),
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
            if not possible or canonical(sheet.to_item()) != data:
                raise AtlasError(f"damaged, altered or not an item of orthonav: {sheet.id:.40}")
        except AtlasError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise AtlasError(f"damaged, or not an item of orthonav ({reason(error)})") from error
        return sheet


def reason(error: Exception) -> str:
    if isinstance(error, TypeError | AttributeError):
        return "a value is of another kind than expected"
    return described(error)


def canonical(plain: Any) -> bytes:
    try:
        return _ENCODER.encode(plain).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise AtlasError(f"cannot be written into the catalogue of an atlas: {error}") from error


def parsed(data: bytes, what: str) -> Any:
    """Plain values of JSON; raises `AtlasError` naming `what` where it is not JSON. The caller must
    compare the bytes with the canonical ones, which also excludes repeated keys and numbers that
    are not finite."""
    try:
        return json.loads(data.decode(), parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise AtlasError(f"damaged, not JSON ({error}): {what}") from error


def item_name(sheet_id: str, revision: int, data: bytes) -> str:
    return f"{sheet_id}.{revision:04d}.{hashlib.sha256(data).hexdigest()[:12]}.json"


def split_name(name: str) -> tuple[str, int] | None:
    match = _ITEM_NAME.fullmatch(name)
    return (match.group(1), int(match.group(2))) if match else None


def read_item(name: str, data: bytes, plain: Any = None) -> Sheet:
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
    folder, suffix, _ = FILES[key]
    return f"{folder}/{sheet_id}.{sha256[:12]}{suffix}"


def sheet_of_file(name: str) -> str | None:
    sheet = name.rpartition("/")[2].partition(".")[0]
    return sheet if _SHEET.fullmatch(sheet) else None


def _files(assets: Any, sheet_id: str) -> dict[str, StoredFile]:
    found = {}
    for key, entry in sorted(assets.items()):
        if key not in FILES:
            raise AtlasError(f"an item names an impossible file: {key:.40} {entry!r:.200}")
        sha256 = entry["file:checksum"].removeprefix(_SHA256_MULTIHASH)
        name = file_name(key, sheet_id, sha256)
        found[key] = StoredFile(name, int(entry["file:size"]), sha256)
    if "map" not in found:
        raise AtlasError("an item names no map")
    return found


def _times(dates: tuple[str, ...]) -> dict[str, Any]:
    """`datetime` and related properties, one of which STAC requires. A single day is a date; a
    year, a month or several dates are a range; unknown dates are the epoch, marked as unknown."""
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
    if not _DATE.fullmatch(text):
        return None
    try:
        first = date.fromisoformat(f"{text}-01-01"[:10])
    except ValueError:
        return None
    if len(text) == len("YYYY-MM"):
        return first, first.replace(day=monthrange(first.year, first.month)[1])
    return first, date.fromisoformat(f"{text}-12-31"[:10])


def _integer(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number has {len(text)} digits")
    return int(text)


log = logging.getLogger(__name__)

ITEMS, SNAPSHOT = "items", "items.geojson"
MAX_SNAPSHOT_BYTES = 2**30  # a guard for memory: 500,000 items of 2 kB
MAX_ITEMS = 10**6  # a guard for memory: seven times a country at 20 cm (docs/country.md)
_READ_AT_ONCE = 1000  # one page of a listing of S3


def read_items(store: Store) -> tuple[dict[str, Sheet], dict[str, str]]:
    """All items by file name, and the errors of damaged items by file name. Where a sheet has
    several items, the last in the order of names is current. Items of a remote atlas that are in
    the snapshot are not read one by one; they are checked in the same way."""
    names = {name: size for name, size in store.names(ITEMS).items() if split_name(name)}
    if len(names) > MAX_ITEMS:
        raise AtlasError(f"more than {MAX_ITEMS} items: {store}")
    known = _read_snapshot(store, names)
    found, broken = read_some(store, {n: s for n, s in names.items() if n not in known})
    return {**known, **found}, broken


def snapshot_of(sheets: Iterable[Sheet]) -> bytes:
    items = [_moved(sheet.to_item(), "../", "./") for sheet in sheets]
    return canonical({"type": "FeatureCollection", "features": items})


def _read_snapshot(store: Store, names: Mapping[str, int]) -> dict[str, Sheet]:
    wanted = len(names) > 1 and not store.is_local  # items of a folder are read as fast
    size = store.size(SNAPSHOT) if wanted else None
    if size is None or size > MAX_SNAPSHOT_BYTES:
        return {}
    try:
        features = parsed(store.read(SNAPSHOT, MAX_SNAPSHOT_BYTES), SNAPSHOT)["features"]
        found = {}
        for feature in features:
            item = _moved(feature, "./", "../")
            data = canonical(item)
            name = item_name(item["id"], item["properties"]["orthonav:sheet"]["revision"], data)
            if name in names:
                found[name] = read_item(name, data, item)
    except (AtlasError, KeyError, TypeError, ValueError, AttributeError) as error:
        log.warning("the snapshot of the atlas is not used: %s", error)
        return {}
    return found


def read_some(store: Store, names: Mapping[str, int]) -> tuple[dict[str, Sheet], dict[str, str]]:
    found: dict[str, Sheet] = {}
    broken = {
        name: f"{size} bytes, at most {MAX_ITEM_BYTES} are allowed: {ITEMS}/{name}"
        for name, size in names.items()
        if size > MAX_ITEM_BYTES
    }
    wanted = [name for name in names if split_name(name) and name not in broken]
    for start in range(0, len(wanted), _READ_AT_ONCE):
        paths = [f"{ITEMS}/{name}" for name in wanted[start : start + _READ_AT_ONCE]]
        for path, data in _contents(store, paths).items():
            name = path.partition("/")[2]
            try:
                found[name] = read_item(name, data)
            except AtlasError as error:
                broken[name] = str(error)
    return found, broken


def _contents(store: Store, paths: list[str]) -> dict[str, bytes]:
    """Contents of files; files that another process has removed meanwhile are left out."""
    try:
        return store.read_many(paths)
    except StorageError:
        there = store.names(ITEMS)
        left = [path for path in paths if path.partition("/")[2] in there]
        if len(left) == len(paths):
            raise
        return _contents(store, left)


def _moved(item: Mapping[str, Any], old: str, new: str) -> dict[str, Any]:
    def moved(entry: Mapping[str, Any]) -> dict[str, Any]:
        return {**entry, "href": new + entry["href"].removeprefix(old)}

    return {
        **item,
        "links": [moved(link) for link in item["links"]],
        "assets": {key: moved(asset) for key, asset in item["assets"].items()},
    }
