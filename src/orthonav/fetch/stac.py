"""STAC: the files of a catalogue that show an area at a time (STAC 0.9 and 1.0).

Documents are read as plain JSON through the client. pystac-client 0.9 was tried instead: a
catalogue that links to itself ended in a RecursionError, one malformed item ended the whole
search, pages were requested without end, and it brings 20 further packages. So the search stays
here, with its limits: each document once, `MAX_DOCUMENTS` documents, `MAX_ITEMS` items, and keys
sent to their own origin only.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.documents import get_json
from orthonav.fetch.options import GSD_TOLERANCE, ImageryOptions, listed
from orthonav.fetch.urls import TOKEN, Secret, carrying_key, joined, origin_of, with_query

MAX_ITEMS = 500
"""Files of one fetch: an open dataset each, per thread."""
MAX_DOCUMENTS = 2000
"""Documents of one search."""
PAGE = 100
"""Items per page; APIs allow at least this many."""
_TIFF = re.compile(r"image/(tiff|vnd\.stac\.geotiff)", re.IGNORECASE)
_PREFERRED = ("visual", "image", "ortho", "data", "rgb")
Box = tuple[float, float, float, float]
Features = Iterator[tuple[dict[str, Any], str]]


@dataclass(frozen=True)
class CatalogItem:
    """One file of a catalogue: its name, time (ISO 8601) and address."""

    name: str
    time: str
    url: str


def find_items(
    client: Client, url: str, box_deg: Box, options: ImageryOptions
) -> list[CatalogItem]:
    """Files that touch a box (west, south, east, north, degrees), newest first.

    `url` is an API (its search is used), a list of items, or a static catalogue or collection.
    `options.time` is an ISO 8601 time or interval with a slash. Raises `FetchError` where there
    are none.
    """
    root = get_json(client, url)
    search, items_url = _link(root, "search", url), _link(root, "items", url)
    if search is not None:
        found = _searched(client, search, box_deg, options, url)
    elif items_url is not None and not _links(root, ("child", "item"), url):
        found = _paged(client, items_url, box_deg, options)
    else:
        found = _walked(client, url, root)
    items = []
    examined = 0
    for feature, where in found:
        examined += 1
        if _touches(feature, box_deg) and _in_time(_time(feature), options.time):
            items.append(_item(feature, where, options))
        if len(items) > MAX_ITEMS:
            raise FetchError(f"more than {MAX_ITEMS} files; choose a smaller area or time: {url}")
    if not items:
        when = f" at {options.time}" if options.time else ""
        raise FetchError(
            f"catalogue has no imagery of the area{when} ({examined} items examined): {url}"
        )
    return sorted(items, key=lambda item: (item.time, item.name), reverse=True)


def sign(client: Client, token_url: str, items: list[CatalogItem]) -> list[CatalogItem]:
    """Items with `{token}` in their addresses, for which a service issued a query string.

    The token goes only to the origins of these items. Raises `FetchError`.
    """
    token = get_json(client, token_url).get("token")
    if not isinstance(token, str) or not token:
        raise FetchError(f"signing service returned no token: {token_url}")
    signed = []
    for item in items:
        client.add_secret(Secret(TOKEN, origin_of(item.url), token.lstrip("?")))
        mark = "&" if "?" in item.url else "?"
        signed.append(CatalogItem(item.name, item.time, f"{item.url}{mark}{TOKEN}"))
    return signed


def date_of(items: list[CatalogItem]) -> str | None:
    """Date of the items: one day, or the first and the last with a slash between."""
    days = sorted({item.time[:10] for item in items if item.time})
    if not days:
        return None
    return days[0] if len(days) == 1 else f"{days[0]}/{days[-1]}"


def _searched(
    client: Client, search: str, box_deg: Box, options: ImageryOptions, root: str
) -> Features:
    """Items that a search returns (POST), page by page."""
    query: dict[str, Any] = {"bbox": list(box_deg), "limit": PAGE}
    if options.collection:
        query["collections"] = [options.collection]
    if options.time:
        query["datetime"] = options.time
    body: dict[str, Any] | None = query
    url = carrying_key(root, search)
    for _ in range(MAX_DOCUMENTS):
        page = get_json(client, url, body)
        yield from ((feature, url) for feature in _features(page, url))
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


def _paged(client: Client, items_url: str, box_deg: Box, options: ImageryOptions) -> Features:
    """Items of one collection of an API without a search (GET), page by page."""
    parameters = {"bbox": ",".join(f"{value:.7f}" for value in box_deg), "limit": str(PAGE)}
    if options.time:
        parameters["datetime"] = options.time
    url: str | None = with_query(items_url, parameters)
    for _ in range(MAX_DOCUMENTS):
        if url is None:
            return
        page, here = get_json(client, url), url
        yield from ((feature, here) for feature in _features(page, here))
        url = _link(page, "next", here)
    raise FetchError(f"list of items does not end: {items_url}")


def _walked(client: Client, url: str, root: dict[str, Any]) -> Features:
    """Items of a static catalogue, depth first, each document once."""
    stack, known = [(url, root)], {url}
    for _ in range(MAX_DOCUMENTS):
        if not stack:
            return
        where, document = stack.pop()
        if document.get("type") == "Feature":
            yield document, where
            continue
        for link in _links(document, ("child", "item"), where):
            if link not in known:
                known.add(link)
                stack.append((link, get_json(client, link)))
    raise FetchError(
        f"catalogue has more than {MAX_DOCUMENTS} documents; give the address of a part: {url}"
    )


def _item(feature: dict[str, Any], where: str, options: ImageryOptions) -> CatalogItem:
    assets = feature.get("assets") or {}
    name = str(feature.get("id", ""))[:200]
    if not isinstance(assets, dict):
        raise FetchError(f"item {name} is malformed: {where}")
    asset = assets[_asset(assets, options, name)]
    href = str(asset.get("href", "")) if isinstance(asset, dict) else ""
    return CatalogItem(name, _time(feature), joined(where, href))


def _asset(assets: dict[str, Any], options: ImageryOptions, name: str) -> str:
    """The asset requested, else a GeoTIFF by name, or the coarsest that is fine enough."""
    if options.asset is not None:
        if options.asset in assets:
            return options.asset
        raise FetchError(
            f"item {name} has no asset {options.asset}; available: {listed(list(assets))}"
        )
    tiffs = {
        key: asset
        for key, asset in assets.items()
        if isinstance(asset, dict)
        and (_TIFF.search(str(asset.get("type", ""))) or _ends_in_tif(asset))
        and not {"thumbnail", "metadata", "overview"} & set(asset.get("roles") or [])
    }
    if not tiffs:
        raise FetchError(f"item {name} has no GeoTIFF; available: {listed(list(assets))}")
    for key in _PREFERRED:
        if key in tiffs:
            return key
    if len(tiffs) == 1:
        return next(iter(tiffs))
    gsds_m = {
        key: float(asset.get("gsd", asset.get("eo:gsd", 0)) or 0) for key, asset in tiffs.items()
    }
    fitting = [
        key for key, gsd_m in gsds_m.items() if 0 < gsd_m <= options.wanted_gsd_m * GSD_TOLERANCE
    ]
    if fitting:
        return max(fitting, key=lambda key: gsds_m[key])
    raise FetchError(f"choose one with --asset; item {name} has {listed(list(tiffs))}")


def _ends_in_tif(asset: dict[str, Any]) -> bool:
    href = str(asset.get("href", "")).partition("?")[0].lower()
    return not asset.get("type") and href.endswith((".tif", ".tiff"))


def _touches(feature: dict[str, Any], box_deg: Box) -> bool:
    """Whether an item's box meets the box; one without a valid box may."""
    box = feature.get("bbox")
    if not isinstance(box, list) or len(box) not in (4, 6):
        return True
    try:
        numbers = [float(value) for value in box]
    except (TypeError, ValueError):
        return True
    west, south = numbers[0], numbers[1]
    east, north = (numbers[2], numbers[3]) if len(box) == 4 else (numbers[3], numbers[4])
    return west <= box_deg[2] and east >= box_deg[0] and south <= box_deg[3] and north >= box_deg[1]


