"""The catalogue of an atlas: its recipe, its sheets, and how a sheet is put in or taken out.

A sheet exists if and only if its item does, and the item is written last. Files are named by their
content and never change. After a kill at any moment the finished sheets are intact; files without
an item may remain, which `orthonav.ground.atlas.integrity` finds.

An item is a STAC item (https://stacspec.org) in canonical JSON: the same sheet gives the same
bytes. It is accepted only if writing the sheet read from it gives the same bytes again, so that an
untrusted item can hold nothing that this program would not write."""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from orthonav.core.errors import AtlasError, described
from orthonav.core.files import Progress, no_progress
from orthonav.ground.atlas.store import Store, digest_of
from orthonav.ground.planning.area import Extent
from orthonav.ground.planning.sheets import WorldSheets

SCHEMA = 2
FORMAT = "orthonav-atlas"  # and the id of its collection
CATALOG, ITEMS, SNAPSHOT = "atlas.json", "items", "items.geojson"
MAX_ITEM_BYTES = 2**20  # a guard for memory: 2 kB, 60 bytes more for each further orthophoto
FILES = {  # folder, suffix and media type of the files that a sheet may have
    "map": ("sheets", ".onav", "application/octet-stream"),
    "coarse": ("coarse", ".safetensors", "application/octet-stream"),
}
_SHEET = "r[0-9]{6}c[0-9]{6}"


@dataclass(frozen=True)
class StoredFile:
    name: str
    size_bytes: int
    sha256: str

    def __post_init__(self) -> None:
        if not (isinstance(self.size_bytes, int) and self.size_bytes >= 0):
            raise AtlasError(f"size of a file is {self.size_bytes!r:.40}")
        if not (isinstance(self.sha256, str) and re.fullmatch("[0-9a-f]{64}", self.sha256)):
            raise AtlasError(f"sha256 of a file is {self.sha256!r:.80}")


@dataclass(frozen=True)
class Sheet:
    """A sheet of an atlas. Nothing depends on place and time of building, so that the same sheet is
    the same bytes everywhere. `imagery`: its orthophotos, as the manifest of a map describes them.
    """

    id: str  # name in the lattice, as r001526c001392
    bounds_deg: Extent  # its box in the lattice: west, south, east, north
    gsd_m: float  # ground resolution of its map, metres per pixel
    tiles: int  # tiles of its map, 1 or more
    area_km2: float  # area of its tile centres
    dates: tuple[str, ...]  # dates of its imagery, YYYY[-MM[-DD]]
    imagery: tuple[Mapping[str, Any], ...]
    request: str  # digest of all that it was made from and how
    made_by: Mapping[str, str]  # programs and versions that made it
    files: Mapping[str, StoredFile] = field(default_factory=dict)

    @property
    def size_bytes(self) -> int:
        return sum(file.size_bytes for file in self.files.values())

    @property
    def item_name(self) -> str:
        return f"{ITEMS}/{self.id}.json"

    def to_item(self) -> dict[str, Any]:
        west, south, east, north = map(float, self.bounds_deg)
        ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        return {
            "type": "Feature",
            "stac_version": "1.0.0",
            "stac_extensions": ["https://stac-extensions.github.io/file/v2.1.0/schema.json"],
            "id": self.id,
            "collection": FORMAT,
            "geometry": {"type": "Polygon", "coordinates": [ring]},
            "bbox": [west, south, east, north],
            "properties": {
                **_times(self.dates),
                "gsd": float(self.gsd_m),
                "orthonav:sheet": {
                    "schema": SCHEMA,
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
                    "file:checksum": f"1220{file.sha256}",  # a multihash
                }
                for key, file in self.files.items()
            },
        }

    @classmethod
    def from_item(cls, data: bytes) -> "Sheet":
        """Inverse of `to_item` and `canonical`. Writing the sheet must give `data`, which also
        refuses values of another type."""
        plain = parsed(data)
        try:
            properties = plain["properties"]
            own = properties["orthonav:sheet"]
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
                files=_files(plain["assets"], plain["id"]),
            )
        except AtlasError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise AtlasError(f"damaged, or not an item of orthonav ({reason(error)})") from error
        possible = (
            re.fullmatch(_SHEET, sheet.id)
            and -180 <= west < east <= 180
            and -90 <= south < north <= 90
            and sheet.gsd_m > 0
            and sheet.tiles >= 1
            and sheet.area_km2 >= 0
        )
        if not possible or canonical(sheet.to_item()) != data:
            raise AtlasError(f"damaged, altered or not an item of orthonav: {sheet.id:.40}")
        return sheet


