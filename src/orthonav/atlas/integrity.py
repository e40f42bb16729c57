"""Is an atlas whole? What is missing, half there, damaged, made otherwise, or left over."""

import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from orthonav.atlas.catalog import Atlas
from orthonav.atlas.coarse import read_coarse
from orthonav.atlas.index import FOLDER as INDEX
from orthonav.atlas.index import MANIFEST, read_manifest, stale_sheets
from orthonav.atlas.item import ASSETS, Asset, Sheet, sheet_of_file, split_name
from orthonav.atlas.listing import (
    ITEMS,
    MAX_SNAPSHOT_BYTES,
    SNAPSHOT,
    read_items,
    snapshot_of,
)
from orthonav.atlas.recipe import AtlasRecipe
from orthonav.atlas.store import Store, digest_of
from orthonav.errors import AtlasError, MapFileError
from orthonav.files import Progress
from orthonav.mapfile import Manifest, open_map
from orthonav.prepare.methods import usual_edges

MIN_AGE_S = 24 * 3600.0
"""What is younger may be of a build that runs: a sheet's files come before its item."""
_LEFTOVER = re.compile(r"\..+\.[A-Za-z0-9_]{8,12}\.tmp(\.[A-Za-z0-9]+)?")
_FOLDERS = [folder for folder, _, _ in ASSETS.values()]
_CLOSE = 1e-6


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong: its kind in two words, the file, what there is to know or to do.

    `removed`: it was left over, and is gone.
    """

    kind: str
    name: str
    detail: str
    removed: bool = False


def check_atlas(
    atlas: Atlas,
    deep: bool = False,
    progress: Progress | None = None,
    *,
    clean: bool = False,
    min_age_s: float = MIN_AGE_S,
) -> list[Problem]:
    """All that is wrong with an atlas, in the order of names; empty where it is whole.

    `deep` reads every file, checks its checksum, opens it and compares it with the recipe. `clean`
    removes what was left over longer than `min_age_s` ago (files that no item names, halves of
    files, revisions that do not count) and writes a stale snapshot anew; nothing else is touched.
    Raises `StorageError` where the place fails.
    """
    report = progress or (lambda stage, share: None)
    items, broken = read_items(atlas.store)
    files = _files(atlas.store)
    problems = [Problem("damaged item", f"{ITEMS}/{name}", why) for name, why in broken.items()]
    current = _that_count(items)
    not_whole = {found[0] for found in map(split_name, broken) if found}
    for number, (name, sheet) in enumerate(sorted(current.items())):
        report("check", number / len(current))
        found = list(_of_sheet(atlas, name, sheet, files, deep))
        problems += found
        not_whole |= {sheet.id for _ in found}
    cleaner = _Cleaner(atlas.store, min_age_s if clean else None)
    older = {name: sheet for name, sheet in items.items() if name not in current}
    for name, sheet in older.items():
        problems.append(cleaner.second_revision(name, sheet, sheet.id not in not_whole))
    if clean and older:
        items, files = read_items(atlas.store)[0], _files(atlas.store)
    unnamed = _unnamed(atlas.store, files, items, not_whole)
    problems += [cleaner.left_over(name, "orphan", "no item names it") for name in unnamed]
    for folder in ("", ITEMS, *_FOLDERS, INDEX):
        for file in filter(_LEFTOVER.fullmatch, atlas.store.names(folder)):
            name = f"{folder}/{file}" if folder else file
            problems.append(cleaner.left_over(name, "leftover", "half of a file"))
    if not broken:
        problems += cleaner.snapshot(_that_count(items).values())
    if not any(each.kind == "damaged item" for each in problems):
        atlas.sheets(refresh=True)
        problems += _of_index(atlas, deep)
    return sorted(problems, key=lambda each: (each.name, each.kind))


class _Cleaner:
    """Says what is left over, and removes it where that was asked for."""

    def __init__(self, store: Store, min_age_s: float | None) -> None:
        self._store = store
        self._min_age_s = min_age_s

    def left_over(self, name: str, kind: str, detail: str, may_go: bool = True) -> Problem:
        """The problem, and the file gone where it is old enough."""
        problem = Problem(kind, name, detail)
        if self._min_age_s is None or not may_go:
            return problem
        age_s = self._store.age_s(name)
        if (age_s is None and self._min_age_s > 0) or (age_s or 0) < self._min_age_s:
            return replace(problem, detail=f"{detail}; too young to be removed")
        self._store.remove(name)
        return replace(problem, removed=True)

    def second_revision(self, name: str, sheet: Sheet, whole: bool) -> Problem:
        """An item that a higher revision of its sheet has replaced; goes only if that is whole."""
        detail = f"revision {sheet.revision} of {sheet.id} was replaced and not removed"
        return self.left_over(f"{ITEMS}/{name}", "second revision", detail, whole)

    def snapshot(self, sheets: Iterable[Sheet]) -> list[Problem]:
        """A snapshot that is not of these sheets; written anew rather than removed."""
        should = snapshot_of(sorted(sheets, key=lambda sheet: sheet.id))
        size = self._store.size(SNAPSHOT)
        if size is None or (
            size == len(should) and self._store.read(SNAPSHOT, MAX_SNAPSHOT_BYTES) == should
        ):
            return []
        if self._min_age_s is not None:
            self._store.write(SNAPSHOT, should)
        detail = "not the sheets that are there; only slower to open"
        return [Problem("stale snapshot", SNAPSHOT, detail, removed=self._min_age_s is not None)]


def _that_count(items: Mapping[str, Sheet]) -> dict[str, Sheet]:
    """The items of the highest revisions."""
    last = {items[name].id: name for name in sorted(items)}
    return {name: items[name] for name in last.values()}


def _files(store: Store) -> dict[str, int]:
    return {
        f"{folder}/{name}": size
        for folder in _FOLDERS
        for name, size in store.names(folder).items()
    }


def _unnamed(
    store: Store, files: Mapping[str, int], items: Mapping[str, Sheet], not_whole: set[str]
) -> list[str]:
    """Files of sheets that no item names; none of a sheet of which an item cannot be read."""

    def left(items: Iterable[Sheet]) -> list[str]:
        named = {asset.name for sheet in items for asset in sheet.assets.values()}
        return [name for name in files if _is_of_a_sheet(name) and name not in named]

    if not left(items.values()):
        return []
    now, broken = read_items(store)  # a sheet may have been finished since
    unread = {found[0] for found in map(split_name, broken) if found}
    return [name for name in left(now.values()) if sheet_of_file(name) not in unread | not_whole]


def _is_of_a_sheet(name: str) -> bool:
    suffixes = {folder: suffix for folder, suffix, _ in ASSETS.values()}
    folder = name.partition("/")[0]
    return sheet_of_file(name) is not None and name.endswith(suffixes[folder])


def _of_sheet(
    atlas: Atlas, name: str, sheet: Sheet, files: Mapping[str, int], deep: bool
) -> Iterator[Problem]:
    """What is wrong with a sheet that counts."""
    try:
        atlas.require_place(sheet)
    except AtlasError as error:
        yield Problem("damaged item", f"{ITEMS}/{name}", str(error))
    again = f"build sheet {sheet.id} again"
    for key, asset in sheet.assets.items():
        size = files.get(asset.name, atlas.store.size(asset.name))
        if size is None and atlas.store.size(f"{ITEMS}/{name}") is None:
            return  # replaced or retired while the atlas is checked
        wrong = list(_of_file(atlas.store, asset, size, deep, again))
        yield from wrong
        if deep and not wrong:
            with _here(atlas.store, asset.name) as path:
                yield from _content(atlas.recipe, sheet, key, asset.name, path)


def _of_file(
    store: Store, asset: Asset, size: int | None, deep: bool, again: str
) -> Iterator[Problem]:
    """What is wrong with a file of that size, seen from outside."""
    if size is None:
        yield Problem("missing file", asset.name, again)
    elif size != asset.size_bytes:
        yield Problem("wrong size", asset.name, f"{size} of {asset.size_bytes} bytes; {again}")
    elif deep:
        with _here(store, asset.name) as path:
            if digest_of(path) != asset.sha256:
                yield Problem("wrong checksum", asset.name, again)


def _of_index(atlas: Atlas, deep: bool) -> Iterator[Problem]:
    """What is wrong with the index, which may be made anew at any time."""
    again = "make the index anew: orthonav atlas index --anew"
    try:
        manifest = read_manifest(atlas)
    except AtlasError as error:
        yield Problem("damaged file", MANIFEST, f"{error}; {again}")
        return
    if manifest is None:
        return
    sizes = atlas.store.names(INDEX)
    for name, asset in manifest.files.items():
        if asset.name == f"{INDEX}/{name}":
            yield from _of_file(atlas.store, asset, sizes.get(name), deep, again)
        else:
            yield Problem("damaged file", MANIFEST, f"names a file elsewhere; {again}")
    new, gone = stale_sheets(atlas, manifest)
    if new or gone:
        detail = f"{len(new)} sheets are new or changed, {len(gone)} gone; run orthonav atlas index"
        yield Problem("stale index", MANIFEST, detail)


@contextmanager
def _here(store: Store, name: str) -> Iterator[Path]:
    """A file of the atlas on this machine, for as long as it is looked at."""
    if store.is_local:
        yield Path(store.url, *name.split("/"))
        return
    with tempfile.TemporaryDirectory(prefix="orthonav-check-") as folder:
        path = Path(folder) / name.rpartition("/")[2]
        store.download(name, path)
        yield path


def _content(
    recipe: AtlasRecipe, sheet: Sheet, key: str, name: str, path: Path
) -> Iterator[Problem]:
    """What is wrong inside a file whose checksum is right."""
    try:
        if key == "map":
            differences = _differences(recipe, sheet, open_map(path).manifest)
        else:
            made = read_coarse(path)
            differences = [] if made.recipe == recipe.coarse else [f"made with {made.recipe}"]
    except (MapFileError, AtlasError) as error:
        yield Problem("damaged file", name, str(error))
        return
    if differences:
        yield Problem("other recipe", name, "; ".join(differences))


def _differences(recipe: AtlasRecipe, sheet: Sheet, manifest: Manifest) -> list[str]:
    """How a map differs from the recipe of its atlas and from its item."""
    info = manifest.sheets[0]
    represent = manifest.recipe.get("represent")
    pairs = [
        ("gsd_m", info.grid.gsd_m, recipe.gsd_m),
        ("tile_px", info.grid.tile_px, recipe.tile_px),
        ("overlap", manifest.recipe.get("overlap"), recipe.overlap),
        ("method", manifest.recipe.get("method"), recipe.method.partition(":")[0]),
        (
            "edges",
            represent.get("name") if isinstance(represent, dict) else None,
            (recipe.edges or usual_edges(recipe.method)).partition(":")[0],
        ),
        ("seed", manifest.recipe.get("seed"), recipe.seed),
        ("registration", info.grey is not None, recipe.registration),
        ("sheets", len(manifest.sheets), 1),
        ("tiles (of its item)", info.tiles, sheet.tiles),
    ]
    return [
        f"{name}: {mine}, not {theirs}" for name, mine, theirs in pairs if not _same(mine, theirs)
    ]


def _same(mine: object, theirs: object) -> bool:
    if isinstance(mine, int | float) and isinstance(theirs, int | float):
        return abs(mine - theirs) <= _CLOSE * abs(theirs)
    return mine == theirs