def _time(feature: dict[str, Any]) -> str:
    """Time of an item, or its start; empty where there is none."""
    properties = feature.get("properties")
    if not isinstance(properties, dict):
        return ""
    return str(properties.get("datetime") or properties.get("start_datetime") or "")


def _in_time(time: str, wanted: str | None) -> bool:
    """Whether a time lies within the one requested (compared as text, which ISO 8601 allows)."""
    if wanted is None:
        return True
    low, slash, high = wanted.partition("/")
    if not slash:
        return time.startswith(low)
    after = low in ("", "..") or time[: len(low)] >= low
    return after and (high in ("", "..") or time[: len(high)] <= high)


def _features(page: dict[str, Any], url: str) -> list[dict[str, Any]]:
    features = page.get("features")
    if not isinstance(features, list) or not all(isinstance(item, dict) for item in features):
        raise FetchError(f"answer is not a list of items: {url}")
    return features


def _links(document: dict[str, Any], kinds: tuple[str, ...], url: str) -> list[str]:
    links = document.get("links")
    if not isinstance(links, list):
        return []
    return [
        carrying_key(url, joined(url, str(link.get("href", ""))))
        for link in links
        if _rel(link) in kinds
    ]


def _link(document: dict[str, Any], kind: str, url: str) -> str | None:
    return next(iter(_links(document, (kind,), url)), None)


def _rel(link: Any) -> str:
    return str(link.get("rel", "")) if isinstance(link, dict) else ""