def reason(error: Exception) -> str:
    if isinstance(error, TypeError | AttributeError):
        return "a value is of another kind than expected"
    return described(error)


def canonical(plain: Any) -> bytes:
    try:
        return json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise AtlasError(f"cannot be written into the catalogue of an atlas: {error}") from error


def parsed(data: bytes) -> Any:
    """Plain values of JSON. The caller must compare the bytes with the canonical ones, which also
    excludes repeated keys and numbers that are not finite."""
    try:
        return json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise AtlasError(f"damaged, not JSON ({error})") from error


def read_item(name: str, data: bytes) -> Sheet:
    """The sheet of an item, a file `items/SHEET.json`."""
    try:
        sheet = Sheet.from_item(data)
    except AtlasError as error:
        raise AtlasError(f"{error}: {name}") from error
    if sheet.item_name != name:
        raise AtlasError(f"damaged or altered: {name}")
    return sheet


def sheet_of_file(name: str) -> str | None:
    """The sheet to which a map or coarse tiles belong by their name; None for other files."""
    folders = "|".join(folder for folder, _, _ in FILES.values())
    match = re.fullmatch(rf"(?:{folders})/({_SHEET})\.[0-9a-f]{{12}}\.[a-z]+", name)
    return match[1] if match else None


def _file(key: str, sheet_id: str, size_bytes: int, sha256: str) -> StoredFile:
    folder, suffix, _ = FILES[key]
    return StoredFile(f"{folder}/{sheet_id}.{sha256[:12]}{suffix}", size_bytes, sha256)


def _files(assets: Any, sheet_id: str) -> dict[str, StoredFile]:
    found = {}
    for key, entry in sorted(assets.items()):
        if key not in FILES:
            raise AtlasError(f"an item names an impossible file: {key:.40} {entry!r:.200}")
        sha256 = entry["file:checksum"].removeprefix("1220")
        found[key] = _file(key, sheet_id, int(entry["file:size"]), sha256)
    if "map" not in found:
        raise AtlasError("an item names no map")
    return found


def _times(dates: tuple[str, ...]) -> dict[str, Any]:
    """`datetime` and related properties, one of which STAC requires. A single day is a date; a
    year, a month or several dates are a range; unknown dates are the epoch, marked as unknown."""
    spans = [span for text in dates for span in _span(text)]
    if not spans:
        return {"datetime": "1970-01-01T00:00:00Z", "orthonav:date_known": False}
    first, last = min(spans), max(spans)
    if first == last:
        return {"datetime": f"{first}T00:00:00Z"}
    return {
        "datetime": None,
        "start_datetime": f"{first}T00:00:00Z",
        "end_datetime": f"{last}T23:59:59Z",
    }


def _span(text: str) -> list[np.datetime64]:
    """First and last day of a year, month or day; empty for other texts."""
    if not re.fullmatch(r"[0-9]{4}(-[0-9]{2}){0,2}", text):
        return []
    try:
        first = np.datetime64(text)
    except ValueError:
        return []
    return [first.astype("M8[D]"), (first + 1).astype("M8[D]") - 1]


