"""Checking an atlas: missing, incomplete, damaged or leftover files, and other recipes."""

import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from orthonav.core.errors import AtlasError, MapFileError
from orthonav.core.files import Progress, no_progress
from orthonav.core.mapfile import Manifest, open_map
from orthonav.ground.atlas.catalog import Atlas, AtlasRecipe
from orthonav.ground.atlas.coarse import read_coarse
from orthonav.ground.atlas.index import FOLDER as INDEX
from orthonav.ground.atlas.index import MANIFEST, read_manifest, stale_sheets
from orthonav.ground.atlas.item import (
    FILES,
    ITEMS,
    MAX_SNAPSHOT_BYTES,
    SNAPSHOT,
    Sheet,
    StoredFile,
    read_items,
    sheet_of_file,
    snapshot_of,
    split_name,
)
from orthonav.ground.atlas.store import Store, digest_of
from orthonav.ground.build.methods import usual_edges

MIN_AGE_S = 24 * 3600.0
"""Younger files may belong to a running build, which writes the files of a sheet before its item:
no sheet takes a day."""
_TEMPORARY = re.compile(r"\..+\.[A-Za-z0-9_]{8,12}\.tmp(\.[A-Za-z0-9]+)?")
_FOLDERS = [folder for folder, _, _ in FILES.values()]
_SUFFIXES = {folder: suffix for folder, suffix, _ in FILES.values()}
_CLOSE = 1e-6
"""Relative difference of numbers of manifest and recipe that is rounding."""


@dataclass(frozen=True)
class Problem:
    """One problem of an atlas.

    `kind`: two words, such as `missing file`.
    `name`: the file.
    `detail`: cause or remedy.
    `removed`: whether the problem was removed.
    """

    kind: str
    name: str
    detail: str
    removed: bool = False


def check_atlas(
    atlas: Atlas,
    deep: bool = False,
    progress: Progress = no_progress,
    *,
    clean: bool = False,
    min_age_s: float = MIN_AGE_S,
) -> list[Problem]:
    """All problems of an atlas by name; empty where it is whole.

    `deep` reads every file, verifies its checksum, opens it and compares it with the recipe.
    `clean` removes leftovers older than `min_age_s` (files that no item names, temporary files,
    replaced revisions) and rewrites a stale snapshot; nothing else is changed. Raises
    `StorageError` where the storage fails.
    """
    items, broken = read_items(atlas.store)
    files = _files(atlas.store)
    problems = [Problem("damaged item", f"{ITEMS}/{name}", why) for name, why in broken.items()]
    current = _current(items)
    not_whole = {found[0] for found in map(split_name, broken) if found}
    for number, (name, sheet) in enumerate(sorted(current.items())):
        progress("check", number / len(current))
        found = list(_sheet_problems(atlas, name, sheet, files, deep))
        problems += found
        not_whole |= {sheet.id for _ in found}
    cleaner = _Cleaner(atlas.store, min_age_s if clean else None)
    older = {name: sheet for name, sheet in items.items() if name not in current}
    for name, sheet in older.items():
        detail = f"revision {sheet.revision} of {sheet.id} was replaced and not removed"
        whole = sheet.id not in not_whole  # else the old revision is all that there is
        problems.append(cleaner.leftover(f"{ITEMS}/{name}", "second revision", detail, whole))
    if clean and older:
        items, files = read_items(atlas.store)[0], _files(atlas.store)
    for name in _orphans(atlas.store, files, items, not_whole):
        problems.append(cleaner.leftover(name, "orphan", "no item names it"))
    for folder in ("", ITEMS, *_FOLDERS, INDEX):
        for file in filter(_TEMPORARY.fullmatch, atlas.store.names(folder)):
            name = f"{folder}/{file}" if folder else file
            problems.append(cleaner.leftover(name, "leftover", "incomplete file"))
    if not broken:
        problems += cleaner.snapshot(_current(items).values())
    if not any(each.kind == "damaged item" for each in problems):
        atlas.sheets(refresh=True)
        problems += _index_problems(atlas, deep)
    return sorted(problems, key=lambda each: (each.name, each.kind))


class _Cleaner:
    """Reports leftovers, and removes them if requested."""

    def __init__(self, store: Store, min_age_s: float | None) -> None:
        self._store = store
        self._min_age_s = min_age_s

    def leftover(self, name: str, kind: str, detail: str, removable: bool = True) -> Problem:
        """The problem; the file is removed if that was requested and it is old enough."""
        problem = Problem(kind, name, detail)
        if self._min_age_s is None or not removable:
            return problem
        age_s = self._store.age_s(name)
        if (age_s is None and self._min_age_s > 0) or (age_s or 0) < self._min_age_s:
            return replace(problem, detail=f"{detail}; too young to be removed")
        self._store.remove(name)
        return replace(problem, removed=True)

    def snapshot(self, sheets: Iterable[Sheet]) -> list[Problem]:
        """A snapshot that does not show these sheets; rewritten if that was requested."""
        expected = snapshot_of(sorted(sheets, key=lambda sheet: sheet.id))
        size = self._store.size(SNAPSHOT)
        if size is None or (
            size == len(expected) and self._store.read(SNAPSHOT, MAX_SNAPSHOT_BYTES) == expected
        ):
            return []
        if self._min_age_s is not None:
            self._store.write(SNAPSHOT, expected)
        detail = "does not show the present sheets; the atlas opens more slowly"
        return [Problem("stale snapshot", SNAPSHOT, detail, removed=self._min_age_s is not None)]


