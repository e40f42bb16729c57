"""The catalogue of an atlas: which sheets it has, of what, and how one is put in.

A sheet is there if and only if its item is, and the item is written last. Files are named by their
content and never change. So a kill at any moment leaves the sheets that were finished, and at most
files that nobody names, which `orthonav.atlas.integrity` finds.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from orthonav.atlas.item import (
    ASSETS,
    COLLECTION,
    MAX_ITEM_BYTES,
    STAC_VERSION,
    Asset,
    NewSheet,
    Sheet,
    asset_name,
    canonical,
    parsed,
    split_name,
)
from orthonav.atlas.listing import ITEMS, SNAPSHOT, read_items, read_some, snapshot_of
from orthonav.atlas.recipe import FORMAT, SCHEMA, AtlasRecipe
from orthonav.atlas.store import Store, digest_of
from orthonav.errors import AreaError, AtlasError, MissingFileError
from orthonav.files import Progress
from orthonav.geo.area import Extent

__all__ = ["Asset", "Atlas", "NewSheet", "Sheet", "copy_sheets"]

CATALOG = "atlas.json"
_SAME_PLACE_DEG = 1e-9


class Atlas:
    """An atlas that is there. Sheets are known as they were when first asked for, or refreshed.

    Many processes may put sheets into it at once. Raises `StorageError` where the place fails.
    """

    def __init__(self, store: Store, recipe: AtlasRecipe) -> None:
        self.store = store
        self.recipe = recipe
        self._sheets: dict[str, Sheet] | None = None

    @property
    def url(self) -> str:
        """Where it lies: a folder or a URL."""
        return self.store.url

    @classmethod
    def open(cls, url: str | Path, *, cache: Path | None = None) -> "Atlas":
        """Open an atlas. Raises `AtlasError` where there is none or another program's."""
        store = Store.open(str(url), cache=cache)
        if store.size(CATALOG) is None:
            raise AtlasError(f"no atlas: it has no {CATALOG}: {store}")
        return cls(store, _read_catalog(store))

    @classmethod
    def create(cls, url: str | Path, recipe: AtlasRecipe, *, cache: Path | None = None) -> "Atlas":
        """Begin an atlas. Raises `AtlasError` where there is one, or anything else, already."""
        store = Store.open(str(url), cache=cache)
        if store.size(CATALOG) is not None:
            raise AtlasError(f"there is an atlas already: {store}")
        if not _is_free(store):
            raise AtlasError(f"the folder holds other things; name another: {store}")
        store.write(CATALOG, _catalog(recipe))
        return cls.open(url, cache=cache)._checked(recipe)

    @classmethod
    def open_or_create(
        cls, url: str | Path, recipe: AtlasRecipe, *, cache: Path | None = None
    ) -> "Atlas":
        """Open the atlas, or begin it where there is none.

        Raises `AtlasError` naming what differs where it has another recipe.
        """
        store = Store.open(str(url), cache=cache)
        if store.size(CATALOG) is None:
            try:
                return cls.create(url, recipe, cache=cache)
            except AtlasError:
                if store.size(CATALOG) is None:
                    raise  # else another process was faster
        return cls.open(url, cache=cache)._checked(recipe)

    def sheets(self, refresh: bool = False) -> dict[str, Sheet]:
        """All sheets by name, in order. Raises `AtlasError` where an item is damaged."""
        if self._sheets is None or refresh:
            found, broken = read_items(self.store)
            if broken:
                why = next(iter(broken.values()))
                raise AtlasError(
                    f"{len(broken)} items of the atlas cannot be used, the first: {why}; see "
                    f"'orthonav atlas check', remove with 'orthonav atlas retire': {self.store}"
                )
            self._sheets = {found[name].id: found[name] for name in sorted(found)}  # highest last
            for sheet in self._sheets.values():
                self.require_place(sheet)
        return dict(self._sheets)

    def over(self, bounds_deg: Extent) -> list[Sheet]:
        """The sheets that a box touches; its west lies east of its east across the antimeridian."""
        west, south, east, north = bounds_deg
        next(self.recipe.sheets.over((west, south, east, north)), None)  # refuses what is no box
        if west > east:
            east += 360
        return [
            sheet
            for sheet in self.sheets().values()
            if sheet.bounds_deg[1] <= north
            and sheet.bounds_deg[3] > south
            and any(
                sheet.bounds_deg[0] + turn <= east and sheet.bounds_deg[2] + turn > west
                for turn in (-360, 0, 360)
            )
        ]

    def put(self, sheet_id: str, files: Mapping[str, Path], described: NewSheet) -> Sheet:
        """Put a sheet in, or the next revision of one; `files` by kind: `map`, `coarse`.

        Where the same files of the same request are there already, nothing is written. Safe beside
        other processes, and a kill leaves the sheet as it was or as it is to be.
        Raises `AtlasError` where the sheet is none of the lattice, `MissingFileError`.
        """
        if described.id != sheet_id:
            raise AtlasError(f"described is sheet {described.id:.40}, put is {sheet_id:.40}")
        assets = {key: _asset(key, sheet_id, Path(path)) for key, path in sorted(files.items())}
        there = self._revisions(sheet_id)
        before = there.get(max(there)) if there else None
        if before and before.request == described.request and before.assets == assets:
            sheet = before
        else:
            sheet = Sheet.of(
                described, 1 + max((_revision(each) for each in there), default=0), assets
            )
        self.require_place(sheet)
        self._upload(sheet, files, _assets_of(there))
        if sheet is not before:
            self.store.write(f"{ITEMS}/{sheet.item_name}", canonical(sheet.to_item()))
            there = self._revisions(sheet_id)
        if len(there) > 1:
            self._tidy(there)
            there = self._revisions(sheet_id)
        if sheet.item_name in there:
            self._upload(sheet, files, _assets_of(there))  # another process may have tidied them
        elif there:  # another process put the same sheet at the same time, and its revision counts
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

    def path(self, sheet: Sheet, asset: str = "map") -> Path:
        """A local file with that asset of the sheet, verified: a copy where the atlas is far."""
        found = sheet.assets.get(asset)
        if found is None:
            raise AtlasError(f"sheet {sheet.id} has no {asset}: {self.store}")
        return self.store.fetch(found.name, found.size_bytes, found.sha256)

    def snapshot(self) -> None:
        """Write all items as one file, which opens faster and in any GIS; it is never the truth."""
        self.store.write(SNAPSHOT, snapshot_of(self.sheets(refresh=True).values()))

    def _checked(self, recipe: AtlasRecipe) -> "Atlas":
        """This atlas if it has that recipe."""
        differences = self.recipe.differences(recipe)
        if differences:
            raise AtlasError(
                "all sheets of an atlas are made alike; this one has "
                f"{'; '.join(differences)}: {self.store}"
            )
        return self

    def require_place(self, sheet: Sheet) -> None:
        """Raise `AtlasError` where a sheet is none of the lattice of this atlas."""
        try:
            box = self.recipe.sheets.bounds_deg(sheet.id)
        except AreaError as error:
            raise AtlasError(f"{error}: {self.store}") from error
        if max(abs(a - b) for a, b in zip(box, sheet.bounds_deg, strict=True)) > _SAME_PLACE_DEG:
            raise AtlasError(
                f"sheet {sheet.id} does not lie where the atlas has it "
                f"({sheet.bounds_deg}, not {box}): {self.store}"
            )

    def _revisions(self, sheet_id: str) -> dict[str, Sheet | None]:
        """The items of one sheet by file name; None what is damaged."""
        names = self.store.names(ITEMS, f"{sheet_id}.")
        found, broken = read_some(self.store, names)
        return {**found, **dict.fromkeys(broken)}

    def _upload(self, sheet: Sheet, files: Mapping[str, Path], named: set[str]) -> None:
        """Copy what is not there whole; what no item names yet may be removed any moment."""
        for key, asset in sheet.assets.items():
            if asset.name not in named or self.store.size(asset.name) != asset.size_bytes:
                self.store.put(Path(files[key]), asset.name)

    def _tidy(self, there: Mapping[str, Sheet | None]) -> None:
        """Remove the revisions that do not count, then their files."""
        self._remove_items([name for name in there if name != max(there)], there)

    def _remove_items(self, names: Iterable[str], there: Mapping[str, Sheet | None]) -> None:
        """Remove some of the items of a sheet, then the files that the others do not name."""
        names = sorted(names)
        for name in names:
            self.store.remove(f"{ITEMS}/{name}")
        gone = _assets_of({name: there[name] for name in names})
        if gone:
            still = _assets_of(self._revisions(names[0].partition(".")[0]))
            for asset in sorted(gone - still):
                self.store.remove(asset)


