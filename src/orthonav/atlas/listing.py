"""All items of an atlas at once: as files, and as the snapshot that saves reading them."""

import logging
from collections.abc import Iterable, Mapping
from typing import Any

from orthonav.atlas.item import (
    MAX_ITEM_BYTES,
    Sheet,
    canonical,
    item_name,
    parsed,
    read_item,
    split_name,
)
from orthonav.atlas.store import Store
from orthonav.errors import AtlasError, StorageError

log = logging.getLogger(__name__)

ITEMS, SNAPSHOT = "items", "items.geojson"
MAX_SNAPSHOT_BYTES = 2**30
MAX_ITEMS = 10**6
_READ_AT_ONCE = 1000


def read_items(store: Store) -> tuple[dict[str, Sheet], dict[str, str]]:
    """All items by file name, and by file name what is wrong with those that are damaged.

    Where a sheet has several, the last in the order of names counts. Of a far atlas, items in the
    snapshot are not read one by one; it is checked like them.
    """
    names = {name: size for name, size in store.names(ITEMS).items() if split_name(name)}
    if len(names) > MAX_ITEMS:
        raise AtlasError(f"more than {MAX_ITEMS} items: {store}")
    known = _read_snapshot(store, names)
    found, broken = read_some(store, {n: s for n, s in names.items() if n not in known})
    return {**known, **found}, broken


def snapshot_of(sheets: Iterable[Sheet]) -> bytes:
    """A STAC item collection; references are from where it lies, not from the items' folder."""
    items = [_moved(sheet.to_item(), "../", "./") for sheet in sheets]
    return canonical({"type": "FeatureCollection", "features": items})


def _read_snapshot(store: Store, names: Mapping[str, int]) -> dict[str, Sheet]:
    """Those sheets of the snapshot whose items are there; none where it is missing or damaged."""
    asks = len(names) > 1 and not store.is_local  # in a folder, items are as fast
    size = store.size(SNAPSHOT) if asks else None
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
    """Like `read_items`, of those file names (and sizes) only."""
    found: dict[str, Sheet] = {}
    broken = {
        name: f"larger than an item may be ({size} bytes): {ITEMS}/{name}"
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
    """Contents of files; those that another process removed meanwhile are left out."""
    try:
        return store.read_many(paths)
    except StorageError:
        there = store.names(ITEMS)
        left = [path for path in paths if path.partition("/")[2] in there]
        if len(left) == len(paths):
            raise
        return _contents(store, left)


def _moved(item: Mapping[str, Any], old: str, new: str) -> dict[str, Any]:
    """The item with its references as seen from another folder."""

    def moved(entry: Mapping[str, Any]) -> dict[str, Any]:
        return {**entry, "href": new + entry["href"].removeprefix(old)}

    return {
        **item,
        "links": [moved(link) for link in item["links"]],
        "assets": {key: moved(asset) for key, asset in item["assets"].items()},
    }