def read_items(store: Store) -> tuple[dict[str, Sheet], dict[str, str]]:
    """Sheets by name, and the errors of damaged items by the name of their sheet."""
    found: dict[str, Sheet] = {}
    broken: dict[str, str] = {}
    wanted = {}
    for file, size in store.names(ITEMS).items():
        sheet_id = file.removesuffix(".json")
        if not re.fullmatch(rf"{_SHEET}\.json", file):
            continue
        wanted[f"{ITEMS}/{file}"] = sheet_id
        if size > MAX_ITEM_BYTES:
            broken[sheet_id] = f"{size} bytes, at most {MAX_ITEM_BYTES} are allowed: {ITEMS}/{file}"
    names = [name for name, sheet_id in wanted.items() if sheet_id not in broken]
    for start in range(0, len(names), 1000):  # a page of a listing of S3
        for name, data in store.read_many(names[start : start + 1000]).items():
            try:
                found[wanted[name]] = read_item(name, data)
            except AtlasError as error:
                broken[wanted[name]] = str(error)
    return found, broken


def _require_possible(recipe: "CoarseRecipe | AtlasRecipe") -> None:
    for each in fields(recipe):
        value, kind = getattr(recipe, each.name), cast(type, each.type)
        if kind in (int, float):
            kinds = int if kind is int else (int, float)
            right = isinstance(value, kinds) and not isinstance(value, bool) and 0 <= value < 1e9
        else:
            right = isinstance(value, kind)
        if not right:
            raise AtlasError(f"{each.name} is {value!r:.40}")
    if not (recipe.gsd_m > 0 and recipe.tile_px > 0 and recipe.overlap < 1):
        raise AtlasError(
            f"gsd_m {recipe.gsd_m}, tile_px {recipe.tile_px}, overlap {recipe.overlap}"
        )


@dataclass(frozen=True)
class CoarseRecipe:
    """The coarse tiles in which a view is searched in the whole atlas: wide, at low resolution.
    `overlap`: share that neighbouring tiles have in common, 0 to below 1; below 0.875 fewer views
    are found (docs/decisions, the atlas)."""

    gsd_m: float = 8.0  # metres per pixel, above 0
    tile_px: int = 128  # width of a tile
    overlap: float = 0.875

    def __post_init__(self) -> None:
        _require_possible(self)

    @property
    def tile_m(self) -> float:
        return self.gsd_m * self.tile_px