def _current(items: Mapping[str, Sheet]) -> dict[str, Sheet]:
    """The items of the highest revisions."""
    last = {items[name].id: name for name in sorted(items)}
    return {name: items[name] for name in last.values()}


def _files(store: Store) -> dict[str, int]:
    return {
        f"{folder}/{name}": size
        for folder in _FOLDERS
        for name, size in store.names(folder).items()
    }


def _orphans(
    store: Store, files: Mapping[str, int], items: Mapping[str, Sheet], not_whole: set[str]
) -> list[str]:
    """Files of sheets that no item names, except those of sheets with an unreadable item."""

    def orphans(items: Iterable[Sheet]) -> list[str]:
        named = {file.name for sheet in items for file in sheet.files.values()}
        return [name for name in files if _is_sheet_file(name) and name not in named]

    if not orphans(items.values()):
        return []
    now, broken = read_items(store)  # a sheet may have been finished since
    unread = {found[0] for found in map(split_name, broken) if found}
    return [name for name in orphans(now.values()) if sheet_of_file(name) not in unread | not_whole]


def _is_sheet_file(name: str) -> bool:
    folder = name.partition("/")[0]
    return sheet_of_file(name) is not None and name.endswith(_SUFFIXES[folder])


def _sheet_problems(
    atlas: Atlas, name: str, sheet: Sheet, files: Mapping[str, int], deep: bool
) -> Iterator[Problem]:
    try:
        atlas.require_place(sheet)
    except AtlasError as error:
        yield Problem("damaged item", f"{ITEMS}/{name}", str(error))
    remedy = f"build sheet {sheet.id} again"
    for key, file in sheet.files.items():
        size = files.get(file.name, atlas.store.size(file.name))
        if size is None and atlas.store.size(f"{ITEMS}/{name}") is None:
            return  # replaced or retired during the check
        content = partial(_content_problems, atlas.recipe, sheet, key, file.name)
        yield from _file_problems(atlas.store, file, size, deep, remedy, content)


def _file_problems(
    store: Store,
    file: StoredFile,
    size: int | None,
    deep: bool,
    remedy: str,
    content: Callable[[Path], Iterable[Problem]] = lambda path: (),
) -> Iterator[Problem]:
    """Problems of a file that is `size` bytes long, None where it is missing.

    `content` finds those of the content of a file whose checksum is right.
    """
    if size is None:
        yield Problem("missing file", file.name, remedy)
    elif size != file.size_bytes:
        yield Problem("wrong size", file.name, f"{size} of {file.size_bytes} bytes; {remedy}")
    elif deep:
        with _local_path(store, file.name) as path:
            if digest_of(path) != file.sha256:
                yield Problem("wrong checksum", file.name, remedy)
            else:
                yield from content(path)


def _index_problems(atlas: Atlas, deep: bool) -> Iterator[Problem]:
    remedy = "rebuild the index: orthonav atlas index --rebuild"
    try:
        manifest = read_manifest(atlas)
    except AtlasError as error:
        yield Problem("damaged file", MANIFEST, f"{error}; {remedy}")
        return
    if manifest is None:
        return
    sizes = atlas.store.names(INDEX)
    for name, file in manifest.files.items():
        yield from _file_problems(atlas.store, file, sizes.get(name), deep, remedy)
    new, gone = stale_sheets(atlas, manifest)
    if new or gone:
        detail = f"{len(new)} sheets are new or changed, {len(gone)} gone; run orthonav atlas index"
        yield Problem("stale index", MANIFEST, detail)


@contextmanager
def _local_path(store: Store, name: str) -> Iterator[Path]:
    """A file of the atlas on this machine, while the context lasts."""
    if store.is_local:
        yield Path(store.url, *name.split("/"))
        return
    with tempfile.TemporaryDirectory(prefix="orthonav-check-") as folder:
        path = Path(folder) / name.rpartition("/")[2]
        store.download(name, path)
        yield path


def _content_problems(
    recipe: AtlasRecipe, sheet: Sheet, key: str, name: str, path: Path
) -> Iterator[Problem]:
    """Problems of the content of a file whose checksum is right."""
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
    """The differences between a map, the recipe of its atlas and its item."""
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
    return [f"{name}: {own}, not {other}" for name, own, other in pairs if not _same(own, other)]


def _same(own: object, other: object) -> bool:
    if isinstance(own, int | float) and isinstance(other, int | float):
        return abs(own - other) <= _CLOSE * abs(other)
    return own == other
