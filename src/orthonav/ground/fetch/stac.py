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

from orthonav.core.errors import FetchError
from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.documents import get_json
from orthonav.ground.fetch.options import GSD_TOLERANCE, ImageryOptions, listed
from orthonav.ground.fetch.urls import TOKEN, Secret, carrying_key, joined, origin_of, with_query

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
    search, listing = _related(root, "search"), _related(root, "items")
    if search:
        found = _paged(client, _linked(url, search[0]), _query(box_deg, options))
    elif listing and not _related(root, "child", "item"):
        parameters = {"bbox": ",".join(f"{value:.7f}" for value in box_deg), "limit": str(PAGE)}
        parameters |= {"datetime": options.time} if options.time else {}
        found = _paged(client, with_query(_linked(url, listing[0]), parameters), None)
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


def _query(box_deg: Box, options: ImageryOptions) -> dict[str, Any]:
    """What a search is asked for."""
    query: dict[str, Any] = {"bbox": list(box_deg), "limit": PAGE}
    if options.collection:
        query["collections"] = [options.collection]
    if options.time:
        query["datetime"] = options.time
    return query


def _paged(client: Client, url: str, body: dict[str, Any] | None) -> Features:
    """Items of a search (POST of `body`) or of one collection (GET), page by page."""
    start = url
    for _ in range(MAX_DOCUMENTS):
        page, here = get_json(client, url, body), url
        yield from ((feature, here) for feature in _features(page, here))
        following = next(iter(_related(page, "next")), None)
        if following is None:
            return
        url = _linked(here, following, start)
        more = following.get("body")
        if str(following.get("method", "GET")).upper() == "POST":
            merged = body if following.get("merge") and body else {}
            body = {**merged, **(more if isinstance(more, dict) else {})}
        else:
            body = None
    raise FetchError(f"list of items does not end: {start}")


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
        for link in _related(document, "child", "item"):
            if (address := _linked(where, link)) not in known:
                known.add(address)
                stack.append((address, get_json(client, address)))
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


def _related(document: dict[str, Any], *kinds: str) -> list[dict[str, Any]]:
    """Links of a document of these kinds."""
    links = document.get("links")
    known = [link for link in links if isinstance(link, dict)] if isinstance(links, list) else []
    return [link for link in known if link.get("rel") in kinds]


def _linked(base: str, link: dict[str, Any], keyed: str | None = None) -> str:
    """Address of a link in the document at `base`, with the key of that or of `keyed`."""
    return carrying_key(keyed or base, joined(base, str(link.get("href", ""))))
