"""Checking an atlas: missing, incomplete, damaged or leftover files, and other recipes."""

import math
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
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
from orthonav.ground.build.encoders import usual_edges

MIN_AGE_S = 24 * 3600.0
"""Younger files may belong to a running build, which writes the files of a sheet before its item:
no sheet takes a day."""
_TEMPORARY = re.compile(r"\..+\.[A-Za-z0-9_]{8,12}\.tmp(\.[A-Za-z0-9]+)?")
_SUFFIXES = {folder: suffix for folder, suffix, _ in FILES.values()}


@dataclass(frozen=True)
class Problem:
    """A problem of an atlas: its kind (such as `missing file`), the file, cause or remedy, and
    whether it was removed."""

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
    """All problems of an atlas by name; empty where it is whole. `deep` reads every file, verifies
    its checksum, opens it and compares it with the recipe. `clean` removes leftovers older than
    `min_age_s` (files that no item names, temporary files, replaced revisions) and rewrites a stale
    snapshot; nothing else is changed."""
    store, clean_s = atlas.store, min_age_s if clean else None
    items, broken = read_items(store)
    files = _files(store)
    problems = [Problem("damaged item", f"{ITEMS}/{name}", why) for name, why in broken.items()]
    not_whole = {found[0] for found in map(split_name, broken) if found}
    current = _current(items)
    for number, (name, sheet) in enumerate(sorted(current.items())):
        progress("check", number / len(current))
        found = list(_sheet_problems(atlas, name, sheet, files, deep))
        problems += found
        not_whole |= {sheet.id for _ in found}
    older = {name: sheet for name, sheet in items.items() if name not in current}
    for name, sheet in older.items():
        detail = f"revision {sheet.revision} of {sheet.id} was replaced and not removed"
        # Where the sheet is not whole, the old revision is all that there is.
        age_s = None if sheet.id in not_whole else clean_s
        problems.append(_leftover(store, f"{ITEMS}/{name}", "second revision", detail, age_s))
    if clean and older:
        items, files = read_items(store)[0], _files(store)
    for name in _orphans(store, files, items, not_whole):
        problems.append(_leftover(store, name, "orphan", "no item names it", clean_s))
    for folder in ("", ITEMS, *_SUFFIXES, INDEX):
        for file in filter(_TEMPORARY.fullmatch, store.names(folder)):
            name = f"{folder}/{file}" if folder else file
            problems.append(_leftover(store, name, "leftover", "incomplete file", clean_s))
    if not broken:
        problems += _snapshot_problems(store, _current(items).values(), clean)
    if not any(each.kind == "damaged item" for each in problems):
        atlas.sheets(refresh=True)
        problems += _index_problems(atlas, deep)
    return sorted(problems, key=lambda each: (each.name, each.kind))


def _leftover(store: Store, name: str, kind: str, detail: str, min_age_s: float | None) -> Problem:
    if min_age_s is None:
        return Problem(kind, name, detail)
    age_s = store.age_s(name)
    if (age_s is None and min_age_s > 0) or (age_s or 0) < min_age_s:
        return Problem(kind, name, f"{detail}; too young to be removed")
    store.remove(name)
    return Problem(kind, name, detail, removed=True)


def _snapshot_problems(store: Store, sheets: Iterable[Sheet], clean: bool) -> Iterator[Problem]:
    expected = snapshot_of(sorted(sheets, key=lambda sheet: sheet.id))
    size = store.size(SNAPSHOT)
    if size is None or (
        size == len(expected) and store.read(SNAPSHOT, MAX_SNAPSHOT_BYTES) == expected
    ):
        return
    if clean:
        store.write(SNAPSHOT, expected)
    detail = "does not show the present sheets; the atlas opens more slowly"
    yield Problem("stale snapshot", SNAPSHOT, detail, removed=clean)


def _current(items: Mapping[str, Sheet]) -> dict[str, Sheet]:
    last = {items[name].id: name for name in sorted(items)}
    return {name: items[name] for name in last.values()}


def _files(store: Store) -> dict[str, int]:
    return {
        f"{folder}/{name}": size
        for folder in _SUFFIXES
        for name, size in store.names(folder).items()
    }


def _orphans(
    store: Store, files: Mapping[str, int], items: Mapping[str, Sheet], not_whole: set[str]
) -> list[str]:
    def unnamed(items: Mapping[str, Sheet]) -> list[str]:
        named = {file.name for sheet in items.values() for file in sheet.files.values()}
        return [
            name
            for name in files
            if name not in named
            and sheet_of_file(name) is not None
            and name.endswith(_SUFFIXES[name.partition("/")[0]])
        ]

    if not unnamed(items):
        return []
    now, broken = read_items(store)  # a sheet may have been finished since
    kept = not_whole | {found[0] for found in map(split_name, broken) if found}
    return [name for name in unnamed(now) if sheet_of_file(name) not in kept]


def _sheet_problems(
    atlas: Atlas, name: str, sheet: Sheet, files: Mapping[str, int], deep: bool
) -> Iterator[Problem]:
    try:
        atlas.require_place(sheet)
    except AtlasError as error:
        yield Problem("damaged item", f"{ITEMS}/{name}", str(error))
    for key, file in sheet.files.items():
        size = files.get(file.name, atlas.store.size(file.name))
        if size is None and atlas.store.size(f"{ITEMS}/{name}") is None:
            return  # replaced or retired during the check
        content = partial(_content_problem, atlas.recipe, sheet, key, file.name)
        remedy = f"build sheet {sheet.id} again"
        yield from _file_problems(atlas.store, file, size, deep, remedy, content)


def _file_problems(
    store: Store,
    file: StoredFile,
    size: int | None,
    deep: bool,
    remedy: str,
    content: Callable[[Path], Problem | None] = lambda path: None,
) -> Iterator[Problem]:
    """The problem of a file that is `size` bytes long, None where it is missing. `content` finds
    that of the content of a file whose checksum is right."""
    if size is None:
        yield Problem("missing file", file.name, remedy)
    elif size != file.size_bytes:
        yield Problem("wrong size", file.name, f"{size} of {file.size_bytes} bytes; {remedy}")
    elif deep:
        with _local_path(store, file.name) as path:
            if digest_of(path) != file.sha256:
                yield Problem("wrong checksum", file.name, remedy)
            elif problem := content(path):
                yield problem


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
    if store.is_local:
        yield Path(store.url, *name.split("/"))
        return
    with tempfile.TemporaryDirectory(prefix="orthonav-check-") as folder:
        path = Path(folder) / name.rpartition("/")[2]
        store.download(name, path)
        yield path


def _content_problem(
    recipe: AtlasRecipe, sheet: Sheet, key: str, name: str, path: Path
) -> Problem | None:
    try:
        if key == "map":
            differences = _differences(recipe, sheet, open_map(path).manifest)
        else:
            made = read_coarse(path)
            differences = [] if made.recipe == recipe.coarse else [f"made with {made.recipe}"]
    except (MapFileError, AtlasError) as error:
        return Problem("damaged file", name, str(error))
    return Problem("other recipe", name, "; ".join(differences)) if differences else None


def _differences(recipe: AtlasRecipe, sheet: Sheet, manifest: Manifest) -> list[str]:
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
        return math.isclose(own, other, rel_tol=1e-6)
    return own == other