def copy_sheets(
    source: Atlas,
    atlas: Atlas,
    sheet_ids: Sequence[str] | None = None,
    replace: bool = False,
    progress: Progress | None = None,
) -> tuple[list[str], list[str]]:
    """Copy sheets of one atlas into another of the same recipe: names of those put and those kept.

    Sheets that are there already are kept, unless `replace`. Raises `AtlasError` where the recipes
    differ or a sheet is not in the source.
    """
    atlas._checked(source.recipe)
    found, there = source.sheets(), atlas.sheets(refresh=True)
    unknown = [each for each in sheet_ids or () if each not in found]
    if unknown:
        raise AtlasError(f"the atlas has no sheet {unknown[0]!r:.40}: {source.store}")
    put: list[str] = []
    kept: list[str] = []
    wanted = list(dict.fromkeys(sheet_ids)) if sheet_ids is not None else list(found)
    for number, sheet_id in enumerate(wanted):
        if progress:
            progress("copy", number / len(wanted))
        sheet = found[sheet_id]
        old = there.get(sheet_id)
        if old is not None and (not replace or _alike(old, sheet)):
            kept.append(sheet_id)
            continue
        atlas.put(sheet_id, {key: source.path(sheet, key) for key in sheet.assets}, sheet)
        put.append(sheet_id)
    atlas.snapshot()
    return put, kept


