"""STAC: which files of a catalogue show an area at a date (STAC 1.0.0 and the older 0.9).

Read here as plain JSON, through the client that keeps limits, pauses and keys for every request;
that is all a search needs: items with a box, a time and files.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.documents import get_json
from orthonav.fetch.service import Wish, listed
from orthonav.fetch.urls import TOKEN, Secret, carrying_key, joined, origin_of, with_query

MAX_ITEMS = 500
MAX_DOCUMENTS = 2000
PAGE = 100
_TIFF = re.compile(r"image/(tiff|vnd\.stac\.geotiff)", re.IGNORECASE)
_PREFERRED = ("visual", "image", "ortho", "data", "rgb")
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Item:
    """One picture of a catalogue: its name, time (ISO 8601) and the address of its file."""

    name: str
    time: str
    url: str
    gsd_m: float | None


def find_items(client: Client, url: str, box_deg: Box, wish: Wish) -> list[Item]:
    """Files that touch a box (west, south, east, north, degrees), newest first.

    `url` is an API (search is asked) or a static catalogue or collection (walked). `wish.time` is
    an ISO 8601 time or interval with a slash. Raises `FetchError` where there is none.
    """
    root = get_json(client, url)
    search = _link(root, "search", url)
    if search is not None:
        found = _searched(client, search, box_deg, wish, url)
    elif _link(root, "items", url) is not None and not _links(root, ("child", "item"), url):
        found = _paged(client, _link(root, "items", url) or url, box_deg, wish)
    else:
        found = _walked(client, url, root)
    items = []
    seen = 0
    for plain, where in found:
        seen += 1
        if not _touches(plain, box_deg) or not _in_time(plain, wish.time):
            continue
        items.append(_item(plain, where, wish))
        if len(items) > MAX_ITEMS:
            raise FetchError(
                f"more than {MAX_ITEMS} pictures; ask for a smaller area or time: {url}"
            )
    if not items:
        when = f" at {wish.time}" if wish.time else ""
        raise FetchError(f"catalogue has no picture of the area{when} ({seen} looked at): {url}")
    return sorted(items, key=lambda item: (item.time, item.name), reverse=True)


def sign(client: Client, token_url: str, items: list[Item]) -> list[Item]:
    """Items with `{token}` in their addresses, for which a service gave a query string.

    The token is added only to addresses of hosts that the items were found with. Raises
    `FetchError`.
    """
    token = get_json(client, token_url).get("token")
    if not isinstance(token, str) or not token:
        raise FetchError(f"signing service gave no token: {token_url}")
    signed = []
    for item in items:
        client.add_secret(Secret(TOKEN, origin_of(item.url), token.lstrip("?")))
        mark = "&" if "?" in item.url else "?"
        signed.append(Item(item.name, item.time, f"{item.url}{mark}{TOKEN}", item.gsd_m))
    return signed


def date_of(items: list[Item]) -> str | None:
    """Date of the pictures: one day, or the first and the last with a slash between."""
    days = sorted({item.time[:10] for item in items if item.time})
    if not days:
        return None
    return days[0] if len(days) == 1 else f"{days[0]}/{days[-1]}"


Found = Iterator[tuple[dict[str, Any], str]]


def _searched(client: Client, search: str, box_deg: Box, wish: Wish, root: str) -> Found:
    """Items that a search gives (POST), page by page."""
    asked: dict[str, Any] = {"bbox": list(box_deg), "limit": PAGE}
    if wish.collection:
        asked["collections"] = [wish.collection]
    if wish.time:
        asked["datetime"] = wish.time
    body: dict[str, Any] | None = asked
    url = carrying_key(root, search)
    for _ in range(MAX_DOCUMENTS):
        page = get_json(client, url, body)
        yield from ((plain, url) for plain in _features(page, url))
        following = next((link for link in page.get("links", []) if _rel(link) == "next"), None)
        if following is None:
            return
        url = carrying_key(root, joined(url, str(following.get("href", ""))))
        more = following.get("body")
        if str(following.get("method", "GET")).upper() == "POST":
            merged = body if following.get("merge") and body else {}
            body = {**merged, **(more if isinstance(more, dict) else {})}
        else:
            body = None
    raise FetchError(f"search does not end: {root}")


def _paged(client: Client, items_url: str, box_deg: Box, wish: Wish) -> Found:
    """Items of one collection of an API without a search (GET), page by page."""
    parameters = {"bbox": ",".join(f"{value:.7f}" for value in box_deg), "limit": str(PAGE)}
    if wish.time:
        parameters["datetime"] = wish.time
    url: str | None = with_query(items_url, parameters)
    for _ in range(MAX_DOCUMENTS):
        if url is None:
            return
        page = get_json(client, url)
        here = url
        yield from ((plain, here) for plain in _features(page, here))
        url = _link(page, "next", here)
    raise FetchError(f"list of items does not end: {items_url}")


def _walked(client: Client, url: str, root: dict[str, Any]) -> Found:
    """Items of a static catalogue, depth first, each document once."""
    stack, known = [(url, root)], {url}
    for _ in range(MAX_DOCUMENTS):
        if not stack:
            return
        where, plain = stack.pop()
        if plain.get("type") == "Feature":
            yield plain, where
            continue
        for link in _links(plain, ("child", "item"), where):
            if link not in known:
                known.add(link)
                stack.append((link, get_json(client, link)))
    raise FetchError(f"catalogue has more than {MAX_DOCUMENTS} documents; name a part of it: {url}")


def _item(plain: dict[str, Any], where: str, wish: Wish) -> Item:
    properties = plain.get("properties") or {}
    assets = plain.get("assets") or {}
    name = str(plain.get("id", ""))[:200]
    if not isinstance(assets, dict) or not isinstance(properties, dict):
        raise FetchError(f"item {name} is broken: {where}")
    key = _asset(assets, wish, name)
    asset = assets[key]
    gsd = asset.get("gsd", asset.get("eo:gsd", properties.get("gsd")))
    return Item(
        name,
        str(properties.get("datetime") or properties.get("start_datetime") or ""),
        joined(where, str(asset.get("href", ""))),
        float(gsd) if isinstance(gsd, int | float) and gsd > 0 else None,
    )


def _asset(assets: dict[str, Any], wish: Wish, name: str) -> str:
    """Which file of an item: the one that is named, else a GeoTIFF by name, role or resolution."""
    if wish.asset is not None:
        if wish.asset in assets:
            return wish.asset
        raise FetchError(f"item {name} has no asset {wish.asset}; there is {listed(list(assets))}")
    tiffs = {
        key: asset
        for key, asset in assets.items()
        if isinstance(asset, dict)
        and (_TIFF.search(str(asset.get("type", ""))) or _ends_in_tif(asset))
        and not {"thumbnail", "metadata", "overview"} & set(asset.get("roles") or [])
    }
    if not tiffs:
        raise FetchError(f"item {name} has no GeoTIFF; there is {listed(list(assets))}")
    for key in _PREFERRED:
        if key in tiffs:
            return key
    gsds = {
        key: float(asset.get("gsd", asset.get("eo:gsd", 0)) or 0) for key, asset in tiffs.items()
    }
    if len(tiffs) == 1:
        return next(iter(tiffs))
    fitting = [key for key, gsd in gsds.items() if 0 < gsd <= wish.ground_m * 1.05]
    if fitting:
        return max(fitting, key=lambda key: gsds[key])
    raise FetchError(f"name one with --asset; item {name} has {listed(list(tiffs))}")


def _ends_in_tif(asset: dict[str, Any]) -> bool:
    href = str(asset.get("href", "")).partition("?")[0].lower()
    return not asset.get("type") and href.endswith((".tif", ".tiff"))


def _touches(plain: dict[str, Any], box_deg: Box) -> bool:
    """Whether an item's box meets the box; one without a box may."""
    box = plain.get("bbox")
    if not isinstance(box, list) or len(box) not in (4, 6):
        return True
    try:
        numbers = [float(value) for value in box]
    except (TypeError, ValueError):
        return True
    west, south = numbers[0], numbers[1]
    east, north = (numbers[2], numbers[3]) if len(box) == 4 else (numbers[3], numbers[4])
    return west <= box_deg[2] and east >= box_deg[0] and south <= box_deg[3] and north >= box_deg[1]


