"""The catalogue of an atlas: its recipe, its sheets, and how a sheet is put in or taken out.

A sheet exists if and only if its item does, and the item is written last. Files are named by their
content and never change. After a kill at any moment the finished sheets are intact; files without
an item may remain, which `orthonav.ground.atlas.integrity` finds.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, cast

from orthonav.core.errors import AreaError, AtlasError, MissingFileError
from orthonav.core.files import Progress, no_progress
from orthonav.ground.atlas.item import (
    COLLECTION,
    FILES,
    ITEMS,
    MAX_ITEM_BYTES,
    SNAPSHOT,
    STAC_VERSION,
    Sheet,
    StoredFile,
    canonical,
    file_name,
    parsed,
    read_items,
    read_some,
    reason,
    snapshot_of,
    split_name,
)
from orthonav.ground.atlas.store import Store, digest_of
from orthonav.ground.planning.area import Extent
from orthonav.ground.planning.sheets import WorldSheets

FORMAT = "orthonav-atlas"
SCHEMA = 1


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
    """How every sheet is made; fields and defaults not listed here are those of `BuildRequest`.
    `coarse`: recipe of the coarse tiles; None leaves them out, and views then need a prior."""

    gsd_m: float  # metres per pixel
    tile_px: int = 256
    overlap: float = 0.875
    method: str = "gradient"
    edges: str | None = None
    seed: int = 0
    registration: bool = True
    calibration_views: int = 24
    sheet_km: float = 10.0  # greatest width of a sheet
    coarse: CoarseRecipe | None = CoarseRecipe()

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
        try:
            values = {each.name: plain[each.name] for each in fields(cls)}
            coarse = values.pop("coarse")
            return cls(**values, coarse=None if coarse is None else CoarseRecipe(**coarse))
        except (KeyError, TypeError, ValueError) as error:
            raise AtlasError(f"recipe of the atlas cannot be read ({reason(error)})") from error

    def differences(self, other: "AtlasRecipe") -> list[str]:
        mine, theirs = self.to_plain(), other.to_plain()
        return [
            f"{name}: {mine[name]}, not {theirs[name]}"
            for name in mine
            if mine[name] != theirs[name]
        ]


CATALOG = "atlas.json"
_SAME_PLACE_DEG = 1e-9  # a tenth of a millimetre: rounding only


class Atlas:
    """An existing atlas. The list of sheets is read once, and again on request. Several processes
    may put sheets into it at the same time."""

    def __init__(self, store: Store, recipe: AtlasRecipe) -> None:
        self.store = store
        self.recipe = recipe
        self._sheets: dict[str, Sheet] | None = None

    @property
    def url(self) -> str:
        return self.store.url

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
            # The highest revision comes last.
            self._sheets = {found[name].id: found[name] for name in sorted(found)}
            for sheet in self._sheets.values():
                self.require_place(sheet)
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
        """Put a sheet in, or its next revision; `files` by kind: `map`, `coarse`. Nothing is
        written where the same files of the same request are there already. Safe with several
        processes; after a kill the sheet is as before or as described."""
        sheet_id = described.id
        stored = {key: _stored(key, sheet_id, Path(path)) for key, path in sorted(files.items())}
        there = self._revisions(sheet_id)
        before = there.get(max(there)) if there else None
        if before and before.request == described.request and before.files == stored:
            sheet = before
        else:
            revisions = [found[1] for found in map(split_name, there) if found]
            revision = 1 + max(revisions, default=0)
            sheet = described.stored(revision, stored)
        self.require_place(sheet)
        self._upload(sheet, files, _named_by(there))
        if sheet is not before:
            self.store.write(f"{ITEMS}/{sheet.item_name}", canonical(sheet.to_item()))
            there = self._revisions(sheet_id)
        if len(there) > 1:
            self._remove_items([name for name in there if name != max(there)], there)
            there = self._revisions(sheet_id)
        if sheet.item_name in there:
            self._upload(sheet, files, _named_by(there))  # another process may have removed some
        elif there:  # another process has put this sheet meanwhile, and its revision is current
            sheet = there[max(there)] or sheet
        if self._sheets is not None:
            self._sheets = dict(sorted({**self._sheets, sheet_id: sheet}.items()))
        return sheet

    def retire(self, sheet_id: str) -> None:
        """Take a sheet out: its items first, then the files that no item names."""
        there = self._revisions(sheet_id)
        if not there:
            raise AtlasError(f"the atlas has no sheet {sheet_id!r:.40}: {self.store}")
        self._remove_items(there, there)
        if self._sheets is not None:
            self._sheets.pop(sheet_id, None)

    def path(self, sheet: Sheet, kind: str = "map") -> Path:
        found = sheet.files.get(kind)
        if found is None:
            raise AtlasError(f"sheet {sheet.id} has no {kind}: {self.store}")
        return self.store.fetch(found.name, found.size_bytes, found.sha256)

    def snapshot(self) -> None:
        self.store.write(SNAPSHOT, snapshot_of(self.sheets(refresh=True).values()))

    def require_recipe(self, recipe: AtlasRecipe) -> "Atlas":
        if differences := self.recipe.differences(recipe):
            raise AtlasError(
                "all sheets of an atlas are made alike; this one has "
                f"{'; '.join(differences)}: {self.store}"
            )
        return self

    def require_place(self, sheet: Sheet) -> None:
        try:
            box = self.recipe.sheets.bounds_deg(sheet.id)
        except AreaError as error:
            raise AtlasError(f"{error}: {self.store}") from error
        if max(abs(a - b) for a, b in zip(box, sheet.bounds_deg, strict=True)) > _SAME_PLACE_DEG:
            raise AtlasError(
                f"sheet {sheet.id} has bounds {sheet.bounds_deg}, the lattice of the atlas has "
                f"{box}: {self.store}"
            )

    def _revisions(self, sheet_id: str) -> dict[str, Sheet | None]:
        names = self.store.names(ITEMS, f"{sheet_id}.")
        found, broken = read_some(self.store, names)
        return {**found, **dict.fromkeys(broken)}

    def _upload(self, sheet: Sheet, files: Mapping[str, Path], named: set[str]) -> None:
        """Copy missing files. Files that no item names yet may be removed at any moment, so they
        are copied in any case."""
        for key, file in sheet.files.items():
            if file.name not in named or self.store.size(file.name) != file.size_bytes:
                self.store.write(file.name, Path(files[key]))

    def _remove_items(self, names: Iterable[str], there: Mapping[str, Sheet | None]) -> None:
        names = sorted(names)
        for name in names:
            self.store.remove(f"{ITEMS}/{name}")
        gone = _named_by({name: there[name] for name in names})
        if gone:
            still = _named_by(self._revisions(names[0].partition(".")[0]))
            for file in sorted(gone - still):
                self.store.remove(file)


def copy_sheets(
    source: Atlas,
    atlas: Atlas,
    sheet_ids: Sequence[str] | None = None,
    replace: bool = False,
    progress: Progress = no_progress,
) -> tuple[list[str], list[str]]:
    """Copy sheets of one atlas into another of the same recipe: names of copied sheets, and of
    those that were there and left unchanged. With `replace` sheets that differ are replaced."""
    atlas.require_recipe(source.recipe)
    found, there = source.sheets(), atlas.sheets(refresh=True)
    unknown = [each for each in sheet_ids or () if each not in found]
    if unknown:
        raise AtlasError(f"the atlas has no sheet {unknown[0]!r:.40}: {source.store}")
    copied: list[str] = []
    unchanged: list[str] = []
    wanted = list(dict.fromkeys(sheet_ids)) if sheet_ids is not None else list(found)
    for number, sheet_id in enumerate(wanted):
        progress("copy", number / len(wanted))
        new, old = found[sheet_id], there.get(sheet_id)
        same = old is not None and (old.request, old.files) == (new.request, new.files)
        if old is not None and (same or not replace):
            unchanged.append(sheet_id)
            continue
        atlas.put({key: source.path(new, key) for key in new.files}, new)
        copied.append(sheet_id)
    atlas.snapshot()
    return copied, unchanged


def _is_free(store: Store) -> bool:
    names: Iterable[str] = store.names()
    if store.is_local and (folder := Path(store.url)).exists():
        names = [path.name for path in folder.iterdir()] if folder.is_dir() else [folder.name]
    return all(name.startswith(".") for name in names)


def _named_by(items: Mapping[str, Sheet | None]) -> set[str]:
    return {file.name for sheet in items.values() if sheet for file in sheet.files.values()}


def _stored(key: str, sheet_id: str, path: Path) -> StoredFile:
    if key not in FILES:
        raise AtlasError(f"a sheet has {' and '.join(FILES)}, not {key!r:.40}")
    try:
        sha256, size = digest_of(path), path.stat().st_size
    except OSError as error:
        raise MissingFileError(
            f"file of a sheet cannot be read ({error.strerror}): {path}"
        ) from error
    return StoredFile(file_name(key, sheet_id, sha256), size, sha256)


def _catalog(recipe: AtlasRecipe) -> bytes:
    return canonical(
        {
            "type": "Collection",
            "stac_version": STAC_VERSION,
            "id": COLLECTION,
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
    plain = parsed(data, where)
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
