"""Reading all items of an atlas: from their files, or from the snapshot that holds them all."""

import logging
from collections.abc import Iterable, Mapping
from typing import Any

from orthonav.core.errors import AtlasError, StorageError
from orthonav.ground.atlas.item import (
    MAX_ITEM_BYTES,
    Sheet,
    canonical,
    item_name,
    parsed,
    read_item,
    split_name,
)
from orthonav.ground.atlas.store import Store

log = logging.getLogger(__name__)

ITEMS, SNAPSHOT = "items", "items.geojson"
MAX_SNAPSHOT_BYTES = 2**30
"""A guard for memory: 500,000 items of 2 kB."""
MAX_ITEMS = 10**6
"""A guard for memory: seven times the sheets of a country at 20 cm (docs/country.md)."""
_READ_AT_ONCE = 1000
"""One page of a listing of S3."""


def read_items(store: Store) -> tuple[dict[str, Sheet], dict[str, str]]:
    """All items by file name, and the errors of damaged items by file name.

    Where a sheet has several items, the last in the order of names is current. Items of a remote
    atlas that are in the snapshot are not read one by one; they are checked in the same way.
    """
    names = {name: size for name, size in store.names(ITEMS).items() if split_name(name)}
    if len(names) > MAX_ITEMS:
        raise AtlasError(f"more than {MAX_ITEMS} items: {store}")
    known = _read_snapshot(store, names)
    found, broken = read_some(store, {n: s for n, s in names.items() if n not in known})
    return {**known, **found}, broken


def snapshot_of(sheets: Iterable[Sheet]) -> bytes:
    """A STAC item collection, with references relative to the root of the atlas."""
    items = [_moved(sheet.to_item(), "../", "./") for sheet in sheets]
    return canonical({"type": "FeatureCollection", "features": items})


def _read_snapshot(store: Store, names: Mapping[str, int]) -> dict[str, Sheet]:
    """The sheets of the snapshot whose items exist; none where it is missing or damaged."""
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
    """As `read_items`, for items of these file names (and sizes) only."""
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
    """The item with its references relative to another folder."""

    def moved(entry: Mapping[str, Any]) -> dict[str, Any]:
        return {**entry, "href": new + entry["href"].removeprefix(old)}

    return {
        **item,
        "links": [moved(link) for link in item["links"]],
        "assets": {key: moved(asset) for key, asset in item["assets"].items()},
    }