def _is_free(store: Store) -> bool:
    """Is there nothing yet, but for hidden files?"""
    names: Iterable[str] = store.names()
    if store.is_local and (folder := Path(store.url)).exists():
        names = [path.name for path in folder.iterdir()] if folder.is_dir() else [folder.name]
    return all(name.startswith(".") for name in names)


def _revision(name: str) -> int:
    """Revision from the file name of an item."""
    found = split_name(name)
    return found[1] if found else 0


def _assets_of(items: Mapping[str, Sheet | None]) -> set[str]:
    """Names of the files that items name."""
    return {
        asset.name
        for sheet in items.values()
        if sheet is not None
        for asset in sheet.assets.values()
    }


def _alike(old: Sheet, new: Sheet) -> bool:
    return old.request == new.request and old.assets == new.assets


def _asset(key: str, sheet_id: str, path: Path) -> Asset:
    if key not in ASSETS:
        raise AtlasError(f"a sheet has {' and '.join(ASSETS)}, not {key!r:.40}")
    try:
        sha256, size = digest_of(path), path.stat().st_size
    except OSError as error:
        raise MissingFileError(
            f"file of a sheet cannot be read ({error.strerror}): {path}"
        ) from error
    return Asset(asset_name(key, sheet_id, sha256), size, sha256)


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
            "orthonav:atlas": {
                "format": FORMAT,
                "schema": SCHEMA,
                "recipe": recipe.to_plain(),
            },
        }
    )


def _read_catalog(store: Store) -> AtlasRecipe:
    data = store.read(CATALOG, MAX_ITEM_BYTES)
    plain = parsed(data, f"{store}/{CATALOG}")
    own = plain.get("orthonav:atlas") if isinstance(plain, dict) else None
    if not isinstance(own, dict) or own.get("format") != FORMAT:
        raise AtlasError(f"not an atlas of orthonav: {store}/{CATALOG}")
    schema = own.get("schema")
    if type(schema) is not int or schema < 1:
        raise AtlasError(f"atlas has an impossible schema: {store}/{CATALOG}")
    if schema > SCHEMA:
        raise AtlasError(
            f"atlas has schema {schema}, this program reads up to {SCHEMA}; update orthonav: "
            f"{store}"
        )
    recipe = AtlasRecipe.from_plain(own.get("recipe"))
    if _catalog(recipe) != data:
        raise AtlasError(f"atlas was altered or has an impossible recipe: {store}/{CATALOG}")
    return recipe
