"""Checking an atlas: missing, incomplete, damaged or leftover files, and a stale index."""

import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from orthonav.core.errors import AreaError, AtlasError
from orthonav.core.files import Progress, no_progress
from orthonav.ground.atlas.catalog import (
    FILES,
    ITEMS,
    Atlas,
    Sheet,
    StoredFile,
    read_items,
    sheet_of_file,
)
from orthonav.ground.atlas.index import FOLDER as INDEX
from orthonav.ground.atlas.index import MANIFEST, read_manifest, stale_sheets
from orthonav.ground.atlas.store import Store, digest_of

MIN_AGE_S = 24 * 3600.0
"""Younger files may belong to a running build, which writes the files of a sheet before its item:
no sheet takes a day."""


@dataclass(frozen=True)
class Problem:
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
    """All problems of an atlas by name; empty where it is whole. `deep` reads every file and
    verifies its checksum. `clean` removes leftovers older than `min_age_s` (files that no item
    names, and temporary files); nothing else is changed."""
    store = atlas.store
    # Files before items: a sheet that is finished meanwhile has both.
    folders = (*(folder for folder, _, _ in FILES.values()), INDEX)
    sizes = {f"{each}/{name}": size for each in folders for name, size in store.names(each).items()}
    sheets, broken = read_items(store)
    problems = [
        Problem("damaged item", f"{ITEMS}/{name}.json", why) for name, why in broken.items()
    ]
    for number, sheet in enumerate(sheets.values()):
        progress("check", number / len(sheets))
        problems += _sheet_problems(atlas, sheet, sizes, deep)
    named = {file.name for sheet in sheets.values() for file in sheet.files.values()}
    leftovers = [
        (name, "orphan", "no item names it")
        for name in sizes.keys() - named
        if (sheet_id := sheet_of_file(name)) is not None and sheet_id not in broken
    ]
    for folder in ("", ITEMS, *folders):
        for file in store.names(folder):
            if re.fullmatch(r"\..+\.[A-Za-z0-9_]{8,12}\.tmp(\.[A-Za-z0-9]+)?", file):
                leftovers.append((f"{folder}/{file}".lstrip("/"), "leftover", "incomplete file"))
    problems += [_leftover(store, *each, min_age_s if clean else None) for each in leftovers]
    if not any(each.kind == "damaged item" for each in problems):
        atlas.sheets(refresh=True)
        problems += _index_problems(atlas, sizes, deep)
    return sorted(problems, key=lambda each: (each.name, each.kind))


def _sheet_problems(
    atlas: Atlas, sheet: Sheet, sizes: Mapping[str, int], deep: bool
) -> Iterator[Problem]:
    try:
        atlas.require_place(sheet)
    except (AreaError, AtlasError) as error:
        yield Problem("damaged item", sheet.item_name, str(error))
    for file in sheet.files.values():
        remedy = f"build sheet {sheet.id} again"
        yield from _file_problems(atlas.store, file, sizes, deep, remedy)


def _leftover(store: Store, name: str, kind: str, detail: str, min_age_s: float | None) -> Problem:
    if min_age_s is None:
        return Problem(kind, name, detail)
    if store.age_s(name) < min_age_s:
        return Problem(kind, name, f"{detail}; too young to be removed")
    store.remove(name)
    return Problem(kind, name, detail, removed=True)


def _index_problems(atlas: Atlas, sizes: Mapping[str, int], deep: bool) -> Iterator[Problem]:
    remedy = "rebuild the index: orthonav atlas index --replace"
    try:
        manifest = read_manifest(atlas)
    except AtlasError as error:
        yield Problem("damaged file", MANIFEST, f"{error}; {remedy}")
        return
    if manifest is None:
        return
    for file in manifest.files.values():
        yield from _file_problems(atlas.store, file, sizes, deep, remedy)
    new, gone = stale_sheets(atlas, manifest)
    if new or gone:
        detail = f"{len(new)} sheets are new or changed, {len(gone)} gone; run orthonav atlas index"
        yield Problem("stale index", MANIFEST, detail)


def _file_problems(
    store: Store, file: StoredFile, sizes: Mapping[str, int], deep: bool, remedy: str
) -> Iterator[Problem]:
    size = sizes.get(file.name, store.size(file.name))
    if size is None:
        yield Problem("missing file", file.name, remedy)
    elif size != file.size_bytes:
        yield Problem("wrong size", file.name, f"{size} of {file.size_bytes} bytes; {remedy}")
    elif deep and _digest(store, file.name) != file.sha256:
        yield Problem("wrong checksum", file.name, remedy)


def _digest(store: Store, name: str) -> str:
    if store.is_local:
        return digest_of(Path(store.url, name))
    with tempfile.TemporaryDirectory(prefix="orthonav-check-") as folder:
        path = Path(folder, name.rpartition("/")[2])
        store.download(name, path)
        return digest_of(path)