@dataclass(frozen=True)
class AtlasRecipe:
    """How every sheet is made; fields are those of `BuildRequest`, whose defaults hold for all
    others. `coarse`: recipe of the coarse tiles."""

    gsd_m: float  # metres per pixel
    tile_px: int = 256
    overlap: float = 0.875
    calibration_views: int = 24
    sheet_km: float = 10.0  # greatest width of a sheet
    coarse: CoarseRecipe = CoarseRecipe()

    def __post_init__(self) -> None:
        _require_possible(self)
        WorldSheets(self.sheet_km * 1000)  # refuses impossible widths

    @property
    def sheets(self) -> WorldSheets:
        return WorldSheets(self.sheet_km * 1000)

    def to_plain(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_plain(cls, plain: Any) -> "AtlasRecipe":
        if isinstance(plain, dict) and "coarse" in plain and plain["coarse"] is None:
            raise AtlasError(
                "the atlas has no coarse tiles, which this version needs; build it again"
            )
        try:
            values = {each.name: plain[each.name] for each in fields(cls)}
            return cls(**values | {"coarse": CoarseRecipe(**values["coarse"])})
        except (KeyError, TypeError, ValueError) as error:
            raise AtlasError(f"recipe of the atlas cannot be read ({reason(error)})") from error


class Atlas:
    """An existing atlas. The list of sheets is read once, and again on request. Several processes
    may put sheets into it at the same time."""

    def __init__(self, store: Store, recipe: AtlasRecipe) -> None:
        self.store, self.url = store, store.url
        self.recipe = recipe
        self._sheets: dict[str, Sheet] | None = None

    @classmethod
    def open(cls, url: str | Path) -> "Atlas":
        store = Store(str(url))
        if store.size(CATALOG) is None:
            raise AtlasError(f"no atlas: it has no {CATALOG}: {store}")
        return cls(store, _read_catalog(store))

    @classmethod
    def open_or_create(cls, url: str | Path, recipe: AtlasRecipe) -> "Atlas":
        store = Store(str(url))
        if store.size(CATALOG) is None:
            if _is_free(store):
                store.write(CATALOG, _catalog(recipe))
            elif store.size(CATALOG) is None:  # no other process has created it meanwhile
                raise AtlasError(f"the folder holds other files; name another: {store}")
        return cls.open(url).require_recipe(recipe)

    def sheets(self, refresh: bool = False) -> dict[str, Sheet]:
        if self._sheets is None or refresh:
            found, broken = read_items(self.store)
            if broken:
                first = next(iter(broken.values()))
                raise AtlasError(
                    f"{len(broken)} items of the atlas cannot be used, the first: {first}; see "
                    f"'orthonav atlas check', remove with 'orthonav atlas retire': {self.store}"
                )
            for sheet in found.values():
                self.require_place(sheet)
            self._sheets = found
        return dict(self._sheets)

    def over(self, bounds_deg: Extent) -> list[Sheet]:
        """The sheets that a box touches; west is greater than east across the antimeridian."""
        touched = set(self.recipe.sheets.over(bounds_deg))
        return [sheet for name, sheet in self.sheets().items() if name in touched]

    @property
    def bounds_deg(self) -> Extent | None:
        boxes = [sheet.bounds_deg for sheet in self.sheets().values()]
        if not boxes:
            return None
        west, south, east, north = zip(*boxes, strict=True)
        return min(west), min(south), max(east), max(north)

    def put(self, files: Mapping[str, Path], described: Sheet) -> Sheet:
        """Put a sheet in, or replace it; `files` by kind: `map`, `coarse`. Nothing is written where
        the same sheet is there already. After a kill it is as before or as described."""
        sheet_id, stored = described.id, {}
        for key, path in sorted(files.items()):
            stored[key] = _file(key, sheet_id, path.stat().st_size, digest_of(path))
        data = canonical(replace(described, files=stored).to_item())
        sheet = Sheet.from_item(data)
        self.require_place(sheet)
        before = self._item(sheet_id)
        for key, file in stored.items():
            if sheet != before or self.store.size(file.name) != file.size_bytes:
                self.store.write(file.name, files[key])
        if sheet != before:
            self.store.write(sheet.item_name, data)
            self._remove_files(before)
        return sheet

    def retire(self, sheet_id: str) -> None:
        name = f"{ITEMS}/{sheet_id:.40}.json"
        if not re.fullmatch(_SHEET, sheet_id) or self.store.size(name) is None:
            raise AtlasError(f"the atlas has no sheet {sheet_id!r:.40}: {self.store}")
        before = self._item(sheet_id)
        self.store.remove(name)
        self._remove_files(before)

    def path(self, sheet: Sheet, kind: str = "map") -> Path:
        found = sheet.files[kind]
        return self.store.fetch(found.name, found.size_bytes, found.sha256)

    def snapshot(self) -> None:
        """Write all items into one file."""
        items = [sheet.to_item() for sheet in self.sheets(refresh=True).values()]
        for item in items:
            for link in (*item["links"], *item["assets"].values()):
                link["href"] = f"./{link['href'].removeprefix('../')}"
        self.store.write(SNAPSHOT, canonical({"type": "FeatureCollection", "features": items}))

    def require_recipe(self, recipe: AtlasRecipe) -> "Atlas":
        mine, other = self.recipe.to_plain(), recipe.to_plain()
        differences = [
            f"{name}: {value}, not {other[name]}"
            for name, value in mine.items()
            if value != other[name]
        ]
        if differences:
            raise AtlasError(
                "all sheets of an atlas are made alike; this one has "
                f"{'; '.join(differences)}: {self.store}"
            )
        return self

    def require_place(self, sheet: Sheet) -> None:
        box = self.recipe.sheets.bounds_deg(sheet.id)
        if max(abs(a - b) for a, b in zip(box, sheet.bounds_deg, strict=True)) > 1e-9:
            raise AtlasError(
                f"sheet {sheet.id} has bounds {sheet.bounds_deg}, the lattice of the atlas has "
                f"{box}: {self.store}"
            )

    def _item(self, sheet_id: str) -> Sheet | None:
        """None where there is none, or a damaged one."""
        name = f"{ITEMS}/{sheet_id}.json"
        if (self.store.size(name) or 0) > MAX_ITEM_BYTES:
            return None
        data = self.store.read_many([name]).get(name)
        try:
            return None if data is None else read_item(name, data)
        except AtlasError:
            return None

    def _remove_files(self, before: Sheet | None) -> None:
        """Remove the files of a sheet that was replaced or removed, unless its item names them."""
        self._sheets = None
        if before is None:
            return
        there = self._item(before.id)  # perhaps of another process
        left = {file.name for file in there.files.values()} if there else set()
        for file in before.files.values():
            if file.name not in left:
                self.store.remove(file.name)


def copy_sheets(
    source: Atlas, atlas: Atlas, replace: bool = False, progress: Progress = no_progress
) -> tuple[list[str], list[str]]:
    """Copy the sheets of one atlas into another of the same recipe: names of copied sheets, and of
    those that were there and left unchanged. With `replace` sheets that differ are replaced."""
    atlas.require_recipe(source.recipe)
    found, there = source.sheets(), atlas.sheets(refresh=True)
    copied: list[str] = []
    for number, (sheet_id, new) in enumerate(found.items()):
        progress("copy", number / len(found))
        old = there.get(sheet_id)
        if old is None or (replace and old != new):
            atlas.put({key: source.path(new, key) for key in new.files}, new)
            copied.append(sheet_id)
    atlas.snapshot()
    return copied, [each for each in found if each not in copied]


def _is_free(store: Store) -> bool:
    names: Iterable[str] = store.names()
    if store.is_local and (folder := Path(store.url)).exists():
        names = [path.name for path in folder.iterdir()] if folder.is_dir() else [folder.name]
    return all(name.startswith(".") for name in names)


def _catalog(recipe: AtlasRecipe) -> bytes:
    return canonical(
        {
            "type": "Collection",
            "stac_version": "1.0.0",
            "id": FORMAT,
            "title": "orthonav atlas",
            "description": "Maps for position fixes from a downward camera, a sheet per item. "
            "Licences and attributions are those of the imagery of each item.",
            "license": "various",
            "extent": {
                "spatial": {"bbox": [[-180.0, -90.0, 180.0, 90.0]]},
                "temporal": {"interval": [["1970-01-01T00:00:00Z", None]]},
            },
            "links": [
                {"rel": "root", "href": "./atlas.json", "type": "application/json"},
                {"rel": "items", "href": f"./{SNAPSHOT}", "type": "application/geo+json"},
            ],
            "orthonav:atlas": {"format": FORMAT, "schema": SCHEMA, "recipe": recipe.to_plain()},
        }
    )


def _read_catalog(store: Store) -> AtlasRecipe:
    where = f"{store}/{CATALOG}"
    data = store.read(CATALOG, MAX_ITEM_BYTES)
    try:
        plain = parsed(data)
    except AtlasError as error:
        raise AtlasError(f"{error}: {where}") from error
    own = plain.get("orthonav:atlas") if isinstance(plain, dict) else None
    if not isinstance(own, dict) or own.get("format") != FORMAT:
        raise AtlasError(f"not an atlas of orthonav: {where}")
    schema = own.get("schema")
    if isinstance(schema, int) and schema > SCHEMA:
        raise AtlasError(
            f"atlas has schema {schema}, this program reads up to {SCHEMA}; update orthonav: "
            f"{where}"
        )
    recipe = AtlasRecipe.from_plain(own.get("recipe"))
    if _catalog(recipe) != data:
        raise AtlasError(f"atlas was altered or has an impossible recipe or schema: {where}")
    return recipe