def _in_time(plain: dict[str, Any], wanted: str | None) -> bool:
    """Whether an item's time lies in what is wanted (compared as text, which ISO 8601 allows)."""
    if wanted is None:
        return True
    properties = plain.get("properties") or {}
    time = str(properties.get("datetime") or properties.get("start_datetime") or "")
    low, slash, high = wanted.partition("/")
    if not slash:
        return time.startswith(low)
    after = low in ("", "..") or time[: len(low)] >= low
    return after and (high in ("", "..") or time[: len(high)] <= high)


def _features(page: dict[str, Any], url: str) -> list[dict[str, Any]]:
    features = page.get("features")
    if not isinstance(features, list) or not all(isinstance(item, dict) for item in features):
        raise FetchError(f"answer is no list of items: {url}")
    return features


def _links(plain: dict[str, Any], kinds: tuple[str, ...], url: str) -> list[str]:
    links = plain.get("links")
    if not isinstance(links, list):
        return []
    return [
        carrying_key(url, joined(url, str(link.get("href", ""))))
        for link in links
        if _rel(link) in kinds
    ]


def _link(plain: dict[str, Any], kind: str, url: str) -> str | None:
    return next(iter(_links(plain, (kind,), url)), None)


def _rel(link: Any) -> str:
    return str(link.get("rel", "")) if isinstance(link, dict) else ""
